//! `perturb run`.

use std::collections::HashSet;
use std::io::{BufRead, Read};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::sync::Mutex;
use std::time::Duration;

use perturb_experiment::runs::Kind;
use perturb_experiment::scheduler::{CellEvent, Local, News, Order, OrderedCell, Teller};
use perturb_experiment::{Cell, Folder, Grouping, Plan, Taken, estimates, representatives};
use perturb_files::interrupt::StopFlag;
use perturb_files::require_writable;
use perturb_learner::cell::{CellOrder, run_cells};
use perturb_learner::client::{Address, PrivateServer, Servers};
use perturb_learner::measure::{MeasureError, measure};
use perturb_text::count;

use super::args::{Engine, RunArgs};
use super::cells::Doing;
use super::display::{is_quiet, note, say};
use super::error::{CommandError, Result, system};
use super::plan::step_limits;
use super::{cores, load_plan, recurrent, refuse_file, servers_of_jobs, slurm};

/// How long each group of trainings is measured.
const MEASURE: Duration = Duration::from_secs(1);

pub(super) fn run(args: &RunArgs) -> Result<ExitCode> {
    let folder = Folder::new(&args.out);
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    if args.worker {
        return work(args, &folder, &stop);
    }
    let plan = load_plan(&args.plan)?;
    refuse_file(&args.out)?;
    if Kind::of(&args.out) == Some(Kind::Training) {
        let message = format!("--out {} holds a training (config.toml): choose another directory", args.out.display());
        return Err(CommandError::Usage(message));
    }
    // What is in the folder of the results, or beside it, has its folder when it is written.
    let is_made = |page: &Path| {
        let beside = |folder: &Path| args.out.starts_with(folder) || folder.starts_with(&args.out);
        !page.exists() && page.parent().is_some_and(beside)
    };
    args.html.iter().filter(|page| !is_made(page)).try_for_each(|page| require_writable(page))?;
    if args.engine.engine == Some(Engine::Slurm) {
        return slurm::run(args, plan, &stop);
    }
    if args.cell.is_empty() {
        return all_cells(args, plan, &folder, &stop);
    }
    let mut cells = args.cell.iter().map(|name| find(args, &plan, name).cloned()).collect::<Result<Vec<Cell>>>()?;
    cells.sort_by_key(|cell| cell.index);
    cells.dedup_by_key(|cell| cell.index); // named by index and by id
    all_cells(args, Plan { cells, candidates: Vec::new(), ..plan }, &folder, &stop)
}

/// The cell with this index or id.
fn find<'a>(args: &RunArgs, plan: &'a Plan, name: &str) -> Result<&'a Cell> {
    plan.find(name).ok_or_else(|| {
        CommandError::Usage(format!(
            "{} has no cell `{name}`: give an index from 0 to {}, or an id that `perturb plan --cells` prints",
            args.plan.display(),
            plan.cells.len() + plan.candidates.len() - 1
        ))
    })
}

/// Does the cells of the order on standard input, as a process that another one started for them.
fn work(args: &RunArgs, folder: &Folder, stop: &StopFlag) -> Result<ExitCode> {
    let mut text = String::new();
    std::io::stdin().lock().read_line(&mut text).map_err(system("read the order"))?;
    let order: Order = serde_json::from_str(&text)
        .map_err(|error| CommandError::Usage(format!("the order is not understood: {error}")))?;
    stop_with_input(stop)?;
    let mut teller = Teller::new(order.cells.len(), std::io::stdout());
    let plan = Plan::load(&args.plan);
    let mut orders = Vec::new();
    for OrderedCell { cell: id, retry } in &order.cells {
        let cell = match &plan {
            Ok(plan) => find(args, plan, id).map_err(|error| error.to_string()),
            Err(error) => Err(error.to_string()),
        };
        match cell {
            Ok(cell) => orders.push(CellOrder { cell, folder: folder.cell(&cell.id), retry: *retry }),
            Err(reason) => {
                teller.tell(id, CellEvent::Refused { reason });
                return Ok(ExitCode::SUCCESS);
            }
        }
    }
    let mut tell = |cell: &Cell, event| teller.tell(&cell.id, event);
    match Servers::connect_to_one(&args.server.server, order.turn) {
        Ok(servers) => {
            for order in &orders {
                for address in servers.addresses() {
                    tell(order.cell, CellEvent::Server { address: address.to_string() });
                }
            }
            run_cells(&servers, &orders, stop, &mut tell);
        }
        Err(error) => {
            let reason = error.to_string();
            orders.iter().for_each(|order| tell(order.cell, CellEvent::LostServer { reason: reason.clone() }));
        }
    }
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
fn all_cells(args: &RunArgs, plan: Plan, folder: &Folder, stop: &StopFlag) -> Result<ExitCode> {
    recurrent::prepare_for(&plan)?; // the workers are this program
    let grouping = Grouping { most: args.group, at_a_time: args.jobs.unwrap_or_else(cores) };
    let left = unsettled(args, &plan.in_full(Some(folder))?, folder).len();
    let (local, addresses) = servers_of_jobs(&args.server, grouping.at_a_time.min(left))?;
    let local: Vec<Mutex<PrivateServer>> = local.into_iter().map(Mutex::new).collect();
    let (servers, troubles) = Servers::connect_to_some(&addresses)?;
    troubles.iter().for_each(|trouble| say(format_args!("perturb: {trouble}; going on with the other servers")));
    step_limits(&servers, &plan)?; // refuses environments that there are not
    let addresses: Vec<String> = addresses.iter().map(Address::to_string).collect();
    let command = |seat: usize| match local.len() {
        0 => worker(args, folder, &addresses.join(",")),
        count => worker(args, folder, &addresses[seat % count]),
    };
    let end = |server: &Mutex<PrivateServer>| {
        let mut server = server.lock().ok()?;
        let ended = format!("the private server ended with {}", server.exit_status()?);
        if args.wait.time().is_zero() {
            return Some(News::NoServer(ended));
        }
        Some(match server.restart() {
            Ok(()) => News::Note(format!("{ended}; it is started again")),
            Err(error) => News::NoServer(format!("{ended}; {error}")),
        })
    };
    let server = || local.iter().find_map(end);
    let mut doing = Doing::begin(args, plan, folder, stop)?;
    while let Some(plan) = doing.next()? {
        let most = if is_quiet() { Vec::new() } else { most(args, &servers, &plan, folder, grouping, stop)? };
        doing.run(&plan, &mut Local::new(&plan, folder, grouping, &command, &server).with_most(most))?;
    }
    doing.end()
}

/// The places in the plan of the cells that a run has yet to do.
fn unsettled(args: &RunArgs, plan: &Plan, folder: &Folder) -> Vec<usize> {
    let is_settled = |&cell: &usize| folder.cell(&plan.cells[cell].id).is_settled(!args.retry_failed);
    (0..plan.cells.len()).filter(|cell| !is_settled(cell)).collect()
}

/// What cells may take at most that are of kinds which do not begin at once, so that the time that is left can be told:
/// by a short measurement.
fn most(
    args: &RunArgs,
    servers: &Servers,
    plan: &Plan,
    folder: &Folder,
    grouping: Grouping,
    stop: &StopFlag,
) -> Result<Vec<Option<f64>>> {
    let kind = |cell: usize| (&plan.cells[cell].config.common.environment, plan.cells[cell].method());
    let left = unsettled(args, plan, folder);
    let groups = plan.groups(&left, grouping);
    let at_a_time = grouping.at_a_time.min(groups.len());
    let first: HashSet<_> = groups.iter().take(at_a_time).flatten().map(|&cell| kind(cell)).collect();
    let taken = Taken::read(plan, folder);
    let unknown = |&cell: &usize| !first.contains(&kind(cell)) && taken.seconds(&plan.cells[cell]).is_none();
    let unknown: Vec<usize> = left.into_iter().filter(unknown).collect();
    if unknown.is_empty() {
        return Ok(Vec::new());
    }
    let groups = representatives(plan, &unknown, grouping);
    note(format_args!("measuring what cells cost that begin later: {}", count(groups.len(), "group")));
    let measure = |group: Vec<&Cell>| measure(servers, &group, at_a_time, MEASURE, stop);
    let measured = match groups.into_iter().map(measure).collect::<Result<Vec<_>, _>>() {
        Err(MeasureError::Stopped { .. }) => return Ok(Vec::new()), // the run hears of it, too
        // Settings that come to numbers that are not finite, for instance: the cell will say so, when its turn comes.
        Err(error) => {
            tracing::warn!("the time that is left will be told late: {error}");
            return Ok(Vec::new());
        }
        Ok(measured) => measured,
    };
    let estimates = estimates(plan, &measured, &step_limits(servers, plan)?);
    let mut most = vec![None; plan.cells.len()];
    unknown.into_iter().for_each(|cell| most[cell] = Some(estimates[cell].seconds()));
    Ok(most)
}

/// The command of a worker.
fn worker(args: &RunArgs, folder: &Folder, servers: &str) -> Command {
    // The running program, even if its file has been replaced meanwhile: all cells of a run are of one commit.
    let mut command = Command::new("/proc/self/exe");
    // The copy, which nobody edits meanwhile, unless it may be another plan's.
    let plan = if args.cell.is_empty() { folder.plan_path() } else { args.plan.clone() };
    command.arg0("perturb").arg("run").arg(plan).arg("--out").arg(folder.path());
    command.args(["--worker", "--server", servers]);
    recurrent::set_one_thread(&mut command);
    command
}
