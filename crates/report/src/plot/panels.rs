//! Draws line charts with bands, in panels below each other.

use std::ops::Range;

use perturb_text::Table;
use plotters::coord::Shift;
use plotters::prelude::*;

use super::canvas::{INSIDE, LINE, LineStyle, MARGIN, PlotCanvas, TextAnchor, text_width, wrapped};
use super::frame::{Frame, NAME, NUMBERS, y_numbers_width};
use super::{Plot, PlotError, WIDTH};

/// Height of a panel's frame, in units.
const HEIGHT: f64 = 128.0;
/// Gap between two panels and around the legend, in units.
const GAP: f64 = 8.0;
/// Length of a line's sample in the legend, in units.
const SAMPLE: f64 = 30.0;
/// Gap between columns of the legend, in units.
const BETWEEN: f64 = 16.0;
/// Radius of the dot for a line with a single point, in units.
const DOT: f64 = 3.0;

/// Axis range for success rates, %. It is slightly larger than 0 to 100, so that lines at the ends are visible.
pub(crate) const RATES: Range<f64> = -2.0..102.0;

/// A picture of line charts below each other, with a common legend. If successive panels have the same x axis, only the
/// lowest of these panels shows the axis' numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Panels {
    /// The title above all panels.
    pub(crate) title: String,
    /// The panels from top to bottom.
    pub(crate) panels: Vec<PlotPanel>,
    /// The names of the lines, by [`PanelLine::index`].
    pub(crate) legend: Vec<String>,
    /// The explanation of lines and bands, below the legend.
    pub(crate) note: String,
}

/// A line chart.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PlotPanel {
    pub(crate) caption: String,
    pub(crate) x_name: String,
    pub(crate) x: Range<f64>,
    pub(crate) y_name: String,
    pub(crate) y: Range<f64>,
    pub(crate) lines: Vec<PanelLine>,
}

/// A line with its band.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PanelLine {
    /// The index of the line's name in the legend.
    pub(crate) index: usize,
    pub(crate) points: Vec<PanelPoint>,
}

/// A point of a line, with its band.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PanelPoint {
    pub(crate) x: f64,
    pub(crate) y: f64,
    /// The lower end of the band.
    pub(crate) low: f64,
    /// The upper end of the band.
    pub(crate) high: f64,
}

impl Plot for Panels {
    fn height(&self) -> u32 {
        let texts = self.title_lines().len() + self.legend_places().1 + self.note_lines().len();
        let panels = |index| LINE + HEIGHT + if self.has_x_axis(index) { NUMBERS + LINE } else { 0.0 } + GAP;
        let panels: f64 = (0..self.panels.len()).map(panels).sum();
        (2.0 * MARGIN + LINE * texts as f64 + panels + GAP).ceil() as u32
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        let canvas = PlotCanvas::new(area, scale)?;
        let mut top = canvas.lines(&self.title_lines(), (MARGIN, MARGIN), TextAnchor::Left)?;
        for (index, panel) in self.panels.iter().enumerate() {
            let frame = self.frame(panel, top + LINE);
            canvas.text(&panel.caption, (frame.left, top + LINE / 2.0), TextAnchor::Left)?;
            panel.draw(&canvas, &frame, self.has_x_axis(index))?;
            top = frame.bottom() + GAP;
            if self.has_x_axis(index) {
                canvas.text(
                    &panel.x_name,
                    (frame.middle().0, frame.bottom() + NUMBERS + LINE / 2.0),
                    TextAnchor::Middle,
                )?;
                top += NUMBERS + LINE;
            }
        }
        let below = self.draw_legend(&canvas, top)?;
        canvas.lines(&self.note_lines(), (MARGIN, below), TextAnchor::Left).map(|_| ())
    }
}

impl Panels {
    fn title_lines(&self) -> Vec<String> {
        wrapped(&self.title, INSIDE)
    }

    fn note_lines(&self) -> Vec<String> {
        wrapped(&self.note, INSIDE)
    }

    /// Returns whether the panel shows the numbers and the name of its x axis. This is true for the last panel, and
    /// for every panel whose successor has a different x axis.
    fn has_x_axis(&self, index: usize) -> bool {
        let axis = |panel: &PlotPanel| (panel.x_name.clone(), panel.x.clone());
        self.panels.get(index + 1).is_none_or(|next| axis(next) != axis(&self.panels[index]))
    }

    /// Returns the frame of a panel with its upper edge at `top`. The left edges of all frames are aligned.
    fn frame(&self, panel: &PlotPanel, top: f64) -> Frame {
        let numbers = self.panels.iter().map(|panel| y_numbers_width(&panel.y, HEIGHT)).fold(0.0, f64::max);
        let left = MARGIN + NAME + numbers;
        let width = f64::from(WIDTH) - left - MARGIN - 4.0; // the last number may extend beyond the frame by 4 units
        Frame { left, top, width, height: HEIGHT, x: panel.x.clone(), y: panel.y.clone() }
    }

    /// Returns the left end and the row of each legend entry, and the number of rows.
    fn legend_places(&self) -> (Vec<(f64, usize)>, usize) {
        let widest = self.legend.iter().map(|name| text_width(name)).fold(0.0, f64::max) + SAMPLE + 8.0 + BETWEEN;
        let columns = (((INSIDE + BETWEEN) / widest) as usize).clamp(1, self.legend.len().max(1));
        let column = (INSIDE + BETWEEN) / columns as f64;
        let mut line = 0;
        let mut places = Vec::new();
        for (index, name) in self.legend.iter().enumerate() {
            places.push((MARGIN + column * (index % columns) as f64, line));
            let lines = if columns == 1 { wrapped(name, INSIDE - SAMPLE - 8.0).len() } else { 1 };
            if (index + 1) % columns == 0 || index + 1 == self.legend.len() {
                line += lines;
            }
        }
        (places, line)
    }

    /// Draws the legend at `top`, and returns the y position of its lower end.
    fn draw_legend<DB: DrawingBackend>(&self, canvas: &PlotCanvas<'_, DB>, top: f64) -> Result<f64, PlotError> {
        let (places, lines) = self.legend_places();
        for (index, (name, (x, line))) in self.legend.iter().zip(places).enumerate() {
            let line_top = top + LINE * line as f64;
            let y = line_top + LINE / 2.0;
            canvas.line(&[(x, y), (x + SAMPLE, y)], LineStyle::nth(index))?;
            canvas.lines(&wrapped(name, INSIDE - SAMPLE - 8.0), (x + SAMPLE + 8.0, line_top), TextAnchor::Left)?;
        }
        Ok(top + LINE * lines as f64)
    }

    /// Returns the drawn numbers as a table with a row for each point. Its columns `x_name` and `y_name` have the names
    /// of the axes.
    pub(crate) fn table(&self) -> Table {
        let of_panel = |panel: &'_ PlotPanel| {
            let of_line = |line: &PanelLine| {
                let index = line.index;
                line.points.iter().map(move |point| (index, *point)).collect::<Vec<_>>()
            };
            let points: Vec<_> = panel.lines.iter().flat_map(of_line).collect();
            points.into_iter().map(|(index, point)| (panel.clone_names(), index, point)).collect::<Vec<_>>()
        };
        let points: Vec<([String; 3], usize, PanelPoint)> = self.panels.iter().flat_map(of_panel).collect();
        Table::builder("", &points)
            .text("panel", |([caption, ..], ..)| caption)
            .text("line", |(_, index, _)| self.legend.get(*index).cloned().unwrap_or_default())
            .text("x_name", |([_, x, _], ..)| x)
            .number("x", |(.., point)| point.x)
            .text("y_name", |([.., y], ..)| y)
            .number("y", |(.., point)| point.y)
            .number("low", |(.., point)| point.low)
            .number("high", |(.., point)| point.high)
            .build()
    }
}

impl PlotPanel {
    /// Returns the caption and the names of both axes.
    fn clone_names(&self) -> [String; 3] {
        [self.caption.clone(), self.x_name.clone(), self.y_name.clone()]
    }

    fn draw<DB: DrawingBackend>(
        &self,
        canvas: &PlotCanvas<'_, DB>,
        frame: &Frame,
        numbers: bool,
    ) -> Result<(), PlotError> {
        canvas.frame(frame, true)?;
        canvas.x_ticks(frame, numbers)?;
        canvas.y_ticks(frame, true)?;
        canvas.vertical_text(&self.y_name, (MARGIN + LINE / 2.0, frame.middle().1))?;
        // Values outside the range of the axis are drawn at its end.
        let within = |y: f64| frame.y(y).clamp(frame.top, frame.bottom());
        for PanelLine { index, points } in &self.lines {
            let style = LineStyle::nth(*index);
            // A single point has no line, so it is drawn as a dot with a bar.
            if let [point] = points[..] {
                let (x, bar) = (frame.x(point.x), LineStyle { width: 1, dashes: None, ..style });
                canvas.line(&[(x, within(point.low)), (x, within(point.high))], bar)?;
                canvas.circle((x, within(point.y)), DOT, style.colour.filled())?;
                continue;
            }
            let there = points.iter().map(|point| (frame.x(point.x), within(point.high)));
            let back = points.iter().rev().map(|point| (frame.x(point.x), within(point.low)));
            let band: Vec<_> = there.chain(back).collect();
            canvas.polygon(&band, style.colour.mix(0.16).filled())?;
            let line: Vec<_> = points.iter().map(|point| (frame.x(point.x), within(point.y))).collect();
            canvas.line(&line, style)?;
        }
        Ok(())
    }
}

/// Returns the index of `one` in `all`; 0 if it is not there.
pub(crate) fn index_of<T: PartialEq>(all: &[T], one: &T) -> usize {
    all.iter().position(|known| known == one).unwrap_or_default()
}
