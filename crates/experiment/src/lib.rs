//! Experiments: their plans, their execution and their results, as plain data.
//!
//! - [`Plan`] expands an experiment file to cells, [`Folder`] stores them, and [`scheduler`] runs them in processes or on a
//!   cluster.
//! - [`runs`] finds trainings and experiments, and reports their progress.
//! - [`Results`] reads the cells' results and selects configurations; [`export`](export()) turns them into rows of a table.
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate self as perturb_experiment; // by this name fixtures call it in every crate

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
    CellFolder, CellResult, CellState, Failure, FailureId, Folder, FolderError, IntermediateEvaluation, Timing,
    Training,
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

/// The version, and the commit that was built, e.g. "0.1.0 (1a2b3c4d5e6f)"; "-dirty" follows a commit whose files were
/// changed.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("PERTURB_COMMIT"), ")");
