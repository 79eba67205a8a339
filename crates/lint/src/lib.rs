//! Checks of the source text of the workspace that neither rustc nor clippy makes:
//!
//! - [`cycles`]: import cycles between sibling modules, in each crate and in the Python package;
//! - [`doc_comments`]: doc comments that open without a subject;
//! - [`names`]: type names with two definitions, constants with superlative names, constructors called `of`, long test
//!   names;
//! - [`glossary`]: public types of the server, the pool and the learner that the glossary does not explain.
//!
//! [`limits`] compares the number of findings with the limits in `crates/lint/limits.toml`.

pub mod cycles;
pub mod doc_comments;
pub mod glossary;
pub mod imports;
pub mod lexer;
pub mod limits;
pub mod names;
pub mod source;
