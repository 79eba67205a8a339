//! Numbers, times and tables as people read them, and commands as they paste them.
#![forbid(unsafe_code)]

mod format;
mod table;

pub use format::{count, counted, duration, grouped, quoted, shortened};
pub use table::{Column, Entry, Table, TableBuilder};
