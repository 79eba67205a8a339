//! Compares advantages and returns with numbers from numpy (`crates/torch/tests/fixtures/make_losses.py`), and checks
//! identities between them.

use perturb_learner::algorithm::{gae, n_step_returns};
use perturb_learner::rollout::{Trajectories, explained_variance};
use proptest::prelude::*;

/// Tolerance for means over 11 samples of order 1 in f32: some ten roundings of 2⁻²⁴.
const TOLERANCE: f64 = 2e-6;

fn fixture(case: &str, name: &str) -> Vec<f32> {
    let cases: serde_json::Value =
        serde_json::from_str(include_str!("../../../crates/torch/tests/fixtures/losses.json")).expect("JSON");
    let numbers = cases[case][name].as_array().unwrap_or_else(|| panic!("no {case}.{name}"));
    numbers.iter().map(|x| x.as_f64().expect("a number") as f32).collect()
}

#[track_caller]
fn assert_close(got: &[f32], expected: &[f32], tolerance: f64) {
    assert_eq!(got.len(), expected.len());
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        assert!((f64::from(*got) - f64::from(*expected)).abs() <= tolerance, "{i}: got {got}, expected {expected}");
    }
}

#[test]
fn explained_variance_agrees_with_numpy() {
    let explained = explained_variance(&fixture("losses", "values"), &fixture("losses", "returns"));
    assert_close(&[explained.expect("returns vary") as f32], &fixture("losses", "explained_variance"), TOLERANCE);
}

#[test]
fn explained_variance_has_its_limits() {
    assert_eq!(explained_variance(&[1.0, 2.0], &[1.0, 2.0]), Some(1.0));
    assert_eq!(explained_variance(&[5.0, 5.0], &[1.0, 2.0]), Some(0.0));
    assert_eq!(explained_variance(&[1.0, 2.0], &[3.0, 3.0]), None);
}

/// The fixture has 7 steps of 3 environments, with two terminations, two truncations, and a step with both
/// flags.
#[test]
fn advantages_and_returns_agree_with_sums_from_the_definitions() {
    for (case, bootstrap) in [("advantages_bootstrap", true), ("advantages_reference", false)] {
        let get = |name| fixture(case, name);
        let flags = |name| get(name).iter().map(|&x| x != 0.0).collect::<Vec<_>>();
        let rewards = get("rewards");
        let values = get("values");
        let last_values = get("last_values");
        let terminated = flags("terminated");
        let truncated = flags("truncated");
        let trajectories = Trajectories {
            n_envs: 3,
            rewards: &rewards,
            values: &values,
            terminated: &terminated,
            truncated: &truncated,
            truncation_values: &get("truncation_values"),
            last_values: &last_values,
        };
        // Sums are computed in f64, and only the result is rounded to f32.
        assert_close(&gae(&trajectories, 0.9, 0.8, bootstrap).advantages, &get("gae"), 1e-6);
        let estimates = n_step_returns(&trajectories, 0.9, bootstrap);
        assert_close(&estimates.returns, &get("n_step"), 1e-6);
        let expected: Vec<f32> = estimates.returns.iter().zip(&values).map(|(r, v)| r - v).collect();
        assert_close(&estimates.advantages, &expected, 1e-6);
    }
}

/// Returns the trajectories of one environment in which no episode ends.
fn endless<'a>(rewards: &'a [f32], values: &'a [f32], last_values: &'a [f32]) -> Trajectories<'a> {
    const NEVER: [bool; 64] = [false; 64];
    const ZEROS: [f32; 64] = [0.0; 64];
    let size = rewards.len();
    Trajectories {
        n_envs: 1,
        rewards,
        values,
        terminated: &NEVER[..size],
        truncated: &NEVER[..size],
        truncation_values: &ZEROS[..size],
        last_values,
    }
}

#[test]
fn n_step_returns_of_a_hand_computed_case() {
    let estimates = n_step_returns(&endless(&[1.0, 2.0, 4.0], &[0.5, 0.5, 0.5], &[8.0]), 0.5, true);
    // The returns are 4 + 8/2 = 8, 2 + 8/2 = 6 and 1 + 6/2 = 4.
    assert_eq!(estimates.returns, [4.0, 6.0, 8.0]);
    assert_eq!(estimates.advantages, [3.5, 5.5, 7.5]);
}

#[test]
fn last_value_depends_on_the_kind_of_end() {
    let ended = |terminated: bool, truncated: bool, bootstrap: bool| {
        let trajectories = Trajectories {
            terminated: &[terminated, false],
            truncated: &[truncated, false],
            truncation_values: &[30.0, 0.0],
            ..endless(&[1.0, 2.0], &[10.0, 20.0], &[40.0])
        };
        let gae = gae(&trajectories, 0.5, 0.5, bootstrap);
        let n_step = n_step_returns(&trajectories, 0.5, bootstrap);
        (gae.advantages[0], n_step.returns[0])
    };
    for bootstrap in [true, false] {
        assert_eq!(ended(true, false, bootstrap), (1.0 - 10.0, 1.0));
        assert_eq!(ended(true, true, bootstrap), (1.0 - 10.0, 1.0), "termination wins");
        // By hand: δ_1 = 2 + 20 - 20 = 2, δ_0 = 1 + 10 - 10 = 1, R_1 = 2 + 20 = 22 and R_0 = 1 + 11 = 12.
        assert_eq!(ended(false, false, bootstrap), (1.0 + 0.25 * 2.0, 12.0));
    }
    assert_eq!(ended(false, true, true), (1.0 + 15.0 - 10.0, 16.0));
    assert_eq!(ended(false, true, false), (1.0 - 10.0, 1.0));
}

#[test]
fn bootstrapping_removes_the_time_limit_from_values() {
    // Iterates V ← R_0 for all states, with an episode of 10 steps that the step limit ends.
    let fixed_point = |bootstrap| {
        let mut value = 0.0f32;
        for _ in 0..200 {
            let values = [value; 10];
            let trajectories = Trajectories {
                truncated: &[false, false, false, false, false, false, false, false, false, true],
                truncation_values: &values,
                ..endless(&[1.0; 10], &values, &[99.0])
            };
            value = n_step_returns(&trajectories, 0.9, bootstrap).returns[0];
        }
        f64::from(value)
    };
    // The influence of the initial value has shrunk to 0.9²⁰⁰⁰. Near 10, f32 rounds to 1e-6.
    assert!((fixed_point(true) - 10.0).abs() < 1e-5);
    assert!((fixed_point(false) - (1.0 - 0.9f64.powi(10)) / 0.1).abs() < 1e-5);
}

proptest! {
    #[test]
    fn gae_with_lambda_1_is_the_monte_carlo_return_minus_the_value(
        steps in prop::collection::vec((-5.0f32..5.0, -5.0f32..5.0), 1..40), last in -5.0f32..5.0,
    ) {
        let (rewards, values): (Vec<f32>, Vec<f32>) = steps.into_iter().unzip();
        let size = rewards.len();
        let gamma = 0.97f64;
        let last_values = [last];
        let trajectories = endless(&rewards, &values, &last_values);
        let advantages = gae(&trajectories, gamma, 1.0, true).advantages;
        for t in 0..size {
            let sum: f64 = (t..size).map(|k| gamma.powi((k - t) as i32) * f64::from(rewards[k])).sum();
            let tail = gamma.powi((size - t) as i32) * f64::from(last);
            // The tolerance is the f32 rounding of numbers up to 5·(1-0.97⁴⁰)/0.03 + 10 < 130.
            prop_assert!((f64::from(advantages[t]) - (sum + tail - f64::from(values[t]))).abs() < 1e-5);
        }
        for (a, b) in advantages.iter().zip(n_step_returns(&trajectories, gamma, true).advantages) {
            prop_assert!((a - b).abs() < 1e-5, "f32 rounding of the same sum in another order");
        }
    }

    #[test]
    fn gae_with_lambda_0_is_the_one_step_temporal_difference(
        steps in prop::collection::vec((-5.0f32..5.0, -5.0f32..5.0), 1..40), last in -5.0f32..5.0,
    ) {
        let (rewards, values): (Vec<f32>, Vec<f32>) = steps.into_iter().unzip();
        let last_values = [last];
        let advantages = gae(&endless(&rewards, &values, &last_values), 0.9, 0.0, true).advantages;
        for t in 0..rewards.len() {
            let next = values.get(t + 1).copied().unwrap_or(last);
            let delta = f64::from(rewards[t]) + 0.9 * f64::from(next) - f64::from(values[t]);
            prop_assert!((f64::from(advantages[t]) - delta).abs() < 1e-6, "f32 rounding of numbers up to 15");
        }
    }
}
