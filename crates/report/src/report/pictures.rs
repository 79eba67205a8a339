//! Pictures of a report's numbers, for its page and as separate files.

use std::path::Path;

use perturb_files::write_atomically;
use perturb_settings::Method;
use perturb_text::Table;
use plotters::coord::Shift;
use plotters::prelude::{DrawingArea, DrawingBackend};

use super::Report;
use super::figure::{Figure, FigureData};
use crate::plot::{IntervalPlot, Panels, Plot, PlotError, save, svg};

/// A picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// The environment; empty for all together.
    pub environment: String,
    /// The names of the files, without extension.
    pub file: String,
    /// A few words for those who do not see it.
    pub name: String,
    /// The caption.
    pub caption: String,
    /// The drawing.
    pub drawing: PictureDrawing,
    /// The numbers of it.
    pub data: Table,
}

/// A drawing of a report's numbers.
#[derive(Clone, Debug, PartialEq)]
pub enum PictureDrawing {
    /// Lines.
    Panels(Panels),
    /// Numbers with intervals.
    Intervals(IntervalPlot),
}

impl Plot for PictureDrawing {
    fn height(&self) -> u32 {
        match self {
            Self::Panels(panels) => panels.height(),
            Self::Intervals(intervals) => intervals.height(),
        }
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        match self {
            Self::Panels(panels) => panels.draw(area, scale),
            Self::Intervals(intervals) => intervals.draw(area, scale),
        }
    }
}

impl Picture {
    /// Returns the figure for the page.
    pub(super) fn figure(&self) -> Result<Figure, PlotError> {
        let Self { environment, file, name, caption, drawing, data } = self.clone();
        let picture = FigureData::Svg { svg: svg(&drawing)?, csv: data.to_csv() };
        Ok(Figure { environment, file, name, caption, picture })
    }

    /// Writes it into the folder `out` as SVG, PNG and CSV.
    ///
    /// # Errors
    /// [`PlotError`].
    pub fn save(&self, out: &Path) -> Result<(), PlotError> {
        save(&self.drawing, &out.join(&self.file))?;
        Ok(write_atomically(&out.join(format!("{}.csv", self.file)), &self.data.to_csv())?)
    }
}

impl Report<'_> {
    /// All of them: what the page opens with, performance profiles, what training on R brings, success over parameters and
    /// over the threshold, what settings do, as far as there are numbers.
    pub fn pictures(&self) -> Vec<Picture> {
        let finding = self.finding_pictures().into_iter().chain(self.environment_pictures());
        let profiles = finding.chain(self.profiles_picture()).chain(self.gains_picture());
        let swept = self.parameter_pictures().into_iter().chain(self.threshold_pictures());
        profiles.chain(swept).chain(self.settings_pictures()).collect()
    }
}

/// The method's name in small letters, digits and hyphens.
pub(super) fn file_name(method: &Method) -> String {
    let name = method.to_string().to_lowercase();
    let words = name.split(|letter: char| !letter.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.collect::<Vec<_>>().join("-")
}
