//! The results of several studies in one table. It has a row for each test of each cell, where a cell is one training
//! with its tests.
//!
//! `docs/results-table.md` describes every column.

mod choice;
mod columns;

use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Path, PathBuf};

use perturb_files::{FileError, read_if_exists, write_atomically};
use serde::{Deserialize, Serialize};

use crate::parquet_file::{ParquetFile, encode, one_group};
use crate::results::TestResult;
use crate::statistics::wilson;
pub use choice::{NamedRows, RowFilter};

/// Version of the table's columns. Increase it when older programs could misread a table.
pub const SCHEMA_VERSION: u32 = 1;
/// The name of the test by which a configuration (settings of the training) is selected. Results and records contain
/// this name, so no parameter set may have it.
pub const SELECTION_TEST: &str = "selection";
/// The name of the Parquet schema.
const MESSAGE: &str = "results";

/// A table with the results of several studies.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResultsTable {
    /// The plan of each study, by the study's name.
    pub studies: BTreeMap<String, StudyPlan>,
    /// The rows. All rows of a cell are adjacent.
    rows: Vec<TableRow>,
}

/// The experiment file of a study. The table contains it so that reports need no other file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StudyPlan {
    /// The text of the experiment file.
    pub plan: String,
    /// The contents of the other files to which the experiment file refers, by file name.
    #[serde(rename = "beside", default, skip_serializing_if = "BTreeMap::is_empty")]
    pub csv_files: BTreeMap<String, String>,
}

/// A row of the table: the result of a test, or the failure of a cell, which is a training with its tests.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TableRow {
    /// Version of the columns when this row was written.
    pub schema_version: u32,
    /// The study's name.
    pub study: String,
    /// The id of the cell, within its study.
    pub cell: String,
    /// The environment's name.
    pub environment: String,
    /// The environment's revision; `None` for a failure.
    pub revision: Option<u64>,
    /// SHA-256 of the model's MJCF text, or of all files of the task folder that the server read. `None` if the
    /// environment has no model, and for a failure.
    pub model_hash: Option<String>,
    /// The algorithm's name.
    pub algorithm: String,
    /// The policy's architecture: "ff" (feed-forward) or "rc" (recurrent).
    pub architecture: String,
    /// The preset: the name of the set of default settings.
    pub preset: String,
    /// The quantities that the policy observes: "state" or "parameters".
    pub observe: String,
    /// The name of the parameter set or version that the policy was trained on.
    pub trained_on: String,
    /// The name of the parameter set or version of the test. `None` for a failure.
    pub tested_on: Option<String>,
    /// The number of the run, from 1. A study is run several times, with a different seed in each run.
    pub run: u32,
    /// The seed of the training and of the test.
    pub seed: u64,
    /// Number of training episodes before the test. It is smaller than the whole training if an intermediate policy was
    /// tested. `None` for a failure.
    pub after_episodes: Option<u64>,
    /// Number of test episodes.
    pub episodes: Option<u64>,
    /// Number of successful test episodes.
    pub successes: Option<u64>,
    /// Mean undiscounted return.
    pub mean_return: Option<f64>,
    /// Mean number of steps of the test episodes.
    pub mean_length: Option<f64>,
    /// Mean of the lowest tenth of returns; `None` if the episodes were not recorded.
    pub cvar_10: Option<f64>,
    /// Number of training steps before the test, summed over all environments.
    pub timesteps: Option<u64>,
    /// Duration of the cell's training and tests, in s.
    pub seconds: Option<f64>,
    /// Versions of the programs that trained and tested, separated by "; ".
    pub commit: String,
    /// All settings of the training, as a JSON object.
    pub settings: String,
    /// SHA-256 of the test's episodes; `None` if they were not recorded.
    pub checksum: Option<String>,
    /// The error message of a failure; `None` for a result.
    pub failure: Option<String>,
}

/// The numbers of cells (trainings with their tests) that a merge added, replaced and left unchanged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MergeCounts {
    /// Number of cells that were not in the table before.
    pub added: usize,
    /// Number of cells whose rows in the table were replaced.
    pub replaced: usize,
    /// Number of cells whose rows were already in the table.
    pub unchanged: usize,
}

/// A failure to read or write a results table.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum TableError {
    /// The operating system could not read or write the file.
    #[error(transparent)]
    File(#[from] FileError),
    #[error("there is no results table {}: give a file that `perturb export` wrote", path.display())]
    Missing { path: PathBuf },
    #[error("{} is not a results table: {reason}; give a file that `perturb export` wrote", path.display())]
    Damaged { path: PathBuf, reason: String },
    #[error(
        "{} has schema version {version}, this program reads 1 to {SCHEMA_VERSION}: use the version of perturb that \
         wrote it",
        path.display()
    )]
    Newer { path: PathBuf, version: u32 },
}

/// The JSON document in the Parquet file's metadata.
#[derive(Serialize, Deserialize)]
struct TableMetadata {
    schema_version: u32,
    studies: BTreeMap<String, StudyPlan>,
}

impl ResultsTable {
    /// Reads the table at `path`.
    ///
    /// # Errors
    /// [`TableError`] if the file is missing, damaged or too new.
    pub fn read(path: &Path) -> Result<Self, TableError> {
        Self::read_if_exists(path)?.ok_or_else(|| TableError::Missing { path: path.to_owned() })
    }

    /// Reads the table at `path`. Returns `None` if the file does not exist.
    ///
    /// # Errors
    /// [`TableError`] if the file is damaged or too new.
    pub fn read_if_exists(path: &Path) -> Result<Option<Self>, TableError> {
        let Some(content) = read_if_exists(path)? else { return Ok(None) };
        let damaged = |reason: String| TableError::Damaged { path: path.to_owned(), reason };
        if content.is_empty() || ParquetFile::is_other(&content) {
            return Err(damaged("it is not a Parquet file".into()));
        }
        let file = ParquetFile::open(content).map_err(|error| damaged(error.to_string()))?;
        let not_understood = |error: serde_json::Error| damaged(format!("its metadata cannot be parsed: {error}"));
        let TableMetadata { schema_version: version, studies } =
            serde_json::from_str(file.about()).map_err(not_understood)?;
        if !(1..=SCHEMA_VERSION).contains(&version) {
            return Err(TableError::Newer { path: path.to_owned(), version });
        }
        let rows = columns::decode(&file).map_err(|error| damaged(error.to_string()))?;
        Ok(Some(Self { studies, rows }))
    }

    /// Reads the table that `path` names. `path` has the form FILE.parquet or FILE.parquet/STUDY. Returns the path of
    /// the file, the table, and the study's name, which is empty if `path` has none. The table may lack this study.
    /// Returns `None` if no part of `path` is a Parquet file.
    ///
    /// # Errors
    /// [`TableError`] if the table is damaged or too new.
    pub fn find(path: &Path) -> Result<Option<(PathBuf, Self, String)>, TableError> {
        let is_table = |path: &&Path| path.extension().is_some_and(|ending| ending == "parquet") && path.is_file();
        let Some(file) = path.ancestors().find(is_table) else { return Ok(None) };
        let study = path.strip_prefix(file).unwrap_or(Path::new("")).display().to_string();
        Ok(Some((file.to_owned(), Self::read(file)?, study)))
    }

    /// Writes the table atomically.
    ///
    /// # Errors
    /// [`TableError`] if the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), TableError> {
        let damaged = |reason: String| TableError::Damaged { path: path.to_owned(), reason };
        let about = TableMetadata { schema_version: SCHEMA_VERSION, studies: self.studies.clone() };
        let about = serde_json::to_string(&about).map_err(|error| damaged(error.to_string()))?;
        let columns = self.columns();
        let content =
            encode(MESSAGE, &columns, about, &one_group(&columns)).map_err(|error| damaged(error.to_string()))?;
        Ok(write_atomically(path, &content)?)
    }

    /// Returns all rows. The rows of one training and its tests are adjacent.
    pub fn rows(&self) -> &[TableRow] {
        &self.rows
    }

    /// Returns the rows of a study, grouped by the id of their cell.
    pub fn of_study(&self, study: &str) -> HashMap<&str, Vec<&TableRow>> {
        let mut cells: HashMap<&str, Vec<&TableRow>> = HashMap::new();
        for row in self.rows.iter().filter(|row| row.study == study) {
            cells.entry(&row.cell).or_default().push(row);
        }
        cells
    }

    /// Adds `rows` of a study's cells to the table. The new rows replace earlier rows of the same cells. If a new row
    /// lacks a value because a file was deleted, the earlier value is kept.
    pub fn merge(&mut self, study: &str, plan: StudyPlan, rows: Vec<TableRow>) -> MergeCounts {
        self.studies.insert(study.to_owned(), plan);
        let mut counts = MergeCounts::default();
        // Groups the new rows (`blocks`) and the table's rows (`earlier`) by cell.
        let mut blocks: Vec<Vec<TableRow>> = Vec::new();
        for row in rows {
            match blocks.last_mut().filter(|block| block[0].cell == row.cell) {
                Some(block) => block.push(row),
                None => blocks.push(vec![row]),
            }
        }
        let mut earlier: HashMap<String, Vec<TableRow>> = HashMap::new();
        for row in self.rows.iter().filter(|row| row.study == study) {
            earlier.entry(row.cell.clone()).or_default().push(row.clone());
        }
        // Sorts the new rows into cells to add and cells to replace.
        let mut replacements: HashMap<String, Vec<TableRow>> = HashMap::new();
        let mut added = Vec::new();
        for mut block in blocks {
            let cell = block[0].cell.clone();
            let Some(before) = earlier.get(&cell) else {
                counts.added += 1;
                added.extend(block);
                continue;
            };
            block.iter_mut().for_each(|row| row.keep_from(before));
            if block == *before {
                counts.unchanged += 1;
            } else {
                counts.replaced += 1;
                replacements.insert(cell, block);
            }
        }
        // Replaces the old rows of each replaced cell by its new rows, at the position of the first old row.
        let mut written = HashSet::new();
        let mut all = Vec::with_capacity(self.rows.len() + added.len());
        for row in std::mem::take(&mut self.rows) {
            match replacements.get(&row.cell).filter(|_| row.study == study) {
                None => all.push(row),
                Some(block) if written.insert(row.cell.clone()) => all.extend(block.iter().cloned()),
                Some(_) => {}
            }
        }
        // New cells of a study are inserted after its other cells.
        let end = all.iter().rposition(|row| row.study == study).map_or(all.len(), |last| last + 1);
        all.splice(end..end, added);
        self.rows = all;
        counts
    }
}

impl TableRow {
    /// Returns the result of the test; `None` if the row is a failure.
    pub fn result(&self) -> Option<TestResult> {
        let (episodes, successes) = (self.episodes?, self.successes?);
        let (low, high) = wilson(successes, episodes);
        Some(TestResult {
            episodes,
            success_percent: 100.0 * successes as f64 / episodes as f64,
            success_percent_95: [100.0 * low, 100.0 * high],
            mean_return: self.mean_return?,
            mean_length: self.mean_length?,
        })
    }

    /// Copies missing values from the row of the same test in `earlier`. These values are computed from files that may
    /// have been deleted.
    fn keep_from(&mut self, earlier: &[Self]) {
        let key = |row: &Self| (row.tested_on.clone(), row.after_episodes, row.successes, row.failure.is_some());
        let Some(before) = earlier.iter().find(|row| key(row) == key(self)) else { return };
        if before.mean_return != self.mean_return || before.mean_length != self.mean_length {
            return;
        }
        self.cvar_10 = self.cvar_10.or(before.cvar_10);
        self.seconds = self.seconds.or(before.seconds);
        self.checksum = self.checksum.take().or_else(|| before.checksum.clone());
    }
}

#[cfg(test)]
mod tests;
