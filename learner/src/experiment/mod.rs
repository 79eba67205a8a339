//! Experiments: from a file that states them to tables and pictures.
//!
//! [`Plan`] expands a file to cells, [`run_cell`] trains and tests one of them, [`run()`] does all in worker processes,
//! [`slurm`] has a cluster do them, and [`Folder`] is where they are kept. [`Results`] reads them back and selects,
//! [`report`] makes tables of them, [`plot`] pictures.

mod cell;
mod cost;
mod curves;
#[cfg(test)]
mod fixture;
mod folder;
mod heatmap;
mod heatmaps;
mod plan;
pub mod plot;
pub mod report;
mod run;
mod selection;
pub mod slurm;
mod statistics;
pub mod table;

pub use cell::{CellEnd, run_cell};
pub use cost::{Estimate, Measurement, Speed, Work, cell_seconds, estimate, measure, representatives};
pub use curves::{Curve, EnvironmentCurves, Point, curves_table, read_curves};
pub use folder::{
    CellFolder, CellLock, CellResult, CellState, Failure, FailureMark, Folder, FolderError, Timing, Training,
    write_atomically,
};
pub use heatmap::{Axis, Heatmap, HeatmapError, HeatmapOptions, MOST_POINTS, default_axes, heatmap, heatmap_csv};
pub use heatmaps::{
    HeatmapPlace, HeatmapRecord, NoHeatmap, StoredHeatmap, heatmap_files, heatmap_places, store_heatmap,
};
pub use plan::{Cell, Counts, Plan, PlanError, Tests};
pub use run::{Attempt, BUSY, NO_SERVER, ON, RunEnd, RunError, RunOptions, RunStatus, run};
pub use selection::{Results, Selected, SelectedRun, Selection, average, interquartile};
pub use statistics::{Iqm, Summary, interquartile_mean};
