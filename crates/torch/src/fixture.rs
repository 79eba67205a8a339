//! Expected numbers for unit tests. `tests/fixtures/make_losses.py` computed them with numpy.

use tch::{Kind, Tensor};

/// Returns the array called `name` of `case`.
pub(crate) fn fixture(case: &str, name: &str) -> Vec<f64> {
    let cases: serde_json::Value =
        serde_json::from_str(include_str!("../tests/fixtures/losses.json")).expect("the fixture is JSON");
    let numbers = cases[case][name].as_array().unwrap_or_else(|| panic!("no {case}.{name}"));
    numbers.iter().map(|x| x.as_f64().expect("a number")).collect()
}

/// Returns the array called `name` of `case` as f32.
pub(crate) fn fixture_f32(case: &str, name: &str) -> Vec<f32> {
    fixture(case, name).iter().map(|&x| x as f32).collect()
}

/// Returns the array called `name` of `case` as a one-dimensional tensor.
pub(crate) fn tensor(case: &str, name: &str) -> Tensor {
    Tensor::of_slice(&fixture_f32(case, name))
}

/// Asserts that every element of `got` is within `tolerance` of `expected`.
#[track_caller]
pub(crate) fn assert_close(got: &Tensor, expected: &[f64], tolerance: f64) {
    let got: Vec<f64> = got.detach().contiguous().view((-1,)).to_kind(Kind::Double).into();
    assert_eq!(got.len(), expected.len());
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        assert!((got - expected).abs() < tolerance, "element {i} is {got}, expected {expected}");
    }
}
