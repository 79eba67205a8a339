//! The frame of a chart: a rectangle with axes, ticks and their numbers.

use std::ops::Range;

use plotters::prelude::*;

use super::PlotError;
use super::canvas::{CanvasPoint, LINE, LineStyle, PlotCanvas, TICK, TextAnchor, text_width};
use super::colours::GRID;
use super::ticks::round_ticks;

/// Minimum gap between neighbouring numbers below the x axis, in units.
const MIN_NUMBER_GAP: f64 = 6.0;
/// Minimum gap between the numbers of the first and the last tick if only these have numbers, in units. It is the width
/// of a space.
const MIN_END_GAP: f64 = 4.6;
/// Maximum length by which a number may extend beyond the left or right edge of its frame, in units. The limit is
/// small, because another frame may be next to it.
const MAX_OVERHANG: f64 = 2.0;
/// Maximum number of ticks of an axis.
const MAX_TICKS: usize = 6;
/// The style of the grid lines behind a chart.
const GRID_STYLE: LineStyle = LineStyle { colour: GRID, width: 1, dashes: None };
/// Height of the ticks and numbers below an x axis, in units.
pub(super) const NUMBERS: f64 = LINE + 5.0;
/// Width of a y axis' name with the gap to the axis' numbers, in units.
pub(super) const NAME: f64 = LINE + 2.0;

/// The position and size of a chart, in units, and the ranges of its axes.
#[derive(Clone, Debug)]
pub(super) struct Frame {
    pub(super) left: f64,
    pub(super) top: f64,
    pub(super) width: f64,
    pub(super) height: f64,
    pub(super) x: Range<f64>,
    pub(super) y: Range<f64>,
}

impl Frame {
    pub(super) fn right(&self) -> f64 {
        self.left + self.width
    }

    pub(super) fn bottom(&self) -> f64 {
        self.top + self.height
    }

    pub(super) fn middle(&self) -> CanvasPoint {
        (self.left + self.width / 2.0, self.top + self.height / 2.0)
    }

    /// Returns the x position of a value on the x axis, in units.
    pub(super) fn x(&self, value: f64) -> f64 {
        self.left + self.width * share(&self.x, value)
    }

    /// Returns the y position of a value on the y axis, in units.
    pub(super) fn y(&self, value: f64) -> f64 {
        self.bottom() - self.height * share(&self.y, value)
    }

    /// Returns the values of the x ticks, with their numbers as text. If the frame is too narrow for all numbers, only
    /// the first and the last tick, or only the last tick, have a number.
    fn x_ticks(&self) -> Vec<(f64, Option<String>)> {
        let sets: Vec<_> = (2..=MAX_TICKS).rev().map(|most| round_ticks(&self.x, most)).collect();
        // A single tick would not show the scale of the axis.
        let several = || sets.iter().filter(|ticks| ticks.len() > 1);
        let mut all =
            several().filter(|ticks| ticks.windows(2).all(|pair| self.gap(&pair[0], &pair[1]) >= MIN_NUMBER_GAP));
        if let Some(ticks) = all.next() {
            return numbered(ticks, |_| true);
        }
        let mut ends = several().filter(|ticks| self.gap(&ticks[0], &ticks[ticks.len() - 1]) >= MIN_END_GAP);
        if let Some(ticks) = ends.next() {
            return numbered(ticks, |index| index == 0 || index + 1 == ticks.len());
        }
        let ticks = round_ticks(&self.x, 2);
        numbered(&ticks, |index| index + 1 == ticks.len())
    }

    /// Returns the gap between the numbers of two ticks, in units.
    fn gap(&self, left: &(f64, String), right: &(f64, String)) -> f64 {
        let middle = |(value, number): &(f64, String)| self.number(*value, number);
        middle(right) - middle(left) - (text_width(&left.1) + text_width(&right.1)) / 2.0
    }

    /// Returns the x position, in units, of the middle of the number below a tick. Near the edges the number is moved
    /// inwards.
    fn number(&self, value: f64, number: &str) -> f64 {
        let half = text_width(number) / 2.0 - MAX_OVERHANG;
        self.x(value).clamp(self.left + half, (self.right() - half).max(self.left + half))
    }

    /// Returns the values of the y ticks, with their numbers as text.
    fn y_ticks(&self) -> Vec<(f64, String)> {
        round_ticks(&self.y, ((self.height / (LINE + 2.0)) as usize).clamp(2, MAX_TICKS))
    }
}

/// Returns the ticks. A tick keeps its text if `has_number` is true for its index.
fn numbered(ticks: &[(f64, String)], has_number: impl Fn(usize) -> bool) -> Vec<(f64, Option<String>)> {
    let of = |(index, (value, number)): (usize, &(f64, String))| (*value, has_number(index).then(|| number.clone()));
    ticks.iter().enumerate().map(of).collect()
}

/// Returns the width, in units, of the numbers beside a y axis with range `y` and this height.
pub(super) fn y_numbers_width(y: &Range<f64>, height: f64) -> f64 {
    let frame = Frame { left: 0.0, top: 0.0, width: 0.0, height, x: 0.0..1.0, y: y.clone() };
    frame.y_ticks().iter().map(|(_, number)| text_width(number)).fold(0.0, f64::max) + 6.0
}

/// Returns the relative position of a value in a range: 0 at its start, 1 at its end. Returns 0.5 for an empty range.
fn share(range: &Range<f64>, value: f64) -> f64 {
    let span = range.end - range.start;
    if span > 0.0 { (value - range.start) / span } else { 0.5 }
}

impl<DB: DrawingBackend> PlotCanvas<'_, DB> {
    /// Draws the frame's left and lower edges. If `with_lines` is set, also draws grid lines at the ticks.
    pub(super) fn frame(&self, frame: &Frame, with_lines: bool) -> Result<(), PlotError> {
        let Frame { left, top, .. } = *frame;
        let (right, bottom) = (frame.right(), frame.bottom());
        if with_lines {
            for (value, _) in frame.x_ticks() {
                self.line(&[(frame.x(value), top), (frame.x(value), bottom)], GRID_STYLE)?;
            }
            for (value, _) in frame.y_ticks().into_iter().filter(|_| !frame.y.is_empty()) {
                self.line(&[(left, frame.y(value)), (right, frame.y(value))], GRID_STYLE)?;
            }
        }
        self.line(&[(left, top), (left, bottom), (right, bottom)], TICK)
    }

    /// Draws the ticks below the frame, with their numbers if `numbers` is set.
    pub(super) fn x_ticks(&self, frame: &Frame, numbers: bool) -> Result<(), PlotError> {
        let bottom = frame.bottom();
        for (value, number) in frame.x_ticks() {
            let x = frame.x(value);
            self.line(&[(x, bottom), (x, bottom + 4.0)], TICK)?;
            if let Some(number) = number.filter(|_| numbers) {
                self.text(&number, (frame.number(value, &number), bottom + 5.0 + LINE / 2.0), TextAnchor::Middle)?;
            }
        }
        Ok(())
    }

    /// Draws the ticks left of the frame, with their numbers if `numbers` is set.
    pub(super) fn y_ticks(&self, frame: &Frame, numbers: bool) -> Result<(), PlotError> {
        for (value, number) in frame.y_ticks() {
            let y = frame.y(value);
            self.line(&[(frame.left - 4.0, y), (frame.left, y)], TICK)?;
            if numbers {
                self.text(&number, (frame.left - 6.0, y), TextAnchor::Right)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    /// The x range is that of MountainCar's force. The widths are those of a panel in rows of one, three and four
    /// panels.
    #[rstest]
    #[case(210.0, &["0.005", "0.010"])]
    #[case(85.0, &["0.002", "", "", "", "0.010"])]
    #[case(61.0, &["", "0.010"])]
    fn x_axis_has_two_numbers_of_one_style(#[case] width: f64, #[case] expected: &[&str]) {
        let frame = Frame { left: 76.0, top: 0.0, width, height: 96.0, x: 0.0001..0.01, y: 0.0001..0.01 };
        let ticks = frame.x_ticks();
        let numbers: Vec<&str> = ticks.iter().map(|(_, number)| number.as_deref().unwrap_or_default()).collect();
        assert_eq!(numbers, expected);
        assert!(frame.y_ticks().iter().all(|(_, number)| number.len() == "0.010".len()), "{:?}", frame.y_ticks());
    }
}
