//! A file with the recorded episodes of all policies of a study. Each policy has its own row group.
//!
//! The file omits the applied parameters, because they follow from the requested parameters and the environment. It
//! therefore takes a third of the space of the files that the trainings of the study wrote, one for each training. Each
//! row still has the episode's address (seed and indices) and all its results.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use perturb_files::{AnyError, read_if_exists, write_atomically};
use serde::{Deserialize, Serialize};

use crate::parquet_file::{ColumnValues, NamedColumn, ParquetFile, RowGroup, encode};
use crate::records::{Ending, EpisodeRecord, Records, RecordsError, RecordsMetadata};

/// The name of the Parquet schema.
const MESSAGE: &str = "study_episodes";

/// The recorded episodes of a study, by the id of the cell (a training with its tests). Applied parameters are omitted.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StudyEpisodes {
    cells: BTreeMap<String, Records>,
}

/// The JSON document in the Parquet file's metadata. It lists the policies in the order of the row groups.
#[derive(Serialize, Deserialize)]
struct StudyMetadata {
    policies: Vec<EpisodesEntry>,
}

#[derive(Serialize, Deserialize)]
struct EpisodesEntry {
    cell: String,
    about: RecordsMetadata,
}

impl StudyEpisodes {
    /// Returns the path of the episodes file of `study` in the `folder` of a results table.
    pub fn path(folder: &Path, study: &str) -> PathBuf {
        folder.join("episodes").join(format!("{}.parquet", study.replace('/', "-")))
    }

    /// Reads the file at `path`. Returns `None` if it does not exist.
    ///
    /// # Errors
    /// [`RecordsError`] if the file cannot be read, or has another format.
    pub fn read_if_exists(path: &Path) -> Result<Option<Self>, RecordsError> {
        let Some(content) = read_if_exists(path)? else { return Ok(None) };
        if ParquetFile::is_other(&content) {
            return Err(RecordsError::Other { path: path.to_owned() });
        }
        let damaged = |error: AnyError| RecordsError::Damaged { path: path.to_owned(), reason: error.to_string() };
        Self::decode(content).map(Some).map_err(damaged)
    }

    /// Writes the file atomically.
    ///
    /// # Errors
    /// [`RecordsError`] if the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), RecordsError> {
        let damaged = |error: AnyError| RecordsError::Damaged { path: path.to_owned(), reason: error.to_string() };
        Ok(write_atomically(path, &self.encode().map_err(damaged)?)?)
    }

    /// Returns the episodes of the policy that was trained in the cell with the id `cell`.
    pub fn of_cell(&self, cell: &str) -> Option<&Records> {
        self.cells.get(cell)
    }

    /// Returns the number of policies in the file.
    pub fn policies(&self) -> usize {
        self.cells.len()
    }

    /// Adds the episodes of a cell's policy without their applied parameters. Replaces the cell's earlier episodes.
    pub fn insert(&mut self, cell: &str, records: Records) {
        self.cells.insert(cell.to_owned(), without_applied(records));
    }

    /// Compares the recorded episodes of `cell` on test set `set` with `replayed`. Returns a description of the first
    /// episode that differs. Does not compare seeds and successes. Returns `None` if no episode differs, or if the file
    /// has no episodes of `cell`.
    pub fn first_difference(&self, cell: &str, set: &str, replayed: &Records) -> Option<String> {
        let replayed = without_applied(replayed.clone());
        let mut recorded = self.of_cell(cell)?.episodes_on(set);
        let mut again = replayed.episodes_on(set);
        loop {
            match (recorded.next(), again.next()) {
                (None, None) => return None,
                (Some(was), Some(is)) => {
                    if let Some(difference) = was.difference(is) {
                        return Some(difference);
                    }
                }
                (was, _) => {
                    let longer =
                        if was.is_some() { "the record has more episodes" } else { "the record has fewer episodes" };
                    return Some(format!("{set}: {longer}"));
                }
            }
        }
    }

    fn encode(&self) -> Result<Vec<u8>, AnyError> {
        let rows =
            || self.cells.iter().flat_map(|(cell, records)| records.episodes.iter().map(move |it| (cell, records, it)));
        let policy =
            |(cell, records): (&String, &Records)| EpisodesEntry { cell: cell.clone(), about: records.about.clone() };
        let about = StudyMetadata { policies: self.cells.iter().map(policy).collect() };
        // Computes the range of rows of each cell. Each range becomes a row group.
        let mut groups = Vec::new();
        let mut end = 0;
        for records in self.cells.values() {
            groups.push(end..end + records.episodes.len());
            end += records.episodes.len();
        }
        let texts = |of: fn(&EpisodeRecord) -> &str| ColumnValues::Text(rows().map(|(.., it)| of(it)).collect());
        let optional =
            |of: fn(&EpisodeRecord) -> Option<f64>| ColumnValues::Optional(rows().map(|(.., it)| of(it)).collect());
        let mut columns: Vec<NamedColumn<'_>> = vec![
            ("cell".into(), ColumnValues::Text(rows().map(|(cell, ..)| cell.as_str()).collect())),
            ("set".into(), texts(|it| &it.set)),
            ("seed".into(), ColumnValues::Unsigned64(rows().map(|(.., it)| it.seed).collect())),
            (
                "environment_index".into(),
                ColumnValues::Unsigned32(rows().map(|(.., it)| it.environment_index).collect()),
            ),
            ("episode_index".into(), ColumnValues::Unsigned64(rows().map(|(.., it)| it.episode_index).collect())),
            ("model_hash".into(), texts(|it| &it.model_hash)),
            ("return".into(), ColumnValues::Number(rows().map(|(.., it)| it.episode_return).collect())),
            ("length".into(), ColumnValues::Unsigned32(rows().map(|(.., it)| it.length).collect())),
            ("success".into(), ColumnValues::Flag(rows().map(|(.., it)| it.success).collect())),
            ("ending".into(), texts(|it| it.ending.name())),
            ("achieved".into(), optional(|it| it.achieved)),
            ("also_achieved".into(), optional(|it| it.also_achieved)),
        ];
        // Each parameter has a column. The column has no value in rows of environments without the parameter.
        for name in self.parameters() {
            let value = |(_, records, it): (&String, &Records, &EpisodeRecord)| {
                let place = records.about.parameters.iter().position(|parameter| parameter.name == name)?;
                it.requested.get(place).copied()
            };
            columns.push((requested(&name), ColumnValues::Optional(rows().map(value).collect())));
        }
        encode(MESSAGE, &columns, serde_json::to_string(&about)?, &groups)
    }

    /// Returns the sorted names of the parameters of all environments.
    fn parameters(&self) -> Vec<String> {
        let all = self.cells.values().flat_map(|records| &records.about.parameters);
        let mut names: Vec<String> = all.map(|parameter| parameter.name.clone()).collect();
        names.sort();
        names.dedup();
        names
    }

    fn decode(content: Vec<u8>) -> Result<Self, AnyError> {
        let file = ParquetFile::open(content)?;
        let StudyMetadata { policies } = serde_json::from_str(file.about())?;
        if policies.len() != file.groups() {
            return Err(format!("it has {} policies in {} row groups", policies.len(), file.groups()).into());
        }
        let mut cells = BTreeMap::new();
        for (index, EpisodesEntry { cell, about }) in policies.into_iter().enumerate() {
            let episodes = episodes(&about, &file.group(index)?)?;
            cells.insert(cell, Records { about, episodes });
        }
        Ok(Self { cells })
    }
}

fn requested(parameter: &str) -> String {
    format!("requested_{parameter}")
}

fn without_applied(mut records: Records) -> Records {
    records.about.applied.clear();
    records.episodes.iter_mut().for_each(|episode| episode.applied.clear());
    records
}

fn episodes(about: &RecordsMetadata, group: &RowGroup<'_>) -> Result<Vec<EpisodeRecord>, AnyError> {
    let place = |name: &str| group.column_index(name).ok_or_else(|| format!("it has no column {name}"));
    let mut sets = group.texts(place("set")?)?;
    let seeds = group.unsigned_64(place("seed")?)?;
    let environments = group.unsigned_32(place("environment_index")?)?;
    let indices = group.unsigned_64(place("episode_index")?)?;
    let mut hashes = group.texts(place("model_hash")?)?;
    let (returns, lengths) = (group.numbers(place("return")?)?, group.unsigned_32(place("length")?)?);
    let (successes, endings) = (group.flags(place("success")?)?, group.texts(place("ending")?)?);
    let achieved = group.optional_numbers(place("achieved")?)?;
    let also_achieved = group.optional_numbers(place("also_achieved")?)?;
    let parameter = |parameter: &crate::RecordedParameter| -> Result<_, AnyError> {
        group.optional_numbers(place(&requested(&parameter.name))?)
    };
    let parameters = about.parameters.iter().map(parameter).collect::<Result<Vec<_>, _>>()?;
    let episode = |row: usize| {
        Ok(EpisodeRecord {
            set: std::mem::take(&mut sets[row]),
            seed: seeds[row],
            environment_index: environments[row],
            episode_index: indices[row],
            requested: parameters.iter().map(|values| values[row].unwrap_or(f64::NAN)).collect(),
            applied: Vec::new(),
            model_hash: std::mem::take(&mut hashes[row]),
            episode_return: returns[row],
            length: lengths[row],
            success: successes[row],
            ending: Ending::from_name(&endings[row])?,
            achieved: achieved[row],
            also_achieved: also_achieved[row],
        })
    };
    (0..group.rows()).map(episode).collect()
}

#[cfg(test)]
#[path = "episodes_file_tests.rs"]
mod tests;
