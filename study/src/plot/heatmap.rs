//! Heatmaps: mean return and, below it, success over two parameters, with the sets of R and E. Pictures are narrow, so that
//! those of policies trained on D, R and E fit side by side.

use plotters::coord::Shift;
use plotters::element::DashedPathElement;
use plotters::prelude::*;

use super::super::heatmap::{Axis, Heatmap};
use super::curves::tick;
use super::{Picture, PlotError, drawing, font, viridis};

const PANEL: (u32, u32) = (400, 316);
const TITLE: u32 = 48;
const KEY: u32 = 34;
/// The part of a panel that the colour bar takes.
const BAR: u32 = 74;

/// The picture of `heatmap`.
pub fn draw_heatmap(heatmap: &Heatmap) -> impl Picture + '_ {
    HeatmapPicture(heatmap)
}

struct HeatmapPicture<'a>(&'a Heatmap);

impl Picture for HeatmapPicture<'_> {
    fn size(&self) -> (u32, u32) {
        (PANEL.0, TITLE + 2 * PANEL.1 + KEY)
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        area.fill(&WHITE).map_err(drawing)?;
        let unit = scale as i32;
        let (title, rest) = area.split_vertically(TITLE * scale);
        let (panels, key) = rest.split_vertically(2 * PANEL.1 * scale);
        let Heatmap { environment, policy, episodes, .. } = self.0;
        title
            .draw_text(&format!("{environment}: {policy}"), &font(13, scale), (10 * unit, 8 * unit))
            .map_err(drawing)?;
        let text = format!("{episodes} episodes at each point, other parameters at their defaults");
        title.draw_text(&text, &font(11, scale), (10 * unit, 28 * unit)).map_err(drawing)?;
        let panels = panels.split_evenly((2, 1));
        let (low, high) = range(&self.0.returns);
        self.panel(&panels[0], "mean return", &self.0.returns, low..high, scale)?;
        self.panel(&panels[1], "success rate, %", &self.0.success, 0.0..100.0, scale)?;
        for (i, (name, set)) in [("R", Set::Random), ("E", Set::Extreme)].into_iter().enumerate() {
            let (x, y) = ((60 + 60 * i as i32) * unit, 8 * unit);
            outline(&key, [(x, y), (x + 22 * unit, y + 14 * unit)], set, scale)?;
            key.draw_text(name, &font(13, scale), (x + 28 * unit, y)).map_err(drawing)?;
        }
        Ok(())
    }
}

/// Which set an outline is of.
#[derive(Clone, Copy)]
enum Set {
    Random,
    Extreme,
}

impl HeatmapPicture<'_> {
    fn panel<DB: DrawingBackend>(
        &self,
        area: &DrawingArea<DB, Shift>,
        name: &str,
        values: &[f64],
        range: std::ops::Range<f64>,
        scale: u32,
    ) -> Result<(), PlotError> {
        let (map, bar) = area.split_horizontally((PANEL.0 - BAR) * scale);
        let [x, y] = &self.0.axes;
        let mut chart = ChartBuilder::on(&map)
            .margin(8 * scale)
            .x_label_area_size(38 * scale)
            .y_label_area_size(56 * scale)
            .caption(name, font(13, scale))
            .build_cartesian_2d(x.low..x.high, y.low..y.high)
            .map_err(drawing)?;
        chart
            .configure_mesh()
            .disable_mesh()
            .x_labels(6)
            .y_labels(6)
            .label_style(font(11, scale))
            .axis_desc_style(font(12, scale))
            .x_desc(label(x))
            .y_desc(label(y))
            .x_label_formatter(&|x| tick(*x))
            .y_label_formatter(&|y| tick(*y))
            .axis_style(RGBColor(120, 120, 120).stroke_width(scale))
            .set_all_tick_mark_size(3 * scale)
            .draw()
            .map_err(drawing)?;
        let grid = self.0.grid;
        let edge = |axis: &Axis, index: usize| axis.low + (axis.high - axis.low) * index as f64 / grid as f64;
        let tiles = values.iter().enumerate().map(|(slot, value)| {
            let (column, row) = (slot % grid, slot / grid);
            let corners = [(edge(x, column), edge(y, row)), (edge(x, column + 1), edge(y, row + 1))];
            let share = (value - range.start) / (range.end - range.start);
            Rectangle::new(corners, viridis(share).filled())
        });
        chart.draw_series(tiles).map_err(drawing)?;
        let place = |x: f64, y: f64| {
            let (px, py) = chart.backend_coord(&(x, y));
            let (left, top) = map.get_base_pixel();
            (px - left, py - top)
        };
        for (set, of) in [
            (Set::Extreme, (|axis: &Axis| axis.extreme.clone()) as fn(&Axis) -> Vec<(f64, f64)>),
            (Set::Random, |axis| axis.random.clone()),
        ] {
            for (left, right) in of(x) {
                for (bottom, top) in of(y) {
                    outline(&map, [place(left, top), place(right, bottom)], set, scale)?;
                }
            }
        }
        colour_bar(&bar, range, scale)
    }
}

fn label(axis: &Axis) -> String {
    if axis.unit == "1" { axis.name.clone() } else { format!("{}, {}", axis.name, axis.unit) }
}

/// A box in white within a black one, so that it is seen on every colour: whole for R, dashed for E.
fn outline<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    [(left, top), (right, bottom)]: [(i32, i32); 2],
    set: Set,
    scale: u32,
) -> Result<(), PlotError> {
    let path = vec![(left, top), (right, top), (right, bottom), (left, bottom), (left, top)];
    let (wide, narrow) = (BLACK.stroke_width(3 * scale), WHITE.stroke_width(scale));
    area.draw(&PathElement::new(path.clone(), wide)).map_err(drawing)?;
    match set {
        Set::Random => area.draw(&PathElement::new(path, narrow)).map_err(drawing),
        Set::Extreme => {
            let dashed = DashedPathElement::new(path, 7 * scale, 5 * scale, narrow);
            area.draw(&dashed).map_err(drawing)
        }
    }
}

/// The colours with their values.
fn colour_bar<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    range: std::ops::Range<f64>,
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

/// The range of `values`; of width 1 if all are equal.
fn range(values: &[f64]) -> (f64, f64) {
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if high > low { (low, high) } else { (low - 0.5, low + 0.5) }
}
