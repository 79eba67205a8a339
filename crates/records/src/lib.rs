//! The recorded episodes of tests, what follows from them, and the paper's numbers to compare with.
//!
//! - [`ResultsTable`] has every result of studies in one Parquet file, [`StudyEpisodes`] the episodes of one study.
//! - [`Records`] are the episodes of a policy's tests, in a Parquet file; [`testing`] says which episodes a test plays.
//! - [`success`] has the rules of success; [`outcomes`] has success over parameters and thresholds, and tail risk.
//! - [`statistics`] are means, intervals and tests over runs; [`Metric`] and [`Scenario`] are the paper's.
//! - [`Heatmap`] is a policy over two parameters; [`ExternalEvaluation`] is an agent that no experiment trained.
//! - [`comparison`] compares conditions over their seeds and over episodes.
//! - [`paper`] has the published numbers; [`ledger`] compares records with a server's ledger.
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate self as perturb_records; // by this name fixtures call it in every crate

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
pub use results_table::{MergeCounts, ResultsTable, SCHEMA_VERSION, StudyPlan, TableError, TableRow};
pub use scenarios::{Metric, Scenario, TrainedOn, versions};
