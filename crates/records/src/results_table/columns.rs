//! The columns of a results table.

use perturb_files::AnyError;

use super::{ResultsTable, TableRow};
use crate::parquet_file::{ColumnValues, NamedColumn, ParquetFile, RowGroup};

impl ResultsTable {
    /// Returns the columns with their names, in order.
    pub fn columns(&self) -> Vec<NamedColumn<'_>> {
        let rows = || self.rows.iter();
        let texts = |of: fn(&TableRow) -> &str| ColumnValues::Text(rows().map(of).collect());
        let optional_texts = |of: fn(&TableRow) -> Option<&str>| ColumnValues::OptionalText(rows().map(of).collect());
        let counts = |of: fn(&TableRow) -> Option<u64>| ColumnValues::OptionalUnsigned64(rows().map(of).collect());
        let numbers = |of: fn(&TableRow) -> Option<f64>| ColumnValues::Optional(rows().map(of).collect());
        let small = |of: fn(&TableRow) -> u32| ColumnValues::Unsigned32(rows().map(of).collect());
        let columns = [
            ("study", texts(|row| &row.study)),
            ("cell", texts(|row| &row.cell)),
            ("environment", texts(|row| &row.environment)),
            ("revision", counts(|row| row.revision)),
            ("model_hash", optional_texts(|row| row.model_hash.as_deref())),
            ("algorithm", texts(|row| &row.algorithm)),
            ("architecture", texts(|row| &row.architecture)),
            ("preset", texts(|row| &row.preset)),
            ("observe", texts(|row| &row.observe)),
            ("trained_on", texts(|row| &row.trained_on)),
            ("tested_on", optional_texts(|row| row.tested_on.as_deref())),
            ("run", small(|row| row.run)),
            ("seed", ColumnValues::Unsigned64(rows().map(|row| row.seed).collect())),
            ("after_episodes", counts(|row| row.after_episodes)),
            ("episodes", counts(|row| row.episodes)),
            ("successes", counts(|row| row.successes)),
            ("mean_return", numbers(|row| row.mean_return)),
            ("mean_length", numbers(|row| row.mean_length)),
            ("cvar_10", numbers(|row| row.cvar_10)),
            ("timesteps", counts(|row| row.timesteps)),
            ("seconds", numbers(|row| row.seconds)),
            ("commit", texts(|row| &row.commit)),
            ("settings", texts(|row| &row.settings)),
            ("checksum", optional_texts(|row| row.checksum.as_deref())),
            ("failure", optional_texts(|row| row.failure.as_deref())),
            ("schema_version", small(|row| row.schema_version)),
        ];
        columns.into_iter().map(|(name, values)| (name.to_owned(), values)).collect()
    }
}

impl ResultsTable {
    /// Returns the table as CSV. A missing value is an empty field.
    ///
    /// # Errors
    /// The errors of the CSV writer.
    pub fn to_csv(&self) -> Result<Vec<u8>, AnyError> {
        let columns = self.columns();
        let mut writer = csv::Writer::from_writer(Vec::new());
        writer.write_record(columns.iter().map(|(name, _)| name))?;
        for row in 0..self.rows.len() {
            writer.write_record(columns.iter().map(|(_, values)| values.value_text(row)))?;
        }
        Ok(writer.into_inner().map_err(|error| error.to_string())?)
    }
}

/// Reads the rows. Columns are found by name, so their order is irrelevant and unknown columns are ignored.
pub(super) fn decode(file: &ParquetFile) -> Result<Vec<TableRow>, AnyError> {
    let mut rows = Vec::new();
    for index in 0..file.groups() {
        rows.extend(rows_of(&file.group(index)?)?);
    }
    Ok(rows)
}

/// Reads the rows of a row group: reads all columns, and takes the values of each row from them.
fn rows_of(group: &RowGroup<'_>) -> Result<Vec<TableRow>, AnyError> {
    let place = |name: &str| group.column_index(name).ok_or_else(|| format!("it has no column {name}"));
    let texts = |name: &str| -> Result<_, AnyError> { Ok(group.texts(place(name)?)?.into_iter()) };
    let optional_texts = |name: &str| -> Result<_, AnyError> { Ok(group.optional_texts(place(name)?)?.into_iter()) };
    let counts = |name: &str| -> Result<_, AnyError> { Ok(group.optional_unsigned_64(place(name)?)?.into_iter()) };
    let numbers = |name: &str| -> Result<_, AnyError> { Ok(group.optional_numbers(place(name)?)?.into_iter()) };
    let small = |name: &str| -> Result<_, AnyError> { Ok(group.unsigned_32(place(name)?)?.into_iter()) };
    let (mut study, mut cell, mut environment) = (texts("study")?, texts("cell")?, texts("environment")?);
    let (mut revision, mut model_hash) = (counts("revision")?, optional_texts("model_hash")?);
    let (mut algorithm, mut architecture) = (texts("algorithm")?, texts("architecture")?);
    let (mut preset, mut observe) = (texts("preset")?, texts("observe")?);
    let (mut trained_on, mut tested_on) = (texts("trained_on")?, optional_texts("tested_on")?);
    let (mut run, mut seed) = (small("run")?, group.unsigned_64(place("seed")?)?.into_iter());
    let (mut after_episodes, mut episodes, mut successes) =
        (counts("after_episodes")?, counts("episodes")?, counts("successes")?);
    let (mut mean_return, mut mean_length) = (numbers("mean_return")?, numbers("mean_length")?);
    let (mut cvar_10, mut timesteps, mut seconds) = (numbers("cvar_10")?, counts("timesteps")?, numbers("seconds")?);
    let (mut commit, mut settings) = (texts("commit")?, texts("settings")?);
    let (mut checksum, mut failure) = (optional_texts("checksum")?, optional_texts("failure")?);
    let mut schema_version = small("schema_version")?;
    let mut row = || {
        Some(TableRow {
            schema_version: schema_version.next()?,
            study: study.next()?,
            cell: cell.next()?,
            environment: environment.next()?,
            revision: revision.next()?,
            model_hash: model_hash.next()?,
            algorithm: algorithm.next()?,
            architecture: architecture.next()?,
            preset: preset.next()?,
            observe: observe.next()?,
            trained_on: trained_on.next()?,
            tested_on: tested_on.next()?,
            run: run.next()?,
            seed: seed.next()?,
            after_episodes: after_episodes.next()?,
            episodes: episodes.next()?,
            successes: successes.next()?,
            mean_return: mean_return.next()?,
            mean_length: mean_length.next()?,
            cvar_10: cvar_10.next()?,
            timesteps: timesteps.next()?,
            seconds: seconds.next()?,
            commit: commit.next()?,
            settings: settings.next()?,
            checksum: checksum.next()?,
            failure: failure.next()?,
        })
    };
    Ok(std::iter::from_fn(&mut row).collect())
}
