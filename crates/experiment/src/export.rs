//! Exports the results in an experiment's folder as rows of a table.

use std::collections::HashSet;

use perturb_files::list;
use perturb_records::outcomes::{Outcomes, SHARE, conditional_value_at_risk};
use perturb_records::{Records, SCHEMA_VERSION, TableRow, TestResult};
use perturb_settings::Method;

use crate::folder::{CellFolder, CellResult, CellState, ExperimentFolder, FolderError};
use crate::plan::{Cell, Plan};
use crate::states::COMMIT_SEPARATOR;
use crate::verify::{VerifyError, follows};

/// The reason why an experiment's folder cannot be exported.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// A file of a cell cannot be read.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A result contradicts its recorded episodes.
    #[error(transparent)]
    Verify(#[from] VerifyError),
}

/// Returns the table rows of all done or failed cells in `folder`.
///
/// The order is: cells of `plan` in the plan's order, then its candidates, then done cells that are not in the plan, by
/// id. Checks each result against its recorded episodes, if there are any. For each done cell with recorded episodes of
/// its final policy, calls `each` with the cell's id and these episodes.
///
/// # Errors
/// [`ExportError`] if a file cannot be read, or a result contradicts its recorded episodes.
pub fn export(
    plan: &Plan,
    folder: &ExperimentFolder,
    study: &str,
    mut each: impl FnMut(&str, Records),
) -> Result<Vec<TableRow>, ExportError> {
    let mut rows = Vec::new();
    let mut add = |id: &str, cell: Option<&Cell>| -> Result<(), ExportError> {
        let place = folder.cell(id);
        match place.state()? {
            CellState::Missing => {}
            CellState::Failed(failure) => rows.extend(cell.map(|cell| TableRow {
                failure: Some(failure.reason),
                commit: failure.commit,
                ..failed_row(study, cell)
            })),
            CellState::Done(result) => {
                if let Some(records) = add_done(study, &place, &result, &mut rows)? {
                    each(id, records);
                }
            }
        }
        Ok(())
    };
    let mut planned = HashSet::new();
    // A selected candidate is in both lists, but its rows are added only once.
    for cell in plan.cells.iter().chain(&plan.candidates) {
        if planned.insert(cell.id.as_str()) {
            add(&cell.id, Some(cell))?;
        }
    }
    for place in list(&folder.path().join("cells")).map_err(FolderError::from)? {
        if let Some(id) = place.file_name().and_then(|name| name.to_str()).filter(|id| !planned.contains(id)) {
            add(id, None)?;
        }
    }
    Ok(rows)
}

/// Adds the rows of a finished cell: first the tests of its intermediate policies, then the tests of its final policy.
/// Returns the recorded episodes of the final policy, if there are any.
fn add_done(
    study: &str,
    place: &CellFolder,
    result: &CellResult,
    rows: &mut Vec<TableRow>,
) -> Result<Option<Records>, VerifyError> {
    let training = &result.training;
    let commits: Vec<&str> = result.commits().collect();
    let common = TableRow {
        revision: Some(training.environment_revision.into()),
        model_hash: Some(training.model_hash.clone()).filter(|hash| !hash.is_empty()),
        seconds: place.timing().map(|timing| timing.seconds),
        commit: commits.join(COMMIT_SEPARATOR),
        ..row_of(
            study,
            &result.id,
            &training.environment,
            &training.method,
            training.set.clone().unwrap_or_else(|| training.version.to_string()),
            (training.run, training.seed),
            &training.settings,
        )
    };
    let test = |name: &String, figures: &TestResult, records: Option<&Records>| {
        let returns = records.map(|records| Outcomes::new(records, name).returns);
        TableRow {
            tested_on: Some(name.clone()),
            episodes: Some(figures.episodes),
            // Rounding gives the exact number, because the rate was computed from it.
            successes: Some((figures.success_percent * figures.episodes as f64 / 100.0).round() as u64),
            mean_return: Some(figures.mean_return),
            mean_length: Some(figures.mean_length),
            cvar_10: returns.map(|returns| conditional_value_at_risk(&returns, SHARE)),
            checksum: records.and_then(|records| records.checksum(name)),
            ..common.clone()
        }
    };
    for (&mark, of) in &result.marks {
        let records = follows(result, &place.mark(mark), &of.results, Some(&of.agreement))?;
        let of_mark = of.results.iter().map(|(name, figures)| TableRow {
            after_episodes: Some(mark),
            timesteps: Some(of.counters.timesteps),
            ..test(name, figures, records.as_ref())
        });
        rows.extend(of_mark);
    }
    let records = follows(result, place.path(), &result.results, result.agreement.as_ref())?;
    let of_final = result.results.iter().map(|(name, figures)| TableRow {
        after_episodes: Some(training.counters.episodes),
        timesteps: Some(training.counters.timesteps),
        ..test(name, figures, records.as_ref())
    });
    rows.extend(of_final);
    Ok(records)
}

/// Returns the row of a failed cell, in which the caller fills in the columns `failure` and `commit`.
fn failed_row(study: &str, cell: &Cell) -> TableRow {
    let common = &cell.config.common;
    let (trained_on, run) = (cell.trained_on().to_string(), (cell.run, common.seed));
    row_of(study, &cell.id, &common.environment, &cell.method(), trained_on, run, &cell.config.table())
}

/// Returns a row that describes a training. The columns of its tests are empty.
fn row_of(
    study: &str,
    cell: &str,
    environment: &str,
    method: &Method,
    trained_on: String,
    (run, seed): (u32, u64),
    settings: &toml::Table,
) -> TableRow {
    TableRow {
        schema_version: SCHEMA_VERSION,
        study: study.to_owned(),
        cell: cell.to_owned(),
        environment: environment.to_owned(),
        revision: None,
        model_hash: None,
        algorithm: method.algorithm.clone(),
        architecture: method.architecture.clone(),
        preset: method.preset.to_string(),
        observe: method.observe.to_string(),
        trained_on,
        tested_on: None,
        run,
        seed,
        after_episodes: None,
        episodes: None,
        successes: None,
        mean_return: None,
        mean_length: None,
        cvar_10: None,
        timesteps: None,
        seconds: None,
        commit: String::new(),
        settings: serde_json::to_string(settings).unwrap_or_default(), // a table of numbers and texts is always JSON
        checksum: None,
        failure: None,
    }
}

#[cfg(test)]
#[path = "export_tests.rs"]
mod tests;
