//! `perturb plan`: prints the size of an experiment, and estimates how long it takes.

use std::collections::HashMap;
use std::io::Write;
use std::time::Duration;

use perturb_experiment::{
    Cell, CellDurations, CellStates, Estimate, ExperimentFolder, Grouping, Measurement, Plan, Selection,
    benchmark_cells, estimates,
};
use perturb_files::interrupt::StopFlag;
use perturb_learner::client::Servers;
use perturb_learner::measure::measure;
use perturb_text::{Table, count, counted, duration, grouped};
use serde_json::json;

use super::args::PlanArgs;
use super::display::output;
use super::error::{CommandError, Result, system};
use super::{cores, load_plan, recurrent, servers_of_jobs, with_tasks_of};

pub(super) fn run(args: &PlanArgs) -> Result<()> {
    let plan = load_plan(&args.file)?;
    if args.measure > 0 && !args.json.is_printed() && args.unfinished_in.is_none() {
        recurrent::prepare_for(&plan)?;
    }
    let mut out = output();
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    if args.json.json.is_some() && !args.cells && args.unfinished_in.is_none() {
        return Err(CommandError::Usage("--json lists cells: give --cells or --unfinished-in DIR with it".into()));
    }
    args.json.check()?;
    // List cells: all with --cells, or the unfinished ones with --unfinished-in.
    let folder = args.unfinished_in.as_deref().map(ExperimentFolder::new);
    let known = folder.as_ref().map_or_else(|| Ok(plan.clone()), |folder| plan.with_selected_cells(folder))?;
    let listed: Vec<&Cell> = match &folder {
        Some(folder) => known.cells.iter().filter(|cell| !folder.cell(&cell.id).is_settled(true)).collect(),
        None if args.cells => known.cells.iter().collect(),
        None => Vec::new(),
    };
    args.json.write(listed.iter().map(|cell| json!({ "index": cell.index, "id": cell.id })).collect::<Vec<_>>())?;
    if args.json.is_printed() {
        return Ok(());
    }
    for cell in listed {
        writeln!(out, "{:>6} {}", cell.index, cell.id)?;
    }
    if folder.is_some() {
        return Ok(());
    }
    // Divide the cells into groups as `perturb run` would. Cells that tuning will select are included.
    let timings_from = args.timings_from.as_deref().map(ExperimentFolder::new);
    timings_from.iter().try_for_each(|folder| folder.require_plan().map(drop))?;
    let known = plan.with_expected_cells(timings_from.as_ref().map(|folder| folder as &dyn CellStates))?;
    let grouping = Grouping { max_cells: args.group, at_a_time: args.jobs.unwrap_or_else(cores) };
    let all: Vec<usize> = (0..known.cells.len()).collect();
    let groups = known.groups(&all, grouping);
    let groups_shown = groups_line(&groups, grouping);
    let grouping = Grouping { at_a_time: grouping.at_a_time.min(groups.len()), ..grouping };
    let (_private, addresses) = servers_of_jobs(&with_tasks_of(&args.server, &plan)?, grouping.at_a_time, &stop)?;
    // Ignore servers that do not answer. `perturb run` will report them.
    let (servers, _) = Servers::connect_to_some(&addresses, &stop)?;
    let limits = step_limits(&servers, &known)?;
    // Print the numbers of configurations, trainings and tests.
    let counts = plan.counts();
    writeln!(
        out,
        "{}, {}, {}, {} with {}{}",
        counted(counts.configurations, "configuration"),
        counted(counts.trainings, "training"),
        counted(counts.pairs, "train/test pair"),
        grouped(counts.all_pairs),
        count(counts.runs as usize, "run"),
        if plan.selection == Selection::Clean { " to select from" } else { "" }
    )?;
    let second_stage = &known.cells[plan.cells.len()..];
    if let Some(pairs) = second_stage.first().map(|cell| cell.tests.sets.len()) {
        let cells = second_stage.len();
        let runs = plan.runs as usize;
        let are = if cells / runs == 1 { "is" } else { "are" };
        let trained = format!("{} {are} selected and trained on new seeds", grouped(cells / runs));
        writeln!(out, "{trained}, {} with {}", counted(cells * pairs, "train/test pair"), count(runs, "run"))?;
    }
    writeln!(out, "{groups_shown}")?;
    let measured = timings_from.map(|folder| (folder.clone(), CellDurations::read(&known, &folder)));
    estimate(args, &known, grouping, measured.as_ref(), (&servers, &limits), &stop)
}

/// Returns a text such as "24 cells in 4 groups of 5 to 7, 2 at a time".
fn groups_line(groups: &[Vec<usize>], Grouping { at_a_time, .. }: Grouping) -> String {
    let sizes = || groups.iter().map(Vec::len);
    let min = sizes().min().unwrap_or_default();
    let max = sizes().max().unwrap_or_default();
    let sizes_shown = if min == max { max.to_string() } else { format!("{min} to {max}") };
    let cells = cells(sizes().sum());
    let number = counted(groups.len(), "group");
    format!("{cells} in {number} of {sizes_shown}, {} at a time", at_a_time.min(groups.len()))
}

/// Estimates and prints how long the plan takes. A cell's duration is taken from finished cells of the same environment
/// and method. Without such cells it is measured, which gives an upper bound. --measure 0 measures nothing.
fn estimate(
    args: &PlanArgs,
    plan: &Plan,
    grouping: Grouping,
    finished: Option<&(ExperimentFolder, CellDurations<'_>)>,
    (servers, limits): (&Servers, &HashMap<&str, u32>),
    stop: &StopFlag,
) -> Result<()> {
    let mut out = output();
    // Sum the durations that are known from finished cells of the same environment and method.
    let measured_seconds = |cell: &Cell| finished.and_then(|(_, timings)| timings.seconds(cell));
    let (known, unknown): (Vec<usize>, Vec<usize>) =
        (0..plan.cells.len()).partition(|&cell| measured_seconds(&plan.cells[cell]).is_some());
    let mut seconds: Vec<Option<f64>> = plan.cells.iter().map(measured_seconds).collect();
    if let Some((folder, timings)) = finished {
        let known_seconds: f64 = seconds.iter().flatten().sum();
        writeln!(
            out,
            "\nby the durations of {} of the same environment and method in {}: {}, {}",
            count(timings.cells(), "finished cell"),
            folder.path().display(),
            cells(known.len()),
            duration(known_seconds)
        )?;
    }
    if args.measure == 0 && finished.is_some() && !unknown.is_empty() {
        writeln!(out, "not measured: {}", cells(unknown.len()))?;
    }
    // Measure the durations of all other cells.
    if args.measure > 0 && !unknown.is_empty() {
        let measurements = measurements(args, plan, grouping, &unknown, servers, stop, &mut out)?;
        let estimates = estimates(plan, &measurements, limits);
        unknown.iter().for_each(|&cell| seconds[cell] = Some(estimates[cell].seconds()));
        print_upper_bound(&mut out, unknown.len(), &unknown.iter().map(|&cell| estimates[cell]).sum())?;
    }
    if seconds.iter().all(Option::is_some) {
        let jobs = grouping.at_a_time;
        let total = |cells: &mut dyn Iterator<Item = usize>| {
            let seconds: f64 = cells.filter_map(|cell| seconds[cell]).sum();
            format!("{}, {} with --jobs {jobs}", duration(seconds), duration(seconds / jobs as f64))
        };
        writeln!(out, "\ntotal: {}", total(&mut (0..seconds.len())))?;
        if let Some((folder, _)) = finished {
            let left = |&cell: &usize| !folder.cell(&plan.cells[cell].id).is_settled(true);
            let left: Vec<usize> = (0..seconds.len()).filter(left).collect();
            let (path, time) = (folder.path().display(), total(&mut left.iter().copied()));
            writeln!(out, "unfinished in {path}, {}: {time}", cells(left.len()))?;
        }
    }
    Ok(())
}

/// Measures groups of cells that cover each environment and each method of `cells`, and prints their speeds.
fn measurements(
    args: &PlanArgs,
    plan: &Plan,
    grouping: Grouping,
    cells: &[usize],
    servers: &Servers,
    stop: &StopFlag,
    out: &mut impl Write,
) -> Result<Vec<Measurement>> {
    let groups = benchmark_cells(plan, cells, grouping);
    let jobs = grouping.at_a_time;
    writeln!(
        out,
        "\nmeasured: {} for about {} s each, with settings from the whole grid, in {}",
        count(groups.len(), "group"),
        args.measure,
        if jobs == 1 { "1 process".to_owned() } else { format!("{jobs} processes at once, steps/s of each") }
    )?;
    let measure_one = |group: Vec<&Cell>| measure(servers, &group, jobs, Duration::from_secs(args.measure), stop);
    let measurements: Vec<Measurement> = groups.into_iter().map(measure_one).collect::<Result<_, _>>()?;
    writeln!(out, "{}", speeds(&measurements).to_text())?;
    Ok(measurements)
}

/// Returns the step limit of each environment of the plan. Refuses unknown environments, and plans that do not fit
/// their environments.
pub(super) fn step_limits<'a>(servers: &Servers, plan: &'a Plan) -> Result<HashMap<&'a str, u32>> {
    let limit = |name: &'a str| {
        let environment = servers.environment(name)?;
        plan.check(&environment)?;
        Ok((name, environment.step_limit))
    };
    plan.environments().into_iter().map(limit).collect()
}

fn speeds(measurements: &[Measurement]) -> Table {
    let per_second = |seconds: f64| grouped((1.0 / seconds.max(1e-9)).round() as usize);
    Table::builder("", measurements)
        .text("environment", |measured| &measured.environment)
        .text("method", |measured| &measured.method)
        .number("cells", |measured| measured.cells)
        .number("steps/s training", |measured| per_second(measured.speed.training))
        .number("steps/s testing", |measured| per_second(measured.speed.testing))
        .build()
}

fn print_upper_bound(out: &mut impl Write, number: usize, estimate: &Estimate) -> std::io::Result<()> {
    writeln!(
        out,
        "\nat most, if every episode lasts until the step limit: {}, {:.2e} steps of training, {:.2e} of testing;\n\
         at the measured speed {}: {} of training, {} of testing",
        cells(number),
        estimate.training_steps,
        estimate.testing_steps,
        duration(estimate.seconds()),
        duration(estimate.training_seconds),
        duration(estimate.testing_seconds)
    )
}

/// Returns a text such as "1 cell" or "1 200 cells".
fn cells(number: usize) -> String {
    counted(number, "cell")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_described_in_a_line() {
        let line = |sizes: &[usize], at_a_time| {
            let groups: Vec<Vec<usize>> = sizes.iter().map(|&size| vec![0; size]).collect();
            groups_line(&groups, Grouping { max_cells: 36, at_a_time })
        };
        assert_eq!(line(&[36, 35, 36, 1], 2), "108 cells in 4 groups of 1 to 36, 2 at a time");
        assert_eq!(line(&[3], 8), "3 cells in 1 group of 3, 1 at a time");
        assert_eq!(line(&[1], 8), "1 cell in 1 group of 1, 1 at a time");
    }
}
