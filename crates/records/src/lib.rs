//! Recorded episodes of tests, the statistics computed from them, and the numbers of Packer et al. (2018), "the
//! paper", for comparison.
//!
//! - [`ResultsTable`] holds every result of several studies, and [`StudyEpisodes`] the episodes of one study. Each is
//!   one Parquet file.
//! - [`Records`] are the recorded episodes of a policy's tests. [`testing`] chooses the episodes of a test.
//! - [`success`] has the rules of success. [`outcomes`] computes how success depends on parameters, and tail risk.
//! - [`statistics`] has means, intervals and significance tests over runs. [`Metric`] and [`Scenario`] are the paper's.
//! - [`Heatmap`] shows a policy's results on a grid of two parameters. [`ExternalEvaluation`] holds the tests of an
//!   agent that was not trained by an experiment.
//! - [`comparison`] compares conditions over seeds and over episodes.
//! - [`paper`] has the published numbers. [`ledger`] checks a policy against the servers' ledgers.
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate self as perturb_records; // `fixture.rs` uses this name, because other crates include the file too

mod axis;
pub mod comparison;
mod episodes_file;
mod external_evaluation;
#[cfg(test)]
mod fixture;
mod heatmap;
pub mod ledger;
#[cfg(test)]
mod ledger_tests;
pub mod outcomes;
pub mod paper;
mod parquet_file;
mod records;
mod results;
mod results_table;
mod scenarios;
pub mod statistics;
pub mod success;
pub mod testing;

pub use axis::Axis;
pub use episodes_file::StudyEpisodes;
pub use external_evaluation::{
    ASSESSMENT, ExternalEvaluation, ExternalEvaluationError, ExternalPolicy, PolicyMetadata,
};
pub use heatmap::{Heatmap, HeatmapKind, HeatmapOptions, HeatmapPoint, MAX_POINTS, heatmap_table};
pub use parquet_file::ColumnValues;
pub use records::{
    Difference, Ending, EpisodeRecord, FILE, ParameterCheck, ParameterComparison, ROUNDING, RecordedParameter,
    RecordedTest, Records, RecordsError, RecordsMetadata,
};
pub use results::TestResult;
pub use results_table::{
    MergeCounts, NamedRows, ResultsTable, RowFilter, SCHEMA_VERSION, SELECTION_TEST, StudyPlan, TableError, TableRow,
};
pub use scenarios::{Metric, Scenario, TrainedOn, versions};
