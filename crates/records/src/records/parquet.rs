//! Recorded episodes as a Parquet file: a row an episode, a column a quantity, and what they have in common as JSON in
//! the file's metadata, under the key `perturb`.
//!
//! Parquet, because pandas, polars, DuckDB and R read it without us, with types and units of 64 bits, at about half the
//! size of CSV; and because its Rust implementation is Apache's own. The same records give the same bytes.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use parquet::basic::Compression;
use parquet::column::reader::get_typed_column_reader;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, Int32Type, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::reader::{FileReader, RowGroupReader, SerializedFileReader};
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter};
use parquet::schema::parser::parse_message_type;
use parquet::schema::types::Type;
use perturb_files::{AnyError, FileError, checksum, read_if_there, write_atomically};

use super::{ColumnValues, Ending, EpisodeRecord, Records, RecordsMetadata};

/// The name of the records file beside a result.
pub const FILE: &str = "episodes.parquet";
/// The key of [`RecordsMetadata`] in the file's metadata.
const KEY: &str = "perturb";
/// The first and last bytes of a Parquet file.
const MAGIC: &[u8] = b"PAR1";

/// Why records cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum RecordsError {
    /// The operating system refused the file.
    #[error(transparent)]
    File(#[from] FileError),
    /// There is no such file.
    #[error("there are no recorded episodes in {}", path.display())]
    Missing { path: PathBuf },
    /// The file is of another kind.
    #[error(
        "{} holds no recorded episodes: it is no Parquet file; give the --records of `perturb evaluate`, or a cell of \
         `perturb run`",
        path.display()
    )]
    Other { path: PathBuf },
    /// The file is not what this program writes.
    #[error("{} does not hold recorded episodes: {reason}", path.display())]
    Damaged {
        path: PathBuf,
        /// The fault.
        reason: String,
    },
}

impl ColumnValues<'_> {
    /// Returns the column's type in the schema, before and after the column's name.
    fn kind(&self) -> (&'static str, &'static str) {
        match self {
            Self::Text(_) => ("required binary", " (STRING)"),
            Self::Unsigned64(_) => ("required int64", " (INTEGER(64,false))"),
            Self::Unsigned32(_) => ("required int32", " (INTEGER(32,false))"),
            Self::Flag(_) => ("required boolean", ""),
            Self::Number(_) => ("required double", ""),
            Self::Optional(_) => ("optional double", ""),
        }
    }

    fn write(&self, writer: &mut SerializedColumnWriter<'_>) -> Result<usize, ParquetError> {
        match self {
            Self::Text(texts) => {
                let texts: Vec<ByteArray> = texts.iter().map(|&text| text.into()).collect();
                writer.typed::<ByteArrayType>().write_batch(&texts, None, None)
            }
            // Parquet's unsigned numbers are signed ones of the same bits.
            Self::Unsigned64(numbers) => {
                let numbers: Vec<i64> = numbers.iter().map(|number| number.cast_signed()).collect();
                writer.typed::<Int64Type>().write_batch(&numbers, None, None)
            }
            Self::Unsigned32(numbers) => {
                let numbers: Vec<i32> = numbers.iter().map(|number| number.cast_signed()).collect();
                writer.typed::<Int32Type>().write_batch(&numbers, None, None)
            }
            Self::Flag(flags) => writer.typed::<BoolType>().write_batch(flags, None, None),
            Self::Number(numbers) => writer.typed::<DoubleType>().write_batch(numbers, None, None),
            Self::Optional(numbers) => {
                // Those that are there, and for each row whether it has one.
                let there: Vec<i16> = numbers.iter().map(|number| number.is_some().into()).collect();
                let numbers: Vec<f64> = numbers.iter().flatten().copied().collect();
                writer.typed::<DoubleType>().write_batch(&numbers, Some(&there), None)
            }
        }
    }
}

fn schema(columns: &[(String, ColumnValues<'_>)]) -> Result<Type, ParquetError> {
    let line = |(name, values): &(String, ColumnValues<'_>)| {
        let (kind, annotation) = values.kind();
        format!("{kind} {name}{annotation};")
    };
    let lines: Vec<String> = columns.iter().map(line).collect();
    parse_message_type(&format!("message episodes {{ {} }}", lines.join(" ")))
}

impl Records {
    /// Writes the file, complete or not at all.
    ///
    /// # Errors
    /// [`RecordsError`].
    pub fn write(&self, path: &Path) -> Result<(), RecordsError> {
        let failed = |error: AnyError| RecordsError::Damaged { path: path.to_owned(), reason: error.to_string() };
        Ok(write_atomically(path, &self.encode().map_err(failed)?)?)
    }

    fn encode(&self) -> Result<Vec<u8>, AnyError> {
        let columns = self.columns();
        let about = serde_json::to_string(&self.about)?;
        let properties = WriterProperties::builder()
            .set_compression(Compression::SNAPPY)
            .set_created_by("perturb".into())
            .set_key_value_metadata(Some(vec![KeyValue::new(KEY.into(), about)]))
            .build();
        let mut file = SerializedFileWriter::new(Vec::new(), Arc::new(schema(&columns)?), Arc::new(properties))?;
        let mut rows = file.next_row_group()?;
        for (_, values) in &columns {
            if let Some(mut writer) = rows.next_column()? {
                values.write(&mut writer)?;
                writer.close()?;
            }
        }
        rows.close()?;
        let mut file = file.into_inner()?;
        // Before the footer, whose length stands before the last four bytes: readers find everything by its offset.
        let footer = file.last_chunk::<8>().map_or(0, |end| 8 + u32::from_le_bytes([end[0], end[1], end[2], end[3]]));
        let place = file.len() - footer as usize;
        checksum::insert(&mut file, place);
        Ok(file)
    }

    /// Reads the file.
    ///
    /// # Errors
    /// [`RecordsError`].
    pub fn read(path: &Path) -> Result<Self, RecordsError> {
        let content = read_if_there(path)?.ok_or_else(|| RecordsError::Missing { path: path.to_owned() })?;
        let is_other = !content.is_empty() && !content.starts_with(MAGIC) && !content.ends_with(MAGIC);
        if is_other {
            return Err(RecordsError::Other { path: path.to_owned() });
        }
        let damaged = |error: AnyError| RecordsError::Damaged { path: path.to_owned(), reason: error.to_string() };
        Self::decode(content).map_err(damaged)
    }

    fn decode(content: Vec<u8>) -> Result<Self, AnyError> {
        // First of all: the decoder takes what has changed for what it says, and may panic.
        checksum::check(&content).map_err(|broken| format!("{broken}; give a copy that is whole, or test again"))?;
        let reader = SerializedFileReader::new(Bytes::from(content))?;
        let metadata = reader.metadata().file_metadata();
        let about = metadata.key_value_metadata().and_then(|pairs| pairs.iter().find(|pair| pair.key == KEY));
        let about = about.and_then(|pair| pair.value.as_ref());
        let about = about.ok_or_else(|| format!("its metadata have no `{KEY}`"))?;
        let mut records = Self::new(serde_json::from_str(about)?);
        let there = metadata.schema().get_fields();
        for (index, column) in schema(&records.columns())?.get_fields().iter().enumerate() {
            let name = column.name();
            match there.get(index) {
                Some(field) if field == column => {}
                Some(field) if field.name() == name => {
                    return Err(format!("the column {name} is of another type").into());
                }
                _ => return Err(format!("no column {name} in its place").into()),
            }
        }
        for group in 0..reader.num_row_groups() {
            records.episodes.extend(episodes(&records.about, &*reader.get_row_group(group)?)?);
        }
        Ok(records)
    }
}

/// The rows of a part of the file, whose columns are those of [`Records::columns`]: by columns, since row by row takes four times as
/// long, and a report reads millions.
fn episodes(about: &RecordsMetadata, group: &dyn RowGroupReader) -> Result<Vec<EpisodeRecord>, AnyError> {
    let mut columns = Columns { group, place: 0 };
    let mut sets = columns.texts()?;
    let (seeds, environments, indices) =
        (columns.all::<Int64Type>()?, columns.all::<Int32Type>()?, columns.all::<Int64Type>()?);
    let requested = columns.numbers(about.parameters.len())?;
    let applied = columns.numbers(about.applied.len())?;
    let mut hashes = columns.texts()?;
    let (returns, lengths, successes) =
        (columns.all::<DoubleType>()?, columns.all::<Int32Type>()?, columns.all::<BoolType>()?);
    let endings = columns.texts()?;
    let achieved = columns.optional()?;
    let also_achieved = about.also.as_ref().map(|_| columns.optional()).transpose()?;
    let episode = |row: usize| {
        let of_row = |columns: &[Vec<f64>]| columns.iter().map(|column| column[row]).collect();
        let ending = Ending::NAMED.into_iter().find(|(name, _)| *name == endings[row]);
        Ok(EpisodeRecord {
            set: std::mem::take(&mut sets[row]),
            seed: seeds[row].cast_unsigned(),
            environment_index: environments[row].cast_unsigned(),
            episode_index: indices[row].cast_unsigned(),
            requested: of_row(&requested),
            applied: of_row(&applied),
            model_hash: std::mem::take(&mut hashes[row]),
            episode_return: returns[row],
            length: lengths[row].cast_unsigned(),
            success: successes[row],
            ending: ending.ok_or_else(|| format!("an ending is `{}`", endings[row]))?.1,
            achieved: achieved[row],
            also_achieved: also_achieved.as_ref().and_then(|also| also[row]),
        })
    };
    (0..columns.rows()).map(episode).collect()
}

/// The columns of a part of the file, one after the other; their types are known to be right.
struct Columns<'a> {
    group: &'a dyn RowGroupReader,
    place: usize,
}

impl Columns<'_> {
    fn rows(&self) -> usize {
        usize::try_from(self.group.metadata().num_rows()).unwrap_or_default()
    }

    /// The values of the next column that are there and, if it is optional, which of its rows have one.
    fn next<T: DataType>(&mut self, is_optional: bool) -> Result<(Vec<T::T>, Vec<i16>), AnyError> {
        let mut reader = get_typed_column_reader::<T>(self.group.get_column_reader(self.place)?);
        self.place += 1;
        let (mut values, mut there, mut read) = (Vec::new(), Vec::new(), 0);
        while read < self.rows() {
            let levels = is_optional.then_some(&mut there);
            let (more, ..) = reader.read_records(self.rows() - read, levels, None, &mut values)?;
            if more == 0 {
                return Err(format!("column {} has {read} of {} rows", self.place, self.rows()).into());
            }
            read += more;
        }
        Ok((values, there))
    }

    /// Reads a column that has a value in each row.
    fn all<T: DataType>(&mut self) -> Result<Vec<T::T>, AnyError> {
        let (values, _) = self.next::<T>(false)?;
        Ok(values)
    }

    fn texts(&mut self) -> Result<Vec<String>, AnyError> {
        let texts = self.all::<ByteArrayType>()?;
        texts.iter().map(|text| Ok(text.as_utf8()?.to_owned())).collect()
    }

    /// Reads `count` columns.
    fn numbers(&mut self, count: usize) -> Result<Vec<Vec<f64>>, AnyError> {
        (0..count).map(|_| self.all::<DoubleType>()).collect()
    }

    fn optional(&mut self) -> Result<Vec<Option<f64>>, AnyError> {
        let (values, there) = self.next::<DoubleType>(true)?;
        let mut values = values.into_iter();
        Ok(there.into_iter().map(|there| if there == 1 { values.next() } else { None }).collect())
    }
}
