//! The pictures of a report, for its page and as separate files.

use std::path::Path;

use perturb_files::write_atomically;
use perturb_settings::Method;
use perturb_text::Table;
use plotters::coord::Shift;
use plotters::prelude::{DrawingArea, DrawingBackend};

use crate::plot::{HeatmapPanels, IntervalPlot, Panels, Plot, PlotError, save};

/// A picture of a report with its texts and its data.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// The environment; empty for a picture of all environments.
    pub environment: String,
    /// The name of the picture's files, without extension.
    pub file: String,
    /// The alternative text, for readers who cannot see the picture.
    pub name: String,
    /// The caption.
    pub caption: String,
    /// The drawing itself.
    pub drawing: PictureDrawing,
    /// The drawn numbers, as a table.
    pub data: Table,
}

/// The drawing of a picture, by kind.
#[derive(Clone, Debug, PartialEq)]
pub enum PictureDrawing {
    /// Line charts.
    Panels(Panels),
    /// Numbers with their intervals.
    Intervals(IntervalPlot),
    /// Heatmaps over two parameters.
    Heatmaps(HeatmapPanels),
}

impl Plot for PictureDrawing {
    fn height(&self) -> u32 {
        match self {
            Self::Panels(panels) => panels.height(),
            Self::Intervals(intervals) => intervals.height(),
            Self::Heatmaps(heatmaps) => heatmaps.height(),
        }
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        match self {
            Self::Panels(panels) => panels.draw(area, scale),
            Self::Intervals(intervals) => intervals.draw(area, scale),
            Self::Heatmaps(heatmaps) => heatmaps.draw(area, scale),
        }
    }

    fn finish(&self, svg: String) -> String {
        match self {
            Self::Heatmaps(heatmaps) => heatmaps.finish(svg),
            Self::Panels(_) | Self::Intervals(_) => svg,
        }
    }
}

impl Picture {
    /// Writes the picture into the folder `out` as SVG, PNG and CSV.
    ///
    /// # Errors
    /// [`PlotError`] if the picture cannot be drawn or a file cannot be written.
    pub fn save(&self, out: &Path) -> Result<(), PlotError> {
        save(&self.drawing, &out.join(&self.file))?;
        Ok(write_atomically(&out.join(format!("{}.csv", self.file)), &self.data.to_csv())?)
    }
}

/// Returns the method's name as a part of a file name: in lower-case letters, digits and hyphens.
pub(super) fn file_name(method: &Method) -> String {
    let name = method.to_string().to_lowercase();
    let words = name.split(|letter: char| !letter.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.collect::<Vec<_>>().join("-")
}
