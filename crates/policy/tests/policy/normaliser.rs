//! Tests of the running normalisation of observations and rewards.

use perturb_policy::random::{Purpose, normal, stream};
use perturb_policy::{Error, ObservationNormaliser, RewardNormaliser};
use proptest::prelude::*;

/// Returns the mean and the population variance, computed in two passes.
fn moments(numbers: &[f64]) -> (f64, f64) {
    let mean = numbers.iter().sum::<f64>() / numbers.len() as f64;
    (mean, numbers.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / numbers.len() as f64)
}

proptest! {
    #[test]
    fn merged_statistics_are_those_of_all_data(
        numbers in prop::collection::vec(-100.0f32..100.0, 3..200), cuts in prop::collection::vec(0usize..200, 2),
        offset in -1e3f32..1e3,
    ) {
        let numbers: Vec<f32> = numbers.iter().map(|x| x + offset).collect();
        let (mean, variance) = moments(&numbers.iter().map(|&x| f64::from(x)).collect::<Vec<_>>());
        let a = cuts[0].min(cuts[1]).min(numbers.len());
        let b = cuts[0].max(cuts[1]).min(numbers.len());
        let parts = [&numbers[..a], &numbers[a..b], &numbers[b..]];
        let mut in_order = ObservationNormaliser::new(1);
        for part in parts {
            in_order.update(part).expect("finite numbers");
        }
        let parts = parts.map(|part| {
            let mut alone = ObservationNormaliser::new(1);
            alone.update(part).expect("finite numbers");
            alone.moments().clone()
        });
        for order in [[0, 1, 2], [2, 0, 1], [1, 2, 0]] {
            let mut merged = parts[order[0]].clone();
            merged.merge(&parts[order[1]]).expect("the same size");
            merged.merge(&parts[order[2]]).expect("the same size");
            for got in [in_order.moments(), &merged] {
                prop_assert_eq!(got.count(), numbers.len() as u64);
                // The tolerance covers the rounding in f64 of sums over 200 numbers up to 1100, and over their squares.
                prop_assert!((got.mean()[0] - mean).abs() < 1e-10);
                prop_assert!((got.variance(0) - variance).abs() < 1e-7);
            }
        }
    }
}

#[test]
fn observations_get_mean_0_and_variance_1_in_every_element() {
    let mut rng = stream(1, Purpose::Weights);
    let mut observations: Vec<f32> =
        (0..3000).map(|i| (normal(&mut rng) * [0.01, 1.0, 50.0][i % 3] + [5.0, 0.0, -300.0][i % 3]) as f32).collect();
    let mut normaliser = ObservationNormaliser::new(3);
    observations.chunks(30).for_each(|batch| normaliser.update(batch).expect("finite numbers"));
    let before = normaliser.clone();
    normaliser.normalise(&mut observations).expect("whole observations");
    assert_eq!(normaliser, before, "testing changes no statistics");
    for i in 0..3 {
        let (mean, variance) =
            moments(&observations.iter().skip(i).step_by(3).map(|&x| f64::from(x)).collect::<Vec<_>>());
        // The tolerance covers f32 rounding and ε = 1e-8, relative to the smallest variance of 1e-4.
        assert!(mean.abs() < 1e-6 && (variance - 1.0).abs() < 2e-4, "{i}: {mean} {variance}");
    }
}

#[test]
fn normalised_numbers_are_clipped_to_10() {
    let mut normaliser = ObservationNormaliser::new(1);
    normaliser.update(&[-1.0, 1.0]).expect("finite numbers");
    let mut observations = [1e6, -1e6, 0.5];
    normaliser.normalise(&mut observations).expect("whole observations");
    assert_eq!(observations, [10.0, -10.0, 0.5]);
}

#[test]
fn first_observation_is_only_centred() {
    let mut normaliser = ObservationNormaliser::new(2);
    normaliser.update(&[3.0, 4.0]).expect("finite numbers");
    let mut observations = [3.0, 5.0];
    normaliser.normalise(&mut observations).expect("whole observations");
    assert_eq!(observations, [0.0, 1.0]);
}

#[test]
fn rewards_are_divided_by_the_deviation_of_discounted_returns() {
    let mut normaliser = RewardNormaliser::new(2, 0.5);
    normaliser.update(&[1.0, -2.0], &[false, true]).expect("two rewards"); // returns 1, -2; then 1, 0
    normaliser.update(&[3.0, 4.0], &[false, false]).expect("two rewards"); // returns 3.5, 4
    let (_, variance) = moments(&[1.0, -2.0, 3.5, 4.0]);
    let mut rewards = [3.0, 0.0];
    normaliser.normalise(&mut rewards);
    let expected = (3.0 / (variance + 1e-8).sqrt()) as f32;
    assert!((rewards[0] - expected).abs() < 1e-6 && rewards[1] == 0.0, "{rewards:?}, not shifted; f32 rounding");
    normaliser.reset_returns();
    normaliser.update(&[1.0, 1.0], &[false, false]).expect("two rewards"); // returns 1, 1
    let (_, variance) = moments(&[1.0, -2.0, 3.5, 4.0, 1.0, 1.0]);
    assert!((normaliser.moments().variance(0) - variance).abs() < 1e-12, "f64 rounding");
}

#[test]
fn a_discounted_return_can_run_on_over_the_ends_of_episodes() {
    let mut normaliser = RewardNormaliser::new(2, 0.5).running_on(true);
    normaliser.update(&[1.0, -2.0], &[false, true]).expect("two rewards"); // returns 1, -2
    normaliser.reset_returns();
    normaliser.update(&[3.0, 4.0], &[true, false]).expect("two rewards"); // returns 3.5, 3
    assert_eq!(normaliser.returns(), [3.5, 3.0]);
    let (_, variance) = moments(&[1.0, -2.0, 3.5, 3.0]);
    assert!((normaliser.moments().variance(0) - variance).abs() < 1e-12, "f64 rounding");
    let stored: RewardNormaliser =
        serde_json::from_str(&serde_json::to_string(&normaliser).expect("JSON")).expect("a normaliser");
    assert_eq!(stored, normaliser);
    assert!(stored.fits(2, 0.5, true).is_ok() && stored.fits(2, 0.5, false).is_err());
    let before = serde_json::to_string(&RewardNormaliser::new(2, 0.5)).expect("JSON");
    assert!(!before.contains("runs_on"), "as earlier programs kept it: {before}");
}

#[test]
fn numbers_that_are_not_finite_are_refused_and_change_nothing() {
    let mut observations = ObservationNormaliser::new(1);
    let mut rewards = RewardNormaliser::new(1, 0.9);
    let before = (observations.clone(), rewards.clone());
    for bad in [f32::NAN, f32::INFINITY] {
        assert!(matches!(observations.update(&[1.0, bad]), Err(Error::Input { .. })));
        assert!(matches!(rewards.update(&[bad], &[false]), Err(Error::Input { .. })));
    }
    assert!(matches!(ObservationNormaliser::new(2).update(&[1.0; 3]), Err(Error::Length { .. })));
    assert_eq!((observations, rewards), before);
}

#[test]
fn stored_normaliser_continues_exactly() {
    let mut rng = stream(2, Purpose::Weights);
    let mut observations = ObservationNormaliser::new(4);
    let mut rewards = RewardNormaliser::new(8, 0.99);
    for _ in 0..500 {
        let batch: Vec<f32> = (0..32).map(|_| normal(&mut rng) as f32).collect();
        observations.update(&batch).expect("finite numbers");
        rewards.update(&batch[..8], &[false; 8]).expect("eight rewards");
        let json = serde_json::to_string(&(&observations, &rewards)).expect("JSON");
        let stored: (ObservationNormaliser, RewardNormaliser) = serde_json::from_str(&json).expect("the same types");
        assert_eq!(stored, (observations.clone(), rewards.clone()));
    }
}

#[test]
fn elements_left_alone_are_not_normalised() {
    let rows = [[1.0f32, 5.0, -3.0], [3.0, 5.0, 70.0]].concat();
    let mut normaliser = ObservationNormaliser::new(1).leaving_alone(2);
    normaliser.update(&rows).expect("rows");
    assert_eq!((normaliser.moments().count(), normaliser.moments().mean()), (2, &[2.0][..]));
    let mut normalised = rows;
    normaliser.normalise(&mut normalised).expect("rows");
    let ends = [&normalised[1..3], &normalised[4..]].concat();
    assert_eq!(ends, [5.0, -3.0, 5.0, 70.0], "not even a constant, nor beyond the clip");
    // The divisor is the square root of 1 + 10⁻⁸, in float32.
    assert!((normalised[0] + 1.0).abs() < 1e-6 && (normalised[3] - 1.0).abs() < 1e-6, "{normalised:?}");
    assert_eq!(normaliser.check(3, 2), Ok(()));
    assert!(normaliser.check(3, 0).is_err() && normaliser.check(2, 2).is_err());
    let json = serde_json::to_string(&normaliser).expect("JSON");
    assert_eq!(serde_json::from_str::<ObservationNormaliser>(&json).expect("the same type"), normaliser);
    let usual = serde_json::to_string(&ObservationNormaliser::new(1)).expect("JSON");
    assert!(!usual.contains("left_alone"), "earlier checkpoints have no such field, and others none either: {usual}");
}
