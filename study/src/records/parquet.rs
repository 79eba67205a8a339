//! Recorded episodes as a Parquet file: a row an episode, a column a quantity, and what they have in common as JSON in
//! the file's metadata, under the key `perturb`.
//!
//! Parquet, because pandas, polars, DuckDB and R read it without us, with types and units of 64 bits, at about half the
//! size of CSV; and because its Rust implementation is Apache's own. The same records give the same bytes.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use parquet::basic::Compression;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DoubleType, Int32Type, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter};
use parquet::record::{Field, Row};
use parquet::schema::parser::parse_message_type;

use super::{About, Ending, EpisodeRecord, Records};
use crate::files::{FileError, read_if_there, write_atomically};

/// What the file is called beside a result.
pub const FILE: &str = "episodes.parquet";
/// The key of [`About`] in the file's metadata.
const KEY: &str = "perturb";

/// Why records cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordsError {
    /// The operating system refused the file.
    #[error(transparent)]
    File(#[from] FileError),
    /// There is no such file.
    #[error("there are no recorded episodes in {}", path.display())]
    Missing {
        /// What was given.
        path: PathBuf,
    },
    /// The file is not what this program writes.
    #[error("{} does not hold recorded episodes: {reason}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// A column: its name in the file, and its values.
struct Column {
    name: String,
    values: Values,
}

enum Values {
    Text(fn(&EpisodeRecord) -> &str),
    Unsigned64(fn(&EpisodeRecord) -> u64),
    Unsigned32(fn(&EpisodeRecord) -> u32),
    Flag(fn(&EpisodeRecord) -> bool),
    Number(Box<dyn Fn(&EpisodeRecord) -> f64>),
    Optional(fn(&EpisodeRecord) -> Option<f64>),
}

impl Ending {
    fn as_str(self) -> &'static str {
        match self {
            Ending::Terminated => "terminated",
            Ending::Truncated => "truncated",
            Ending::Diverged => "diverged",
        }
    }
}

/// The columns of the tests that `about` describes, in order.
fn columns(about: &About) -> Vec<Column> {
    let column = |name: &str, values| Column { name: name.to_owned(), values };
    let numbers = |prefix: &str, index: usize, name: &str, of: fn(&EpisodeRecord) -> &Vec<f64>| Column {
        name: format!("{prefix}_{name}"),
        values: Values::Number(Box::new(move |episode| of(episode).get(index).copied().unwrap_or(f64::NAN))),
    };
    let mut columns = vec![
        column("set", Values::Text(|episode| &episode.set)),
        column("seed", Values::Unsigned64(|episode| episode.seed)),
        column("environment_index", Values::Unsigned32(|episode| episode.environment_index)),
        column("episode_index", Values::Unsigned64(|episode| episode.episode_index)),
    ];
    for (index, parameter) in about.parameters.iter().enumerate() {
        columns.push(numbers("requested", index, &parameter.name, |episode| &episode.requested));
    }
    for (index, name) in about.applied.iter().enumerate() {
        columns.push(numbers("applied", index, name, |episode| &episode.applied));
    }
    columns.extend([
        column("model_hash", Values::Text(|episode| &episode.model_hash)),
        column("return", Values::Number(Box::new(|episode| episode.episode_return))),
        column("length", Values::Unsigned32(|episode| episode.length)),
        column("success", Values::Flag(|episode| episode.success)),
        column("ending", Values::Text(|episode| episode.ending.as_str())),
        column("achieved", Values::Optional(|episode| episode.achieved)),
    ]);
    columns
}

impl Column {
    /// Its line of the file's schema.
    fn schema(&self) -> String {
        let (kind, annotation) = match self.values {
            Values::Text(_) => ("required binary", " (STRING)"),
            Values::Unsigned64(_) => ("required int64", " (INTEGER(64,false))"),
            Values::Unsigned32(_) => ("required int32", " (INTEGER(32,false))"),
            Values::Flag(_) => ("required boolean", ""),
            Values::Number(_) => ("required double", ""),
            Values::Optional(_) => ("optional double", ""),
        };
        format!("{kind} {}{annotation};", self.name)
    }

    fn write(&self, episodes: &[EpisodeRecord], writer: &mut SerializedColumnWriter<'_>) -> Result<(), ParquetError> {
        let rows = episodes.iter();
        match &self.values {
            Values::Text(of) => {
                let texts: Vec<ByteArray> = rows.map(|episode| of(episode).as_bytes().to_vec().into()).collect();
                writer.typed::<ByteArrayType>().write_batch(&texts, None, None)
            }
            // Parquet's unsigned numbers are signed ones of the same bits.
            Values::Unsigned64(of) => {
                let numbers: Vec<i64> = rows.map(|episode| of(episode).cast_signed()).collect();
                writer.typed::<Int64Type>().write_batch(&numbers, None, None)
            }
            Values::Unsigned32(of) => {
                let numbers: Vec<i32> = rows.map(|episode| of(episode).cast_signed()).collect();
                writer.typed::<Int32Type>().write_batch(&numbers, None, None)
            }
            Values::Flag(of) => {
                writer.typed::<BoolType>().write_batch(&rows.map(of).collect::<Vec<bool>>(), None, None)
            }
            Values::Number(of) => {
                writer.typed::<DoubleType>().write_batch(&rows.map(of).collect::<Vec<f64>>(), None, None)
            }
            Values::Optional(of) => {
                let there: Vec<i16> = rows.clone().map(|episode| i16::from(of(episode).is_some())).collect();
                let numbers: Vec<f64> = rows.filter_map(of).collect();
                writer.typed::<DoubleType>().write_batch(&numbers, Some(&there), None)
            }
        }
        .map(drop)
    }
}

impl Records {
    /// Writes the file, complete or not at all.
    ///
    /// # Errors
    /// [`RecordsError`].
    pub fn write(&self, path: &Path) -> Result<(), RecordsError> {
        let failed = |error: ParquetError| RecordsError::Damaged { path: path.to_owned(), reason: error.to_string() };
        Ok(write_atomically(path, &self.encode().map_err(failed)?)?)
    }

    fn encode(&self) -> Result<Vec<u8>, ParquetError> {
        let columns = columns(&self.about);
        let lines: Vec<String> = columns.iter().map(Column::schema).collect();
        let schema = Arc::new(parse_message_type(&format!("message episodes {{ {} }}", lines.join(" ")))?);
        let about = serde_json::to_string(&self.about).map_err(|error| ParquetError::External(error.into()))?;
        let properties = WriterProperties::builder()
            .set_compression(Compression::SNAPPY)
            .set_created_by("perturb".into())
            .set_key_value_metadata(Some(vec![KeyValue::new(KEY.into(), about)]))
            .build();
        let mut file = SerializedFileWriter::new(Vec::new(), schema, Arc::new(properties))?;
        let mut rows = file.next_row_group()?;
        for column in &columns {
            if let Some(mut writer) = rows.next_column()? {
                column.write(&self.episodes, &mut writer)?;
                writer.close()?;
            }
        }
        rows.close()?;
        file.into_inner()
    }

    /// Reads the file.
    ///
    /// # Errors
    /// [`RecordsError`].
    pub fn read(path: &Path) -> Result<Self, RecordsError> {
        let content = read_if_there(path)?.ok_or_else(|| RecordsError::Missing { path: path.to_owned() })?;
        Self::decode(content).map_err(|reason| RecordsError::Damaged { path: path.to_owned(), reason })
    }

    fn decode(content: Vec<u8>) -> Result<Self, String> {
        let words = |error: ParquetError| error.to_string();
        let reader = SerializedFileReader::new(Bytes::from(content)).map_err(words)?;
        let metadata = reader.metadata().file_metadata().key_value_metadata();
        let about = metadata.and_then(|pairs| pairs.iter().find(|pair| pair.key == KEY)?.value.as_ref());
        let about = about.ok_or_else(|| format!("its metadata have no `{KEY}`"))?;
        let about: About = serde_json::from_str(about).map_err(|error| error.to_string())?;
        let rows = reader.get_row_iter(None).map_err(words)?;
        let episodes = rows.map(|row| episode(&about, row.map_err(words)?)).collect::<Result<_, String>>()?;
        Ok(Self { about, episodes })
    }
}

/// A row of the file.
fn episode(about: &About, row: Row) -> Result<EpisodeRecord, String> {
    let mut row = Fields(row.into_columns().into_iter());
    Ok(EpisodeRecord {
        set: row.text("set")?,
        seed: row.unsigned("seed")?,
        environment_index: row.unsigned32("environment_index")?,
        episode_index: row.unsigned("episode_index")?,
        requested: about
            .parameters
            .iter()
            .map(|parameter| row.number(&format!("requested_{}", parameter.name)))
            .collect::<Result<_, _>>()?,
        applied: about.applied.iter().map(|name| row.number(&format!("applied_{name}"))).collect::<Result<_, _>>()?,
        model_hash: row.text("model_hash")?,
        episode_return: row.number("return")?,
        length: row.unsigned32("length")?,
        success: row.take("success", |field| match field {
            Field::Bool(flag) => Some(flag),
            _ => None,
        })?,
        ending: match row.text("ending")?.as_str() {
            "terminated" => Ending::Terminated,
            "truncated" => Ending::Truncated,
            "diverged" => Ending::Diverged,
            other => return Err(format!("an ending is `{other}`")),
        },
        achieved: row.take("achieved", |field| match field {
            Field::Null => Some(None),
            Field::Double(number) => Some(Some(number)),
            _ => None,
        })?,
    })
}

/// The fields of a row, taken in the order of the columns.
struct Fields(std::vec::IntoIter<(String, Field)>);

impl Fields {
    fn take<T>(&mut self, name: &str, of: impl FnOnce(Field) -> Option<T>) -> Result<T, String> {
        let (_, field) =
            self.0.next().filter(|(got, _)| got == name).ok_or_else(|| format!("no column {name} in its place"))?;
        of(field).ok_or_else(|| format!("the column {name} is of another type"))
    }

    fn text(&mut self, name: &str) -> Result<String, String> {
        self.take(name, |field| match field {
            Field::Str(text) => Some(text),
            _ => None,
        })
    }

    fn number(&mut self, name: &str) -> Result<f64, String> {
        self.take(name, |field| match field {
            Field::Double(number) => Some(number),
            _ => None,
        })
    }

    fn unsigned(&mut self, name: &str) -> Result<u64, String> {
        self.take(name, |field| match field {
            Field::ULong(number) => Some(number),
            _ => None,
        })
    }

    fn unsigned32(&mut self, name: &str) -> Result<u32, String> {
        self.take(name, |field| match field {
            Field::UInt(number) => Some(number),
            _ => None,
        })
    }
}
