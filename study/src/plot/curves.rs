//! Training curves: three panels, D, R and E, side by side.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::super::plan::distinct;
use super::super::statistics::Summary;
use super::{AxisLook, LineStyle, Plot, PlotError, chart, drawing, font};
use crate::curves::{Curve, EnvironmentCurves, Point};
use crate::{Method, Version};

const PANEL: (u32, u32) = (320, 260);
const TITLE: u32 = 34;
const LEGEND_LINE: u32 = 22;
const LEGEND_COLUMNS: usize = 4;

/// What a picture shows over episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// The mean undiscounted return.
    Return,
    /// The success rate, %.
    Success,
}

impl Quantity {
    /// Both.
    pub const ALL: [Quantity; 2] = [Quantity::Return, Quantity::Success];

    fn of(self, point: &Point) -> Summary {
        match self {
            Quantity::Return => point.episode_return,
            Quantity::Success => point.success,
        }
    }
}

impl std::fmt::Display for Quantity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Quantity::Return => "return",
            Quantity::Success => "success",
        })
    }
}

/// The picture of training curves, a panel for each version that is trained on.
pub fn draw_curves(curves: &EnvironmentCurves, quantity: Quantity) -> impl Plot + '_ {
    CurvesPlot::new(curves, None, quantity)
}

/// The picture of tests of what was trained on a version, a panel for each version that is tested on.
pub(crate) fn draw_tests(curves: &EnvironmentCurves, trained_on: Version, quantity: Quantity) -> impl Plot + '_ {
    CurvesPlot::new(curves, Some(trained_on), quantity)
}

struct CurvesPlot<'a> {
    curves: &'a EnvironmentCurves,
    /// Of tests, what was trained on; `None` of training curves.
    trained_on: Option<Version>,
    quantity: Quantity,
    methods: Vec<Method>,
}

impl Plot for CurvesPlot<'_> {
    fn size(&self) -> (u32, u32) {
        let lines = self.methods.len().div_ceil(LEGEND_COLUMNS) as u32;
        (3 * PANEL.0, TITLE + PANEL.1 + LEGEND_LINE * lines + 10)
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        area.fill(&WHITE).map_err(drawing)?;
        let (title, rest) = area.split_vertically(TITLE * scale);
        let (panels, legend) = rest.split_vertically(PANEL.1 * scale);
        let what = match self.quantity {
            Quantity::Return => "mean return",
            Quantity::Success => "success rate, %",
        };
        let environment = &self.curves.environment;
        let of = match self.trained_on {
            None => format!("{environment}: {what} while training"),
            Some(version) => format!("{environment}, trained on {version}: {what} in tests"),
        };
        let text = format!("{of}, mean and deviation over runs");
        title.draw_text(&text, &font(15, scale), (12 * scale as i32, 10 * scale as i32)).map_err(drawing)?;
        for (version, panel) in Version::ALL.into_iter().zip(panels.split_evenly((1, 3))) {
            self.panel(&panel, version, scale)?;
        }
        self.legend(&legend, scale)
    }
}

impl<'a> CurvesPlot<'a> {
    fn new(curves: &'a EnvironmentCurves, trained_on: Option<Version>, quantity: Quantity) -> Self {
        let methods = distinct(curves.curves.iter().map(|curve| curve.method.clone()));
        Self { curves, trained_on, quantity, methods }
    }
}

impl CurvesPlot<'_> {
    fn panel<DB: DrawingBackend>(
        &self,
        area: &DrawingArea<DB, Shift>,
        version: Version,
        scale: u32,
    ) -> Result<(), PlotError> {
        let (episodes, range) = self.ranges();
        let x = AxisLook { name: "episodes".into(), range: 0.0..episodes, ticks: 4 };
        let y = AxisLook { name: String::new(), range, ticks: 6 };
        let panel = if self.trained_on.is_some() { "tested on" } else { "trained on" };
        let mut chart = chart(area, &format!("{panel} {version}"), x, y, scale)?;
        for Curve { method, points, .. } in self.curves.curves.iter().filter(|curve| curve.version == version) {
            let index = self.methods.iter().position(|known| known == method).unwrap_or_default();
            let style = LineStyle::nth(index);
            let at = |point: &Point, sign: f64| {
                let summary = self.quantity.of(point);
                (point.episodes, summary.mean + sign * summary.std.unwrap_or_default())
            };
            let there = points.iter().map(|point| at(point, 1.0));
            let back = points.iter().rev().map(|point| at(point, -1.0));
            let band: Vec<(f64, f64)> = there.chain(back).collect();
            chart.draw_series([Polygon::new(band, style.colour.mix(0.16).filled())]).map_err(drawing)?;
            let line = points.iter().map(|point| at(point, 0.0)).collect();
            chart.plotting_area().draw(&style.along(line, scale)).map_err(drawing)?;
        }
        Ok(())
    }

    /// The last episode, and the values that all panels share.
    fn ranges(&self) -> (f64, std::ops::Range<f64>) {
        let points = || self.curves.curves.iter().flat_map(|curve| &curve.points);
        let spacing = points().map(|point| point.episodes).fold(f64::INFINITY, f64::min);
        let last = points().map(|point| point.episodes).fold(0.0, f64::max);
        let end = if spacing.is_finite() { last + spacing } else { 1.0 };
        if self.quantity == Quantity::Success {
            return (end, -2.0..102.0);
        }
        let values = points().map(|point| self.quantity.of(point));
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), summary| {
            let std = summary.std.unwrap_or_default();
            (low.min(summary.mean - std), high.max(summary.mean + std))
        });
        if low > high {
            return (end, 0.0..1.0);
        }
        let margin = 0.04 * (high - low).max(1e-3 * high.abs()).max(1e-9);
        (end, low - margin..high + margin)
    }

    fn legend<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        let (width, unit) = ((3 * PANEL.0 - 50) as i32 / LEGEND_COLUMNS as i32, scale as i32);
        for (index, method) in self.methods.iter().enumerate() {
            let (column, line) = ((index % LEGEND_COLUMNS) as i32, (index / LEGEND_COLUMNS) as i32);
            let (x, y) = ((50 + column * width) * unit, (line * LEGEND_LINE as i32 + 11) * unit);
            let sample = LineStyle::nth(index).along(vec![(x, y), (x + 34 * unit, y)], scale);
            area.draw(&sample).map_err(drawing)?;
            area.draw_text(&method.to_string(), &font(12, scale), (x + 42 * unit, y - 6 * unit)).map_err(drawing)?;
        }
        Ok(())
    }
}
