//! A rectangle with axes, whose ticks and texts look alike in all pictures.

use std::ops::Range;

use plotters::prelude::*;

use super::PlotError;
use super::canvas::{CanvasPoint, LINE, LineStyle, PlotCanvas, TICK, TextAnchor, text_width};
use super::colours::GRID;
use super::ticks::round_ticks;

/// Least gap between two numbers along an axis, units.
const BETWEEN: f64 = 6.0;
/// Least gap between the first and the last number, where the ticks between have none, units. It is the width of a
/// space.
const SPACE: f64 = 4.6;
/// Most that a number may stand out beyond its frame, which may have a neighbour, units.
const BEYOND: f64 = 2.0;
/// The most ticks at an axis.
const MAX_TICKS: usize = 6;
/// The style of the grid lines behind a chart.
const BEHIND: LineStyle = LineStyle { colour: GRID, width: 1, dashes: None };
/// Height of the x axis' numbers with their ticks.
pub(super) const NUMBERS: f64 = LINE + 5.0;
/// Width of a y axis' name and the gap to its numbers.
pub(super) const NAME: f64 = LINE + 2.0;

/// The position of a plot and the ranges of its axes.
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

    pub(super) fn x(&self, value: f64) -> f64 {
        self.left + self.width * share(&self.x, value)
    }

    pub(super) fn y(&self, value: f64) -> f64 {
        self.bottom() - self.height * share(&self.y, value)
    }

    /// Returns the x ticks with their numbers. If not all numbers have room, only the first and the last tick have one,
    /// or the last alone.
    fn x_ticks(&self) -> Vec<(f64, Option<String>)> {
        let sets: Vec<_> = (2..=MAX_TICKS).rev().map(|most| round_ticks(&self.x, most)).collect();
        // A single number would not say how far it is to the next.
        let several = || sets.iter().filter(|ticks| ticks.len() > 1);
        let mut all = several().filter(|ticks| ticks.windows(2).all(|pair| self.gap(&pair[0], &pair[1]) >= BETWEEN));
        if let Some(ticks) = all.next() {
            return numbered(ticks, |_| true);
        }
        let mut ends = several().filter(|ticks| self.gap(&ticks[0], &ticks[ticks.len() - 1]) >= SPACE);
        if let Some(ticks) = ends.next() {
            return numbered(ticks, |index| index == 0 || index + 1 == ticks.len());
        }
        let ticks = round_ticks(&self.x, 2);
        numbered(&ticks, |index| index + 1 == ticks.len())
    }

    /// Returns the gap between the numbers of two ticks, units.
    fn gap(&self, left: &(f64, String), right: &(f64, String)) -> f64 {
        let middle = |(value, number): &(f64, String)| self.number(*value, number);
        middle(right) - middle(left) - (text_width(&left.1) + text_width(&right.1)) / 2.0
    }

    /// Returns the x position of the middle of the number below a tick.
    fn number(&self, value: f64, number: &str) -> f64 {
        let half = text_width(number) / 2.0 - BEYOND;
        self.x(value).clamp(self.left + half, (self.right() - half).max(self.left + half))
    }

    fn y_ticks(&self) -> Vec<(f64, String)> {
        round_ticks(&self.y, ((self.height / (LINE + 2.0)) as usize).clamp(2, MAX_TICKS))
    }
}

fn numbered(ticks: &[(f64, String)], has_number: impl Fn(usize) -> bool) -> Vec<(f64, Option<String>)> {
    let of = |(index, (value, number)): (usize, &(f64, String))| (*value, has_number(index).then(|| number.clone()));
    ticks.iter().enumerate().map(of).collect()
}

/// Returns the width of the numbers of a y axis of this height.
pub(super) fn y_numbers_width(y: &Range<f64>, height: f64) -> f64 {
    let frame = Frame { left: 0.0, top: 0.0, width: 0.0, height, x: 0.0..1.0, y: y.clone() };
    frame.y_ticks().iter().map(|(_, number)| text_width(number)).fold(0.0, f64::max) + 6.0
}

fn share(range: &Range<f64>, value: f64) -> f64 {
    let span = range.end - range.start;
    if span > 0.0 { (value - range.start) / span } else { 0.5 }
}

impl<DB: DrawingBackend> PlotCanvas<'_, DB> {
    /// Draws the frame's edges, and grid lines at the ticks if `with_lines` is set.
    pub(super) fn frame(&self, frame: &Frame, with_lines: bool) -> Result<(), PlotError> {
        let Frame { left, top, .. } = *frame;
        let (right, bottom) = (frame.right(), frame.bottom());
        if with_lines {
            for (value, _) in frame.x_ticks() {
                self.line(&[(frame.x(value), top), (frame.x(value), bottom)], BEHIND)?;
            }
            for (value, _) in frame.y_ticks().into_iter().filter(|_| !frame.y.is_empty()) {
                self.line(&[(left, frame.y(value)), (right, frame.y(value))], BEHIND)?;
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

    /// MountainCar's force: in a row of one panel, of three and of four.
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
