//! Reports of experiments: tables, pictures and pages.
//!
//! - [`Report`] compares results in tables and on an HTML page. [`plot`] draws the pictures.
#![forbid(unsafe_code)]

#[cfg(test)]
#[path = "../../experiment/src/fixture.rs"]
mod fixture;
mod heatmap_policies;
pub mod plot;
mod report;

pub use heatmap_policies::{PolicyHeatmap, policies_side_by_side};
pub use report::{
    EnvironmentComparison, HeatmapPictures, Picture, PictureDrawing, Report, ReportBundle, ReportError, ReportInputs,
    StudySource, comparison_page, curves_table, heatmap_pictures, save_heatmaps,
};
