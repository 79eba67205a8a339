//! Tasks that users define by a folder with an MJCF model and a file `task.toml`. docs/tasks.md explains the file.
//!
//! The modules, in the order in which a folder passes through them:
//!
//! - `child` loads a new folder in a separate process first, because MuJoCo may crash or hang.
//! - `load` then loads the folder in the server's process, by the following modules.
//! - `files` reads the files of the folder; `table` reads TOML, and reports the line of each error.
//! - `mjcf` resolves includes and writes the model's text for MuJoCo; `elements` finds model elements by name.
//! - `file` builds the task from its parts: `reading`, `reading_source` and `number` (what is read from the
//!   simulation), `reward`, `rules`, `reset`, `parameter` and `target` (what a parameter edits), `declared` (pushes and
//!   disturbances), and `picture` (the camera).
//! - `checks` refuses edits that cannot have an effect; `effect` finds edits that have no visible effect.
//! - `lengths` edits lengths in the model's text, with the help of `attributes`; `recompilation` compiles the edited
//!   text.
//! - `environment` is the environment; `template` applies edits to the simulation that a thread's environments share.
//! - `report` writes the report that `--check` prints.

mod attributes;
mod checks;
pub mod child;
mod declared;
mod effect;
mod elements;
mod environment;
mod error;
mod file;
mod files;
mod lengths;
mod load;
mod mjcf;
mod number;
mod parameter;
mod picture;
mod reading;
mod reading_source;
mod recompilation;
mod report;
mod reset;
mod reward;
mod rules;
mod table;
mod target;
mod template;

pub use error::{Error, LoadError};
pub use load::{TaskFolder, load, read_model};
pub use report::report;

/// The JSON schema of `task.toml`, as text.
pub const SCHEMA: &str = include_str!("schema.json");
