//! The results of studies as one table: a row for each cell, test set and tested policy of its training.
//!
//! `docs/results-table.md` describes every column.

mod columns;

use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Path, PathBuf};

use perturb_files::{FileError, read_if_there, write_atomically};
use serde::{Deserialize, Serialize};

use crate::parquet_file::{ParquetFile, encode, one_group};
use crate::results::TestResult;
use crate::statistics::wilson;

/// Version of the columns. Raised when older programs could misread a table.
pub const SCHEMA_VERSION: u32 = 1;
/// The name of the schema in the file.
const MESSAGE: &str = "results";

/// The results of studies.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResultsTable {
    /// The plans of the studies, by the studies' names.
    pub studies: BTreeMap<String, StudyPlan>,
    /// The rows of a cell stand together.
    rows: Vec<TableRow>,
}

/// The experiment file of a study, so that reports need no other file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StudyPlan {
    /// The text of the experiment file.
    pub plan: String,
    /// The files that it names, by their names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub beside: BTreeMap<String, String>,
}

/// A test of a policy, or a failed cell.
#[derive(Clone, Debug, PartialEq)]
pub struct TableRow {
    /// Version of the columns when the row was written.
    pub schema_version: u32,
    /// The study's name.
    pub study: String,
    /// The cell's id.
    pub cell: String,
    /// The environment's name.
    pub environment: String,
    /// The environment's revision; `None` for a failed cell.
    pub revision: Option<u64>,
    /// SHA-256 of the environment's model; `None` without one.
    pub model_hash: Option<String>,
    /// The algorithm's name.
    pub algorithm: String,
    /// "ff" or "rc".
    pub architecture: String,
    /// The origin of the default settings.
    pub preset: String,
    /// The observed quantities.
    pub observe: String,
    /// The name of the set or version that it was trained on.
    pub trained_on: String,
    /// The name of the set or version of the test; `None` for a failed cell.
    pub tested_on: Option<String>,
    /// The run, from 1.
    pub run: u32,
    /// The seed of the training and of the test.
    pub seed: u64,
    /// Episodes of training before the test: the mark of an intermediate policy, or the length of the whole training.
    pub after_episodes: Option<u64>,
    /// Number of test episodes.
    pub episodes: Option<u64>,
    /// Number of successful test episodes.
    pub successes: Option<u64>,
    /// Mean undiscounted return.
    pub mean_return: Option<f64>,
    /// Mean length of episodes, in steps.
    pub mean_length: Option<f64>,
    /// Mean of the worst tenth of returns; `None` if the episodes were not recorded.
    pub cvar_10: Option<f64>,
    /// Steps of training before the test, of all environments together.
    pub timesteps: Option<u64>,
    /// Duration of the cell with all its tests, in s.
    pub seconds: Option<f64>,
    /// Versions of the programs that trained and tested, joined by "; ".
    pub commit: String,
    /// All settings of the training, as a JSON object.
    pub settings: String,
    /// SHA-256 of the test's episodes; `None` if they were not recorded.
    pub checksum: Option<String>,
    /// Why the cell failed; `None` for a result.
    pub failure: Option<String>,
}

/// Numbers of cells that a merge added and changed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MergeCounts {
    /// Cells that were not in the table.
    pub added: usize,
    /// Cells whose rows were replaced by others.
    pub replaced: usize,
    /// Cells whose rows were there already.
    pub unchanged: usize,
}

/// Why a table of results cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum TableError {
    /// The operating system refused the file.
    #[error(transparent)]
    File(#[from] FileError),
    #[error("there is no results table {}: give a file that `perturb export` wrote", path.display())]
    Missing { path: PathBuf },
    #[error("{} is no results table: {reason}; give a file that `perturb export` wrote", path.display())]
    Damaged { path: PathBuf, reason: String },
    #[error(
        "{} has schema version {version}, this program reads 1 to {SCHEMA_VERSION}: use the version of perturb that \
         wrote it",
        path.display()
    )]
    Newer { path: PathBuf, version: u32 },
}

/// The JSON document in the file's metadata.
#[derive(Serialize, Deserialize)]
struct TableMetadata {
    schema_version: u32,
    studies: BTreeMap<String, StudyPlan>,
}

impl ResultsTable {
    /// Reads the table in `path`.
    ///
    /// # Errors
    /// [`TableError`].
    pub fn read(path: &Path) -> Result<Self, TableError> {
        Self::read_if_there(path)?.ok_or_else(|| TableError::Missing { path: path.to_owned() })
    }

    /// Reads the table in `path`; `None` if there is no such file.
    ///
    /// # Errors
    /// [`TableError`].
    pub fn read_if_there(path: &Path) -> Result<Option<Self>, TableError> {
        let Some(content) = read_if_there(path)? else { return Ok(None) };
        let damaged = |reason: String| TableError::Damaged { path: path.to_owned(), reason };
        if content.is_empty() || ParquetFile::is_other(&content) {
            return Err(damaged("it is no Parquet file".into()));
        }
        let file = ParquetFile::open(content).map_err(|error| damaged(error.to_string()))?;
        let not_understood = |error: serde_json::Error| damaged(format!("its metadata are not understood: {error}"));
        let TableMetadata { schema_version: version, studies } =
            serde_json::from_str(file.about()).map_err(not_understood)?;
        if !(1..=SCHEMA_VERSION).contains(&version) {
            return Err(TableError::Newer { path: path.to_owned(), version });
        }
        let rows = columns::decode(&file).map_err(|error| damaged(error.to_string()))?;
        Ok(Some(Self { studies, rows }))
    }

    /// Writes the table, complete or not at all.
    ///
    /// # Errors
    /// [`TableError`].
    pub fn write(&self, path: &Path) -> Result<(), TableError> {
        let damaged = |reason: String| TableError::Damaged { path: path.to_owned(), reason };
        let about = TableMetadata { schema_version: SCHEMA_VERSION, studies: self.studies.clone() };
        let about = serde_json::to_string(&about).map_err(|error| damaged(error.to_string()))?;
        let columns = self.columns();
        let content =
            encode(MESSAGE, &columns, about, &one_group(&columns)).map_err(|error| damaged(error.to_string()))?;
        Ok(write_atomically(path, &content)?)
    }

    /// Returns all rows. Those of a cell stand together.
    pub fn rows(&self) -> &[TableRow] {
        &self.rows
    }

    /// Returns the rows of a study by its cells' ids.
    pub fn of_study(&self, study: &str) -> HashMap<&str, Vec<&TableRow>> {
        let mut cells: HashMap<&str, Vec<&TableRow>> = HashMap::new();
        for row in self.rows.iter().filter(|row| row.study == study) {
            cells.entry(&row.cell).or_default().push(row);
        }
        cells
    }

    /// Adds the rows of a study's cells. The rows of a cell replace those that the table had. A value that the new row
    /// lacks, because a file is gone, is kept from the old one.
    pub fn merge(&mut self, study: &str, plan: StudyPlan, rows: Vec<TableRow>) -> MergeCounts {
        self.studies.insert(study.to_owned(), plan);
        let mut counts = MergeCounts::default();
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
        let mut written = HashSet::new();
        let mut all = Vec::with_capacity(self.rows.len() + added.len());
        for row in std::mem::take(&mut self.rows) {
            match replacements.get(&row.cell).filter(|_| row.study == study) {
                None => all.push(row),
                Some(block) if written.insert(row.cell.clone()) => all.extend(block.iter().cloned()),
                Some(_) => {}
            }
        }
        // A study's new cells follow its other cells.
        let end = all.iter().rposition(|row| row.study == study).map_or(all.len(), |last| last + 1);
        all.splice(end..end, added);
        self.rows = all;
        counts
    }
}

impl TableRow {
    /// Returns the figures of the test; `None` for a failed cell.
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

    /// Takes over values that follow from files that may have been deleted, if the same test has them in `earlier`.
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
