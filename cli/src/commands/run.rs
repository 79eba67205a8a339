//! `perturb run`.

use std::fs::File;
use std::io::{IsTerminal, Read};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::args::{Engine, RunArgs};
use super::bar::Bar;
use super::error::{CommandError, Result, system};
use super::plan::{duration, step_limits};
use super::{Ending, report, servers, single_thread, slurm};
use perturb_learner::cell::{CellEnd, run_cell};
use perturb_learner::client::{Address, PrivateServer, Servers};
use perturb_study::interrupt::StopFlag;
use perturb_study::{
    Attempt, BUSY, Cell, Folder, NO_SERVER, ON, Plan, RunEnd, RunOptions, RunStatus, run as run_cells,
};

/// How often a plain line is printed.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

pub(super) fn run(args: &RunArgs) -> Result<Ending> {
    let plan = Plan::load(&args.plan)?;
    let folder = Folder::new(&args.out);
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    if args.engine.engine == Some(Engine::Slurm) {
        return slurm::run(args, &plan, &stop);
    }
    match &args.cell[..] {
        [name] if args.jobs.is_none() => one_cell(args, &plan, &folder, find(args, &plan, name)?, &stop),
        [] => all_cells(args, &plan, &folder, &stop),
        names => {
            let cells = names.iter().map(|name| find(args, &plan, name).cloned()).collect::<Result<_, _>>()?;
            all_cells(args, &Plan { cells, ..plan.clone() }, &folder, &stop)
        }
    }
}

/// The cell that --cell names.
fn find<'a>(args: &RunArgs, plan: &'a Plan, name: &str) -> Result<&'a Cell> {
    plan.find(name).ok_or_else(|| {
        CommandError::Usage(format!(
            "{} has no cell `{name}`: give an index from 0 to {}, or an id that `perturb plan --cells` prints",
            args.plan.display(),
            plan.cells.len() - 1
        ))
    })
}

/// Does one cell in this process.
fn one_cell(args: &RunArgs, plan: &Plan, folder: &Folder, cell: &Cell, stop: &StopFlag) -> Result<Ending> {
    if args.exit_with_stdin {
        stop_with_input(stop)?;
    }
    let place = folder.cell(&cell.id);
    let retry = args.retry_failure.or_else(|| place.failure_mark().filter(|_| args.retry_failed));
    // A worker has its plan from there.
    if !args.exit_with_stdin {
        keep_plan(args, plan, folder)?;
    }
    let servers = match server_of(args, cell) {
        Ok(servers) => servers,
        Err(CommandError::Client(error)) => return no_server(&error),
        Err(error) => return Err(error),
    };
    if args.exit_with_stdin {
        servers.addresses().for_each(|address| eprintln!("{ON}{address}"));
    }
    let mut bar = (!args.exit_with_stdin).then(|| Bar::new(cell.id.as_str(), cell.config.common.episodes));
    let mut stage = String::new();
    let mut report = |what: &str, episodes| match &mut bar {
        Some(bar) => bar.testing(episodes),
        None if what != stage => {
            eprintln!("{what}"); // the log says what was begun, and how often
            what.clone_into(&mut stage);
        }
        None => {}
    };
    match run_cell(&servers, cell, &place, retry, stop, &mut report)? {
        CellEnd::Done => Ok(Ending::Done),
        CellEnd::Failed(failure) => Err(CommandError::Failed(format!("{} failed: {}", cell.id, failure.reason))),
        CellEnd::Stopped(signal) => Ok(Ending::Signal(signal)),
        CellEnd::Busy => {
            eprintln!("perturb: another process works on {}", cell.id);
            Ok(Ending::Status(BUSY))
        }
        CellEnd::NoServer(error) => no_server(&error),
    }
}

/// The server of one cell: one of those that were named, by turns, or one of its own.
fn server_of(args: &RunArgs, cell: &Cell) -> Result<Servers> {
    let named = &args.server.server;
    if named.is_empty() {
        return servers(&args.server);
    }
    super::refuse_workers(&args.server)?;
    Ok(Servers::connect_to_one(named, cell.index + args.losses as usize)?)
}

fn no_server(error: &dyn std::error::Error) -> Result<Ending> {
    eprintln!("perturb: {error}");
    Ok(Ending::Status(NO_SERVER))
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
fn all_cells(args: &RunArgs, plan: &Plan, folder: &Folder, stop: &StopFlag) -> Result<Ending> {
    if args.exit_with_stdin {
        return Err(CommandError::Usage("--exit-with-stdin needs a single --cell, and no --jobs".into()));
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let jobs = args.jobs.unwrap_or(cores);
    let (local, addresses) = shared_servers(args)?;
    let local = local.map(Mutex::new);
    let (servers, troubles) = Servers::connect_to_some(&addresses)?;
    troubles.iter().for_each(|trouble| eprintln!("perturb: {trouble}; going on with the other servers"));
    step_limits(&servers, plan)?; // refuses environments that there are not
    drop(servers);
    keep_plan(args, plan, folder)?;
    let addresses: Vec<String> = addresses.iter().map(Address::to_string).collect();
    let worker = |cell: &Cell, attempt| worker(args, folder, cell, attempt, &addresses);
    let server_trouble = || {
        let status = local.as_ref()?.lock().ok()?.exit_status()?;
        Some(format!("the private server ended with {status}"))
    };
    let options =
        RunOptions { jobs, retry_failed: args.retry_failed, worker: &worker, server_trouble: &server_trouble };
    let mut line = Line::new(plan.cells.len());
    let end = run_cells(plan, folder, &options, stop, &mut |status| show(&mut line, status));
    line.finish();
    match end? {
        RunEnd::Stopped(signal) => {
            eprintln!("stopped by signal {signal}; the same command goes on");
            Ok(Ending::Signal(signal))
        }
        RunEnd::Finished { failed } => finished(args, plan, folder, &failed),
    }
}

/// All cells are done, or have failed.
pub(super) fn finished(args: &RunArgs, plan: &Plan, folder: &Folder, failed: &[String]) -> Result<Ending> {
    if let Some(page) = &args.html {
        report::write(folder, Some(page))?;
        eprintln!("the report is in {} and {}", page.display(), folder.path().join("report").display());
    }
    let Some(first) = failed.first() else {
        eprintln!("all {} cells are done; perturb report {}", plan.cells.len(), folder.path().display());
        return Ok(Ending::Done);
    };
    Err(CommandError::Failed(format!(
        "{} of {} cells failed, the first is {first}: see {} for the reason, and use --retry-failed to try again",
        failed.len(),
        plan.cells.len(),
        folder.path().join("cells").join(first).join("failure.json").display()
    )))
}

/// Copies the plan into its folder, and says so if another one was there.
pub(super) fn keep_plan(args: &RunArgs, plan: &Plan, folder: &Folder) -> Result<()> {
    if args.leave_plan && folder.plan_path().exists() {
        return Ok(());
    }
    if folder.keep_plan(plan)? {
        eprintln!(
            "{} was another plan; it is replaced, and cells that both have are kept",
            folder.plan_path().display()
        );
    }
    Ok(())
}

/// The servers that all workers share.
fn shared_servers(args: &RunArgs) -> Result<(Option<PrivateServer>, Vec<Address>)> {
    let named = &args.server.server;
    if !named.is_empty() {
        super::refuse_workers(&args.server)?;
        return Ok((None, named.clone()));
    }
    let server = PrivateServer::start(args.server.workers)?;
    let address = server.address().clone();
    Ok((Some(server), vec![address]))
}

/// The command that does one cell.
fn worker(
    args: &RunArgs,
    folder: &Folder,
    cell: &Cell,
    attempt: Attempt,
    addresses: &[String],
) -> std::io::Result<Command> {
    let place = folder.cell(&cell.id);
    std::fs::create_dir_all(place.path())?;
    let log = File::options().create(true).append(true).open(place.log())?;
    // The running program, even if its file has been replaced meanwhile: all cells of a run are of one commit.
    let program = Path::new("/proc/self/exe");
    let mut command = Command::new(program);
    // The copy, which nobody edits meanwhile.
    let plan = if args.leave_plan { args.plan.clone() } else { folder.plan_path() };
    command.arg0("perturb").arg("run").arg(plan).arg("--out").arg(folder.path());
    command.args(["--cell", &cell.id, "--exit-with-stdin", "--server", &addresses.join(",")]);
    command.args(["--losses", &attempt.losses.to_string()]);
    if let Some(failure) = attempt.retry {
        command.args(["--retry-failure", &failure.to_string()]);
    }
    single_thread::set(&mut command);
    command.stdout(Stdio::null()).stderr(log);
    Ok(command)
}

/// Shows how far the run is.
fn show(line: &mut Line, status: &RunStatus) {
    line.show(status.done, status.failed, &format!("{} running", status.running.len()), status.remaining);
}

/// The line that says how far a run is.
pub(super) struct Line {
    bar: Option<ProgressBar>,
    last_line: Option<Instant>,
    cells: usize,
}

impl Line {
    /// Of so many cells.
    pub(super) fn new(cells: usize) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} cells  {msg}");
            ProgressBar::new(cells as u64).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
        });
        Self { bar, last_line: None, cells }
    }

    /// How many cells are done and have failed, what is going on, and how long it may take.
    pub(super) fn show(&mut self, done: usize, failed: usize, doing: &str, remaining: Option<Duration>) {
        let settled = done + failed;
        let left = remaining.map_or_else(String::new, |left| format!(", {} left", duration(left.as_secs_f64())));
        let failed = if failed > 0 { format!(", {failed} failed") } else { String::new() };
        let figures = format!("{doing}{failed}{left}");
        if let Some(bar) = &self.bar {
            bar.set_position(settled as u64);
            bar.set_message(figures);
            return;
        }
        if self.last_line.is_none_or(|time| time.elapsed() >= LINE_INTERVAL) {
            self.last_line = Some(Instant::now());
            eprintln!("{settled}/{} cells: {figures}", self.cells);
        }
    }

    /// A sentence beside it.
    pub(super) fn say(&self, sentence: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{sentence}")),
            None => eprintln!("{sentence}"),
        }
    }

    /// Takes the line away.
    pub(super) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
