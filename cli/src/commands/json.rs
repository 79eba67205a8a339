//! Option --json: writes the results of commands for other programs.

use std::fs::File;
use std::io::Write;
use std::path::Path;

use perturb_files::{io, require_writable, write_json};
use serde::Serialize;

use super::args::JsonArgs;
use super::error::Result;

/// The value of --json that stands for standard output.
const STANDARD_OUTPUT: &str = "-";

/// Returns `path` if it is a file, and `None` if it stands for standard output.
fn file(path: &Path) -> Option<&Path> {
    (path != Path::new(STANDARD_OUTPUT)).then_some(path)
}

/// Opens the output for event lines: a new file, or standard output.
pub(super) fn event_writer(path: &Path) -> Result<Box<dyn Write>> {
    let Some(path) = file(path) else { return Ok(Box::new(std::io::stdout())) };
    require_writable(path)?;
    Ok(Box::new(File::create(path).map_err(io("write", path))?))
}

impl JsonArgs {
    /// Checks that the file of --json can be written. Commands call this before their work begins.
    pub(super) fn check(&self) -> Result<()> {
        Ok(self.json.as_deref().and_then(file).map_or(Ok(()), require_writable)?)
    }

    /// Tells whether JSON goes to standard output, so that the command must print nothing else there.
    pub(super) fn is_printed(&self) -> bool {
        self.json.as_deref().is_some_and(|path| file(path).is_none())
    }

    /// If --json is given, writes the document to its file or to standard output.
    pub(super) fn write(&self, document: impl Serialize) -> Result<()> {
        match self.json.as_deref().map(file) {
            None => Ok(()),
            Some(Some(path)) => Ok(write_json(path, &document)?),
            Some(None) => {
                let text = serde_json::to_string_pretty(&document).map_err(std::io::Error::from)?;
                Ok(writeln!(std::io::stdout(), "{text}")?)
            }
        }
    }
}
