//! Experiments: plans, execution and results.
//!
//! - [`Plan`] expands an experiment file to cells: one training with its tests each. [`ExperimentFolder`] stores the
//!   results of cells, and [`scheduler`] runs cells in local processes or on a Slurm cluster.
//! - [`runs`] finds trainings and experiments, and reports their progress.
//! - [`Results`] reads the results of cells and selects the best configurations. [`export`](export()) turns results
//!   into rows of a table.
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate self as perturb_experiment; // fixtures that several crates include use this name

mod cost;
mod curves;
mod eta;
mod export;
mod external;
#[cfg(test)]
mod fixture;
mod folder;
mod heatmaps;
mod plan;
mod recorded;
mod reselection;
pub mod runs;
pub mod scheduler;
mod selection;
mod states;
mod tuning;
mod verify;

pub use cost::{Estimate, Measurement, Speed, benchmark_cells, estimates, generated_episodes, tested_episodes};
pub use curves::{BudgetAxis, Curve, CurvePoint, EnvironmentCurves, read_curves};
pub use eta::{CellDurations, RemainingTime, TrainingProgress};
pub use export::{ExportError, export};
pub use external::{add_assessed, elsewhere, judged_as_in};
pub use folder::{
    CellFolder, CellResult, CellState, ExperimentFolder, FailureId, FailureRecord, FolderError, IntermediateEvaluation,
    Timing, Training,
};
pub use heatmaps::{
    HeatmapPlace, HeatmapRecord, NoHeatmap, StoredHeatmap, heatmap_kinds, heatmap_path, heatmap_places, store_heatmap,
};
pub use plan::{Cell, Counts, Grouping, Plan, PlanError, SELECTION_TEST, Selection, Tests, distinct};
pub use recorded::Recorded;
pub use reselection::SelectionBootstrap;
pub use selection::{
    MethodResults, Reported, Results, Selected, SelectedRun, TieRange, average, average_tie_range, interquartile,
    scores,
};
pub use states::{CellStates, DoneCells, LayeredStates, StudyResults};
pub use tuning::{Chosen, Tuned, tuned};
pub use verify::VerifyError;

/// The program's version and the commit that it was built from, e.g. "0.1.0 (1a2b3c4d5e6f)". The commit has the suffix
/// "-dirty" if files differed from it.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("PERTURB_COMMIT"), ")");
