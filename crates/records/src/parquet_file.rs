//! Reading and writing of Parquet files: named columns, and a JSON document in the file's metadata.
//!
//! Parquet was chosen because pandas, polars, DuckDB and R can read it without perturb. It has types, including 64-bit
//! integers, and takes about half the space of CSV. The Rust implementation that is used here is Apache's own. Equal
//! columns give equal bytes.

use std::ops::Range;
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
use perturb_files::{AnyError, checksum};

/// The key under which the JSON document is stored in the file's metadata.
const KEY: &str = "perturb";
/// The bytes with which every Parquet file begins and ends.
const MAGIC: &[u8] = b"PAR1";
/// Maximum size of a column's dictionary of distinct texts, in bytes. When the dictionary is full, the following rows
/// contain their whole text instead of an index into the dictionary.
const MAX_DICTIONARY_BYTES: usize = 8 << 20;

/// The values of a column, one for each row.
#[derive(Clone, Debug, PartialEq)]
pub enum ColumnValues<'a> {
    /// Texts, such as names.
    Text(Vec<&'a str>),
    /// Texts that are missing in some rows.
    OptionalText(Vec<Option<&'a str>>),
    /// 64-bit unsigned integers, such as seeds and indices.
    Unsigned64(Vec<u64>),
    /// 64-bit unsigned integers that are missing in some rows, such as counts.
    OptionalUnsigned64(Vec<Option<u64>>),
    /// 32-bit unsigned integers, such as numbers of steps.
    Unsigned32(Vec<u32>),
    /// Booleans.
    Flag(Vec<bool>),
    /// Floating-point numbers.
    Number(Vec<f64>),
    /// Floating-point numbers that are missing in some rows.
    Optional(Vec<Option<f64>>),
}

/// The name and the values of a column.
pub(crate) type NamedColumn<'a> = (String, ColumnValues<'a>);

impl ColumnValues<'_> {
    /// Returns the column's type in Parquet's schema language: the texts before and after the column's name.
    fn kind(&self) -> (&'static str, &'static str) {
        match self {
            Self::Text(_) => ("required binary", " (STRING)"),
            Self::OptionalText(_) => ("optional binary", " (STRING)"),
            Self::Unsigned64(_) => ("required int64", " (INTEGER(64,false))"),
            Self::OptionalUnsigned64(_) => ("optional int64", " (INTEGER(64,false))"),
            Self::Unsigned32(_) => ("required int32", " (INTEGER(32,false))"),
            Self::Flag(_) => ("required boolean", ""),
            Self::Number(_) => ("required double", ""),
            Self::Optional(_) => ("optional double", ""),
        }
    }

    /// Returns the number of rows.
    fn len(&self) -> usize {
        match self {
            Self::Text(values) => values.len(),
            Self::OptionalText(values) => values.len(),
            Self::Unsigned64(values) => values.len(),
            Self::OptionalUnsigned64(values) => values.len(),
            Self::Unsigned32(values) => values.len(),
            Self::Flag(values) => values.len(),
            Self::Number(values) => values.len(),
            Self::Optional(values) => values.len(),
        }
    }

    /// Returns the value in `row` as text, or an empty text if it is missing.
    pub(crate) fn value_text(&self, row: usize) -> String {
        fn optional<T: ToString>(value: Option<T>) -> String {
            value.map_or_else(String::new, |value| value.to_string())
        }
        match self {
            Self::Text(values) => values[row].to_owned(),
            Self::OptionalText(values) => optional(values[row]),
            Self::Unsigned64(values) => values[row].to_string(),
            Self::OptionalUnsigned64(values) => optional(values[row]),
            Self::Unsigned32(values) => values[row].to_string(),
            Self::Flag(values) => values[row].to_string(),
            Self::Number(values) => values[row].to_string(),
            Self::Optional(values) => optional(values[row]),
        }
    }

    /// Writes the values of the range `rows`. Returns the number of values that are not missing.
    fn write(&self, rows: Range<usize>, writer: &mut SerializedColumnWriter<'_>) -> Result<usize, ParquetError> {
        match self {
            Self::Text(texts) => {
                let texts: Vec<ByteArray> = texts[rows].iter().map(|&text| text.into()).collect();
                writer.typed::<ByteArrayType>().write_batch(&texts, None, None)
            }
            Self::OptionalText(texts) => {
                let texts = &texts[rows];
                let known: Vec<ByteArray> = texts.iter().flatten().map(|&text| text.into()).collect();
                writer.typed::<ByteArrayType>().write_batch(&known, Some(&levels(texts)), None)
            }
            // Parquet stores an unsigned integer as the signed integer with the same bits.
            Self::Unsigned64(numbers) => {
                let numbers: Vec<i64> = numbers[rows].iter().map(|number| number.cast_signed()).collect();
                writer.typed::<Int64Type>().write_batch(&numbers, None, None)
            }
            Self::OptionalUnsigned64(numbers) => {
                let numbers = &numbers[rows];
                let known: Vec<i64> = numbers.iter().flatten().map(|number| number.cast_signed()).collect();
                writer.typed::<Int64Type>().write_batch(&known, Some(&levels(numbers)), None)
            }
            Self::Unsigned32(numbers) => {
                let numbers: Vec<i32> = numbers[rows].iter().map(|number| number.cast_signed()).collect();
                writer.typed::<Int32Type>().write_batch(&numbers, None, None)
            }
            Self::Flag(flags) => writer.typed::<BoolType>().write_batch(&flags[rows], None, None),
            Self::Number(numbers) => writer.typed::<DoubleType>().write_batch(&numbers[rows], None, None),
            Self::Optional(numbers) => {
                let numbers = &numbers[rows];
                let known: Vec<f64> = numbers.iter().flatten().copied().collect();
                writer.typed::<DoubleType>().write_batch(&known, Some(&levels(numbers)), None)
            }
        }
    }
}

/// Returns Parquet's definition levels: 1 for each row with a value, and 0 for each row without a value.
fn levels<T>(values: &[Option<T>]) -> Vec<i16> {
    values.iter().map(|value| value.is_some().into()).collect()
}

fn schema(message: &str, columns: &[NamedColumn<'_>]) -> Result<Type, ParquetError> {
    let line = |(name, values): &NamedColumn<'_>| {
        let (kind, annotation) = values.kind();
        format!("{kind} {name}{annotation};")
    };
    let lines: Vec<String> = columns.iter().map(line).collect();
    parse_message_type(&format!("message {message} {{ {} }}", lines.join(" ")))
}

/// Encodes `columns` as a Parquet file. `message` is the schema's name, and `about` the JSON document in the metadata.
/// Each range of `groups` becomes a row group.
pub(crate) fn encode(
    message: &str,
    columns: &[NamedColumn<'_>],
    about: String,
    groups: &[Range<usize>],
) -> Result<Vec<u8>, AnyError> {
    let properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_dictionary_page_size_limit(MAX_DICTIONARY_BYTES)
        .set_created_by("perturb".into())
        .set_key_value_metadata(Some(vec![KeyValue::new(KEY.into(), about)]))
        .build();
    let mut file = SerializedFileWriter::new(Vec::new(), Arc::new(schema(message, columns)?), Arc::new(properties))?;
    for group in groups {
        let mut rows = file.next_row_group()?;
        for (_, values) in columns {
            if let Some(mut writer) = rows.next_column()? {
                values.write(group.clone(), &mut writer)?;
                writer.close()?;
            }
        }
        rows.close()?;
    }
    let mut file = file.into_inner()?;
    // Inserts a checksum before the footer. This leaves the file readable, because readers find the footer from the
    // end, and everything else by its offset. The footer's length is in the first four of the last eight bytes.
    let footer = file.last_chunk::<8>().map_or(0, |end| 8 + u32::from_le_bytes([end[0], end[1], end[2], end[3]]));
    let place = file.len() - footer as usize;
    checksum::insert(&mut file, place);
    Ok(file)
}

/// Returns the range of all rows of `columns`, to write them as a single row group.
pub(crate) fn one_group(columns: &[NamedColumn<'_>]) -> [Range<usize>; 1] {
    let rows = columns.first().map_or(0, |(_, values)| values.len());
    [Range { start: 0, end: rows }]
}

/// A Parquet file opened for reading.
pub(crate) struct ParquetFile {
    reader: SerializedFileReader<Bytes>,
    about: String,
}

impl ParquetFile {
    /// Returns whether `content` is certainly not a Parquet file. A damaged Parquet file still counts as one if its
    /// beginning or its end is intact.
    pub(crate) fn is_other(content: &[u8]) -> bool {
        !content.is_empty() && !content.starts_with(MAGIC) && !content.ends_with(MAGIC)
    }

    /// Opens a file. Fails if its checksum is wrong.
    pub(crate) fn open(content: Vec<u8>) -> Result<Self, AnyError> {
        // The checksum is compared first, because the decoder trusts the content of a damaged file and may panic.
        checksum::check(&content).map_err(|broken| format!("{broken}; use an undamaged copy, or test again"))?;
        let reader = SerializedFileReader::new(Bytes::from(content))?;
        let metadata = reader.metadata().file_metadata().key_value_metadata();
        let about = metadata.and_then(|pairs| pairs.iter().find(|pair| pair.key == KEY));
        let about = about.and_then(|pair| pair.value.clone());
        let about = about.ok_or_else(|| format!("its metadata have no key `{KEY}`"))?;
        Ok(Self { reader, about })
    }

    /// Returns the JSON document in the file's metadata.
    pub(crate) fn about(&self) -> &str {
        &self.about
    }

    /// Checks that the file's first columns have the names and types of `columns`.
    pub(crate) fn require(&self, message: &str, columns: &[NamedColumn<'_>]) -> Result<(), AnyError> {
        let there = self.reader.metadata().file_metadata().schema().get_fields();
        for (index, column) in schema(message, columns)?.get_fields().iter().enumerate() {
            let name = column.name();
            match there.get(index) {
                Some(field) if field == column => {}
                Some(field) if field.name() == name => {
                    return Err(format!("the column {name} is of another type").into());
                }
                _ => return Err(format!("the column {name} is missing or not in its position").into()),
            }
        }
        Ok(())
    }

    /// Returns the number of row groups.
    pub(crate) fn groups(&self) -> usize {
        self.reader.num_row_groups()
    }

    /// Returns the row group with this index.
    pub(crate) fn group(&self, index: usize) -> Result<RowGroup<'_>, AnyError> {
        Ok(RowGroup { group: self.reader.get_row_group(index)? })
    }
}

/// A row group: a range of a file's rows. It is read column by column. Reading row by row would take four times as
/// long, and reports read millions of rows.
pub(crate) struct RowGroup<'a> {
    group: Box<dyn RowGroupReader + 'a>,
}

impl RowGroup<'_> {
    /// Returns the number of rows.
    pub(crate) fn rows(&self) -> usize {
        usize::try_from(self.group.metadata().num_rows()).unwrap_or_default()
    }

    /// Returns the index of the column called `name`, or `None` if there is none.
    pub(crate) fn column_index(&self, name: &str) -> Option<usize> {
        self.group.metadata().columns().iter().position(|column| column.column_descr().name() == name)
    }

    /// Reads the column with index `place`, in which rows may lack a value.
    fn values<T: DataType>(&self, place: usize) -> Result<Vec<Option<T::T>>, AnyError> {
        let column = self.group.metadata().column(place).column_descr();
        let (name, is_optional) = (column.name().to_owned(), column.max_def_level() > 0);
        if column.physical_type() != T::get_physical_type() || column.max_rep_level() > 0 {
            return Err(format!("the column {name} is of another type").into());
        }
        let mut reader = get_typed_column_reader::<T>(self.group.get_column_reader(place)?);
        let (mut values, mut there, mut read) = (Vec::new(), Vec::new(), 0);
        while read < self.rows() {
            let levels = is_optional.then_some(&mut there);
            let (more, ..) = reader.read_records(self.rows() - read, levels, None, &mut values)?;
            if more == 0 {
                return Err(format!("column {name} has {read} of {} rows", self.rows()).into());
            }
            read += more;
        }
        let mut values = values.into_iter();
        if !is_optional {
            return Ok(values.map(Some).collect());
        }
        Ok(there.into_iter().map(|there| if there == 1 { values.next() } else { None }).collect())
    }

    /// Reads the column with index `place`, in which every row must have a value.
    fn all<T: DataType>(&self, place: usize) -> Result<Vec<T::T>, AnyError> {
        let values: Option<Vec<T::T>> = self.values::<T>(place)?.into_iter().collect();
        values.ok_or_else(|| "a row has no value in a required column".into())
    }

    pub(crate) fn texts(&self, place: usize) -> Result<Vec<String>, AnyError> {
        self.all::<ByteArrayType>(place)?.iter().map(|text| Ok(text.as_utf8()?.to_owned())).collect()
    }

    pub(crate) fn optional_texts(&self, place: usize) -> Result<Vec<Option<String>>, AnyError> {
        let texts = self.values::<ByteArrayType>(place)?;
        texts.iter().map(|text| text.as_ref().map(|text| Ok(text.as_utf8()?.to_owned())).transpose()).collect()
    }

    pub(crate) fn unsigned_64(&self, place: usize) -> Result<Vec<u64>, AnyError> {
        Ok(self.all::<Int64Type>(place)?.into_iter().map(i64::cast_unsigned).collect())
    }

    pub(crate) fn optional_unsigned_64(&self, place: usize) -> Result<Vec<Option<u64>>, AnyError> {
        Ok(self.values::<Int64Type>(place)?.into_iter().map(|number| number.map(i64::cast_unsigned)).collect())
    }

    pub(crate) fn unsigned_32(&self, place: usize) -> Result<Vec<u32>, AnyError> {
        Ok(self.all::<Int32Type>(place)?.into_iter().map(i32::cast_unsigned).collect())
    }

    pub(crate) fn flags(&self, place: usize) -> Result<Vec<bool>, AnyError> {
        self.all::<BoolType>(place)
    }

    pub(crate) fn numbers(&self, place: usize) -> Result<Vec<f64>, AnyError> {
        self.all::<DoubleType>(place)
    }

    pub(crate) fn optional_numbers(&self, place: usize) -> Result<Vec<Option<f64>>, AnyError> {
        self.values::<DoubleType>(place)
    }
}
