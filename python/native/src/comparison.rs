//! The comparison of conditions for Python. It returns the numbers and sentences of `perturb compare`.

use perturb_records::comparison::{self, ComparedCondition, ComparedScore};
use pyo3::prelude::*;

use crate::failure::{INVALID, failure};
use crate::records::Records;

/// A condition: its name, and its policies, each with a key. Policies of two conditions are paired by equal keys.
type NamedCondition<'py> = (String, Vec<(String, PyRef<'py, Records>)>);

/// Compares conditions by their scores in the tests on the given sets. `score` is `success`, `return` or `length`.
/// Returns JSON.
#[pyfunction]
#[pyo3(signature = (conditions, sets, score, baseline))]
pub fn compare(
    conditions: Vec<NamedCondition<'_>>,
    sets: Vec<String>,
    score: &str,
    baseline: Option<&str>,
) -> PyResult<String> {
    let invalid = |error: String| failure(INVALID, 0, error);
    let score: ComparedScore = serde_json::from_value(score.into()).map_err(|error| invalid(error.to_string()))?;
    let conditions: Vec<_> = conditions.iter().map(by_reference).collect();
    let compared =
        comparison::compare(&conditions, &sets, score, baseline).map_err(|error| invalid(error.to_string()))?;
    serde_json::to_string(&compared).map_err(|error| invalid(error.to_string()))
}

fn by_reference<'a>((name, policies): &'a NamedCondition<'_>) -> ComparedCondition<'a> {
    let policies = policies.iter().map(|(key, records)| (key.clone(), &records.0));
    ComparedCondition { name: name.clone(), policies: policies.collect() }
}
