//! Pictures, as SVG and PNG.
//!
//! Lines have the colours of Okabe and Ito, which people with any colour vision tell apart, and dashes, which print
//! keeps. Surfaces have viridis, whose lightness alone says how much.

mod curves;
mod heatmap;

use std::path::Path;
use std::sync::OnceLock;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

use super::folder::write_atomically;
pub use curves::{Quantity, draw_curves};
pub use heatmap::draw_heatmap;

/// DejaVu Sans, cut down to the letters that pictures have; its licence is beside it.
const FONT: &[u8] = include_bytes!("../../data/fonts/DejaVuSans-subset.ttf");
/// What the font is called in an SVG.
pub const FAMILY: &str = "sans-serif";
/// PNG has so many pixels for one unit of the SVG, so that it can be printed.
pub const PNG_SCALE: u32 = 2;

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlotError {
    /// The plotting library refused.
    #[error("cannot draw: {0}")]
    Draw(String),
    /// The file cannot be written.
    #[error("cannot write {path}: {reason}")]
    File {
        /// Its path.
        path: String,
        /// What the library or the system said.
        reason: String,
    },
}

impl PlotError {
    /// Of a file at `path`.
    pub(super) fn file(path: &Path, reason: &dyn std::fmt::Display) -> Self {
        Self::File { path: path.display().to_string(), reason: reason.to_string() }
    }
}

/// A picture that can be drawn with any backend. Everything is in units of the SVG times `scale`.
pub trait Picture {
    /// Width and height.
    fn size(&self) -> (u32, u32);

    /// Draws it.
    ///
    /// # Errors
    /// The backend's.
    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError>;
}

/// The picture as SVG.
///
/// # Errors
/// [`PlotError::Draw`].
pub fn svg(picture: &impl Picture) -> Result<String, PlotError> {
    load_font()?;
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, picture.size()).into_drawing_area();
        picture.draw(&area, 1)?;
        area.present().map_err(drawing)?;
    }
    Ok(text)
}

/// The picture as PNG, with [`PNG_SCALE`] pixels for each unit.
///
/// # Errors
/// [`PlotError`].
pub fn png(picture: &impl Picture) -> Result<Vec<u8>, PlotError> {
    load_font()?;
    // The library encodes to files only.
    let scratch = tempfile::tempdir().map_err(|error| PlotError::file(&std::env::temp_dir(), &error))?;
    let path = scratch.path().join("picture.png");
    let (width, height) = picture.size();
    let area = BitMapBackend::new(&path, (width * PNG_SCALE, height * PNG_SCALE)).into_drawing_area();
    picture.draw(&area, PNG_SCALE)?;
    area.present().map_err(|error| PlotError::file(&path, &error))?;
    std::fs::read(&path).map_err(|error| PlotError::file(&path, &error))
}

/// Writes the picture as SVG and as PNG, each in one piece: `path` with these endings.
///
/// # Errors
/// [`PlotError`].
pub fn save(picture: &impl Picture, path: &Path) -> Result<(), PlotError> {
    for (ending, content) in [("svg", svg(picture)?.into_bytes()), ("png", png(picture)?)] {
        let path = path.with_extension(ending);
        write_atomically(&path, &content).map_err(|error| PlotError::file(&path, &error))?;
    }
    Ok(())
}

/// Makes the font known to the library, once.
pub fn load_font() -> Result<(), PlotError> {
    static LOADED: OnceLock<bool> = OnceLock::new();
    let loaded = LOADED.get_or_init(|| register_font(FAMILY, FontStyle::Normal, FONT).is_ok());
    if *loaded { Ok(()) } else { Err(PlotError::Draw("the font is damaged".into())) }
}

fn drawing(error: impl std::fmt::Display) -> PlotError {
    PlotError::Draw(error.to_string())
}

/// A text of `size` units.
fn font(size: u32, scale: u32) -> TextStyle<'static> {
    (FAMILY, size * scale).into_font().color(&RGBColor(34, 34, 34))
}

/// The colours of lines, after Okabe and Ito (2008), darkest first; yellow is left out, since it is not seen on white.
const LINES: [RGBColor; 7] = [
    RGBColor(0, 0, 0),
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
];

/// Dashes and gaps, in units; none is a whole line.
const DASHES: [Option<(u32, u32)>; 3] = [None, Some((8, 4)), Some((2, 3))];

/// Colour and dashes of the `index`th line.
fn line_style(index: usize) -> (RGBColor, Option<(u32, u32)>) {
    (LINES[index % LINES.len()], DASHES[index % DASHES.len()])
}

/// Anchors of viridis (Smith and van der Walt, 2015) at equal distances.
const VIRIDIS: [(u8, u8, u8); 9] = [
    (68, 1, 84),
    (71, 45, 123),
    (59, 82, 139),
    (44, 114, 142),
    (33, 145, 140),
    (40, 174, 128),
    (94, 201, 98),
    (173, 220, 48),
    (253, 231, 37),
];

/// Light to dark blue, for numbers that are read in the colour: text on it stays readable, and ink is spared.
const BLUES: [(u8, u8, u8); 5] = [(247, 251, 255), (198, 219, 239), (107, 174, 214), (33, 113, 181), (8, 48, 107)];

/// The colour for `share`, 0 … 1, from light to dark.
pub fn shade(share: f64) -> (u8, u8, u8) {
    blend(&BLUES, share)
}

/// The colour for `share`, 0 … 1, from dark to light.
fn viridis(share: f64) -> RGBColor {
    let (r, g, b) = blend(&VIRIDIS, share);
    RGBColor(r, g, b)
}

/// A colour between the anchors.
fn blend(anchors: &[(u8, u8, u8)], share: f64) -> (u8, u8, u8) {
    let place = share.clamp(0.0, 1.0) * (anchors.len() - 1) as f64;
    let below = (place as usize).min(anchors.len() - 2);
    let weight = place - below as f64;
    let mix = |low: u8, high: u8| (f64::from(low) * (1.0 - weight) + f64::from(high) * weight).round() as u8;
    let (low, high) = (anchors[below], anchors[below + 1]);
    (mix(low.0, high.0), mix(low.1, high.1), mix(low.2, high.2))
}

/// Whether white text is read better on a colour than black.
pub fn is_dark((r, g, b): (u8, u8, u8)) -> bool {
    luminance((r, g, b)) < 0.179 // there both contrasts are equal
}

/// Relative luminance, 0 … 1, as WCAG 2 defines it.
fn luminance((r, g, b): (u8, u8, u8)) -> f64 {
    let linear = |channel: u8| {
        let c = f64::from(channel) / 255.0;
        if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
    };
    0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lightness_alone_says_how_much() {
        let shares: Vec<f64> = (0..=100).map(|i| f64::from(i) / 100.0).collect();
        let rising = |colours: Vec<f64>| colours.windows(2).all(|pair| pair[0] < pair[1]);
        assert!(rising(
            shares
                .iter()
                .map(|&share| {
                    let c = viridis(share);
                    luminance((c.0, c.1, c.2))
                })
                .collect()
        ));
        assert!(rising(shares.iter().rev().map(|&share| luminance(shade(share))).collect()));
        assert_eq!((shade(-1.0), shade(2.0)), (BLUES[0], BLUES[4]));
    }

    #[test]
    fn text_on_a_shade_has_the_contrast_that_wcag_asks_for() {
        for i in 0..=100 {
            let colour = shade(f64::from(i) / 100.0);
            let ink = if is_dark(colour) { 1.0 } else { 0.0 };
            let (light, dark) = (luminance(colour).max(ink), luminance(colour).min(ink));
            assert!((light + 0.05) / (dark + 0.05) >= 4.5, "{i} %");
        }
    }

    #[test]
    fn lines_are_seen_on_white_and_differ() {
        for colour in LINES {
            assert!((1.05) / (luminance((colour.0, colour.1, colour.2)) + 0.05) > 2.0, "{colour:?}");
        }
        let styles: std::collections::HashSet<_> = (0..10)
            .map(|i| {
                let (c, dash) = line_style(i);
                ((c.0, c.1, c.2), dash)
            })
            .collect();
        assert_eq!(styles.len(), 10, "as many as the paper has methods");
    }
}
