//! Why a folder is refused.

use std::{fmt, path::Path};

/// A folder that cannot be served: the place of the mistake and a sentence with the remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{place}{problem}")]
pub struct Error {
    /// The file, with the line if there is one, as `task.toml, line 12: `; empty where the folder itself is wrong.
    place: String,
    /// The mistake, what is expected, and what to do.
    problem: String,
}

impl Error {
    /// An error about the folder as a whole.
    pub(crate) fn folder(problem: impl fmt::Display) -> Self {
        Self { place: String::new(), problem: problem.to_string() }
    }

    /// An error in a file.
    pub(crate) fn file(name: &str, problem: impl fmt::Display) -> Self {
        Self { place: format!("{}: ", escaped(name)), problem: problem.to_string() }
    }

    /// An error in a line of a file, counted from 1.
    pub(crate) fn line(name: &str, line: usize, problem: impl fmt::Display) -> Self {
        Self { place: format!("{}, line {line}: ", escaped(name)), problem: problem.to_string() }
    }
}

/// A folder that cannot be served, with its path.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("--task {folder}: {problem}")]
pub struct LoadError {
    folder: String,
    problem: String,
}

impl LoadError {
    /// Makes the error with which loading `folder` failed.
    pub fn new(folder: &Path, problem: impl fmt::Display) -> Self {
        Self { folder: escaped(&folder.display().to_string()), problem: problem.to_string() }
    }

    /// The error without the folder's path.
    pub fn problem(&self) -> &str {
        &self.problem
    }
}

/// Prepares a text of a file for an error or a log: escapes control characters and shortens long texts.
pub(crate) fn escaped(text: &str) -> String {
    const MAX_CHARS: usize = 100;
    let mut shown: String = text.chars().take(MAX_CHARS).flat_map(char::escape_debug).collect();
    if text.chars().nth(MAX_CHARS).is_some() {
        shown.push('…');
    }
    shown.replace("\\'", "'").replace("\\\"", "\"")
}

/// Joins the first names of a list for an error.
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
