//! Heatmaps: mean return and, below it, success over two parameters, with the sets of R and E. Pictures are narrow, so that
//! those of policies trained on D, R and E fit side by side.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::super::heatmap::{Axis, Heatmap, HeatmapPoint};
use super::{AxisLook, LineStyle, Plot, PlotError, chart, drawing, font, tick, viridis};

const PANEL: (u32, u32) = (400, 316);
const TITLE: u32 = 48;
const KEY: u32 = 34;
/// The part of a panel that the colour bar takes.
const BAR: u32 = 74;
/// The outlines of R's box and of E's.
const RANDOM: LineStyle = LineStyle { colour: WHITE, width: 1, dashes: None };
const EXTREME: LineStyle = LineStyle { colour: WHITE, width: 1, dashes: Some((7, 5)) };

impl Plot for Heatmap {
    fn size(&self) -> (u32, u32) {
        (PANEL.0, TITLE + 2 * PANEL.1 + KEY)
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        area.fill(&WHITE).map_err(drawing)?;
        let unit = scale as i32;
        let (title, rest) = area.split_vertically(TITLE * scale);
        let (panels, key) = rest.split_vertically(2 * PANEL.1 * scale);
        let Heatmap { environment, policy, episodes, .. } = self;
        title
            .draw_text(&format!("{environment}: {policy}"), &font(13, scale), (10 * unit, 8 * unit))
            .map_err(drawing)?;
        let text = format!("{episodes} episodes at each point, other parameters at their defaults");
        title.draw_text(&text, &font(11, scale), (10 * unit, 28 * unit)).map_err(drawing)?;
        let panels = panels.split_evenly((2, 1));
        let returns = range(self.points.iter().map(|point| point.mean_return));
        self.panel(&panels[0], "mean return", |point| point.mean_return, returns, scale)?;
        self.panel(&panels[1], "success rate, %", |point| point.success_percent, 0.0..100.0, scale)?;
        for (i, (name, line)) in [("R, random", RANDOM), ("E, extreme", EXTREME)].into_iter().enumerate() {
            let (x, y) = ((60 + 130 * i as i32) * unit, 6 * unit);
            let sample = [(x, y), (x + 40 * unit, y + 18 * unit)];
            // On a colour of the surface, since white lines are not seen on white.
            key.draw(&Rectangle::new(sample, viridis(0.4).filled())).map_err(drawing)?;
            outline(&key, sample, line, scale)?;
            key.draw_text(name, &font(13, scale), (x + 48 * unit, y + 2 * unit)).map_err(drawing)?;
        }
        Ok(())
    }
}

impl Heatmap {
    fn panel<DB: DrawingBackend>(
        &self,
        area: &DrawingArea<DB, Shift>,
        name: &str,
        value: fn(&HeatmapPoint) -> f64,
        range: Range<f64>,
        scale: u32,
    ) -> Result<(), PlotError> {
        let (map, bar) = area.split_horizontally((PANEL.0 - BAR) * scale);
        let [x, y] = &self.axes;
        let look = |axis: &Axis| AxisLook { name: label(axis), range: axis.low..axis.high, ticks: 6 };
        let mut chart = chart(&map, name, look(x), look(y), scale)?;
        let grid = self.grid;
        let edge = |axis: &Axis, index: usize| axis.low + (axis.high - axis.low) * index as f64 / grid as f64;
        let tiles = self.points.iter().enumerate().map(|(slot, point)| {
            let (column, row) = (slot % grid, slot / grid);
            let corners = [(edge(x, column), edge(y, row)), (edge(x, column + 1), edge(y, row + 1))];
            let share = (value(point) - range.start) / (range.end - range.start);
            Rectangle::new(corners, viridis(share).filled())
        });
        chart.draw_series(tiles).map_err(drawing)?;
        let place = |x: f64, y: f64| {
            let (px, py) = chart.backend_coord(&(x, y));
            let (left, top) = map.get_base_pixel();
            (px - left, py - top)
        };
        for (line, x, y) in [(EXTREME, &x.extreme, &y.extreme), (RANDOM, &x.random, &y.random)] {
            for &(left, right) in x {
                for &(bottom, top) in y {
                    outline(&map, [place(left, top), place(right, bottom)], line, scale)?;
                }
            }
        }
        colour_bar(&bar, range, scale)
    }
}

fn label(axis: &Axis) -> String {
    if axis.unit == "1" { axis.name.clone() } else { format!("{}, {}", axis.name, axis.unit) }
}

/// A box in white within a black one, so that it is seen on every colour.
fn outline<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    [(left, top), (right, bottom)]: [(i32, i32); 2],
    line: LineStyle,
    scale: u32,
) -> Result<(), PlotError> {
    let path = vec![(left, top), (right, top), (right, bottom), (left, bottom), (left, top)];
    let around = LineStyle { colour: BLACK, width: 3, dashes: None };
    area.draw(&around.along(path.clone(), scale)).map_err(drawing)?;
    area.draw(&line.along(path, scale)).map_err(drawing)
}

/// The colours with their values.
fn colour_bar<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    range: Range<f64>,
    scale: u32,
) -> Result<(), PlotError> {
    let (steps, unit) = (100, scale as i32);
    let (top, bottom) = (34 * unit, (PANEL.1 as i32 - 50) * unit);
    let height = bottom - top;
    for step in 0..steps {
        let from = bottom - height * (step + 1) / steps;
        let to = bottom - height * step / steps;
        let colour = viridis((f64::from(step) + 0.5) / f64::from(steps));
        area.draw(&Rectangle::new([(2 * unit, from), (18 * unit, to)], colour.filled())).map_err(drawing)?;
    }
    for quarter in 0..=4 {
        let y = bottom - height * quarter / 4;
        let value = range.start + (range.end - range.start) * f64::from(quarter) / 4.0;
        area.draw_text(&tick(value), &font(11, scale), (24 * unit, y - 6 * unit)).map_err(drawing)?;
    }
    Ok(())
}

/// Of width 1 if all `values` are equal.
fn range(values: impl Iterator<Item = f64>) -> Range<f64> {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    if high > low { low..high } else { low - 0.5..low + 0.5 }
}
