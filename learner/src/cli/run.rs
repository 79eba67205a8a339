//! `perturb run`.

use std::fs::File;
use std::io::{IsTerminal, Read};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};

use super::args::RunArgs;
use super::bar::Bar;
use super::plan::{duration, step_limits};
use super::{Ending, UsageError, report, servers, single_thread};
use crate::client::{Address, ClientError, LocalServer, LocalServerOptions, Servers};
use crate::experiment::{
    Attempt, BUSY, Cell, CellEnd, FailureMark, Folder, NO_SERVER, Plan, RunEnd, RunOptions, RunStatus,
    run as run_cells, run_cell,
};
use crate::interrupt::StopFlag;

/// How often a plain line is printed.
const LINE_INTERVAL: Duration = Duration::from_secs(10);
/// A test has so many environments at most.
const TEST_ENVS: usize = 100;

pub(super) fn run(args: &RunArgs) -> Result<Ending> {
    let plan = Plan::load(&args.plan)?;
    let folder = Folder::new(&args.out);
    let stop = StopFlag::on_signals().context("cannot wait for signals")?;
    match &args.cell {
        Some(name) => one_cell(args, &plan, &folder, name, &stop),
        None => all_cells(args, &plan, &folder, &stop),
    }
}

/// Does one cell in this process.
fn one_cell(args: &RunArgs, plan: &Plan, folder: &Folder, name: &str, stop: &StopFlag) -> Result<Ending> {
    let Some(cell) = plan.find(name) else {
        let message = format!(
            "{} has no cell `{name}`: give an index from 0 to {}, or an id that `perturb plan --cells` prints",
            args.plan.display(),
            plan.cells.len() - 1
        );
        return Err(UsageError(message).into());
    };
    if args.exit_with_stdin {
        stop_with_input(stop)?;
    }
    let place = folder.cell(&cell.id);
    let retry = args.retry_failure.or_else(|| place.failure_mark().filter(|_| args.retry_failed));
    // A worker has its plan from there.
    if !args.exit_with_stdin {
        keep_plan(plan, folder)?;
    }
    let servers = match server_of(args, cell) {
        Ok(servers) => servers,
        Err(error) if error.chain().any(|cause| cause.is::<ClientError>()) => return no_server(&error),
        Err(error) => return Err(error),
    };
    if args.exit_with_stdin {
        servers.addresses().for_each(|address| eprintln!("on {address}"));
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
        CellEnd::Failed(failure) => bail!("{} failed: {}", cell.id, failure.reason),
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
        return servers(&args.server, cell.config.common.num_envs.max(TEST_ENVS));
    }
    super::refuse_workers(&args.server)?;
    Ok(Servers::connect_to_one(named, cell.index + args.losses as usize)?)
}

fn no_server(error: &anyhow::Error) -> Result<Ending> {
    eprintln!("perturb: {error:#}");
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
    std::thread::Builder::new().name("input".into()).spawn(wait).context("cannot watch standard input")?;
    Ok(())
}

/// Does all cells in worker processes.
fn all_cells(args: &RunArgs, plan: &Plan, folder: &Folder, stop: &StopFlag) -> Result<Ending> {
    if args.exit_with_stdin {
        return Err(UsageError("--exit-with-stdin needs --cell".into()).into());
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let jobs = args.jobs.unwrap_or(cores);
    let (local, addresses) = shared_servers(args, plan, jobs)?;
    let local = local.map(Mutex::new);
    let (servers, troubles) = Servers::connect_to_some(&addresses)?;
    troubles.iter().for_each(|trouble| eprintln!("perturb: {trouble}; going on with the other servers"));
    step_limits(&servers, plan)?; // refuses environments that there are not
    drop(servers);
    keep_plan(plan, folder)?;
    let addresses: Vec<String> = addresses.iter().map(Address::to_string).collect();
    let worker = |cell: &Cell, attempt| worker(folder, cell, attempt, &addresses);
    let server_trouble = || {
        let status = local.as_ref()?.lock().ok()?.exit_status()?;
        Some(format!("the private server ended with {status}"))
    };
    let options =
        RunOptions { jobs, retry_failed: args.retry_failed, worker: &worker, server_trouble: &server_trouble };
    let mut line = Line::new(plan.cells.len());
    let end = run_cells(plan, folder, &options, stop, &mut |status| line.show(status));
    line.finish();
    let end = end?;
    if let (RunEnd::Finished { .. }, Some(page)) = (&end, &args.html) {
        report::write(folder, Some(page))?;
        eprintln!("the report is in {} and {}", page.display(), folder.path().join("report").display());
    }
    match end {
        RunEnd::Stopped(signal) => {
            eprintln!("stopped by signal {signal}; the same command goes on");
            Ok(Ending::Signal(signal))
        }
        RunEnd::Finished { failed } if failed.is_empty() => {
            eprintln!("all {} cells are done; perturb report {}", plan.cells.len(), folder.path().display());
            Ok(Ending::Done)
        }
        RunEnd::Finished { failed } => {
            let cells = folder.path().join("cells");
            bail!(
                "{} of {} cells failed, the first is {}: see {} for the reason, and use --retry-failed to try again",
                failed.len(),
                plan.cells.len(),
                failed[0],
                cells.join(&failed[0]).join("failure.json").display()
            )
        }
    }
}

/// Copies the plan into its folder, and says so if another one was there.
fn keep_plan(plan: &Plan, folder: &Folder) -> Result<()> {
    if folder.keep_plan(&plan.text)? {
        eprintln!(
            "{} was another plan; it is replaced, and cells that both have are kept",
            folder.plan_path().display()
        );
    }
    Ok(())
}

/// The servers that all workers share.
fn shared_servers(args: &RunArgs, plan: &Plan, jobs: usize) -> Result<(Option<LocalServer>, Vec<Address>)> {
    let named = &args.server.server;
    if !named.is_empty() {
        super::refuse_workers(&args.server)?;
        return Ok((None, named.clone()));
    }
    let most = plan.cells.iter().map(|cell| cell.config.common.num_envs).max().unwrap_or_default();
    let options = LocalServerOptions { workers: args.server.workers, num_envs: jobs * most.max(TEST_ENVS) };
    let server = LocalServer::start(options).context("cannot start a server for this run")?;
    let address = server.address().clone();
    Ok((Some(server), vec![address]))
}

/// The command that does one cell.
fn worker(folder: &Folder, cell: &Cell, attempt: Attempt, addresses: &[String]) -> std::io::Result<Command> {
    let place = folder.cell(&cell.id);
    std::fs::create_dir_all(place.path())?;
    let log = File::options().create(true).append(true).open(place.log())?;
    // The running program, even if its file has been replaced meanwhile: all cells of a run are of one commit.
    let program = Path::new("/proc/self/exe");
    let mut command = Command::new(program);
    command.arg0("perturb").arg("run").arg(folder.plan_path()).arg("--out").arg(folder.path());
    command.args(["--cell", &cell.id, "--exit-with-stdin", "--server", &addresses.join(",")]);
    command.args(["--losses", &attempt.losses.to_string()]);
    if let Some(failure) = attempt.retry {
        command.args(["--retry-failure", &failure.to_string()]);
    }
    single_thread::set(&mut command);
    command.stdout(Stdio::null()).stderr(log);
    Ok(command)
}

/// The line that says how far the run is.
struct Line {
    bar: Option<ProgressBar>,
    last_line: Option<Instant>,
}

impl Line {
    fn new(cells: usize) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} cells  {msg}");
            ProgressBar::new(cells as u64).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
        });
        Self { bar, last_line: None }
    }

    fn show(&mut self, status: &RunStatus) {
        let settled = status.done + status.failed;
        let left = status.remaining.map_or_else(String::new, |left| format!(", {} left", duration(left.as_secs_f64())));
        let failed = if status.failed > 0 { format!(", {} failed", status.failed) } else { String::new() };
        let figures = format!("{} running{failed}{left}", status.running.len());
        if let Some(bar) = &self.bar {
            bar.set_position(settled as u64);
            bar.set_message(figures);
            return;
        }
        if self.last_line.is_none_or(|time| time.elapsed() >= LINE_INTERVAL) {
            self.last_line = Some(Instant::now());
            eprintln!("{settled}/{} cells: {figures}", status.cells);
        }
    }

    fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
