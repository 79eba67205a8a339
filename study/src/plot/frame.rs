//! A rectangle with axes, whose ticks and texts look alike in all pictures.

use std::ops::Range;

use plotters::prelude::*;

use super::PlotError;
use super::canvas::{Canvas, LINE, LineStyle, Place, Side, TICK, text_width};
use super::colours::GRID;
use super::ticks::round_ticks;

/// Between two numbers along an axis, at least.
const BETWEEN: f64 = 6.0;
/// A number goes so far beyond its frame, which may have a neighbour.
const BEYOND: f64 = 2.0;
/// The most ticks at an axis.
const MOST: usize = 6;
/// Lines at ticks.
const BEHIND: LineStyle = LineStyle { colour: GRID, width: 1, dashes: None };
/// How high the numbers of the x axis are, with their ticks.
pub(super) const NUMBERS: f64 = LINE + 5.0;
/// How wide the name of a y axis is, and the gap to its numbers.
pub(super) const NAME: f64 = LINE + 2.0;

/// Where something is drawn, and what its axes reach over.
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

    pub(super) fn middle(&self) -> Place {
        (self.left + self.width / 2.0, self.top + self.height / 2.0)
    }

    pub(super) fn x(&self, value: f64) -> f64 {
        self.left + self.width * share(&self.x, value)
    }

    pub(super) fn y(&self, value: f64) -> f64 {
        self.bottom() - self.height * share(&self.y, value)
    }

    fn x_ticks(&self) -> Vec<(f64, String)> {
        let ends = |tick: &(f64, String)| {
            let (middle, half) = (self.number(tick), text_width(&tick.1) / 2.0);
            [middle - half, middle + half]
        };
        let fit =
            |ticks: &Vec<(f64, String)>| ticks.windows(2).all(|pair| ends(&pair[1])[0] - ends(&pair[0])[1] >= BETWEEN);
        (1..=MOST).rev().map(|most| round_ticks(&self.x, most)).find(fit).unwrap_or_default()
    }

    /// The middle of the number below a tick.
    fn number(&self, (value, number): &(f64, String)) -> f64 {
        let half = text_width(number) / 2.0 - BEYOND;
        self.x(*value).clamp(self.left + half, (self.right() - half).max(self.left + half))
    }

    fn y_ticks(&self) -> Vec<(f64, String)> {
        round_ticks(&self.y, ((self.height / (LINE + 2.0)) as usize).clamp(2, MOST))
    }
}

/// How much the numbers of a y axis of this height take.
pub(super) fn y_numbers_width(y: &Range<f64>, height: f64) -> f64 {
    let frame = Frame { left: 0.0, top: 0.0, width: 0.0, height, x: 0.0..1.0, y: y.clone() };
    frame.y_ticks().iter().map(|(_, number)| text_width(number)).fold(0.0, f64::max) + 6.0
}

fn share(range: &Range<f64>, value: f64) -> f64 {
    let span = range.end - range.start;
    if span > 0.0 { (value - range.start) / span } else { 0.5 }
}

impl<DB: DrawingBackend> Canvas<'_, DB> {
    /// The frame's edges; with lines behind what will be drawn, at the ticks.
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

    /// Below the frame, with numbers if they are wanted.
    pub(super) fn x_ticks(&self, frame: &Frame, numbers: bool) -> Result<(), PlotError> {
        let bottom = frame.bottom();
        let tick = |x: f64| self.line(&[(x, bottom), (x, bottom + 4.0)], TICK);
        let ticks = frame.x_ticks();
        if ticks.len() < 2 {
            // A single number would not say how far it is to the next.
            round_ticks(&frame.x, 2).into_iter().try_for_each(|(value, _)| tick(frame.x(value)))?;
        }
        for written in ticks {
            tick(frame.x(written.0))?;
            if numbers {
                self.text(&written.1, (frame.number(&written), bottom + 5.0 + LINE / 2.0), Side::Middle)?;
            }
        }
        Ok(())
    }

    /// Left of the frame, with numbers if they are wanted.
    pub(super) fn y_ticks(&self, frame: &Frame, numbers: bool) -> Result<(), PlotError> {
        for (value, number) in frame.y_ticks() {
            let y = frame.y(value);
            self.line(&[(frame.left - 4.0, y), (frame.left, y)], TICK)?;
            if numbers {
                self.text(&number, (frame.left - 6.0, y), Side::Right)?;
            }
        }
        Ok(())
    }
}
