//! The comparison of conditions for Python. It returns the numbers and sentences of `perturb compare`.

use perturb_records::TableRow;
use perturb_records::comparison::{self, ComparedCondition, ComparedScore, ConditionComparison, TableCondition};
use perturb_settings::ValueError;
use pyo3::prelude::*;

use crate::failure::{INVALID, failure};
use crate::records::PythonRecords;

/// A condition: its name, and its policies, each with a key. Policies of two conditions are paired by equal keys.
type NamedCondition<'py> = (String, Vec<(String, PyRef<'py, PythonRecords>)>);

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
    let conditions: Vec<_> = conditions.iter().map(by_reference).collect();
    as_json(score, |score| comparison::compare(&conditions, &sets, score, baseline))
}

/// The values of a row of a results table that a comparison needs. A missing value is None.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct ComparedRow {
    study: String,
    cell: String,
    environment: String,
    revision: Option<u64>,
    model_hash: Option<String>,
    trained_on: String,
    tested_on: Option<String>,
    seed: u64,
    after_episodes: Option<u64>,
    episodes: Option<u64>,
    successes: Option<u64>,
    mean_return: Option<f64>,
    mean_length: Option<f64>,
    settings: String,
}

/// Compares conditions that consist of rows of a results table. `sets` names the test sets to compare on. None stands
/// for all sets that every policy was tested on. If the rows are from several studies, None stands only for the
/// versions among these sets. Returns JSON.
#[pyfunction]
#[pyo3(signature = (conditions, sets, score, baseline))]
pub fn compare_rows(
    conditions: Vec<(String, Vec<ComparedRow>)>,
    sets: Option<Vec<String>>,
    score: &str,
    baseline: Option<&str>,
) -> PyResult<String> {
    let row = |row: ComparedRow| TableRow {
        study: row.study,
        cell: row.cell,
        environment: row.environment,
        revision: row.revision,
        model_hash: row.model_hash,
        trained_on: row.trained_on,
        tested_on: row.tested_on,
        seed: row.seed,
        after_episodes: row.after_episodes,
        episodes: row.episodes,
        successes: row.successes,
        mean_return: row.mean_return,
        mean_length: row.mean_length,
        settings: row.settings,
        ..TableRow::default()
    };
    let named = |(name, rows): (String, Vec<ComparedRow>)| (name, rows.into_iter().map(row).collect());
    let conditions: Vec<(String, Vec<TableRow>)> = conditions.into_iter().map(named).collect();
    let conditions: Vec<_> = conditions
        .iter()
        .map(|(name, rows)| TableCondition { name: name.clone(), rows: rows.iter().collect() })
        .collect();
    as_json(score, |score| comparison::compare_rows(&conditions, sets.as_deref(), score, baseline))
}

fn as_json(
    score: &str,
    compare: impl FnOnce(ComparedScore) -> Result<ConditionComparison, ValueError>,
) -> PyResult<String> {
    let invalid = |error: String| failure(INVALID, 0, error);
    let score: ComparedScore = serde_json::from_value(score.into()).map_err(|error| invalid(error.to_string()))?;
    let compared = compare(score).map_err(|error| invalid(error.to_string()))?;
    serde_json::to_string(&compared).map_err(|error| invalid(error.to_string()))
}

fn by_reference<'a>((name, policies): &'a NamedCondition<'_>) -> ComparedCondition<'a> {
    let policies = policies.iter().map(|(key, records)| (key.clone(), &records.0));
    ComparedCondition { name: name.clone(), policies: policies.collect() }
}
