//! The recorded episodes of tests, what follows from them, and the paper's numbers to compare with.
//!
//! - [`Records`] are the episodes of a policy's tests, in a Parquet file; [`testing`] says which episodes a test plays.
//! - [`success`] says when an episode is one; [`outcomes`] are success over parameters and thresholds, and the worst episodes.
//! - [`statistics`] are means, intervals and tests over runs; [`Metric`] and [`Scenario`] are the paper's.
//! - [`Heatmap`] is a policy over two parameters; [`Assessed`] is an agent that no experiment trained.
//! - [`paper`] has the published numbers; [`ledger`] compares records with a server's ledger.
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate self as perturb_records; // by this name fixtures call it in every crate

mod assessed;
mod axis;
#[cfg(test)]
mod fixture;
mod heatmap;
pub mod ledger;
#[cfg(test)]
mod ledger_tests;
pub mod outcomes;
pub mod paper;
mod records;
mod results;
mod scenarios;
pub mod statistics;
pub mod success;
pub mod testing;

pub use assessed::{ASSESSMENT, Assessed, AssessedError, AssessedPolicy, Known};
pub use axis::Axis;
pub use heatmap::{Heatmap, HeatmapKind, HeatmapOptions, HeatmapPoint, MOST_POINTS, heatmap_table};
pub use records::{
    About, Agreement, ColumnValues, Comparison, Difference, Ending, EpisodeRecord, FILE, ROUNDING, RecordedParameter,
    RecordedTest, Records, RecordsError,
};
pub use results::TestResult;
pub use scenarios::{Metric, Scenario, TrainedOn, versions};
