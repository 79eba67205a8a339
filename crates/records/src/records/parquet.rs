//! Recorded episodes as a Parquet file, with a row for each episode and metadata as JSON.

use std::path::{Path, PathBuf};

use perturb_files::{AnyError, FileError, read_if_exists, write_atomically};

use super::{Ending, EpisodeRecord, Records, RecordsMetadata};
use crate::parquet_file::{ParquetFile, RowGroup, encode, one_group};

/// The name of the file with recorded episodes, in the folder that has the test's results.
pub const FILE: &str = "episodes.parquet";
/// The name of the Parquet schema.
const MESSAGE: &str = "episodes";

/// A failure to read or write recorded episodes.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum RecordsError {
    /// The operating system could not read or write the file.
    #[error(transparent)]
    File(#[from] FileError),
    /// The file does not exist.
    #[error("there are no recorded episodes in {}", path.display())]
    Missing { path: PathBuf },
    /// The file is not a Parquet file.
    #[error(
        "{} does not contain recorded episodes: it is not a Parquet file; give the --records of `perturb evaluate`, or \
         a cell of `perturb run`",
        path.display()
    )]
    Other { path: PathBuf },
    /// The file is damaged, or another program wrote it.
    #[error("{} does not contain recorded episodes: {reason}", path.display())]
    Damaged {
        path: PathBuf,
        /// A description of the fault.
        reason: String,
    },
}

impl Records {
    /// Writes the file atomically.
    ///
    /// # Errors
    /// [`RecordsError`] if the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), RecordsError> {
        let failed = |error: AnyError| RecordsError::Damaged { path: path.to_owned(), reason: error.to_string() };
        Ok(write_atomically(path, &self.encode().map_err(failed)?)?)
    }

    fn encode(&self) -> Result<Vec<u8>, AnyError> {
        let columns = self.columns();
        encode(MESSAGE, &columns, serde_json::to_string(&self.about)?, &one_group(&columns))
    }

    /// Reads the file.
    ///
    /// # Errors
    /// [`RecordsError`] if the file does not exist, is not a Parquet file or is damaged.
    pub fn read(path: &Path) -> Result<Self, RecordsError> {
        let content = read_if_exists(path)?.ok_or_else(|| RecordsError::Missing { path: path.to_owned() })?;
        if ParquetFile::is_other(&content) {
            return Err(RecordsError::Other { path: path.to_owned() });
        }
        let damaged = |error: AnyError| RecordsError::Damaged { path: path.to_owned(), reason: error.to_string() };
        Self::decode(content).map_err(damaged)
    }

    fn decode(content: Vec<u8>) -> Result<Self, AnyError> {
        let file = ParquetFile::open(content)?;
        let mut records = Self::new(serde_json::from_str(file.about())?);
        file.require(MESSAGE, &records.columns())?;
        for group in 0..file.groups() {
            records.episodes.extend(episodes(&records.about, &file.group(group)?)?);
        }
        Ok(records)
    }
}

/// Reads the episodes of a row group. Its columns are those of [`Records::columns`].
fn episodes(about: &RecordsMetadata, group: &RowGroup<'_>) -> Result<Vec<EpisodeRecord>, AnyError> {
    let (parameters, quantities) = (about.parameters.len(), about.applied.len());
    let columns = |first: usize, count: usize| (first..first + count).map(|place| group.numbers(place));
    let mut sets = group.texts(0)?;
    let (seeds, environments, indices) = (group.unsigned_64(1)?, group.unsigned_32(2)?, group.unsigned_64(3)?);
    let requested = columns(4, parameters).collect::<Result<Vec<_>, _>>()?;
    let applied = columns(4 + parameters, quantities).collect::<Result<Vec<_>, _>>()?;
    let next = 4 + parameters + quantities;
    let mut hashes = group.texts(next)?;
    let (returns, lengths, successes) =
        (group.numbers(next + 1)?, group.unsigned_32(next + 2)?, group.flags(next + 3)?);
    let endings = group.texts(next + 4)?;
    let achieved = group.optional_numbers(next + 5)?;
    let also_achieved = about.also.as_ref().map(|_| group.optional_numbers(next + 6)).transpose()?;
    let episode = |row: usize| {
        let of_row = |columns: &[Vec<f64>]| columns.iter().map(|column| column[row]).collect();
        Ok(EpisodeRecord {
            set: std::mem::take(&mut sets[row]),
            seed: seeds[row],
            environment_index: environments[row],
            episode_index: indices[row],
            requested: of_row(&requested),
            applied: of_row(&applied),
            model_hash: std::mem::take(&mut hashes[row]),
            episode_return: returns[row],
            length: lengths[row],
            success: successes[row],
            ending: Ending::from_name(&endings[row])?,
            achieved: achieved[row],
            also_achieved: also_achieved.as_ref().and_then(|also| also[row]),
        })
    };
    (0..group.rows()).map(episode).collect()
}
