//! Comparison with the Python library rliable (`tests/fixtures/make_rliable.py`). Statistics are equal. Intervals are
//! equal for the same resamples, and agree statistically for different resamples.

use std::cell::RefCell;
use std::collections::BTreeMap;

use serde::Deserialize;

use super::*;

#[derive(Deserialize)]
struct Fixture {
    thresholds: Vec<f64>,
    cases: BTreeMap<String, Case>,
}

#[derive(Deserialize)]
struct Case {
    /// Scores of a method, by environment, then run. `others` are the scores of another method.
    scores: Vec<Vec<f64>>,
    others: Vec<Vec<f64>>,
    iqm: Numbers,
    optimality_gap: Numbers,
    profile: Numbers,
    improvement: Numbers,
}

/// The expected value of a statistic: one number, or one for each threshold.
#[derive(Deserialize)]
struct Numbers {
    point: Vec<f64>,
    /// A text for each of rliable's resamples. Its words are the strata, and each digit is the index of a drawn run.
    draws: Vec<String>,
    interval_of_draws: Vec<[f64; 2]>,
    interval_95: Vec<[f64; 2]>,
}

/// Tolerance for rounding in sums of a few dozen numbers up to 100.
const ROUNDING: f64 = 1e-9;

/// Number of resamples that this test draws.
const RESAMPLES: usize = 50_000;

fn compare(
    what: &str,
    strata: &[Vec<f64>],
    expected: &Numbers,
    theirs: usize,
    statistic: impl Fn(&[Vec<f64>]) -> Vec<f64>,
) {
    let estimates = RefCell::new(vec![Vec::new(); expected.point.len()]);
    let kept = |strata: &[Vec<f64>]| {
        let numbers = statistic(strata);
        estimates.borrow_mut().iter_mut().zip(&numbers).for_each(|(estimates, number)| estimates.push(*number));
        numbers
    };
    let points: Vec<f64> = bootstrap(strata, RESAMPLES, 1, kept).unwrap().iter().map(|number| number.point).collect();
    assert!(points.iter().zip(&expected.point).all(|(a, b)| (a - b).abs() <= ROUNDING), "{what}: {points:?}");

    let mut of_draws = vec![Vec::new(); points.len()];
    for draw in &expected.draws {
        let drawn = strata
            .iter()
            .zip(draw.split(' '))
            .map(|(runs, digits)| digits.bytes().map(|digit| runs[usize::from(digit - b'0')]).collect());
        let numbers = statistic(&drawn.collect::<Vec<_>>());
        of_draws.iter_mut().zip(numbers).for_each(|(estimates, number)| estimates.push(number));
    }
    let intervals = of_draws.into_iter().map(percentile_interval);
    for (got, expected) in intervals.zip(&expected.interval_of_draws) {
        assert!(
            got.iter().zip(expected).all(|(a, b)| (a - b).abs() <= ROUNDING),
            "{what}: {got:?} is not {expected:?}"
        );
    }

    // A statistic of few scores has only few different values, so the ends of intervals are not compared directly.
    // Instead, 2.5 % of this test's estimates must be beyond each end of rliable's interval, up to five standard
    // deviations. The deviation accounts for the resamples of this test and of rliable (`theirs`).
    let deviation = |resamples: usize| 0.025 * 0.975 / resamples as f64;
    let uncertain = 5.0 * (deviation(RESAMPLES) + deviation(theirs)).sqrt();
    for (estimates, [low, high]) in estimates.into_inner().into_iter().zip(&expected.interval_95) {
        let share = |lies: &dyn Fn(f64) -> bool| {
            estimates.iter().filter(|estimate| lies(**estimate)).count() as f64 / estimates.len() as f64
        };
        let below = [share(&|x| x < low - ROUNDING), share(&|x| x <= low + ROUNDING)];
        let above = [share(&|x| x > high + ROUNDING), share(&|x| x >= high - ROUNDING)];
        for [beyond, beyond_or_at] in [below, above] {
            let fits = beyond < 0.025 + uncertain && beyond_or_at > 0.025 - uncertain;
            assert!(fits, "{what}: {beyond} to {beyond_or_at} are beyond {low} or {high}");
        }
    }
}

#[test]
fn numbers_and_intervals_are_rliables() {
    let fixture: Fixture = serde_json::from_str(include_str!("../../tests/fixtures/rliable.json")).unwrap();
    assert_eq!((fixture.cases.len(), fixture.thresholds.len()), (4, 8));
    for (name, case) in &fixture.cases {
        let of = |number: &str| format!("{number} of {name}");
        let scores = &case.scores;
        compare(&of("IQM"), scores, &case.iqm, 50_000, |strata| vec![interquartile_mean(strata)]);
        compare(&of("gap"), scores, &case.optimality_gap, 50_000, |strata| vec![optimality_gap(strata, 100.0)]);
        compare(&of("profile"), scores, &case.profile, 10_000, |strata| profile(strata, &fixture.thresholds));
        let both = [scores.as_slice(), &case.others].concat();
        compare(&of("improvement"), &both, &case.improvement, 5_000, |strata| {
            let (x, y) = strata.split_at(scores.len());
            vec![probability_of_improvement(x, y)]
        });
    }
}
