//! A canvas that draws texts, lines and areas. All positions and lengths are in units. A unit is a CSS pixel in an SVG,
//! and several pixels in a PNG.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::colours::{FRAME, INK, LINES, PAPER};
use super::dashes::dashes;
use super::{FAMILY, PlotError, WIDTH, drawing, load_font};

/// Font size of all texts, as plotters expects it. In an SVG, plotters divides it by 1.24, which gives 13.7 units.
/// A picture printed 85 mm wide then has text of 9.2 pt.
const TEXT: u32 = 17;
/// Height of a line of text, in units.
pub(super) const LINE: f64 = 18.0;
/// Margin on all sides of a picture, in units.
pub(super) const MARGIN: f64 = 8.0;
/// Width between the left and the right margin, in units.
pub(super) const INSIDE: f64 = WIDTH as f64 - 2.0 * MARGIN;
/// Dash patterns of successive lines of a chart, see [`LineStyle::dashes`].
const DASHES: [Option<(u32, u32)>; 3] = [None, Some((8, 4)), Some((2, 3))];
/// The style of frames and ticks.
pub(super) const TICK: LineStyle = LineStyle { colour: FRAME, width: 1, dashes: None };

/// A position (x, y), in units from the upper left corner.
pub(super) type CanvasPoint = (f64, f64);

/// The style of a line. Widths and lengths are in units.
#[derive(Clone, Copy)]
pub(super) struct LineStyle {
    pub(super) colour: RGBColor,
    pub(super) width: u32,
    /// Lengths of dashes and gaps; `None` for a solid line.
    pub(super) dashes: Option<(u32, u32)>,
}

impl LineStyle {
    /// Returns the style of line `index` of a chart, from 0. Colours repeat after 7 lines and dash patterns after 3, so
    /// 21 lines have different styles.
    pub(super) fn nth(index: usize) -> Self {
        Self { colour: LINES[index % LINES.len()], width: 2, dashes: DASHES[index % DASHES.len()] }
    }
}

/// The horizontal alignment of a text: which part of it is at the given position.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum TextAnchor {
    Left,
    Middle,
    Right,
}

/// Returns the width of a text, in units.
pub(super) fn text_width(text: &str) -> f64 {
    let known = load_font().ok().and_then(|()| font(1).font.box_size(text).ok());
    known.map_or(0.6 * f64::from(TEXT) * text.chars().count() as f64, |(width, _)| f64::from(width))
}

/// Breaks a text into lines of at most `width` units. A wider word gets its own line. A number stays on the line of the
/// word before it, as in "seed 1".
pub(super) fn wrapped(text: &str, width: f64) -> Vec<String> {
    let mut words: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match words.last_mut().filter(|last| last.chars().all(char::is_alphabetic)) {
            Some(last) if word.parse::<f64>().is_ok() => *last += &format!(" {word}"),
            _ => words.push(word.to_owned()),
        }
    }
    let mut lines: Vec<String> = Vec::new();
    for word in words {
        match lines.last_mut() {
            Some(line) if text_width(&format!("{line} {word}")) <= width => *line = format!("{line} {word}"),
            _ => lines.push(word),
        }
    }
    lines
}

/// Returns the text style at this scale.
fn font(scale: u32) -> TextStyle<'static> {
    (FAMILY, TEXT * scale).into_font().color(&INK)
}

/// A drawing surface with coordinates in units, independent of the file format.
pub(super) struct PlotCanvas<'a, DB: DrawingBackend> {
    pub(super) area: &'a DrawingArea<DB, Shift>,
    pub(super) scale: u32,
}

impl<'a, DB: DrawingBackend> PlotCanvas<'a, DB> {
    /// Returns a canvas on `area`, which it fills with the background colour.
    pub(super) fn new(area: &'a DrawingArea<DB, Shift>, scale: u32) -> Result<Self, PlotError> {
        area.fill(&PAPER).map_err(drawing)?;
        Ok(Self { area, scale })
    }

    /// Converts a position in units to the pixels of the backend.
    pub(super) fn at(&self, (x, y): CanvasPoint) -> (i32, i32) {
        let step = |units: f64| (units * f64::from(self.scale)).round() as i32;
        (step(x), step(y))
    }

    /// Writes a line of text, vertically centred at the position.
    pub(super) fn text(&self, text: &str, at: CanvasPoint, side: TextAnchor) -> Result<(), PlotError> {
        let h = [HPos::Left, HPos::Center, HPos::Right][side as usize];
        // plotters does not centre text exactly. In an SVG, it places the middle of the letters at the position, in a
        // PNG a point above their middle. All texts are moved down by one unit.
        self.styled(text, font(self.scale).pos(Pos::new(h, VPos::Center)), (at.0, at.1 + 1.0))
    }

    /// Writes a text rotated by 90°, to be read from bottom to top, with its middle at the position.
    pub(super) fn vertical_text(&self, text: &str, at: CanvasPoint) -> Result<(), PlotError> {
        let turned = font(self.scale).transform(FontTransform::Rotate270);
        self.styled(text, turned.pos(Pos::new(HPos::Center, VPos::Center)), at)
    }

    /// Writes a text with a plotters style.
    fn styled(&self, text: &str, style: TextStyle<'_>, at: CanvasPoint) -> Result<(), PlotError> {
        self.area.draw_text(text, &style, self.at(at)).map_err(drawing)
    }

    /// Writes lines of text below each other, starting at `top`. Returns the y position below the last line.
    pub(super) fn lines(&self, lines: &[String], (x, top): CanvasPoint, side: TextAnchor) -> Result<f64, PlotError> {
        for (index, line) in lines.iter().enumerate() {
            self.text(line, (x, top + LINE * (index as f64 + 0.5)), side)?;
        }
        Ok(top + LINE * lines.len() as f64)
    }

    pub(super) fn rectangle(&self, corners: [CanvasPoint; 2], style: ShapeStyle) -> Result<(), PlotError> {
        self.area.draw(&Rectangle::new(corners.map(|corner| self.at(corner)), style)).map_err(drawing)
    }

    pub(super) fn polygon(&self, corners: &[CanvasPoint], style: ShapeStyle) -> Result<(), PlotError> {
        let corners: Vec<_> = corners.iter().map(|corner| self.at(*corner)).collect();
        self.area.draw(&Polygon::new(corners, style)).map_err(drawing)
    }

    pub(super) fn line(&self, points: &[CanvasPoint], style: LineStyle) -> Result<(), PlotError> {
        match style.dashes {
            None => self.solid_line(points, style),
            Some((dash, gap)) => {
                let dashes = dashes(points, dash.into(), gap.into());
                dashes.iter().try_for_each(|dash| self.solid_line(dash, style))
            }
        }
    }

    /// Draws a solid line.
    fn solid_line(&self, points: &[CanvasPoint], style: LineStyle) -> Result<(), PlotError> {
        let points: Vec<_> = points.iter().map(|point| self.at(*point)).collect();
        self.area.draw(&PathElement::new(points, self.stroke(style.colour, style.width))).map_err(drawing)
    }

    pub(super) fn circle(&self, at: CanvasPoint, radius: f64, style: ShapeStyle) -> Result<(), PlotError> {
        let radius = (radius * f64::from(self.scale)).round() as i32;
        self.area.draw(&Circle::new(self.at(at), radius, style)).map_err(drawing)
    }

    /// Returns the plotters style of a line of `width` units.
    pub(super) fn stroke(&self, colour: RGBColor, width: u32) -> ShapeStyle {
        colour.stroke_width(width * self.scale)
    }
}
