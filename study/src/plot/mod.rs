//! Pictures, as SVG and PNG.
//!
//! Lines have the colours of Okabe and Ito, which people with any colour vision tell apart, and dashes, which print
//! keeps. Surfaces have viridis, whose lightness alone says how much.

mod curves;
mod heatmap;
pub(crate) mod panels;
mod ticks;

use std::ops::Range;
use std::path::Path;
use std::sync::OnceLock;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::element::{DashedPathElement, DynElement};
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

use crate::files::{self, FileError, io, write_atomically};
use crate::folder::FolderError;
pub(crate) use curves::draw_tests;
pub use curves::{Quantity, draw_curves};
pub use heatmap::{HeatmapColumn, HeatmapPanels, common_returns};
pub use panels::Panels;

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
    /// A file cannot be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The folder cannot be read.
    #[error(transparent)]
    Folder(#[from] FolderError),
}

/// What any backend can draw. Everything is in units of the SVG times `scale`.
pub trait Plot {
    /// Width and height.
    fn size(&self) -> (u32, u32);

    /// Draws it.
    ///
    /// # Errors
    /// The backend's.
    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError>;

    /// What becomes of its SVG.
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
    {
        let area = SVGBackend::with_string(&mut text, plot.size()).into_drawing_area();
        plot.draw(&area, 1)?;
        area.present().map_err(drawing)?;
    }
    Ok(plot.finish(text))
}

/// A picture as PNG, with [`PNG_SCALE`] pixels for each unit.
///
/// # Errors
/// [`PlotError`].
pub fn png(plot: &impl Plot) -> Result<Vec<u8>, PlotError> {
    load_font()?;
    // The library encodes to files only.
    let scratch = tempfile::tempdir().map_err(io("create a folder in", &std::env::temp_dir()))?;
    let path = scratch.path().join("picture.png");
    let (width, height) = plot.size();
    let area = BitMapBackend::new(&path, (width * PNG_SCALE, height * PNG_SCALE)).into_drawing_area();
    plot.draw(&area, PNG_SCALE)?;
    area.present().map_err(drawing)?;
    Ok(files::read(&path)?)
}

/// Writes a picture as SVG and as PNG, each in one piece: `path` with these endings.
///
/// # Errors
/// [`PlotError`].
pub fn save(plot: &impl Plot, path: &Path) -> Result<(), PlotError> {
    for (ending, content) in [("svg", svg(plot)?.into_bytes()), ("png", png(plot)?)] {
        write_atomically(&path.with_extension(ending), &content)?;
    }
    Ok(())
}

/// Makes the font known to the library, once.
pub fn load_font() -> Result<(), PlotError> {
    static LOADED: OnceLock<bool> = OnceLock::new();
    let loaded = LOADED.get_or_init(|| register_font(FAMILY, FontStyle::Normal, FONT).is_ok());
    if *loaded { Ok(()) } else { Err(PlotError::Draw("the font is damaged".into())) }
}

/// What a backend of the plotting library refused.
pub fn drawing(error: impl std::fmt::Display) -> PlotError {
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

/// See [`LineStyle::dashes`].
const DASHES: [Option<(u32, u32)>; 3] = [None, Some((8, 4)), Some((2, 3))];

/// How a line looks; widths and lengths are in units.
#[derive(Clone, Copy)]
struct LineStyle {
    colour: RGBColor,
    width: u32,
    /// Dash and gap; none of a whole line.
    dashes: Option<(u32, u32)>,
}

impl LineStyle {
    /// Of the `index`th of several lines.
    fn nth(index: usize) -> Self {
        Self { colour: LINES[index % LINES.len()], width: 2, dashes: DASHES[index % DASHES.len()] }
    }

    fn along<'a, DB, C>(self, points: Vec<C>, scale: u32) -> DynElement<'a, DB, C>
    where
        DB: DrawingBackend + 'a,
        C: Clone + 'static,
    {
        let style = self.colour.stroke_width(self.width * scale);
        match self.dashes {
            None => PathElement::new(points, style).into_dyn(),
            Some((dash, gap)) => DashedPathElement::new(points, dash * scale, gap * scale, style).into_dyn(),
        }
    }
}

/// An axis of a chart.
struct AxisLook {
    name: String,
    range: Range<f64>,
    ticks: usize,
}

type Chart<'a, DB> = ChartContext<'a, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// An empty chart that fills `area`.
fn chart<'a, DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    caption: &str,
    x: AxisLook,
    y: AxisLook,
    scale: u32,
) -> Result<Chart<'a, DB>, PlotError> {
    let mut chart = ChartBuilder::on(area)
        .margin(8 * scale)
        .margin_right(16 * scale)
        .x_label_area_size(38 * scale)
        .y_label_area_size(56 * scale)
        .caption(caption, font(13, scale))
        .build_cartesian_2d(x.range, y.range)
        .map_err(drawing)?;
    chart
        .configure_mesh()
        .x_labels(x.ticks)
        .y_labels(y.ticks)
        .label_style(font(11, scale))
        .axis_desc_style(font(12, scale))
        .x_desc(x.name)
        .y_desc(y.name)
        .x_label_formatter(&|x| tick(*x))
        .y_label_formatter(&|y| tick(*y))
        .light_line_style(TRANSPARENT)
        .bold_line_style(RGBColor(225, 225, 225).stroke_width(scale))
        .axis_style(RGBColor(120, 120, 120).stroke_width(scale))
        .set_all_tick_mark_size(3 * scale)
        .draw()
        .map_err(drawing)?;
    Ok(chart)
}

/// A number at an axis: short, and without the noise of binary fractions.
fn tick(number: f64) -> String {
    let digits = match number.abs() {
        1e6.. => return format!("{}M", (number / 1e5).round() / 10.0),
        10_000.0.. => return format!("{}k", (number / 100.0).round() / 10.0),
        100.0.. => 0,
        10.0.. => 1,
        _ => 3,
    };
    let factor = 10_f64.powi(digits);
    // Adding 0 makes a negative zero positive.
    ((number * factor).round() / factor + 0.0).to_string()
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
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case(0.0, "0")]
    #[case(-0.0001, "0")]
    #[case(0.1 + 0.2, "0.3")]
    #[case(-12.34, "-12.3")]
    #[case(123.4, "123")]
    #[case(9999.6, "10000")]
    #[case(15_000.0, "15k")]
    #[case(-12_345.0, "-12.3k")]
    #[case(2_520_000.0, "2.5M")]
    fn numbers_at_an_axis_are_short(#[case] number: f64, #[case] shown: &str) {
        assert_eq!(tick(number), shown);
    }

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
        let look = |LineStyle { colour: RGBColor(r, g, b), dashes, .. }| (r, g, b, dashes);
        let styles: std::collections::HashSet<_> = (0..10).map(|i| look(LineStyle::nth(i))).collect();
        assert_eq!(styles.len(), 10, "as many as the paper has methods");
    }
}
