//! `perturb run --engine slurm`: runs the cells of an experiment in Slurm jobs.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use perturb_experiment::scheduler::slurm::{JobCommand, Jobs, Slurm, SlurmOptions};
use perturb_experiment::{DoneCells, Estimate, ExperimentFolder, Grouping, Plan, benchmark_cells, estimates};
use perturb_files::interrupt::StopFlag;
use perturb_learner::client::{Address, Servers};
use perturb_learner::measure::measure;
use perturb_text::count;

use super::args::{RunArgs, ServerArgs};
use super::cells::PlanRunner;
use super::display::note;
use super::error::{Result, system};
use super::plan::step_limits;
use super::{check_models, check_server_args, recurrent, servers_of_jobs, with_tasks_of};

/// Time for which each measured group of trainings runs, to estimate the duration of its cells.
const MEASURE_TIME: Duration = Duration::from_secs(2);
/// Time between two requests to Slurm's controller. It is long, because the controller serves all users of the cluster.
const QUEUE_INTERVAL: Duration = Duration::from_secs(15);

pub(super) fn run(args: &RunArgs, plan: Plan, done: Option<&DoneCells<'_>>, stop: &StopFlag) -> Result<ExitCode> {
    // This process measures the durations of cells, so it needs libtorch for recurrent policies.
    recurrent::prepare_for(&plan)?;
    let path = std::path::absolute(&args.out).map_err(system("find the absolute path of --out"))?;
    let folder = ExperimentFolder::new(&path);
    check_server_args(&args.server)?;
    // Task folders are needed even with --server, because a private server checks the plan on this machine.
    let ServerArgs { task, .. } = with_tasks_of(&ServerArgs { server: Vec::new(), ..args.server.clone() }, &plan)?;
    let absolute = |folder: &PathBuf| std::path::absolute(folder).map_err(system("find the absolute path of --task"));
    let tasks = task.iter().map(absolute).collect::<Result<Vec<_>>>()?;
    let options = options(args, tasks.clone())?;
    options.check(&path)?;
    let slurm = Slurm::default();
    slurm.check(stop)?;
    // A private server checks the environments, because the servers of --server, which jobs share, may be unreachable
    // from this machine.
    let checking = Servers::local(args.server.workers, &tasks, stop)?;
    step_limits(&checking, &plan)?;
    check_models(&checking, &plan, &folder)?;
    drop(checking);
    let grouping = Grouping { max_cells: args.group, at_a_time: options.task.jobs };
    let job_servers = ServerArgs { server: Vec::new(), workers: Some(options.task.workers), task: tasks };
    let mut runner = PlanRunner::begin(args, plan, &folder, done, stop)?;
    while let Some(plan) = runner.next_round()? {
        let costs = || {
            let (_private, addresses) = servers_of_jobs(&job_servers, grouping.at_a_time, stop)?;
            let (servers, _) = Servers::connect_to_some(&addresses, stop)?;
            Ok(cell_seconds(&servers, &plan, grouping, stop)?)
        };
        runner.run(&plan, &mut Jobs::new(&plan, &folder, &slurm, &options, &costs, stop))?;
    }
    runner.finish()
}

fn options(args: &RunArgs, tasks: Vec<PathBuf>) -> Result<SlurmOptions> {
    let named = &args.server.server;
    let jobs = args.jobs.unwrap_or(1);
    let task = JobCommand {
        program: recurrent::perturb_program()?,
        jobs,
        group: args.group,
        workers: args.server.workers.unwrap_or(1),
        tasks,
        servers: named.iter().map(Address::to_string).collect(),
        server_wait: args.wait.server_wait,
    };
    let engine = &args.engine;
    Ok(SlurmOptions {
        partition: engine.partition.clone(),
        time: engine.time.clone(),
        array_limit: engine.array_limit,
        cells_per_job: engine.cells_per_job,
        task,
        queue_interval: QUEUE_INTERVAL,
    })
}

/// Returns an upper bound of each cell's duration in seconds, from short measurements on this machine.
fn cell_seconds(servers: &Servers, plan: &Plan, grouping: Grouping, stop: &StopFlag) -> Result<Vec<f64>> {
    let all: Vec<usize> = (0..plan.cells.len()).collect();
    let groups = benchmark_cells(plan, &all, grouping);
    let groups_shown = count(groups.len(), "group");
    note(format_args!("measuring the duration of cells: {groups_shown} for {} s each", MEASURE_TIME.as_secs()));
    let mut measurements = Vec::new();
    for group in groups {
        measurements.push(measure(servers, &group, grouping.at_a_time, MEASURE_TIME, stop)?);
    }
    let limits = step_limits(servers, plan)?;
    Ok(estimates(plan, &measurements, &limits).iter().map(Estimate::seconds).collect())
}
