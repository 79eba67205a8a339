//! The random streams equal NumPy's Philox, number for number, so other languages can reproduce them.

use crate::common;
use perturb::{
    env::{DrawPurpose, Environment, PhiloxStream, Version},
    tasks,
};
use rstest::rstest;
use serde_json::Value;
use std::f64::consts::PI;

/// The numbers of NumPy, written by data/make_streams.py.
const FIXTURE: &str = include_str!("data/streams.jsonl");

fn hex(value: &Value) -> u64 {
    u64::from_str_radix(value.as_str().unwrap(), 16).unwrap()
}

fn rows() -> impl Iterator<Item = (PhiloxStream, Value)> {
    FIXTURE.lines().map(|line| {
        let row: Value = serde_json::from_str(line).unwrap();
        let purpose = [DrawPurpose::Parameters, DrawPurpose::InitialState][row["purpose"].as_u64().unwrap() as usize];
        (PhiloxStream::new(hex(&row["seed"]), hex(&row["environment"]), purpose, hex(&row["index"])), row)
    })
}

#[test]
fn words_are_those_of_numpy() {
    let mut compared = 0;
    for (mut stream, row) in rows() {
        for word in row["words"].as_array().unwrap() {
            assert_eq!(stream.next_u64(), hex(word), "{row}");
            compared += 1;
        }
    }
    assert_eq!(compared, 6 * 4 * 2 * 6 * 11, "the fixture has every seed, environment, purpose, index and draw");
}

#[test]
fn units_are_those_of_numpy() {
    for (mut stream, row) in rows() {
        for unit in row["units"].as_array().unwrap() {
            assert_eq!(stream.unit().to_bits(), hex(unit), "{row}");
        }
    }
}

#[test]
fn uniform_spends_one_number_and_scales_it() {
    for (mut stream, _) in rows() {
        let mut other = stream.clone();
        for (low, high) in [(0.0, 1.0), (-0.6, -0.4), (-3.0, 5.0)] {
            let value = stream.uniform(low, high);
            assert_eq!(value.to_bits(), (low + (high - low) * other.unit()).to_bits());
            assert!((low..=high).contains(&value));
        }
    }
}

#[test]
fn parameters_are_the_trials_numbers_in_the_catalogues_order() {
    for spec in tasks::catalogue().specs() {
        let mut e = common::episodes(spec, Version::R, 12, 34, 2);
        for trial in 0..3 {
            for _ in 0..2 {
                let mut stream = PhiloxStream::new(12, 34, DrawPurpose::Parameters, trial);
                let expected: Vec<f64> = spec
                    .parameters
                    .iter()
                    .map(|p| p.random.low + (p.random.high - p.random.low) * stream.unit())
                    .collect();
                let requested = e.receipt().requested;
                for (requested, expected) in requested.iter().zip(&expected) {
                    // `at` multiplies and adds in the same order. Only the length of the version's interval was rounded
                    // before.
                    assert!((requested - expected).abs() <= 1e-15 * expected.abs(), "{}", spec.name);
                }
                e.begin(None);
            }
        }
    }
}

#[rstest]
#[case("CartPole", &[(-0.05, 0.05); 4])]
#[case("MountainCar", &[(-0.6, -0.4), (0.0, 0.0)])]
#[case("Acrobot", &[(-0.1, 0.1); 4])]
#[case("Pendulum", &[(-PI, PI), (-1.0, 1.0)])]
fn initial_states_are_the_episodes_numbers_in_the_states_order(
    #[case] name: &str,
    #[case] ranges: &[(f64, f64)],
    #[values(0, 1, 7)] episode: u64,
) {
    let mut stream = PhiloxStream::new(12, 34, DrawPurpose::InitialState, episode);
    let mut environment: Box<dyn Environment> = tasks::catalogue().find(name).and_then(|spec| (spec.make)()).unwrap();
    environment.reset(&mut stream.clone());
    let mut state = Vec::new();
    environment.save(&mut state);
    let draw = |&(low, high): &(f64, f64)| if low == high { low } else { low + (high - low) * stream.unit() };
    assert_eq!(state, ranges.iter().map(draw).collect::<Vec<_>>());

    // Episodes use this stream.
    let mut episodes = common::episodes(tasks::catalogue().find(name).unwrap(), Version::D, 12, 34, 1);
    (0..episode).for_each(|_| episodes.begin(None));
    let mut observation = vec![0.0; environment.spec().observation.len()];
    environment.observe(&mut observation);
    assert_eq!(common::observe(&episodes), observation);
}
