//! Reads the parameter sets of an experiment file: its tables `[sets.NAME]`.

use std::collections::BTreeMap;
use std::path::Path;

use perturb_files::read_if_exists;
use perturb_protocol::Version;
use perturb_settings::sets::{Assignment, Contexts, TestSet, set_of, set_of_csv};
use perturb_settings::{ValueError, require};
use toml::{Table, Value};

use super::file::is_plain;

/// Key of a set's table: the version that parameters without an entry in the table are drawn from.
const VERSION: &str = "version";
/// Key of a set's table: the name of a CSV file of contexts.
const FILE: &str = "file";
/// Key of a set's table: how many contexts of the file the set has, counted from the first.
const ROWS: &str = "rows";
/// The part of a CSV file's name that stands for the name of the environment.
const ENVIRONMENT: &str = "{environment}";

/// A function that reads a file by name. Its error is a phrase that describes what was found instead of the file.
pub(super) type ReadCsvFile<'a> = dyn Fn(&str) -> Result<Vec<u8>, String> + 'a;

/// Returns all versions and the parameter sets in `tables`, by name, as `environment` has them. Without an environment,
/// the names of files cannot depend on it. Inserts the CSV files that the sets name into `csv_files`.
pub(super) fn read(
    tables: &BTreeMap<String, Table>,
    environment: Option<&str>,
    read_csv_file: &ReadCsvFile<'_>,
    csv_files: &mut BTreeMap<String, Vec<u8>>,
) -> Result<BTreeMap<String, TestSet>, ValueError> {
    let mut sets = BTreeMap::from(Version::KNOWN.map(|version| (version.to_string(), version.into())));
    for (name, table) in tables {
        let key = format!("[sets.{name}]");
        let named = !name.is_empty() && is_plain(name);
        require(named, &key, format!("`{name}`"), "a name of letters, digits and _")?;
        require(name.parse::<Version>().is_err(), &key, "there already", "another name than D, R, E and R+E")?;
        let expected = "values of some parameters, or left out: it is a version";
        require(table.keys().any(|key| key != VERSION), &key, "without parameters", expected)?;
        let set = read_set(name, table, environment, read_csv_file, csv_files)
            .map_err(|error| ValueError { what: format!("{key}: {}", error.what), ..error })?;
        sets.insert(name.clone(), set);
    }
    Ok(sets)
}

/// Reads the table of one parameter set.
fn read_set(
    name: &str,
    table: &Table,
    environment: Option<&str>,
    read_csv_file: &ReadCsvFile<'_>,
    csv_files: &mut BTreeMap<String, Vec<u8>>,
) -> Result<TestSet, ValueError> {
    let mut version = Version::D;
    let mut file = None;
    let mut rows = None;
    let mut assignments: Vec<Assignment> = Vec::new();
    for (key, value) in table {
        match (key.as_str(), value) {
            (VERSION, Value::String(text)) => {
                version = text.parse().map_err(|_| ValueError::new(key, value, "\"D\", \"R\", \"E\" or \"R+E\""))?;
            }
            (FILE, Value::String(name)) => file = Some(name),
            (ROWS, Value::Integer(number @ 1..)) => rows = Some(*number as usize),
            (ROWS, _) => return Err(ValueError::new(key, value, "a number of rows, at least 1")),
            (VERSION | FILE, _) => return Err(ValueError::new(key, value, "a text")),
            (_, Value::String(text)) => assignments.push(format!("{key}={text}").parse()?),
            (_, Value::Integer(_) | Value::Float(_)) => assignments.push(format!("{key}={value}").parse()?),
            _ => {
                let expected = "a value, or a text such as \"0.3..0.4\" or \"0.1..1.0/10\"";
                return Err(ValueError::new(key, value, expected));
            }
        }
    }
    let Some(file) = file else {
        require(rows.is_none(), ROWS, "given without file", "given with a CSV file")?;
        return set_of(name, version, assignments);
    };
    let expected = "alone: the file's header names the parameters";
    require(assignments.is_empty(), FILE, "given in addition to parameters", expected)?;
    let expected = "the name of one file: no environment is known here";
    require(environment.is_some() || !file.contains(ENVIRONMENT), FILE, format!("`{file}`"), expected)?;
    let file = file.replace(ENVIRONMENT, environment.unwrap_or_default());
    let content = read_csv_file(&file).map_err(|got| ValueError::new(FILE, got, "a CSV file in the plan's folder"))?;
    let mut contexts = set_of_csv(name, version, &content)?.listed();
    let (known, rows) = (contexts.len(), rows.unwrap_or(contexts.len()));
    require(rows <= known, ROWS, rows, format!("at most {known}, the number of rows in {file}"))?;
    contexts.truncate(rows);
    csv_files.insert(file, content);
    Ok(TestSet { name: name.into(), version, contexts: Contexts::Listed(contexts) })
}

/// Reads the CSV file `file` in `folder`. The error is a phrase for [`ReadCsvFile`].
pub(super) fn content(file: &str, folder: &Path) -> Result<Vec<u8>, String> {
    if Path::new(file).components().count() != 1 || file.starts_with('.') || !file.ends_with(".csv") {
        return Err(format!("`{file}`, which is not the name of a .csv file"));
    }
    let path = folder.join(file);
    let refused = |reason: &dyn std::fmt::Display| format!("`{}`, which cannot be read ({reason})", path.display());
    match read_if_exists(&path) {
        Ok(content) => content.ok_or_else(|| refused(&std::io::Error::from(std::io::ErrorKind::NotFound))),
        Err(error) => Err(refused(&error.source)),
    }
}
