//! Draws heatmaps of several policies side by side. The upper panels show the mean return over two parameters, the
//! lower panels the success rate. Each panel also shows the ranges of the versions R (random) and E (extreme) as boxes,
//! and the default parameters as a ring. All panels share their axes. Panels of the same quantity share a colour scale.

mod scale;
mod surfaces;

use std::ops::Range;

use perturb_records::statistics::mean;
use perturb_records::{Axis, Heatmap, HeatmapPoint};
use plotters::coord::Shift;
use plotters::prelude::*;

use super::canvas::{CanvasPoint, INSIDE, LINE, LineStyle, MARGIN, PlotCanvas, TICK, TextAnchor, text_width, wrapped};
use super::colours::viridis;
use super::frame::{Frame, NAME, NUMBERS, y_numbers_width};
use super::{Plot, PlotError, WIDTH, drawing};
pub use scale::common_returns;

/// Maximum number of columns in a single row.
const MAX_COLUMNS: usize = 4;
/// Number of columns in each row if there are more than [`MAX_COLUMNS`].
const COLUMNS_IF_SEVERAL_ROWS: usize = 3;
/// Maximum width of a panel, in units.
const MAX_PANEL_WIDTH: f64 = 210.0;
/// Minimum and maximum height of a panel, in units.
const HEIGHTS: Range<f64> = 96.0..150.0;
/// Gap between panels, and between a panel and the texts below it, in units.
const GAP: f64 = 9.0;
/// Height of the colour scale, in units.
const BAR: f64 = 10.0;
/// The outline of the box that shows the range of version R. It is a white line on a wider black line, so that it is
/// visible on every colour.
const RANDOM: [LineStyle; 2] = [outline(BLACK, 4), outline(WHITE, 2)];
/// The outline of the boxes that show the ranges of version E: a red line on a wider white line.
const EXTREME: [LineStyle; 2] = [outline(WHITE, 4), outline(RGBColor(200, 30, 30), 2)];
/// Minimum distance of a box from the edges of its panel, in units.
const BOX_MARGIN: f64 = 2.0;
/// Width and height of a symbol in the legend, in units.
const SAMPLE: (f64, f64) = (24.0, 14.0);

/// Returns the style of a solid line.
const fn outline(colour: RGBColor, width: u32) -> LineStyle {
    LineStyle { colour, width, dashes: None }
}

/// A picture of heatmaps over the same two parameters, side by side.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatmapPanels {
    /// The lines above all panels: the subject of the picture, and how the heatmaps were made.
    pub title: Vec<String>,
    /// The x and y axes.
    pub axes: [Axis; 2],
    /// The range of mean returns that the colour scale covers.
    pub returns: Range<f64>,
    /// The columns from left to right.
    pub columns: Vec<HeatmapColumn>,
}

/// A column of the picture: one heatmap with its caption.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatmapColumn {
    /// The caption of the column.
    pub caption: String,
    /// The heatmap, or the reason why there is none.
    pub content: Result<Heatmap, String>,
}

/// A quantity that heatmaps show: mean return or success rate.
struct HeatmapQuantity {
    name: &'static str,
    range: Range<f64>,
    value: fn(&HeatmapPoint) -> f64,
}

/// The texts of the legend.
const KEY: [&str; 3] = ["box of R, random", "box of E, extreme", "D, default"];

impl Plot for HeatmapPanels {
    fn height(&self) -> u32 {
        let quantity: f64 = GAP + LINE + NUMBERS + self.rows().map(|row| self.row_height(row)).sum::<f64>();
        let texts = LINE * (self.title_lines().len() + 1) as f64;
        (2.0 * MARGIN + texts + 2.0 * quantity + self.key_places().1 + GAP).ceil() as u32
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        let canvas = PlotCanvas::new(area, scale)?;
        let mut top = canvas.lines(&self.title_lines(), (MARGIN, MARGIN), TextAnchor::Left)?;
        let [x, y] = &self.axes;
        let quantities = [
            HeatmapQuantity { name: "mean return", range: self.returns.clone(), value: |point| point.mean_return },
            HeatmapQuantity { name: "success rate, %", range: 0.0..100.0, value: |point| point.success_percent },
        ];
        for quantity in &quantities {
            top += GAP;
            canvas.colours(quantity, self.frame(0, top).left, top)?;
            top += LINE + NUMBERS;
            for row in self.rows() {
                let captions = self.caption_lines(row);
                for (column, (of, caption)) in row.iter().zip(&captions).enumerate() {
                    let frame = self.frame(column, top + LINE * max_lines(&captions));
                    let first = frame.top - LINE * caption.len() as f64;
                    canvas.lines(caption, (frame.middle().0, first), TextAnchor::Middle)?;
                    match &of.content {
                        Ok(heatmap) => self.panel(&canvas, &frame, heatmap, quantity)?,
                        Err(why) => canvas.missing_note(&frame, why)?,
                    }
                    canvas.frame(&frame, false)?;
                    canvas.x_ticks(&frame, true)?;
                    canvas.y_ticks(&frame, column == 0)?;
                    if column == 0 {
                        canvas.vertical_text(&label(y), (MARGIN + LINE / 2.0, frame.middle().1))?;
                    }
                }
                top += self.row_height(row);
            }
        }
        let middle = self.frame(0, 0.0).left + self.row_width() / 2.0;
        canvas.text(&label(x), (middle, top - GAP + LINE / 2.0), TextAnchor::Middle)?;
        self.key(&canvas, top + LINE)
    }

    /// Replaces the thousands of rectangles of the heatmaps by one path for each colour.
    fn finish(&self, svg: String) -> String {
        surfaces::as_paths(&svg)
    }
}

/// Returns the number of lines of the text with the most lines.
fn max_lines(texts: &[Vec<String>]) -> f64 {
    texts.iter().map(Vec::len).max().unwrap_or(0) as f64
}

/// Returns the name of an axis with its unit.
fn label(axis: &Axis) -> String {
    if axis.unit == "1" { axis.name.clone() } else { format!("{}, {}", axis.name, axis.unit) }
}

impl HeatmapPanels {
    fn title_lines(&self) -> Vec<String> {
        self.title.iter().flat_map(|title| wrapped(title, INSIDE)).collect()
    }

    /// Returns the number of columns in each row of the picture.
    fn per_row(&self) -> usize {
        if self.columns.len() > MAX_COLUMNS { COLUMNS_IF_SEVERAL_ROWS } else { self.columns.len().max(1) }
    }

    /// Returns the picture's columns, divided into the picture's rows.
    fn rows(&self) -> std::slice::Chunks<'_, HeatmapColumn> {
        self.columns.chunks(self.per_row())
    }

    /// Returns the width and height of a panel, in units.
    fn size(&self) -> (f64, f64) {
        let [_, y] = &self.axes;
        let left = MARGIN + NAME + y_numbers_width(&(y.low..y.high), HEIGHTS.start);
        let columns = self.per_row() as f64;
        // Leaves 2 units on the right, because the last number on the x axis may extend beyond its panel by as much.
        let width = (f64::from(WIDTH) - left - MARGIN - 2.0 - GAP * (columns - 1.0)) / columns;
        (width.min(MAX_PANEL_WIDTH), width.clamp(HEIGHTS.start, HEIGHTS.end))
    }

    /// Returns the frame of the panel in this column of a row. The upper edge of the frame is at `top`.
    fn frame(&self, column: usize, top: f64) -> Frame {
        let [x, y] = &self.axes;
        let (width, height) = self.size();
        let left = MARGIN + NAME + y_numbers_width(&(y.low..y.high), height) + column as f64 * (width + GAP);
        Frame { left, top, width, height, x: x.low..x.high, y: y.low..y.high }
    }

    /// Returns the width of a full row, in units.
    fn row_width(&self) -> f64 {
        let columns = self.per_row().min(self.columns.len().max(1)) as f64;
        columns * self.size().0 + (columns - 1.0) * GAP
    }

    /// Returns each caption of a row, broken into lines.
    fn caption_lines(&self, row: &[HeatmapColumn]) -> Vec<Vec<String>> {
        row.iter().map(|of| wrapped(&of.caption, self.size().0)).collect()
    }

    /// Returns the height of a row with captions, panels and tick numbers, in units.
    fn row_height(&self, row: &[HeatmapColumn]) -> f64 {
        LINE * max_lines(&self.caption_lines(row)) + self.size().1 + NUMBERS + GAP
    }

    /// Draws a heatmap into its frame.
    fn panel<DB: DrawingBackend>(
        &self,
        canvas: &PlotCanvas<'_, DB>,
        frame: &Frame,
        heatmap: &Heatmap,
        quantity: &HeatmapQuantity,
    ) -> Result<(), PlotError> {
        canvas.surface(frame, heatmap, quantity)?;
        let [x, y] = &self.axes;
        for (lines, x_pairs, y_pairs) in [(EXTREME, &x.extreme, &y.extreme), (RANDOM, &x.random, &y.random)] {
            for &(left, right) in x_pairs {
                for &(bottom, top) in y_pairs {
                    let inside = |(x, y): CanvasPoint| {
                        let x = x.clamp(frame.left + BOX_MARGIN, frame.right() - BOX_MARGIN);
                        (x, y.clamp(frame.top + BOX_MARGIN, frame.bottom() - BOX_MARGIN))
                    };
                    let corners = [(frame.x(left), frame.y(top)), (frame.x(right), frame.y(bottom))];
                    canvas.outline(corners.map(inside), lines)?;
                }
            }
        }
        let shown = |axis: &Axis| (axis.low..=axis.high).contains(&axis.default);
        if shown(x) && shown(y) { canvas.mark((frame.x(x.default), frame.y(y.default))) } else { Ok(()) }
    }

    /// Returns the positions of the legend's symbols, relative to the top of the legend, and the legend's height.
    fn key_places(&self) -> ([CanvasPoint; 3], f64) {
        let (mut x, mut y) = (MARGIN, GAP);
        let places = KEY.map(|name| {
            let width = SAMPLE.0 + 6.0 + text_width(name) + 14.0;
            if x > MARGIN && x + width > MARGIN + INSIDE + 14.0 {
                (x, y) = (MARGIN, y + LINE + 2.0);
            }
            let place = (x, y);
            x += width;
            place
        });
        (places, y + LINE)
    }

    /// Draws the legend at `top`.
    fn key<DB: DrawingBackend>(&self, canvas: &PlotCanvas<'_, DB>, top: f64) -> Result<(), PlotError> {
        for (index, (name, (x, y))) in KEY.into_iter().zip(self.key_places().0).enumerate() {
            let (left, above) = (x, top + y + (LINE - SAMPLE.1) / 2.0);
            let corners = [(left, above), (left + SAMPLE.0, above + SAMPLE.1)];
            // The background of a symbol is a colour of the heatmap, because the symbol's white lines would be
            // invisible on white.
            canvas.rectangle(corners, viridis(0.4).filled())?;
            let middle = (left + SAMPLE.0 / 2.0, above + SAMPLE.1 / 2.0);
            match index {
                0 => canvas.outline(corners, RANDOM)?,
                1 => canvas.outline(corners, EXTREME)?,
                _ => canvas.mark(middle)?,
            }
            canvas.text(name, (left + SAMPLE.0 + 6.0, middle.1), TextAnchor::Left)?;
        }
        Ok(())
    }
}

impl<DB: DrawingBackend> PlotCanvas<'_, DB> {
    /// Draws the coloured surface of a heatmap. Neighbouring points of the same colour in a row form one rectangle.
    fn surface(&self, frame: &Frame, heatmap: &Heatmap, quantity: &HeatmapQuantity) -> Result<(), PlotError> {
        let ((left, top), (right, bottom)) =
            (self.at((frame.left, frame.top)), self.at((frame.right(), frame.bottom())));
        let (width, height, grid) = (right - left, bottom - top, heatmap.grid as i32);
        let edge = |length: i32, index: usize| length * index as i32 / grid;
        // First draws a background in the mean colour. Some renderers smooth edges, so that the background is visible
        // between rectangles.
        let (low, high) = (quantity.range.start, quantity.range.end);
        let shares =
            heatmap.points.iter().map(|point| (((quantity.value)(point) - low) / (high - low)).clamp(0.0, 1.0));
        let corners = [
            (frame.left, frame.top),
            (frame.right(), frame.top),
            (frame.right(), frame.bottom()),
            (frame.left, frame.bottom()),
        ];
        self.polygon(&corners, viridis(mean(shares)).filled())?;
        let range = &quantity.range;
        let colour =
            |point: &HeatmapPoint| viridis(((quantity.value)(point) - range.start) / (range.end - range.start));
        for (line, points) in heatmap.points.chunks(heatmap.grid).enumerate() {
            let (below, above) = (bottom - edge(height, line), bottom - edge(height, line + 1));
            let mut from = 0;
            for same in points.chunk_by(|a, b| colour(a) == colour(b)) {
                let corners = [(left + edge(width, from), above), (left + edge(width, from + same.len()), below)];
                self.area.draw(&Rectangle::new(corners, colour(&same[0]).filled())).map_err(drawing)?;
                from += same.len();
            }
        }
        Ok(())
    }

    /// Writes the reason why a heatmap is missing into its panel.
    fn missing_note(&self, frame: &Frame, why: &str) -> Result<(), PlotError> {
        let (right, bottom) = (frame.right(), frame.bottom());
        self.line(&[(frame.left, frame.top), (right, frame.top), (right, bottom)], TICK)?;
        let mut lines = wrapped(why, frame.width - 4.0);
        if LINE * lines.len() as f64 > frame.height {
            lines = vec!["missing".into()]; // the reason does not fit; the picture's caption has it
        }
        let first = frame.middle().1 - LINE * lines.len() as f64 / 2.0;
        self.lines(&lines, (frame.middle().0, first), TextAnchor::Middle).map(|_| ())
    }

    /// Draws the outline of a box twice: first with the wider line style, then with the narrower one on top.
    fn outline(
        &self,
        [(left, top), (right, bottom)]: [CanvasPoint; 2],
        lines: [LineStyle; 2],
    ) -> Result<(), PlotError> {
        for line in lines {
            // Draws each side separately, extended to the corners. plotters does not close the corners of a path in a
            // PNG.
            let half = f64::from(line.width) / 2.0;
            for y in [top, bottom] {
                self.line(&[(left - half, y), (right + half, y)], line)?;
            }
            for x in [left, right] {
                self.line(&[(x, top - half), (x, bottom + half)], line)?;
            }
        }
        Ok(())
    }

    /// Marks the default parameters by a black ring on a wider white ring.
    fn mark(&self, at: CanvasPoint) -> Result<(), PlotError> {
        [(WHITE, 5), (BLACK, 2)]
            .into_iter()
            .try_for_each(|(colour, width)| self.circle(at, 4.0, self.stroke(colour, width)))
    }

    /// Draws the name of a quantity and its colour scale.
    fn colours(&self, quantity: &HeatmapQuantity, left: f64, top: f64) -> Result<(), PlotError> {
        self.text(quantity.name, (left, top + LINE / 2.0), TextAnchor::Left)?;
        let from = left + text_width("success rate, %") + 14.0;
        let frame = Frame {
            left: from,
            top: top + (LINE - BAR) / 2.0,
            width: f64::from(WIDTH) - MARGIN - 10.0 - from,
            height: BAR,
            x: quantity.range.clone(),
            y: 0.0..1.0,
        };
        let ((x, above), (right, below)) = (self.at((frame.left, frame.top)), self.at((frame.right(), frame.bottom())));
        let steps = 100;
        for step in 0..steps {
            let place = |step: i32| x + (right - x) * step / steps;
            let colour = viridis(f64::from(step) / f64::from(steps - 1));
            let corners = [(place(step), above), (place(step + 1), below)];
            self.area.draw(&Rectangle::new(corners, colour.filled())).map_err(drawing)?;
        }
        self.x_ticks(&frame, true)
    }
}

#[cfg(test)]
mod tests;
