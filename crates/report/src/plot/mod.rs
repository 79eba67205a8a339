//! Draws pictures as SVG and PNG.
//!
//! All pictures have the width of a column in print, at which their texts are readable. Panels that do not fit side by
//! side are below each other, so pictures also fit the screen of a telephone. Lines have the colours of Okabe and Ito,
//! and dash patterns for print without colour. Heatmaps have the colours of viridis. Ticks are at round numbers.

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

/// The font DejaVu Sans, reduced to the characters that pictures need. Its licence is in the same folder.
const FONT: &[u8] = include_bytes!("../../data/fonts/DejaVuSans-subset.ttf");
/// The font family that an SVG names.
pub const FAMILY: &str = "sans-serif";
/// Width of every picture, in units. In an SVG, a unit is one CSS pixel. Printed pictures are 85 mm wide, the width of
/// a column.
pub const WIDTH: u32 = 360;
/// Number of coordinate steps per unit in an SVG. plotters rounds coordinates to steps, so more steps make lines
/// smoother.
const SVG_SCALE: u32 = 4;
/// Number of pixels per unit in a PNG. This gives some 320 pixels per inch in a column of 85 mm.
pub const PNG_SCALE: u32 = 3;

/// The reason why a picture could not be drawn or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlotError {
    /// plotters reported an error.
    #[error("cannot draw: {0}")]
    Draw(String),
    /// A file cannot be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The experiment's folder cannot be read.
    #[error(transparent)]
    Folder(#[from] FolderError),
}

/// A picture that can be drawn as SVG and as PNG. Its width is [`WIDTH`] units.
pub trait Plot {
    /// Returns the height of the picture, in units.
    fn height(&self) -> u32;

    /// Draws the picture on `area`, which has `scale` pixels or steps per unit.
    ///
    /// # Errors
    /// [`PlotError`] if the backend fails.
    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError>;

    /// Post-processes the SVG. By default returns it unchanged.
    fn finish(&self, svg: String) -> String {
        svg
    }
}

/// Returns a picture as the text of an SVG.
///
/// # Errors
/// [`PlotError::Draw`] if plotters fails.
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
    // plotters writes the size in steps. This replaces only the attributes `width` and `height` by units; the `viewBox`
    // stays in steps.
    let size = |(width, height): (u32, u32)| format!("width=\"{width}\" height=\"{height}\"");
    Ok(plot.finish(text.replacen(&size(steps), &size((width, height)), 1)))
}

/// Returns a picture as the bytes of a PNG, with [`PNG_SCALE`] pixels per unit.
///
/// # Errors
/// [`PlotError`] if plotters or the encoder fails.
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

/// Writes a picture as SVG and as PNG. Appends `.svg` and `.png` to `path`, and replaces each file atomically.
///
/// # Errors
/// [`PlotError`] if the picture cannot be drawn or written.
pub fn save(plot: &impl Plot, path: &Path) -> Result<(), PlotError> {
    for (ending, content) in [("svg", svg(plot)?.into_bytes()), ("png", png(plot)?)] {
        write_atomically(&path.with_added_extension(ending), &content)?;
    }
    Ok(())
}

/// Registers the font with plotters at the first call. Must be called before drawing or measuring text.
pub fn load_font() -> Result<(), PlotError> {
    static LOADED: OnceLock<bool> = OnceLock::new();
    let loaded = LOADED.get_or_init(|| register_font(FAMILY, FontStyle::Normal, FONT).is_ok());
    if *loaded { Ok(()) } else { Err(PlotError::Draw("the font is damaged".into())) }
}

/// Converts an error of plotters or of the PNG encoder.
pub fn drawing(error: impl std::fmt::Display) -> PlotError {
    PlotError::Draw(error.to_string())
}

#[cfg(test)]
mod tests;
