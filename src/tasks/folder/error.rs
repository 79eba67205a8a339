//! Errors of loading a folder.

use std::{fmt, path::Path};

/// The reason why a folder cannot be loaded: where the mistake is, what is expected, and what to do.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{place}{problem}")]
pub struct Error {
    /// The file and the line, such as `task.toml, line 12: `. There is no line if the whole file is wrong. The text is
    /// empty if the folder itself is wrong.
    place: String,
    /// The mistake, what is expected, and what to do.
    problem: String,
}

impl Error {
    /// Creates an error about the folder itself.
    pub(crate) fn folder(problem: impl fmt::Display) -> Self {
        Self { place: String::new(), problem: problem.to_string() }
    }

    /// Creates an error about a whole file.
    pub(crate) fn file(name: &str, problem: impl fmt::Display) -> Self {
        Self { place: format!("{}: ", escaped(name)), problem: problem.to_string() }
    }

    /// Creates an error in a line of a file. Lines count from 1.
    pub(crate) fn line(name: &str, line: usize, problem: impl fmt::Display) -> Self {
        Self { place: format!("{}, line {line}: ", escaped(name)), problem: problem.to_string() }
    }
}

/// The error of a folder that cannot be loaded, with the folder's path.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("--task {folder}: {problem}")]
pub struct LoadError {
    folder: String,
    problem: String,
}

impl LoadError {
    /// Creates the error for the folder with this path.
    pub fn new(folder: &Path, problem: impl fmt::Display) -> Self {
        Self { folder: escaped(&folder.display().to_string()), problem: problem.to_string() }
    }

    /// The message without the folder's path.
    pub fn problem(&self) -> &str {
        &self.problem
    }
}

/// Makes text from a file safe for error messages and logs: escapes control characters, and shortens it to 100
/// characters.
pub(crate) fn escaped(text: &str) -> String {
    const MAX_CHARS: usize = 100;
    let mut shown: String = text.chars().take(MAX_CHARS).flat_map(char::escape_debug).collect();
    if text.chars().nth(MAX_CHARS).is_some() {
        shown.push('…');
    }
    shown.replace("\\'", "'").replace("\\\"", "\"")
}

/// Joins up to 12 names by commas, for an error message. "none" if there are no names.
pub(crate) fn listed<'a>(names: impl Iterator<Item = &'a str> + Clone) -> String {
    const MAX_NAMES: usize = 12;
    let mut shown = names.clone().take(MAX_NAMES).map(escaped).collect::<Vec<_>>().join(", ");
    if shown.is_empty() {
        return "none".into();
    }
    if names.count() > MAX_NAMES {
        shown.push_str(", …");
    }
    shown
}

/// The result of reading a part of a folder.
pub(crate) type Result<T> = std::result::Result<T, Error>;
