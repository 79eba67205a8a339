use super::*;

const WEIGHTS: [f32; 3] = [1.0, -2.0, 0.5];

#[test]
fn gradients_are_clipped_by_global_norm() {
    let gradient = [3.0f32, 0.0, -4.0];
    for (largest, scale) in [(0.5, 0.1), (5.0, 1.0), (10.0, 1.0)] {
        let step = |largest, gradient: [f32; 3]| {
            // With α = 0 and a large ε, a step is nearly the gradient divided by 1000.
            let mut optimiser = Optimiser::new(UpdateRule::rms_prop(0.0, 1e6, 3), largest).with_weight_decay(0.25);
            let mut weights = WEIGHTS;
            (optimiser.step(1.0, &gradient, &mut weights, 1.0).expect("a step"), weights)
        };
        let (norm, weights) = step(largest, gradient);
        assert_eq!(norm, 5.0);
        assert_eq!(weights, step(f64::INFINITY, gradient.map(|g| g * scale)).1);
    }
}

/// The expected weights after five steps were computed with numpy (`crates/torch/tests/fixtures/make_losses.py`). The ε
/// is so large that it matters whether it is inside or outside of the root.
#[test]
fn steps_agree_with_numpy() {
    let cases: serde_json::Value =
        serde_json::from_str(include_str!("../../../torch/tests/fixtures/losses.json")).expect("JSON");
    let numbers = |name: &str| -> Vec<f32> {
        let numbers = cases["optimisers"][name].as_array().expect("an array");
        numbers.iter().map(|x| x.as_f64().expect("a number") as f32).collect()
    };
    let (adam, rms_prop) = (|| UpdateRule::adam(0.25, 3), || UpdateRule::rms_prop(0.99, 0.25, 3));
    for (optimiser, weight_decay, name) in [
        (adam(), 0.0, "adam"),
        (rms_prop(), 0.0, "rms_prop"),
        (adam(), 5.0, "adam_decaying"),
        (rms_prop(), 5.0, "rms_prop_decaying"),
    ] {
        let mut optimiser = Optimiser::new(optimiser, f64::INFINITY).with_weight_decay(weight_decay);
        let mut weights = numbers("weights");
        for gradient in numbers("gradients").chunks_exact(3) {
            optimiser.step(1.0, gradient, &mut weights, 0.01).expect("a step");
        }
        assert_eq!(optimiser.n_updates(), 5);
        for (got, expected) in weights.iter().zip(numbers(name)) {
            assert!((got - expected).abs() < 5e-7, "{name}: {got} {expected}; f32 rounding of five steps");
        }
    }
}

#[test]
fn steps_that_are_not_finite_change_nothing() {
    for (loss, entry) in [(f64::NAN, 1.0), (1.0, f32::INFINITY), (1.0, f32::NAN)] {
        let mut optimiser = Optimiser::new(UpdateRule::adam(1e-5, 3), 0.5);
        let before = optimiser.state();
        let mut weights = WEIGHTS;
        let step = optimiser.step(loss, &[0.0, entry, 0.0], &mut weights, 1.0);
        assert!(matches!(step, Err(Error::NotFinite { update: 0, .. })));
        assert_eq!((weights, optimiser.state(), optimiser.n_updates()), (WEIGHTS, before, 0));
    }
}
