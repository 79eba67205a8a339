//! `perturb run`: runs the cells of an experiment in worker processes.

use std::collections::{HashMap, HashSet};
use std::io::{BufRead, Read};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::sync::Mutex;
use std::time::Duration;

use perturb_experiment::runs::RunKind;
use perturb_experiment::scheduler::{BackendEvent, CellEvent, EventLineWriter, JobCell, Local, WorkerJob};
use perturb_experiment::{
    Cell, CellDurations, DoneCells, ExperimentFolder, Grouping, Plan, benchmark_cells, estimates,
};
use perturb_files::interrupt::StopFlag;
use perturb_files::require_writable;
use perturb_learner::cell::{CellJob, run_cells};
use perturb_learner::client::{Address, PrivateServer, Servers};
use perturb_learner::measure::{MeasureError, measure};
use perturb_records::ResultsTable;
use perturb_text::count;

use super::args::{Engine, RunArgs};
use super::cells::{PlanRunner, layered, without_done};
use super::display::{is_quiet, note, say};
use super::error::{CommandError, Result, system};
use super::plan::step_limits;
use super::{check_models, cores, load_plan, recurrent, refuse_file, servers_of_jobs, slurm, with_tasks_of};

/// Time for which each measured group of trainings runs, to estimate the duration of its cells.
const MEASURE_TIME: Duration = Duration::from_secs(1);

pub(super) fn run(args: &RunArgs) -> Result<ExitCode> {
    let folder = ExperimentFolder::new(&args.out);
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    if args.worker {
        return run_worker(args, &folder, &stop);
    }
    let plan = load_plan(&args.plan)?;
    refuse_file(&args.out)?;
    if RunKind::detect(&args.out) == Some(RunKind::Training) {
        let message = format!("--out {} holds a training (config.toml): choose another directory", args.out.display());
        return Err(CommandError::Usage(message));
    }
    let report = args.out.join("report");
    let is_taken = |page: &Path| {
        let names = ["report", "cells", "plan.toml"];
        args.out.starts_with(page) || names.iter().any(|name| page == args.out.join(name))
    };
    if let Some(page) = args.html.iter().find(|page| is_taken(page)) {
        let message = format!("--html {}: the run writes something else there; give another file", page.display());
        return Err(CommandError::Usage(message));
    }
    // The run creates --out, the folders above it and the report's folder. So the folder of the --html page need not
    // exist yet if it is one of these.
    let is_created = |page: &Path| {
        let is_created_folder = |folder: &Path| args.out.starts_with(folder) || folder.starts_with(&report);
        !page.exists() && page.parent().is_some_and(is_created_folder)
    };
    args.html.iter().filter(|page| !is_created(page)).try_for_each(|page| require_writable(page))?;
    let table = args.done.as_deref().map(ResultsTable::read).transpose()?;
    let done = table.as_ref().map(DoneCells::new).transpose()?;
    if args.engine.engine == Some(Engine::Slurm) {
        return slurm::run(args, plan, done.as_ref(), &stop);
    }
    if args.cell.is_empty() {
        return all_cells(args, plan, &folder, done.as_ref(), &stop);
    }
    let mut cells =
        args.cell.iter().map(|name| find_cell(args, &plan, name).cloned()).collect::<Result<Vec<Cell>>>()?;
    cells.sort_by_key(|cell| cell.index);
    // Remove duplicates, because the user may name the same cell once by its index and once by its id.
    cells.dedup_by_key(|cell| cell.index);
    all_cells(args, Plan { cells, candidates: Vec::new(), ..plan }, &folder, done.as_ref(), &stop)
}

/// Returns the cell whose index or id is `name`.
fn find_cell<'a>(args: &RunArgs, plan: &'a Plan, name: &str) -> Result<&'a Cell> {
    plan.find(name).ok_or_else(|| {
        CommandError::Usage(format!(
            "{} has no cell `{name}`: give an index from 0 to {}, or an id that `perturb plan --cells` prints",
            args.plan.display(),
            plan.cells.len() + plan.candidates.len() - 1
        ))
    })
}

/// Runs this process as a worker: reads a job from a line of standard input, runs its cells, and writes their events to
/// standard output.
fn run_worker(args: &RunArgs, folder: &ExperimentFolder, stop: &StopFlag) -> Result<ExitCode> {
    let mut text = String::new();
    std::io::stdin().lock().read_line(&mut text).map_err(system("read the job"))?;
    let job: WorkerJob = serde_json::from_str(&text)
        .map_err(|error| CommandError::Usage(format!("the job on standard input is not valid: {error}")))?;
    stop_at_end_of_input(stop)?;
    let mut writer = EventLineWriter::new(job.cells.len(), std::io::stdout());
    // Find the cells of the job in the plan. If one is missing, refuse the whole job.
    let plan = Plan::load(&args.plan);
    let mut job_cells = Vec::new();
    for JobCell { cell: id, retry } in &job.cells {
        let cell = match &plan {
            Ok(plan) => find_cell(args, plan, id).map_err(|error| error.to_string()),
            Err(error) => Err(error.to_string()),
        };
        match cell {
            Ok(cell) => job_cells.push(CellJob { cell, folder: folder.cell(&cell.id), retry: *retry }),
            Err(reason) => {
                writer.write(id, CellEvent::Refused { reason });
                return Ok(ExitCode::SUCCESS);
            }
        }
    }
    let mut tell = |cell: &Cell, event| writer.write(&cell.id, event);
    match Servers::connect_to_one(&args.server.server, job.turn, stop) {
        Ok(servers) => {
            for job in &job_cells {
                for address in servers.addresses() {
                    tell(job.cell, CellEvent::Server { address: address.to_string() });
                }
            }
            run_cells(&servers, &job_cells, stop, &mut tell);
        }
        Err(error) => {
            let reason = error.to_string();
            job_cells.iter().for_each(|job| tell(job.cell, CellEvent::LostServer { reason: reason.clone() }));
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Starts a thread that raises the stop flag when standard input is closed, i.e. when the process that started this
/// worker has ended.
fn stop_at_end_of_input(stop: &StopFlag) -> Result<()> {
    let stop = stop.clone();
    let wait = move || {
        let mut buffer = [0; 64];
        while std::io::stdin().read(&mut buffer).is_ok_and(|count| count > 0) {}
        // 15 is SIGTERM.
        stop.raise(15);
    };
    std::thread::Builder::new().name("input".into()).spawn(wait).map_err(system("watch standard input"))?;
    Ok(())
}

/// Runs the cells of the plan in worker processes on this machine.
fn all_cells(
    args: &RunArgs,
    plan: Plan,
    folder: &ExperimentFolder,
    done: Option<&DoneCells<'_>>,
    stop: &StopFlag,
) -> Result<ExitCode> {
    // Workers run this process's program, so it must be `perturb-recurrent` if they will train recurrent policies.
    recurrent::prepare_for(&plan)?;
    let grouping = Grouping { max_cells: args.group, at_a_time: args.jobs.unwrap_or_else(cores) };
    let expected = without_done(plan.with_expected_cells(Some(&layered(folder, done)))?, done)?;
    let jobs = grouping.at_a_time.min(unfinished_cells(args, &expected, folder).len());
    let (local, addresses) = servers_of_jobs(&with_tasks_of(&args.server, &plan)?, jobs, stop)?;
    let local: Vec<Mutex<PrivateServer>> = local.into_iter().map(Mutex::new).collect();
    let (servers, errors) = Servers::connect_to_some(&addresses, stop)?;
    errors.iter().for_each(|error| say(format_args!("perturb: {error}; continuing with the other servers")));
    let limits = step_limits(&servers, &plan)?.into_iter().map(|(name, limit)| (name.to_owned(), limit));
    let limits: HashMap<String, u32> = limits.collect();
    check_models(&servers, &plan, folder)?;
    let addresses: Vec<String> = addresses.iter().map(Address::to_string).collect();
    let command = |worker_index: usize| match local.len() {
        0 => worker_command(args, folder, &addresses.join(",")),
        count => worker_command(args, folder, &addresses[worker_index % count]),
    };
    let restart = |server: &Mutex<PrivateServer>| {
        let mut server = server.lock().ok()?;
        let ended = format!("the private server ended with {}", server.exit_status()?);
        if args.wait.time().is_zero() {
            return Some(BackendEvent::NoServer(ended));
        }
        Some(match server.restart(&|| stop.signal()) {
            Ok(()) => BackendEvent::Note(format!("{ended}; it was restarted")),
            Err(error) => BackendEvent::NoServer(format!("{ended}; {error}")),
        })
    };
    let server = || local.iter().find_map(restart);
    let mut runner = PlanRunner::begin(args, plan, folder, done, stop)?;
    while let Some(plan) = runner.next_round()? {
        let bounds = match is_quiet() {
            true => Vec::new(),
            false => upper_bounds(args, &servers, &limits, &plan, folder, grouping, stop),
        };
        runner.run(&plan, &mut Local::new(&plan, folder, grouping, &command, &server).with_max_seconds(bounds))?;
    }
    if stop.signal().is_some() {
        // All workers have ended. The servers are killed, because waiting for a stuck server could take long.
        local.iter().filter_map(|server| server.lock().ok()).for_each(|mut server| server.kill());
    }
    runner.finish()
}

/// Returns the indices of the cells that are not finished. Failed cells count as finished without --retry-failed.
fn unfinished_cells(args: &RunArgs, plan: &Plan, folder: &ExperimentFolder) -> Vec<usize> {
    let is_settled = |&cell: &usize| folder.cell(&plan.cells[cell].id).is_settled(!args.retry_failed);
    (0..plan.cells.len()).filter(|cell| !is_settled(cell)).collect()
}

/// Returns an upper bound of each cell's duration in seconds, for the estimate of the remaining time.
///
/// Here the kind of a cell is its environment and method. If cells of a kind begin at once, their durations will soon
/// be known, and predict those of all other cells of the kind. Cells of such a kind have `None`. Cells of a kind with
/// finished cells also have `None`. All others are measured. The result is empty if nothing was measured. `step_limits`
/// are those of the plan's environments. They were read before, because a server may be lost during the measurement.
fn upper_bounds(
    args: &RunArgs,
    servers: &Servers,
    step_limits: &HashMap<String, u32>,
    plan: &Plan,
    folder: &ExperimentFolder,
    grouping: Grouping,
    stop: &StopFlag,
) -> Vec<Option<f64>> {
    let kind = |cell: usize| (&plan.cells[cell].config.common.environment, plan.cells[cell].method());
    let unfinished = unfinished_cells(args, plan, folder);
    let groups = plan.groups(&unfinished, grouping);
    let at_a_time = grouping.at_a_time.min(groups.len());
    let first: HashSet<_> = groups.iter().take(at_a_time).flatten().map(|&cell| kind(cell)).collect();
    let timings = CellDurations::read(plan, folder);
    let is_unknown = |&cell: &usize| !first.contains(&kind(cell)) && timings.seconds(&plan.cells[cell]).is_none();
    let unknown: Vec<usize> = unfinished.into_iter().filter(is_unknown).collect();
    if unknown.is_empty() {
        return Vec::new();
    }
    let groups = benchmark_cells(plan, &unknown, grouping);
    note(format_args!("measuring the duration of cells that begin later: {}", count(groups.len(), "group")));
    let measure = |group: Vec<&Cell>| measure(servers, &group, at_a_time, MEASURE_TIME, stop);
    let measured = match groups.into_iter().map(measure).collect::<Result<Vec<_>, _>>() {
        // A signal ended the measurement. The run, which begins next, will see the signal and stop.
        Err(MeasureError::Stopped { .. }) => return Vec::new(),
        // A measurement can fail because settings lead to numbers that are not finite. The cell will report the error
        // when it runs.
        Err(error) => {
            tracing::warn!("the remaining time will be estimated late: {error}");
            return Vec::new();
        }
        Ok(measured) => measured,
    };
    let limits = step_limits.iter().map(|(name, &limit)| (name.as_str(), limit)).collect();
    let estimates = estimates(plan, &measured, &limits);
    let mut bounds = vec![None; plan.cells.len()];
    unknown.into_iter().for_each(|cell| bounds[cell] = Some(estimates[cell].seconds()));
    bounds
}

/// Returns the command of a worker process.
fn worker_command(args: &RunArgs, folder: &ExperimentFolder, servers: &str) -> Command {
    // This path starts the program of this process, even if its file has been replaced since.
    let mut command = Command::new("/proc/self/exe");
    // Workers read the copy of the plan, because users may edit the original file. With --cell they read the original,
    // because the copy may be a different plan.
    let plan = if args.cell.is_empty() { folder.plan_path() } else { args.plan.clone() };
    command.arg0("perturb").arg("run").arg(plan).arg("--out").arg(folder.path());
    command.args(["--worker", "--server", servers]);
    recurrent::set_one_thread(&mut command);
    command
}
