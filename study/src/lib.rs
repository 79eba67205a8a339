//! perturb's studies: what is asked for, and what came of it, as plain data. Without libtorch.
//!
//! - [`settings`]: of a training.
//! - [`Plan`] expands an experiment file to cells, [`Folder`] is where they are kept, [`scheduler`] has processes or a
//!   cluster do them.
//! - [`runs`] finds trainings and experiments, and says how far they are.
//! - [`checkpoint`] has the policies that came of trainings, [`testing`] says which episodes they are tested in.
//! - [`Results`] reads them back and selects; [`paper`] is what was published.
//! - [`report`] compares them, in [`table::Table`]s and on a page; [`plot`] draws.
#![forbid(unsafe_code)]

mod against_training;
mod assessed;
pub mod checkpoint;
mod cost;
mod curves;
pub mod files;
#[cfg(test)]
mod fixture;
mod folder;
mod heatmap;
mod heatmap_policies;
mod heatmaps;
pub mod interrupt;
pub mod ledger;
#[cfg(test)]
mod ledger_tests;
mod means;
pub mod outcomes;
pub mod paper;
mod plan;
pub mod plot;
pub mod records;
pub mod report;
mod reselection;
mod results;
pub mod runs;
mod scenarios;
pub mod scheduler;
mod seal;
mod selection;
pub mod sets;
pub mod settings;
pub mod statistics;
pub mod success;
pub mod table;
pub mod testing;
mod tuning;
mod value_error;
mod verify;
pub mod words;

pub use assessed::{ASSESSMENT, Assessed, AssessedError, AssessedPolicy, Known, add_assessed};
pub use cost::{Estimate, Measurement, Speed, Taken, estimates, generated_episodes, representatives, tested_episodes};
pub use curves::{Curve, EnvironmentCurves, Footing, Point, curves_table, read_curves};
pub use folder::{
    CellFolder, CellResult, CellState, Failure, FailureMark, Folder, FolderError, MarkResult, Timing, Training,
};
pub use heatmap::{Axis, Heatmap, HeatmapOptions, HeatmapPoint, MOST_POINTS, heatmap_table};
pub use heatmap_policies::{PolicyHeatmap, policies_side_by_side};
pub use heatmaps::{
    HeatmapKind, HeatmapPlace, HeatmapRecord, NoHeatmap, StoredHeatmap, heatmap_path, heatmap_places, store_heatmap,
};
pub use means::{geometric_mean, mean, wilson};
pub use paper::Method;
pub use plan::{Cell, Counts, Grouping, Plan, PlanError, SELECTION_TEST, Selection, Tests, TrainedOn};
pub use results::{Counters, TestResult};
pub use scenarios::{Metric, Scenario, Version};
pub use selection::{MethodResults, Reported, Results, Selected, SelectedRun, average, interquartile};
pub use statistics::{Bootstrapped, Summary};
pub use tuning::{Chosen, Tuned, tuned};
pub use value_error::ValueError;
pub use verify::{VerifyError, verify};

/// Whatever went wrong, where its words are all that matters.
pub type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// The version, and the commit that was built, e.g. "0.1.0 (1a2b3c4d5e6f)"; "-dirty" follows a commit whose files were
/// changed.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("PERTURB_COMMIT"), ")");
