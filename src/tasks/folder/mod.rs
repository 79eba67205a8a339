//! Tasks that are folders: an MJCF model and a file `task.toml`. docs/tasks.md explains the file.
//!
//! A folder is loaded in this order:
//!
//! - `files` reads what the folder holds, and nothing outside of it; `table` reads TOML with places for errors.
//! - `mjcf` resolves includes and writes the texts for MuJoCo; `elements` finds elements by name.
//! - `file` assembles the task from `reading` with its `number`s, `reward`, `rules`, `reset` and `parameter` with its
//!   `target`s.
//! - `checks` refuses edits that cannot have an effect, and `effect` looks for edits without a visible effect.
//! - `attributes` looks up attributes of the model's elements, `lengths` edits the model's text, and `recompilation`
//!   compiles it for each other value.
//! - `environment` is the environment. `template` has the simulations, which all environments of a thread share.
//! - `child` loads a folder for the first time in a process of its own, and `report` says what `--check` prints.

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
pub use load::{Folder, load, read_model};
pub use report::report;

/// A JSON schema of `task.toml`.
pub const SCHEMA: &str = include_str!("schema.json");
