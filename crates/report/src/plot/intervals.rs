//! Draws numbers with their confidence intervals, in groups of rows. A row may also have a second number for
//! comparison.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::canvas::{CanvasPoint, INSIDE, LINE, LineStyle, MARGIN, PlotCanvas, TextAnchor, text_width, wrapped};
use super::colours::{INK, PAPER};
use super::frame::{Frame, NUMBERS};
use super::{Plot, PlotError, WIDTH};

/// Maximum width of the rows' names, in units. Longer names are wrapped.
const NAMES: f64 = 150.0;
/// Gap between rows and between groups, in units.
const GAP: f64 = 5.0;
/// Vertical distance of a number from the middle of its row, in units, if the row also has a second number.
const APART: f64 = 4.5;
/// Radius of a marker, in units.
const RADIUS: f64 = 4.0;
/// Half of the height of the caps at the ends of an interval, in units.
const CAP: f64 = 3.5;

/// A picture of numbers with intervals: groups of rows with the same x axis.
#[derive(Clone, Debug, PartialEq)]
pub struct IntervalPlot {
    /// The title above all groups.
    pub(crate) title: String,
    /// The name of the x axis.
    pub(crate) x_name: String,
    pub(crate) x: Range<f64>,
    pub(crate) groups: Vec<Group>,
    /// The texts of the legend. They explain the symbols for a row's number, its interval and its second number (see
    /// [`IntervalRow::other`]). A text may be empty if its symbol occurs in no row.
    pub(crate) legend: [String; 3],
    /// The note below all groups.
    pub(crate) note: String,
}

/// A group of rows with a heading.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Group {
    pub(crate) name: String,
    pub(crate) rows: Vec<IntervalRow>,
}

/// A row: a number with its interval.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct IntervalRow {
    pub(crate) name: String,
    /// The index of the row's line style, see [`LineStyle::nth`].
    pub(crate) index: usize,
    pub(crate) point: Option<f64>,
    pub(crate) interval: Option<[f64; 2]>,
    /// A second number, drawn for comparison with `point`: for example, the result in the paper.
    pub(crate) other: Option<f64>,
}

impl Plot for IntervalPlot {
    fn height(&self) -> u32 {
        let rows: f64 = self.groups.iter().flat_map(|group| &group.rows).map(|row| self.row_height(row)).sum();
        let texts = self.title_lines().len() + self.groups.len() + 1 + self.entries().len() + self.note_lines().len();
        let gaps = GAP * (self.groups.len() + 2) as f64;
        (2.0 * MARGIN + rows + LINE * texts as f64 + gaps + NUMBERS).ceil() as u32
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        let canvas = PlotCanvas::new(area, scale)?;
        let mut top = canvas.lines(&self.title_lines(), (MARGIN, MARGIN), TextAnchor::Left)? + GAP;
        for (index, group) in self.groups.iter().enumerate() {
            let frame = self.frame(group, top + LINE);
            canvas.text(&group.name, (frame.left, top + LINE / 2.0), TextAnchor::Left)?;
            canvas.frame(&frame, true)?;
            let mut above = frame.top;
            for row in &group.rows {
                let names = self.name_lines(row);
                let height = self.row_height(row);
                let first = above + (height - LINE * names.len() as f64) / 2.0;
                canvas.lines(&names, (frame.left - 6.0, first), TextAnchor::Right)?;
                self.draw_row(&canvas, &frame, row, above + height / 2.0)?;
                above += height;
            }
            let is_last = index + 1 == self.groups.len();
            canvas.x_ticks(&frame, is_last)?;
            top = frame.bottom() + GAP;
            if is_last {
                let below = frame.bottom() + NUMBERS + LINE / 2.0;
                canvas.text(&self.x_name, (frame.middle().0, below), TextAnchor::Middle)?;
                top = below + LINE / 2.0 + GAP;
            }
        }
        for (which, text) in self.entries() {
            self.draw_entry(&canvas, which, text, top + LINE / 2.0)?;
            top += LINE;
        }
        canvas.lines(&self.note_lines(), (MARGIN, top), TextAnchor::Left).map(|_| ())
    }
}

impl IntervalPlot {
    fn title_lines(&self) -> Vec<String> {
        wrapped(&self.title, INSIDE)
    }

    fn note_lines(&self) -> Vec<String> {
        wrapped(&self.note, INSIDE)
    }

    fn rows(&self) -> impl Iterator<Item = &IntervalRow> {
        self.groups.iter().flat_map(|group| &group.rows)
    }

    fn name_lines(&self, row: &IntervalRow) -> Vec<String> {
        wrapped(&row.name, NAMES)
    }

    fn row_height(&self, row: &IntervalRow) -> f64 {
        (LINE * self.name_lines(row).len() as f64).max(LINE + 2.0) + GAP
    }

    /// Returns the frame of a group's chart. It is right of the rows' names, with its upper edge at `top`.
    fn frame(&self, group: &Group, top: f64) -> Frame {
        let names = self.rows().flat_map(|row| self.name_lines(row));
        let left = MARGIN + names.map(|name| text_width(&name)).fold(0.0, f64::max) + 6.0;
        let height = group.rows.iter().map(|row| self.row_height(row)).sum();
        let width = f64::from(WIDTH) - left - MARGIN - 6.0;
        Frame { left, top, width, height, x: self.x.clone(), y: 0.0..0.0 }
    }

    /// Draws a row at the height `y`: its interval, its number and its second number. If the number is missing, writes
    /// "missing" at an end of the row.
    fn draw_row<DB: DrawingBackend>(
        &self,
        canvas: &PlotCanvas<'_, DB>,
        frame: &Frame,
        row: &IntervalRow,
        y: f64,
    ) -> Result<(), PlotError> {
        let style = LineStyle { dashes: None, ..LineStyle::nth(row.index) };
        let apart = if row.other.is_some() && row.point.is_some() { APART } else { 0.0 };
        if let Some(interval) = row.interval {
            draw_interval(canvas, interval.map(|end| frame.x(end)), y - apart, style)?;
        }
        match row.point {
            Some(point) => canvas.circle((frame.x(point), y - apart), RADIUS, style.colour.filled())?,
            // If the second number is in the left half, writes "missing" at the right end, so that it does not cover
            // the number.
            None if row.other.is_some_and(|other| frame.x(other) < frame.middle().0) => {
                canvas.text("missing", (frame.right() - 6.0, y), TextAnchor::Right)?;
            }
            None => canvas.text("missing", (frame.left + 6.0, y), TextAnchor::Left)?,
        }
        row.other.map_or(Ok(()), |other| draw_other(canvas, (frame.x(other), y + apart)))
    }

    /// Returns the index and the text of each legend entry whose symbol occurs in the picture.
    fn entries(&self) -> Vec<(usize, &str)> {
        let is_there =
            [true, self.rows().any(|row| row.interval.is_some()), self.rows().any(|row| row.other.is_some())];
        let entries = self.legend.iter().enumerate().filter(|(which, _)| is_there[*which]);
        entries.map(|(which, text)| (which, text.as_str())).collect()
    }

    /// Draws a symbol of the legend with its text. The symbol `which` is that of a number (0), of an interval (1) or of
    /// a second number (2).
    fn draw_entry<DB: DrawingBackend>(
        &self,
        canvas: &PlotCanvas<'_, DB>,
        which: usize,
        text: &str,
        y: f64,
    ) -> Result<(), PlotError> {
        let (left, right) = (MARGIN, MARGIN + 30.0);
        let middle = ((left + right) / 2.0, y);
        match which {
            0 => canvas.circle(middle, RADIUS, INK.filled())?,
            1 => draw_interval(canvas, [left, right], y, LineStyle { colour: INK, width: 2, dashes: None })?,
            _ => draw_other(canvas, middle)?,
        }
        canvas.text(text, (right + 8.0, y), TextAnchor::Left)
    }
}

/// Draws an interval with caps at its ends.
fn draw_interval<DB: DrawingBackend>(
    canvas: &PlotCanvas<'_, DB>,
    [low, high]: [f64; 2],
    y: f64,
    style: LineStyle,
) -> Result<(), PlotError> {
    canvas.line(&[(low, y), (high, y)], style)?;
    [low, high].into_iter().try_for_each(|end| canvas.line(&[(end, y - CAP), (end, y + CAP)], style))
}

/// Draws the marker of a second number: a hollow diamond.
fn draw_other<DB: DrawingBackend>(canvas: &PlotCanvas<'_, DB>, (x, y): CanvasPoint) -> Result<(), PlotError> {
    let corners = [(x, y - 5.0), (x + 5.0, y), (x, y + 5.0), (x - 5.0, y)];
    canvas.polygon(&corners, PAPER.filled())?;
    let around = [corners[0], corners[1], corners[2], corners[3], corners[0], corners[1]];
    canvas.line(&around, LineStyle { colour: INK, width: 1, dashes: None })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::plot::svg;

    pub(crate) fn example() -> IntervalPlot {
        let row = |name: &str, index: usize, point: f64| IntervalRow {
            name: name.into(),
            index,
            point: Some(point),
            interval: Some([point - 5.0, point + 5.0]),
            other: (index == 0).then_some(point - 10.0),
        };
        let group = |name: &str| Group {
            name: name.into(),
            rows: vec![row("ppo ff", 0, 75.0), row("rl2-ppo rc N=5 (paper, sees the parameters)", 1, 20.0)],
        };
        IntervalPlot {
            title: "CartPole: success rate where policies were trained, and elsewhere".into(),
            x_name: "success rate, %".into(),
            x: 0.0..100.0,
            groups: ["Default", "Extrapolation"].map(group).into(),
            legend: ["mean over runs".into(), "95 % t interval".into(), "the paper's mean".into()],
            note: String::new(),
        }
    }

    #[test]
    fn number_and_interval_are_drawn_at_their_values() {
        let plot = example();
        let shown = svg(&plot).unwrap();
        let frame = plot.frame(&plot.groups[0], 0.0);
        let at = |value: f64| (4.0 * frame.x(value)).round() as i32;
        let circle = format!("<circle cx=\"{}\" ", at(75.0));
        assert_eq!(shown.matches(&circle).count(), 2, "of two groups: {shown}");
        assert!(shown.contains(&format!("points=\"{},", at(70.0))) && shown.contains(&format!(" {},", at(80.0))));
        let diamonds = shown.matches("<polygon").count();
        assert_eq!(diamonds, 3, "two rows are compared, and the legend says what that is");
        assert!(frame.width > 150.0, "long names leave room");
    }

    #[test]
    fn the_legend_has_what_is_there() {
        let mut plot = example();
        plot.groups.iter_mut().flat_map(|group| &mut group.rows).for_each(|row| {
            row.interval = None;
            row.other = None;
            row.point = row.point.filter(|point| *point > 50.0);
        });
        let shown = svg(&plot).unwrap();
        assert!(shown.contains("mean over runs") && !shown.contains("t interval") && !shown.contains("paper's"));
        assert_eq!(shown.matches("missing").count(), 2, "a number that there is not is none");
    }
}
