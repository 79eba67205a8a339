//! `perturb run`.

use std::io::{BufRead, Read};
use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode};
use std::sync::Mutex;

use super::args::{Engine, RunArgs};
use super::cells::do_cells;
use super::error::{CommandError, Result, system};
use super::plan::step_limits;
use super::{cores, refuse_workers, single_thread, slurm};
use perturb_learner::cell::run_cell;
use perturb_learner::client::{Address, PrivateServer, Servers};
use perturb_study::interrupt::StopFlag;
use perturb_study::scheduler::{CellEvent, Local, Order, Teller};
use perturb_study::{Cell, Folder, Plan};

pub(super) fn run(args: &RunArgs) -> Result<ExitCode> {
    let folder = Folder::new(&args.out);
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    if args.worker {
        return work(args, &folder, &stop);
    }
    let plan = Plan::load(&args.plan)?;
    if args.engine.engine == Some(Engine::Slurm) {
        return slurm::run(args, &plan, &stop);
    }
    if args.cell.is_empty() {
        return all_cells(args, &plan, &folder, &stop);
    }
    let cells = args.cell.iter().map(|name| find(args, &plan, name)).collect::<Result<_>>()?;
    all_cells(args, &Plan { cells, ..plan }, &folder, &stop)
}

/// The cell with this index or id.
fn find(args: &RunArgs, plan: &Plan, name: &str) -> Result<Cell> {
    plan.find(name).cloned().ok_or_else(|| {
        CommandError::Usage(format!(
            "{} has no cell `{name}`: give an index from 0 to {}, or an id that `perturb plan --cells` prints",
            args.plan.display(),
            plan.cells.len() - 1
        ))
    })
}

/// Does the cell of the order on standard input, as a process that another one started for it.
fn work(args: &RunArgs, folder: &Folder, stop: &StopFlag) -> Result<ExitCode> {
    let mut text = String::new();
    std::io::stdin().lock().read_line(&mut text).map_err(system("read the order"))?;
    let order: Order = serde_json::from_str(&text)
        .map_err(|error| CommandError::Usage(format!("the order is not understood: {error}")))?;
    stop_with_input(stop)?;
    let mut teller = Teller::new(&order.cell, std::io::stdout());
    let plan = Plan::load(&args.plan).map_err(CommandError::from);
    let cell = match plan.and_then(|plan| find(args, &plan, &order.cell)) {
        Ok(cell) => cell,
        Err(error) => {
            teller.tell(CellEvent::Refused { reason: error.to_string() });
            return Ok(ExitCode::SUCCESS);
        }
    };
    let ended = match Servers::connect_to_one(&args.server.server, order.turn) {
        Ok(servers) => {
            servers.addresses().for_each(|address| teller.tell(CellEvent::Server { address: address.to_string() }));
            run_cell(&servers, &cell, &folder.cell(&cell.id), order.retry, stop, &mut |event| teller.tell(event))
        }
        Err(error) => Ok(CellEvent::LostServer { reason: error.to_string() }),
    };
    teller.tell(ended.unwrap_or_else(|error| CellEvent::Failed { reason: error.to_string() }));
    Ok(ExitCode::SUCCESS)
}

/// Raises the flag when standard input is closed.
fn stop_with_input(stop: &StopFlag) -> Result<()> {
    let stop = stop.clone();
    let wait = move || {
        let mut buffer = [0; 64];
        while std::io::stdin().read(&mut buffer).is_ok_and(|count| count > 0) {}
        stop.raise(15); // as SIGTERM would
    };
    std::thread::Builder::new().name("input".into()).spawn(wait).map_err(system("watch standard input"))?;
    Ok(())
}

/// Does all cells in worker processes.
fn all_cells(args: &RunArgs, plan: &Plan, folder: &Folder, stop: &StopFlag) -> Result<ExitCode> {
    let jobs = args.jobs.unwrap_or_else(cores).min(plan.cells.len());
    let (local, addresses) = shared_servers(args)?;
    let local = local.map(Mutex::new);
    let (servers, troubles) = Servers::connect_to_some(&addresses)?;
    troubles.iter().for_each(|trouble| eprintln!("perturb: {trouble}; going on with the other servers"));
    step_limits(&servers, plan)?; // refuses environments that there are not
    drop(servers);
    let addresses: Vec<String> = addresses.iter().map(Address::to_string).collect();
    let command = || worker(args, folder, &addresses);
    let server_ended = || {
        let status = local.as_ref()?.lock().ok()?.exit_status()?;
        Some(format!("the private server ended with {status}"))
    };
    do_cells(args, plan, folder, &mut Local::new(plan, folder, jobs, &command, &server_ended), stop)
}

/// The servers that all workers share.
fn shared_servers(args: &RunArgs) -> Result<(Option<PrivateServer>, Vec<Address>)> {
    let named = &args.server.server;
    if !named.is_empty() {
        refuse_workers(&args.server)?;
        return Ok((None, named.clone()));
    }
    let server = PrivateServer::start(args.server.workers)?;
    let address = server.address().clone();
    Ok((Some(server), vec![address]))
}

/// The command of a worker.
fn worker(args: &RunArgs, folder: &Folder, addresses: &[String]) -> Command {
    // The running program, even if its file has been replaced meanwhile: all cells of a run are of one commit.
    let mut command = Command::new("/proc/self/exe");
    // The copy, which nobody edits meanwhile, unless it may be another plan's.
    let plan = if args.cell.is_empty() { folder.plan_path() } else { args.plan.clone() };
    command.arg0("perturb").arg("run").arg(plan).arg("--out").arg(folder.path());
    command.args(["--worker", "--server", &addresses.join(",")]);
    single_thread::set(&mut command);
    command
}
