//! Formatting of numbers, durations and tables for people, and of words for shells.
#![forbid(unsafe_code)]

mod format;
mod table;

pub use format::{count, counted, duration, grouped, quoted, shortened};
pub use table::{Column, Entry, Table, TableBuilder};
