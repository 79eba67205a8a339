use super::*;
use crate::Training;
use crate::results::Counters;
use crate::{TestResult, paper};

/// Two configurations (A: 7e-3, B: 7e-4) of one method, on two environments, in two runs.
const PLAN: &str = "
environments = ['CartPole', 'Pendulum']
runs = 2
[[algorithm]]
name = 'a2c'
architectures = ['ff']
grid = { learning_rate = [7e-3, 7e-4] }
";

fn plan() -> Plan {
    Plan::parse("test", PLAN.into()).unwrap()
}

/// A result with success rates on D, R and E, and the same mean return on all.
fn done(cell: &Cell, rates: [f64; 3], mean_return: f64) -> CellState {
    let common = &cell.config.common;
    let test = |rate: f64| TestResult {
        episodes: 1000,
        success_percent: rate,
        success_percent_95: [0.0, 100.0],
        mean_return,
        mean_length: 1.0,
    };
    CellState::Done(Box::new(CellResult {
        format_version: CellResult::FORMAT_VERSION,
        id: cell.id.clone(),
        training: Training {
            environment: common.environment.clone(),
            environment_revision: 1,
            model_hash: String::new(),
            version: common.version,
            method: cell.method(),
            configuration: cell.configuration.clone(),
            run: cell.run,
            seed: common.seed,
            counters: Counters::default(),
            settings: cell.config.table(),
        },
        results: Version::ALL.into_iter().zip(rates.map(test)).collect(),
        commit: String::new(),
        earlier_commits: Vec::new(),
        command: String::new(),
    }))
}

/// Success rates on D, R and E and a mean return, by environment, training version, configuration ("A" or "B") and run.
type Known<'f> = &'f dyn Fn(&str, Version, &str, u32) -> Option<([f64; 3], f64)>;

/// What `rates` does not know is missing.
fn results<'a>(plan: &'a Plan, rates: Known<'_>) -> Results<'a> {
    let state = |cell: &Cell| {
        let common = &cell.config.common;
        let name = if cell.config.table()["learning_rate"].as_float() == Some(7e-3) { "A" } else { "B" };
        rates(&common.environment, common.version, name, cell.run)
            .map_or(CellState::Missing, |(rates, mean_return)| done(cell, rates, mean_return))
    };
    Results { plan, states: plan.cells.iter().map(state).collect() }
}

/// All hand-made; the best on the trained version is marked by *.
fn synthetic(environment: &str, version: Version, name: &str, run: u32) -> Option<([f64; 3], f64)> {
    use Version::{D, E, R};
    let rates = match (environment, version, name, run) {
        ("CartPole", D, "A", 1) => [90.0, 20.0, 40.0], // *
        ("CartPole", D, "B", 1) => [80.0, 99.0, 99.0],
        ("CartPole", D, "A", 2) => [70.0, 99.0, 99.0],
        ("CartPole", D, "B", 2) => [80.0, 50.0, 20.0], // *
        ("CartPole", R, "A", 1) => [99.0, 50.0, 99.0],
        ("CartPole", R, "B", 1) => [10.0, 60.0, 10.0], // *
        ("CartPole", R, "A", 2) => [10.0, 70.0, 64.0], // *
        ("CartPole", R, "B", 2) => [99.0, 60.0, 99.0],
        ("CartPole", E, "A", 1) => [1.0, 2.0, 33.0], // *
        ("CartPole", E, "B", 1) => [3.0, 4.0, 32.0],
        ("CartPole", E, "A", 2) => [5.0, 6.0, 7.0],
        ("CartPole", E, "B", 2) => [8.0, 9.0, 10.0],    // *
        ("Pendulum", D, "A", 1) => [50.0, 0.0, 50.0],   // *
        ("Pendulum", D, "A", 2) => [60.0, 100.0, 25.0], // *
        ("Pendulum", R, "A", 1) => [0.0, 30.0, 80.0],   // *
        ("Pendulum", R, "A", 2) => [0.0, 50.0, 40.0],   // *
        ("Pendulum", _, "B", _) => [0.0; 3],
        _ => return None,
    };
    Some((rates, 0.0))
}

fn close(got: f64, expected: f64) {
    assert!((got - expected).abs() < 1e-9, "{got} is not {expected}");
}

#[track_caller]
fn assert_summary(got: Option<Summary>, mean: f64, std: f64, runs: usize) {
    let got = got.expect("a number");
    close(got.mean, mean);
    close(got.std, std);
    assert_eq!(got.runs, runs);
}

#[test]
fn each_run_and_training_version_has_its_best_configuration() {
    let plan = plan();
    let results = results(&plan, &synthetic);
    let groups = results.select();
    assert_eq!(groups.len(), 2);
    let chosen = |group: &Group, run: u32| {
        group.runs[&run].cells.map(|index| {
            index.map(|index| plan.cells[index].config.table()["learning_rate"].as_float().unwrap() == 7e-3)
        })
    };
    assert_eq!(chosen(&groups[0], 1), [Some(true), Some(false), Some(true)]);
    assert_eq!(chosen(&groups[0], 2), [Some(false), Some(true), Some(false)]);
    assert_eq!(
        groups[0].runs[&1].rates,
        [[90.0, 20.0, 40.0], [10.0, 60.0, 10.0], [1.0, 2.0, 33.0]].map(|r| r.map(Some))
    );
    assert_eq!((groups[0].cells, groups[0].done), (12, 12));
    assert_eq!((groups[1].cells, groups[1].done), (12, 10), "Pendulum's E of A is missing");
}

#[test]
fn metrics_are_those_computed_by_hand() {
    let plan = plan();
    let groups = results(&plan, &synthetic).select();
    let cart_pole = &groups[0];
    assert_summary(cart_pole.summary(Metric::Default), 85.0, 5.0, 2);
    assert_summary(cart_pole.summary(Metric::Interpolation), 65.0, 5.0, 2);
    // Run 1: ∛(20 · 40 · 10) = 20. Run 2: ∛(50 · 20 · 64) = 40.
    assert_summary(cart_pole.summary(Metric::Extrapolation), 30.0, 10.0, 2);
    assert_summary(cart_pole.scenario(Scenario { train: Version::E, test: Version::E }), 21.5, 11.5, 2);
    let pendulum = &groups[1];
    // Run 1 has a 0 among its three: 0. Run 2: ∛(100 · 25 · 40) = 46.415888….
    let second = 100_000.0_f64.cbrt();
    assert_summary(pendulum.summary(Metric::Extrapolation), second / 2.0, second / 2.0, 2);

    let both: Vec<&Group> = groups.iter().collect();
    // Run 1: (90 + 50) / 2 = 70, run 2: (80 + 60) / 2 = 70. Deviations of environments do not add up.
    assert_summary(average(&both, Metric::Default), 70.0, 0.0, 2);
    assert_summary(average(&both, Metric::Interpolation), 52.5, 7.5, 2);
    let [first, second] = [20.0 / 2.0, (40.0 + second) / 2.0];
    assert_summary(average(&both, Metric::Extrapolation), (first + second) / 2.0, (second - first) / 2.0, 2);
    // Of 90, 80, 50, 60 the lowest and the highest go.
    let (iqm, runs) = interquartile(&both, Metric::Default, 100).unwrap();
    close(iqm.iqm, 70.0);
    assert_eq!(runs, average(&both, Metric::Default).unwrap().runs);
}

#[test]
fn of_equal_configurations_the_return_and_then_the_plan_decide() {
    let plan = plan();
    let by_return = |_: &str, _: Version, name: &str, run: u32| {
        let higher = if run == 1 { "A" } else { "B" };
        Some(([100.0, if name == "A" { 1.0 } else { 2.0 }, 0.0], f64::from(u8::from(name == higher))))
    };
    let groups = results(&plan, &by_return).select();
    assert_eq!([1, 2].map(|run| groups[0].runs[&run].rates[0][1]), [Some(1.0), Some(2.0)]);
    let equal =
        |_: &str, _: Version, name: &str, _: u32| Some(([100.0, if name == "A" { 1.0 } else { 2.0 }, 0.0], 5.0));
    let groups = results(&plan, &equal).select();
    assert_eq!([1, 2].map(|run| groups[0].runs[&run].rates[0][1]), [Some(1.0), Some(1.0)], "A is listed first");
}

#[test]
fn what_is_missing_is_missing_and_never_zero() {
    let plan = plan();
    // Run 2 has no training on R, and of CartPole no run at all on D.
    let gaps = |environment: &str, version: Version, name: &str, run: u32| match (environment, version, run) {
        (_, Version::R, 2) | ("CartPole", Version::D, _) => None,
        _ => synthetic(environment, version, name, run),
    };
    let groups = results(&plan, &gaps).select();
    let [cart_pole, pendulum] = &groups[..] else { panic!() };
    assert_eq!(cart_pole.summary(Metric::Default), None);
    assert_eq!(cart_pole.summary(Metric::Extrapolation), None);
    assert_summary(cart_pole.summary(Metric::Interpolation), 60.0, 0.0, 1);
    assert_summary(pendulum.summary(Metric::Default), 55.0, 5.0, 2);
    assert_summary(pendulum.summary(Metric::Extrapolation), 0.0, 0.0, 1);
    let both: Vec<&Group> = groups.iter().collect();
    assert_eq!(average(&both, Metric::Default), None);
    assert_eq!(interquartile(&both, Metric::Default, 10), None);
    assert_summary(average(&both, Metric::Interpolation), 45.0, 0.0, 1);
    assert_eq!(average(&[], Metric::Default), None);
}

/// The paper's averages follow from its tables of the environments, to the two digits that they are rounded to.
#[test]
fn the_papers_averages_are_those_of_its_environments() {
    let mut compared = 0;
    for (algorithm, architecture, trials) in paper::rows_of("Average") {
        let average = paper::row_with_trials("Average", &algorithm, &architecture, trials).expect("a row");
        for metric in Metric::ALL {
            let of = |row: &paper::Row| match metric {
                Metric::Default => row.default.mean,
                Metric::Interpolation => row.interpolation.mean,
                Metric::Extrapolation => row.extrapolation.mean,
            };
            let method =
                Method { algorithm: algorithm.clone(), architecture: architecture.clone(), episodes_per_trial: trials };
            let groups: Vec<Group> = ["Acrobot", "CartPole", "MountainCar", "Pendulum", "HalfCheetah", "Hopper"]
                .map(|environment| {
                    let row = paper::row_with_trials(environment, &algorithm, &architecture, trials).expect("a row");
                    // One run whose scenarios all have the metric's mean: then that is the metric.
                    let selected = Selected { cells: [None; 3], rates: [[Some(of(&row)); 3]; 3] };
                    let runs = BTreeMap::from([(1, selected)]);
                    Group { environment: environment.into(), method: method.clone(), cells: 1, done: 1, runs }
                })
                .into();
            let ours = super::average(&groups.iter().collect::<Vec<_>>(), metric).expect("a number");
            let difference = (ours.mean - of(&average)).abs();
            // Either is rounded to 0.01: half of that each, and some for the binary fractions.
            assert!(difference < 0.0101, "{method} {metric}: {} is not {}", ours.mean, of(&average));
            compared += 1;
        }
    }
    assert_eq!(compared, 42);
}
