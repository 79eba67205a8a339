//! Pictures, as SVG and PNG.
//!
//! All pictures fit a printed column: they have its width, and their texts are readable in it. Panels that do not fit
//! side by side stand below each other, so pictures fit a telephone as well. Lines have the colours of Okabe and Ito,
//! and dashes for print without colour. Surfaces have viridis. Ticks are at round numbers.

mod canvas;
mod colours;
mod curves;
mod dashes;
mod frame;
mod heatmap;
pub(crate) mod intervals;
pub(crate) mod panels;
mod ticks;

use std::path::Path;
use std::sync::OnceLock;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

pub use colours::{is_dark, shade};
pub use curves::{CurveQuantity, draw_curves};
pub use heatmap::{HeatmapColumn, HeatmapPanels, common_returns};
pub use intervals::IntervalPlot;
pub use panels::Panels;
use perturb_experiment::FolderError;
use perturb_files::{FileError, write_atomically};

/// DejaVu Sans with only the letters that pictures need. Its licence is in the same folder.
const FONT: &[u8] = include_bytes!("../../data/fonts/DejaVuSans-subset.ttf");
/// The font family in an SVG.
pub const FAMILY: &str = "sans-serif";
/// Width of a picture, units. An SVG shows a unit as one CSS pixel, and prints the picture in a column of 85 mm.
pub const WIDTH: u32 = 360;
/// Steps of an SVG in a unit. More steps make lines smooth in print.
const SVG_SCALE: u32 = 4;
/// Pixels of a PNG in a unit: 320 an inch in a column.
pub const PNG_SCALE: u32 = 3;

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlotError {
    /// The plotting library refused.
    #[error("cannot draw: {0}")]
    Draw(String),
    /// A file cannot be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The folder cannot be read.
    #[error(transparent)]
    Folder(#[from] FolderError),
}

/// A picture that any backend can draw, [`WIDTH`] wide. All lengths are units times `scale`.
pub trait Plot {
    /// Returns the height, units.
    fn height(&self) -> u32;

    /// Draws the picture.
    ///
    /// # Errors
    /// Errors of the backend.
    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError>;

    /// Post-processes the SVG.
    fn finish(&self, svg: String) -> String {
        svg
    }
}

/// A picture as SVG.
///
/// # Errors
/// [`PlotError::Draw`].
pub fn svg(plot: &impl Plot) -> Result<String, PlotError> {
    load_font()?;
    let mut text = String::new();
    let (width, height) = (WIDTH, plot.height());
    let steps = (width * SVG_SCALE, height * SVG_SCALE);
    {
        let area = SVGBackend::with_string(&mut text, steps).into_drawing_area();
        plot.draw(&area, SVG_SCALE)?;
        area.present().map_err(drawing)?;
    }
    // The library writes the size in steps. Only `width` and `height` become units; the `viewBox` stays in steps.
    let size = |(width, height): (u32, u32)| format!("width=\"{width}\" height=\"{height}\"");
    Ok(plot.finish(text.replacen(&size(steps), &size((width, height)), 1)))
}

/// A picture as PNG, with [`PNG_SCALE`] pixels for each unit.
///
/// # Errors
/// [`PlotError`].
pub fn png(plot: &impl Plot) -> Result<Vec<u8>, PlotError> {
    load_font()?;
    let (width, height) = (WIDTH * PNG_SCALE, plot.height() * PNG_SCALE);
    let mut pixels = vec![0; 3 * width as usize * height as usize];
    {
        let area = BitMapBackend::with_buffer(&mut pixels, (width, height)).into_drawing_area();
        plot.draw(&area, PNG_SCALE)?;
        area.present().map_err(drawing)?;
    }
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().map_err(drawing)?;
    writer.write_image_data(&pixels).map_err(drawing)?;
    writer.finish().map_err(drawing)?;
    Ok(file)
}

/// Writes a picture as SVG and as PNG. Adds `.svg` and `.png` to `path`, and replaces each file atomically.
///
/// # Errors
/// [`PlotError`].
pub fn save(plot: &impl Plot, path: &Path) -> Result<(), PlotError> {
    for (ending, content) in [("svg", svg(plot)?.into_bytes()), ("png", png(plot)?)] {
        write_atomically(&path.with_added_extension(ending), &content)?;
    }
    Ok(())
}

/// Makes the font known to the library, once.
pub fn load_font() -> Result<(), PlotError> {
    static LOADED: OnceLock<bool> = OnceLock::new();
    let loaded = LOADED.get_or_init(|| register_font(FAMILY, FontStyle::Normal, FONT).is_ok());
    if *loaded { Ok(()) } else { Err(PlotError::Draw("the font is damaged".into())) }
}

/// Returns the error for a failure of the plotting library.
pub fn drawing(error: impl std::fmt::Display) -> PlotError {
    PlotError::Draw(error.to_string())
}

#[cfg(test)]
mod tests;
