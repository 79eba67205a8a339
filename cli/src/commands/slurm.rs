//! `perturb run --engine slurm`.

use std::time::Duration;

use super::args::RunArgs;
use super::error::{CommandError, Result, system};
use super::plan::step_limits;
use super::run::{Line, finished, keep_plan};
use super::{Ending, refuse_workers};
use perturb_learner::client::{Address, Servers};
use perturb_learner::measure::measure;
use perturb_study::interrupt::StopFlag;
use perturb_study::slurm::{Event, Slurm, SlurmEnd, SlurmOptions, SlurmStatus, Task, count, run_on_slurm};
use perturb_study::{Folder, Plan, cell_seconds, representatives};

/// How long each measured training takes.
const MEASURE: Duration = Duration::from_secs(2);
/// How often Slurm is asked: its controller has others to answer too.
const QUEUE_INTERVAL: Duration = Duration::from_secs(15);
/// How often results are looked for.
const FOLDER_INTERVAL: Duration = Duration::from_secs(2);

pub(super) fn run(args: &RunArgs, plan: &Plan, stop: &StopFlag) -> Result<Ending> {
    let path = std::path::absolute(&args.out).map_err(system("find out where --out is"))?;
    let folder = Folder::new(&path);
    let options = options(args)?;
    options.check(&path)?;
    let slurm = Slurm::default();
    slurm.check(stop)?;
    // Which environments there are, and what they cost, is found out here: servers that jobs share may be out of reach.
    let servers = || Servers::local(args.server.workers);
    step_limits(&servers()?, plan)?;
    keep_plan(args, plan, &folder)?;
    let costs = || Ok(costs(&servers()?, plan, stop)?);
    let mut line = Line::new(plan.cells.len());
    let mut report = |event| match event {
        Event::Status(status) => line.show(status.done, status.failed, &doing(&status), status.remaining),
        Event::Note(sentence) => line.say(&sentence),
    };
    let end = run_on_slurm(plan, &folder, &slurm, &options, &costs, stop, &mut report);
    line.finish();
    match end? {
        SlurmEnd::Finished { failed } => finished(args, plan, &folder, &failed),
        SlurmEnd::Stopped { signal, arrays } if arrays.is_empty() => {
            eprintln!("stopped by signal {signal}, with nothing in Slurm's queue; the same command goes on");
            Ok(Ending::Signal(signal))
        }
        SlurmEnd::Stopped { signal, arrays } => {
            eprintln!(
                "stopped by signal {signal}, but Slurm job {} goes on: the same command watches it again, scancel {} ends \
                 it",
                arrays.join(", "),
                arrays.join(" ")
            );
            Ok(Ending::Signal(signal))
        }
    }
}

fn options(args: &RunArgs) -> Result<SlurmOptions> {
    let named = &args.server.server;
    if !named.is_empty() {
        refuse_workers(&args.server)?;
    }
    let jobs = args.jobs.unwrap_or(1);
    let task = Task {
        program: std::env::current_exe().map_err(system("find out where this program is"))?,
        jobs,
        workers: args.server.workers.unwrap_or(jobs),
        servers: named.iter().map(Address::to_string).collect(),
    };
    let engine = &args.engine;
    Ok(SlurmOptions {
        partition: engine.partition.clone(),
        time: engine.time.clone(),
        array_limit: engine.array_limit,
        cells_per_job: engine.cells_per_job,
        retry_failed: args.retry_failed,
        task,
        queue_interval: QUEUE_INTERVAL,
        folder_interval: FOLDER_INTERVAL,
    })
}

/// What each cell may cost, from a short measurement here.
fn costs(servers: &Servers, plan: &Plan, stop: &StopFlag) -> Result<Vec<f64>> {
    let representatives = representatives(plan);
    eprintln!("measuring what cells cost: {} trainings for {} s each", representatives.len(), MEASURE.as_secs());
    let mut measurements = Vec::new();
    for cell in representatives {
        if stop.signal().is_some() {
            return Err(CommandError::Failed("stopped".into()));
        }
        measurements.push(measure(servers, cell, MEASURE)?);
    }
    let limits = step_limits(servers, plan)?;
    Ok(cell_seconds(plan, &measurements, |environment| limits.get(environment).copied().unwrap_or_default()))
}

/// What Slurm does with the jobs.
fn doing(status: &SlurmStatus) -> String {
    let SlurmStatus { running, nodes, waiting, reason, .. } = status;
    let reason = if reason.is_empty() { String::new() } else { format!(" ({reason})") };
    let (jobs, nodes) = (count(*running, "job"), count(*nodes, "node"));
    match (running, waiting) {
        (0, 0) => "nothing in the queue".into(),
        (0, _) => format!("{} waiting{reason}", count(*waiting, "job")),
        (_, 0) => format!("{jobs} on {nodes}"),
        _ => format!("{jobs} on {nodes}, {waiting} waiting{reason}"),
    }
}
