//! Lines with bands in panels side by side, and what is drawn so.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::{AxisLook, LineStyle, Plot, PlotError, chart, drawing, font};

const WIDTH: u32 = 960;
const PANEL_HEIGHT: u32 = 260;
const TITLE: u32 = 34;
const LEGEND_LINE: u32 = 22;
const LEGEND_COLUMNS: usize = 4;
/// A value that is marked.
const MARK: LineStyle = LineStyle { colour: RGBColor(120, 120, 120), width: 1, dashes: Some((2, 3)) };

/// The range of a success rate, %, with room for lines at its ends.
pub(crate) const RATES: Range<f64> = -2.0..102.0;

/// Panels that share their legend.
#[derive(Clone, Debug, PartialEq)]
pub struct Panels {
    /// Above all.
    pub(crate) title: String,
    /// Panels in a row.
    pub(crate) columns: usize,
    /// By row.
    pub(crate) panels: Vec<Panel>,
    /// What lines are called, by their index.
    pub(crate) legend: Vec<String>,
}

/// A chart.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Panel {
    pub(crate) caption: String,
    pub(crate) x_name: String,
    pub(crate) x: Range<f64>,
    pub(crate) y: Range<f64>,
    pub(crate) lines: Vec<PanelLine>,
    /// Of x.
    pub(crate) mark: Option<f64>,
}

/// A line with its band.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PanelLine {
    /// In the legend.
    pub(crate) index: usize,
    pub(crate) points: Vec<PanelPoint>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PanelPoint {
    pub(crate) x: f64,
    pub(crate) y: f64,
    /// The band's ends.
    pub(crate) low: f64,
    pub(crate) high: f64,
}

impl Plot for Panels {
    fn size(&self) -> (u32, u32) {
        let lines = self.legend.len().div_ceil(LEGEND_COLUMNS) as u32;
        (WIDTH, TITLE + PANEL_HEIGHT * self.rows() as u32 + LEGEND_LINE * lines + 10)
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        area.fill(&WHITE).map_err(drawing)?;
        let (title, rest) = area.split_vertically(TITLE * scale);
        let (panels, legend) = rest.split_vertically(PANEL_HEIGHT * self.rows() as u32 * scale);
        title.draw_text(&self.title, &font(15, scale), (12 * scale as i32, 10 * scale as i32)).map_err(drawing)?;
        for (panel, place) in self.panels.iter().zip(panels.split_evenly((self.rows(), self.columns))) {
            panel.draw(&place, scale)?;
        }
        self.draw_legend(&legend, scale)
    }
}

impl Panels {
    fn rows(&self) -> usize {
        self.panels.len().div_ceil(self.columns)
    }

    fn draw_legend<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        let (width, unit) = ((WIDTH - 50) as i32 / LEGEND_COLUMNS as i32, scale as i32);
        for (index, name) in self.legend.iter().enumerate() {
            let (column, line) = ((index % LEGEND_COLUMNS) as i32, (index / LEGEND_COLUMNS) as i32);
            let (x, y) = ((50 + column * width) * unit, (line * LEGEND_LINE as i32 + 11) * unit);
            let sample = LineStyle::nth(index).along(vec![(x, y), (x + 34 * unit, y)], scale);
            area.draw(&sample).map_err(drawing)?;
            area.draw_text(name, &font(12, scale), (x + 42 * unit, y - 6 * unit)).map_err(drawing)?;
        }
        Ok(())
    }
}

impl Panel {
    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        let x = AxisLook { name: self.x_name.clone(), range: self.x.clone(), ticks: 4 };
        let y = AxisLook { name: String::new(), range: self.y.clone(), ticks: 6 };
        let mut chart = chart(area, &self.caption, x, y, scale)?;
        if let Some(mark) = self.mark {
            let ends = vec![(mark, self.y.start), (mark, self.y.end)];
            chart.plotting_area().draw(&MARK.along(ends, scale)).map_err(drawing)?;
        }
        for PanelLine { index, points } in &self.lines {
            let style = LineStyle::nth(*index);
            let there = points.iter().map(|point| (point.x, point.high));
            let back = points.iter().rev().map(|point| (point.x, point.low));
            let band: Vec<(f64, f64)> = there.chain(back).collect();
            chart.draw_series([Polygon::new(band, style.colour.mix(0.16).filled())]).map_err(drawing)?;
            let line = points.iter().map(|point| (point.x, point.y)).collect();
            chart.plotting_area().draw(&style.along(line, scale)).map_err(drawing)?;
        }
        Ok(())
    }
}

/// What several lines are, in order, without repetitions.
pub(crate) fn index_of<T: PartialEq>(all: &[T], one: &T) -> usize {
    all.iter().position(|known| known == one).unwrap_or_default()
}
