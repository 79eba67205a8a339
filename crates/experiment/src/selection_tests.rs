use super::*;
use crate::fixture;

/// A plan with two configurations, learning rates 7e-3 (A) and 7e-4 (B), in two environments and two runs.
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

/// A function that returns success rates on D, R and E, and a mean return. Its arguments are the environment, the
/// training version, the configuration ("A" or "B") and the run.
type RatesFn<'f> = &'f dyn Fn(&str, Version, &str, u32) -> Option<([f64; 3], f64)>;

/// Returns the results of the cells for which `rates` returns numbers. All other cells are missing.
fn results<'a>(plan: &'a Plan, rates: RatesFn<'_>) -> Results<'a> {
    fixture::results(plan, |cell| {
        let common = &cell.config.common;
        rates(&common.environment, common.version, if is_a(cell) { "A" } else { "B" }, cell.run)
    })
}

fn is_a(cell: &Cell) -> bool {
    cell.config.table()["learning_rate"].as_float() == Some(7e-3)
}

/// Returns made-up success rates on D, R and E. A `*` marks the configuration with the highest rate on its training
/// version.
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

/// Returns the success rate of a scenario, summarized over runs, %.
fn success(row: &MethodResults<'_>, train: Version, test: &str) -> Option<Summary> {
    row.test(TrainedOn::Version(train), test, |test| test.success_percent)
}

#[track_caller]
fn assert_summary(got: Option<Summary>, mean: f64, std: f64, runs: usize) {
    let got = got.expect("a number");
    close(got.mean, mean);
    close(got.std.unwrap_or_default(), std);
    assert_eq!(got.runs, runs);
}

#[test]
fn each_run_and_training_version_has_its_best_configuration() {
    let plan = plan();
    let results = results(&plan, &synthetic);
    let selections = results.select();
    assert_eq!(selections.len(), 2);
    let chosen = |run: u32| {
        let trained_on = |version| {
            selections[0].runs[&run].cell_trained_on(TrainedOn::Version(version)).map(|selected| is_a(selected.cell))
        };
        Version::ALL.map(trained_on)
    };
    assert_eq!(chosen(1), [Some(true), Some(false), Some(true)]);
    assert_eq!(chosen(2), [Some(false), Some(true), Some(false)]);
    let rates: Vec<f64> = Scenario::all().filter_map(|scenario| selections[0].runs[&1].rate(scenario)).collect();
    assert_eq!(rates, [90.0, 20.0, 40.0, 10.0, 60.0, 10.0, 1.0, 2.0, 33.0]);
    assert_eq!((selections[0].cells, selections[0].done), (12, 12));
    assert_eq!((selections[1].cells, selections[1].done), (12, 10), "Pendulum's E of A is missing");
}

#[test]
fn metrics_are_those_computed_by_hand() {
    let plan = plan();
    let results = results(&plan, &synthetic);
    let selections = results.select();
    let cart_pole = &selections[0];
    assert_summary(cart_pole.summary(Metric::Default), 85.0, 5.0, 2);
    assert_summary(cart_pole.summary(Metric::Interpolation), 65.0, 5.0, 2);
    // Run 1 has ∛(20 · 40 · 10) = 20, and run 2 has ∛(50 · 20 · 64) = 40.
    assert_summary(cart_pole.summary(Metric::Extrapolation), 30.0, 10.0, 2);
    assert_summary(success(cart_pole, Version::E, "E"), 21.5, 11.5, 2);
    let pendulum = &selections[1];
    // Run 1 has 0, because one of its three scenarios has 0. Run 2 has ∛(100 · 25 · 40) = 46.415888….
    let second = 100_000.0_f64.cbrt();
    assert_summary(pendulum.summary(Metric::Extrapolation), second / 2.0, second / 2.0, 2);

    let both: Vec<&MethodResults<'_>> = selections.iter().collect();
    // Run 1 has (90 + 50) / 2 = 70, and run 2 has (80 + 60) / 2 = 70. So the standard deviation of the average is 0,
    // although it is 5 in each environment.
    assert_summary(average(&both, Metric::Default), 70.0, 0.0, 2);
    assert_summary(average(&both, Metric::Interpolation), 52.5, 7.5, 2);
    let [first, second] = [20.0 / 2.0, (40.0 + second) / 2.0];
    assert_summary(average(&both, Metric::Extrapolation), (first + second) / 2.0, (second - first) / 2.0, 2);
    // The interquartile mean drops the lowest and the highest of 90, 80, 50 and 60.
    let iqm = interquartile(&both, Metric::Default, 100).unwrap();
    close(iqm.point, 70.0);
    assert_eq!(iqm.runs, 2);
}

#[test]
fn return_breaks_ties_and_the_rest_is_averaged() {
    let plan = plan();
    // The rates on R show whether A or B was selected.
    let on_r = |name: &str| [100.0, if name == "A" { 1.0 } else { 2.0 }, 0.0];
    let chosen = |rates: RatesFn<'_>| {
        let results = results(&plan, rates);
        let selections = results.select();
        [1, 2].map(|run| selections[0].runs[&run].rate(Scenario { train: Version::D, test: Version::R }))
    };
    let higher = ["A", "B"];
    let by_return = |_: &str, _: Version, name: &str, run: u32| {
        Some((on_r(name), f64::from(u8::from(name == higher[run as usize - 1]))))
    };
    assert_eq!(chosen(&by_return), [Some(1.0), Some(2.0)]);
    let equal = |_: &str, _: Version, name: &str, _: u32| Some((on_r(name), 5.0));
    assert_eq!(chosen(&equal), [Some(1.5), Some(1.5)], "the mean of A and B");
    let results = results(&plan, &equal);
    let selections = results.select();
    let first = selections[0].runs[&1].cell_trained_on(TrainedOn::Version(Version::D)).unwrap();
    assert!(is_a(first.cell), "A is listed first and stands for both");
}

#[test]
fn missing_results_do_not_count_as_zero() {
    let plan = plan();
    // Run 2 has no training on R, and CartPole has no training on D in any run.
    let gaps = |environment: &str, version: Version, name: &str, run: u32| match (environment, version, run) {
        (_, Version::R, 2) | ("CartPole", Version::D, _) => None,
        _ => synthetic(environment, version, name, run),
    };
    let results = results(&plan, &gaps);
    let selections = results.select();
    let [cart_pole, pendulum] = &selections[..] else { panic!() };
    assert_eq!(cart_pole.summary(Metric::Default), None);
    assert_eq!(cart_pole.summary(Metric::Extrapolation), None);
    assert_summary(cart_pole.summary(Metric::Interpolation), 60.0, 0.0, 1);
    assert_summary(pendulum.summary(Metric::Default), 55.0, 5.0, 2);
    assert_summary(pendulum.summary(Metric::Extrapolation), 0.0, 0.0, 1);
    let both: Vec<&MethodResults<'_>> = selections.iter().collect();
    assert_eq!(average(&both, Metric::Default), None);
    assert_eq!(interquartile(&both, Metric::Default, 10), None);
    assert_summary(average(&both, Metric::Interpolation), 45.0, 0.0, 1);
    assert_eq!(average(&[], Metric::Default), None);
}

/// Returns rates of configurations that tie: they have equal rates and returns on the training version, and different
/// rates on other versions.
fn tied(_: &str, version: Version, name: &str, _: u32) -> Option<([f64; 3], f64)> {
    let rates = match (version, name) {
        (Version::D, "A") => [100.0, 40.0, 10.0],
        (Version::D, _) => [100.0, 90.0, 80.0],
        (Version::R, "A") => [20.0, 100.0, 30.0],
        (Version::R, _) => [20.0, 100.0, 70.0],
        (Version::E, _) => [0.0, 0.0, 50.0],
        (Version::RE, _) => return None,
    };
    Some((rates, 7.0))
}

#[test]
fn numbers_are_means_over_tied_configurations() {
    let plan = plan();
    let results = results(&plan, &tied);
    let selections = results.select();
    let cart_pole = &selections[0];
    assert_summary(cart_pole.summary(Metric::Default), 100.0, 0.0, 2);
    assert_eq!(cart_pole.tie_range(Metric::Default), Some(TieRange { choices: 2, low: 100.0, high: 100.0 }));
    let extrapolation = |dr: f64, de: f64, re: f64| (dr * de * re).cbrt();
    let choices = [
        extrapolation(40.0, 10.0, 30.0),
        extrapolation(40.0, 10.0, 70.0),
        extrapolation(90.0, 80.0, 30.0),
        extrapolation(90.0, 80.0, 70.0),
    ];
    close(cart_pole.summary(Metric::Extrapolation).unwrap().mean, choices.iter().sum::<f64>() / 4.0);
    let range = cart_pole.tie_range(Metric::Extrapolation).unwrap();
    assert_eq!(range.choices, 4);
    close(range.low, choices[0]);
    close(range.high, choices[3]);
    assert_summary(success(cart_pole, Version::D, "E"), 45.0, 0.0, 2);
    let selections: Vec<&MethodResults<'_>> = selections.iter().collect();
    close(average_tie_range(&selections, Metric::Extrapolation).unwrap().low, choices[0]);
}

#[test]
fn a_higher_return_decides_before_a_tie() {
    let plan = plan();
    let results = results(&plan, &|environment, version, name, run| {
        let (rates, _) = tied(environment, version, name, run)?;
        Some((rates, if name == "A" { 8.0 } else { 7.0 }))
    });
    let selections = results.select();
    assert_eq!(selections[0].tie_range(Metric::Extrapolation), None);
    assert_summary(success(&selections[0], Version::D, "E"), 10.0, 0.0, 2);
}
