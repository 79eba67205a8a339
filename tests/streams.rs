//! The random streams are NumPy's Philox, number for number, so that another language can repeat them.
#![allow(clippy::unwrap_used)]

use perturb::env::{Purpose, Stream};
use serde_json::Value;

/// Written by data/make_streams.py.
const FIXTURE: &str = include_str!("data/streams.jsonl");

fn hex(value: &Value) -> u64 {
    u64::from_str_radix(value.as_str().unwrap(), 16).unwrap()
}

fn rows() -> impl Iterator<Item = (Stream, Value)> {
    FIXTURE.lines().map(|line| {
        let row: Value = serde_json::from_str(line).unwrap();
        let purpose = [Purpose::Parameters, Purpose::InitialState][row["purpose"].as_u64().unwrap() as usize];
        (Stream::new(hex(&row["seed"]), hex(&row["environment"]), purpose, hex(&row["index"])), row)
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
