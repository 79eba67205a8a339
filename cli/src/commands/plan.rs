//! `perturb plan`.

use std::collections::HashMap;
use std::io::Write;
use std::time::Duration;

use serde_json::json;

use super::args::PlanArgs;
use super::error::{CommandError, Result};
use super::servers;
use perturb_learner::client::Servers;
use perturb_learner::measure::measure;
use perturb_study::scheduler::count;
use perturb_study::table::Table;
use perturb_study::{Cell, Estimate, Folder, Measurement, Plan, estimates, representatives};

pub(super) fn run(args: &PlanArgs) -> Result<()> {
    let plan = Plan::load(&args.file)?;
    let mut out = std::io::stdout();
    if args.json && !args.cells && args.missing.is_none() {
        return Err(CommandError::Usage("--json lists cells: give --cells or --missing DIR with it".into()));
    }
    let folder = args.missing.as_deref().map(Folder::new);
    let listed: Vec<&Cell> = match &folder {
        Some(folder) => plan.cells.iter().filter(|cell| !folder.cell(&cell.id).is_settled(true)).collect(),
        None if args.cells => plan.cells.iter().collect(),
        None => Vec::new(),
    };
    if args.json {
        let listed: Vec<_> = listed.iter().map(|cell| json!({ "index": cell.index, "id": cell.id })).collect();
        writeln!(out, "{:#}", json!(listed))?;
        return Ok(());
    }
    for cell in listed {
        writeln!(out, "{:>6} {}", cell.index, cell.id)?;
    }
    if folder.is_some() {
        return Ok(());
    }
    let counts = plan.counts();
    writeln!(
        out,
        "{} configurations, {} trainings, {} train/test pairs, {} with {}",
        grouped(counts.configurations),
        grouped(counts.trainings),
        grouped(counts.pairs),
        grouped(counts.all_pairs),
        count(counts.runs as usize, "run")
    )?;
    if args.measure == 0 {
        return Ok(());
    }
    let servers = servers(&args.server)?;
    let limits = step_limits(&servers, &plan)?;
    let representatives = representatives(&plan);
    writeln!(
        out,
        "\nmeasured: {} trainings for some {} s each, one after the other, with the settings in the middle of their grid",
        representatives.len(),
        args.measure
    )?;
    let measure_one = |cell| measure(&servers, cell, Duration::from_secs(args.measure));
    let measurements: Vec<Measurement> = representatives.into_iter().map(measure_one).collect::<Result<_, _>>()?;
    writeln!(out, "{}", speeds(&measurements).to_text())?;
    let estimate: Estimate = estimates(&plan, &measurements, &limits).into_iter().sum();
    Ok(print_estimate(&mut out, &plan, &estimate)?)
}

/// The step limits of the plan's environments. Refuses plans that do not fit them.
pub(super) fn step_limits<'a>(servers: &Servers, plan: &'a Plan) -> Result<HashMap<&'a str, u32>> {
    let limit = |name: &'a str| {
        let environment = servers.environment(name)?;
        plan.check(&environment).map_err(|refused| CommandError::Failed(refused.to_string()))?;
        Ok((name, environment.step_limit))
    };
    plan.environments().into_iter().map(limit).collect()
}

fn speeds(measurements: &[Measurement]) -> Table {
    let per_second = |seconds: f64| grouped((1.0 / seconds.max(1e-9)).round() as usize);
    Table::of("", measurements)
        .text("environment", |measured| &measured.environment)
        .text("method", |measured| &measured.method)
        .number("steps/s training", |measured| per_second(measured.speed.training))
        .number("steps/s testing", |measured| per_second(measured.speed.testing))
        .build()
}

fn print_estimate(out: &mut impl Write, plan: &Plan, estimate: &Estimate) -> std::io::Result<()> {
    let steps = |number: f64| format!("{number:.2e}");
    writeln!(
        out,
        "\nat most, if every episode of {} cells lasts until the step limit: {} steps of training, {} of testing",
        grouped(plan.cells.len()),
        steps(estimate.training_steps),
        steps(estimate.testing_steps)
    )?;
    writeln!(
        out,
        "which takes {} as measured: {} of training, {} of testing; with two jobs on as many free cores half of it",
        duration(estimate.seconds()),
        duration(estimate.training_seconds),
        duration(estimate.testing_seconds)
    )
}

/// A number with its digits in groups of three.
pub(super) fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

/// A time in two of its units.
pub(super) fn duration(seconds: f64) -> String {
    let seconds = seconds.round() as u64;
    let (minutes, hours, days) = (seconds / 60, seconds / 3600, seconds / 86_400);
    match (days, hours, minutes) {
        (0, 0, 0) => format!("{seconds} s"),
        (0, 0, _) => format!("{minutes} min {} s", seconds % 60),
        (0, _, _) => format!("{hours} h {} min", minutes % 60),
        (0..1000, _, _) => format!("{days} d {} h", hours % 24),
        _ => format!("{} years", grouped((days as f64 / 365.25).round() as usize)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_stand_in_groups_of_three() {
        let shown = [0, 12, 183, 3294, 9882, 49_410, 1_234_567].map(grouped);
        assert_eq!(shown, ["0", "12", "183", "3 294", "9 882", "49 410", "1 234 567"]);
    }

    #[test]
    fn times_have_two_units() {
        let shown = [0.4, 59.4, 61.0, 3600.0, 90_000.0, 86_400.0 * 400.0, 86_400.0 * 3652.5].map(duration);
        assert_eq!(shown, ["0 s", "59 s", "1 min 1 s", "1 h 0 min", "1 d 1 h", "400 d 0 h", "10 years"]);
    }
}
