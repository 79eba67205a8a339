//! Heatmaps side by side, of policies that were trained on different things: mean return and, below it, success over two
//! parameters, with the boxes of R and E and the default. All share their axes, and a row its colours.

mod surfaces;

use std::ops::Range;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::super::heatmap::{Axis, Heatmap, HeatmapPoint};
use super::ticks::round_ticks;
use super::{LineStyle, Plot, PlotError, drawing, font, viridis};

/// Widths of one panel: as much as several leave each other, but not less nor more than these.
const PANELS: i32 = 760;
const NARROWEST: i32 = 190;
const WIDEST: i32 = 330;
const HEIGHT: i32 = 220;
/// Left of the first panel, between two, and right of the last, for the colours.
const LEFT: i32 = 66;
const GAP: i32 = 16;
const RIGHT: i32 = 112;
/// Lines of text above, and what a panel is of.
const LINE: i32 = 18;
const CAPTION: i32 = 24;
/// Below the panels: the axes' numbers and names, and the legend.
const NUMBERS: i32 = 40;
const KEY: i32 = 34;
/// The outlines of R's box and of E's.
const RANDOM: LineStyle = LineStyle { colour: WHITE, width: 2, dashes: None };
const EXTREME: LineStyle = LineStyle { colour: WHITE, width: 2, dashes: Some((7, 5)) };
/// Around a line, so that it is seen on every colour; and as much as a box stays inside, so that it is seen whole.
const AROUND: LineStyle = LineStyle { colour: BLACK, width: 4, dashes: None };
const INSIDE: i32 = 2;

/// Heatmaps over the same two parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatmapPanels {
    /// Above all: what it is of, and how it was made.
    pub title: Vec<String>,
    /// x and y.
    pub axes: [Axis; 2],
    /// The scale of mean returns.
    pub returns: Range<f64>,
    /// From left to right.
    pub columns: Vec<HeatmapColumn>,
}

/// One of several heatmaps.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatmapColumn {
    /// What it is of.
    pub caption: String,
    /// What is shown, or why nothing is.
    pub content: Result<Heatmap, String>,
}

/// A scale for the mean returns of all `heatmaps`, in which the highest has the last colour.
pub fn common_returns<'a>(heatmaps: impl Iterator<Item = &'a Heatmap>) -> Range<f64> {
    let returns = heatmaps.flat_map(|heatmap| heatmap.points.iter().map(|point| point.mean_return));
    let (low, high) = returns.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    if low > high {
        0.0..1.0
    } else if low < high {
        low..high
    } else {
        high - 1.0..high
    }
}

/// What a row shows.
struct Row {
    name: &'static str,
    range: Range<f64>,
    value: fn(&HeatmapPoint) -> f64,
}

impl Plot for HeatmapPanels {
    fn size(&self) -> (u32, u32) {
        let columns = self.columns.len() as i32;
        let width = LEFT + columns * self.panel_width() + (columns - 1).max(0) * GAP + RIGHT;
        (width as u32, (self.top(1) + HEIGHT + NUMBERS + KEY) as u32)
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Result<(), PlotError> {
        area.fill(&WHITE).map_err(drawing)?;
        let canvas = Canvas { area, scale };
        for (line, text) in self.title.iter().enumerate() {
            let size = if line == 0 { 15 } else { 11 };
            canvas.text(text, size, (12, 10 + LINE * line as i32), (HPos::Left, VPos::Top))?;
        }
        let rows = [
            Row { name: "mean return", range: self.returns.clone(), value: |point| point.mean_return },
            Row { name: "success rate, %", range: 0.0..100.0, value: |point| point.success_percent },
        ];
        for (index, row) in rows.iter().enumerate() {
            for (column, of) in self.columns.iter().enumerate() {
                let frame = self.frame(column, index);
                if index == 0 {
                    canvas.text(&of.caption, 13, (frame.middle(), frame.top - 6), (HPos::Center, VPos::Bottom))?;
                }
                match &of.content {
                    Ok(heatmap) => self.panel(&canvas, &frame, heatmap, row)?,
                    Err(why) => canvas.apology(&frame, why)?,
                }
                self.ticks(&canvas, &frame, (column == 0, index == 1))?;
            }
            let last = self.frame(self.columns.len().saturating_sub(1), index);
            canvas.colour_bar(last.left + last.width + 20, last.top, row)?;
        }
        self.axis_names(&canvas)?;
        self.key(&canvas)
    }

    /// The surfaces, thousands of rectangles, as a path for each colour.
    fn finish(&self, svg: String) -> String {
        surfaces::as_paths(&svg)
    }
}

impl HeatmapPanels {
    fn panel_width(&self) -> i32 {
        (PANELS / self.columns.len().max(1) as i32).clamp(NARROWEST, WIDEST)
    }

    fn top(&self, row: usize) -> i32 {
        10 + LINE * self.title.len() as i32 + CAPTION + row as i32 * (HEIGHT + GAP)
    }

    fn frame(&self, column: usize, row: usize) -> Frame {
        let width = self.panel_width();
        Frame { left: LEFT + column as i32 * (width + GAP), top: self.top(row), width, height: HEIGHT }
    }

    fn panel<DB: DrawingBackend>(
        &self,
        canvas: &Canvas<'_, DB>,
        frame: &Frame,
        heatmap: &Heatmap,
        row: &Row,
    ) -> Result<(), PlotError> {
        canvas.surface(frame, heatmap, row)?;
        let [x, y] = &self.axes;
        for (line, x_pairs, y_pairs) in [(EXTREME, &x.extreme, &y.extreme), (RANDOM, &x.random, &y.random)] {
            for &(left, right) in x_pairs {
                for &(bottom, top) in y_pairs {
                    let corners = [(frame.x(x, left), frame.y(y, top)), (frame.x(x, right), frame.y(y, bottom))];
                    canvas.outline(corners.map(|corner| frame.inside(corner)), line)?;
                }
            }
        }
        let shown = |axis: &Axis| (axis.low..=axis.high).contains(&axis.default);
        if shown(x) && shown(y) { canvas.mark((frame.x(x, x.default), frame.y(y, y.default))) } else { Ok(()) }
    }

    /// Beside a panel, with numbers at the left and the lower ones.
    fn ticks<DB: DrawingBackend>(
        &self,
        canvas: &Canvas<'_, DB>,
        frame: &Frame,
        (is_left, is_low): (bool, bool),
    ) -> Result<(), PlotError> {
        let [x, y] = &self.axes;
        let (left, bottom) = (frame.left, frame.top + frame.height);
        for (value, number) in round_ticks(&(x.low..x.high), (frame.width / 48) as usize) {
            let place = frame.x(x, value);
            canvas.line(vec![(place, bottom), (place, bottom + 4)], TICK)?;
            if is_low {
                canvas.text(&number, 11, (place, bottom + 7), (HPos::Center, VPos::Top))?;
            }
        }
        for (value, number) in round_ticks(&(y.low..y.high), 6) {
            let place = frame.y(y, value);
            canvas.line(vec![(left - 4, place), (left, place)], TICK)?;
            if is_left {
                canvas.text(&number, 11, (left - 7, place), (HPos::Right, VPos::Center))?;
            }
        }
        Ok(())
    }

    fn axis_names<DB: DrawingBackend>(&self, canvas: &Canvas<'_, DB>) -> Result<(), PlotError> {
        let [x, y] = &self.axes;
        for column in 0..self.columns.len() {
            let frame = self.frame(column, 1);
            let below = (frame.middle(), frame.top + frame.height + 22);
            canvas.text(&label(x), 12, below, (HPos::Center, VPos::Top))?;
        }
        for row in 0..2 {
            let frame = self.frame(0, row);
            let turned = canvas.style(12).transform(FontTransform::Rotate270).pos(Pos::new(HPos::Center, VPos::Top));
            canvas.styled(&label(y), turned, (10, frame.top + frame.height / 2))?;
        }
        Ok(())
    }

    fn key<DB: DrawingBackend>(&self, canvas: &Canvas<'_, DB>) -> Result<(), PlotError> {
        let y = self.top(1) + HEIGHT + NUMBERS + 8;
        let names = [("R, random", 124), ("E, extreme", 130), ("D, default", 0)];
        let mut x = LEFT;
        for (index, (name, width)) in names.into_iter().enumerate() {
            let corners = [(x, y), (x + 34, y + 18)];
            // On a colour of the surface, since white lines are not seen on white.
            canvas.rectangle(corners, viridis(0.4).filled())?;
            match index {
                0 => canvas.outline(corners, RANDOM)?,
                1 => canvas.outline(corners, EXTREME)?,
                _ => canvas.mark((x + 17, y + 9))?,
            }
            canvas.text(name, 12, (x + 42, y + 9), (HPos::Left, VPos::Center))?;
            x += width;
        }
        Ok(())
    }
}

const TICK: LineStyle = LineStyle { colour: RGBColor(120, 120, 120), width: 1, dashes: None };

fn label(axis: &Axis) -> String {
    if axis.unit == "1" { axis.name.clone() } else { format!("{}, {}", axis.name, axis.unit) }
}

/// Where a panel is.
struct Frame {
    left: i32,
    top: i32,
    width: i32,
    height: i32,
}

impl Frame {
    fn middle(&self) -> i32 {
        self.left + self.width / 2
    }

    fn x(&self, axis: &Axis, value: f64) -> i32 {
        self.left + along(axis, value, self.width)
    }

    fn y(&self, axis: &Axis, value: f64) -> i32 {
        self.top + self.height - along(axis, value, self.height)
    }

    /// The nearest place at which a line is seen whole.
    fn inside(&self, (x, y): (i32, i32)) -> (i32, i32) {
        let within = |place: i32, from: i32, length: i32| place.clamp(from + INSIDE, from + length - INSIDE);
        (within(x, self.left, self.width), within(y, self.top, self.height))
    }
}

/// The distance of a value from the low end of its axis, of this length.
fn along(axis: &Axis, value: f64, length: i32) -> i32 {
    (f64::from(length) * (value - axis.low) / (axis.high - axis.low)).round() as i32
}

/// What is drawn on, in units.
struct Canvas<'a, DB: DrawingBackend> {
    area: &'a DrawingArea<DB, Shift>,
    scale: u32,
}

impl<DB: DrawingBackend> Canvas<'_, DB> {
    fn at(&self, (x, y): (i32, i32)) -> (i32, i32) {
        (x * self.scale as i32, y * self.scale as i32)
    }

    fn style(&self, size: u32) -> TextStyle<'static> {
        font(size, self.scale)
    }

    fn text(&self, text: &str, size: u32, at: (i32, i32), (h, v): (HPos, VPos)) -> Result<(), PlotError> {
        // The library's middle of a line of text is that of its letters in an SVG, and lies above them in a PNG.
        let down = if matches!(v, VPos::Center) { 2 } else { 0 };
        self.styled(text, self.style(size).pos(Pos::new(h, v)), (at.0, at.1 + down))
    }

    fn styled(&self, text: &str, style: TextStyle<'_>, at: (i32, i32)) -> Result<(), PlotError> {
        self.area.draw_text(text, &style, self.at(at)).map_err(drawing)
    }

    fn rectangle(&self, corners: [(i32, i32); 2], style: ShapeStyle) -> Result<(), PlotError> {
        self.area.draw(&Rectangle::new(corners.map(|corner| self.at(corner)), style)).map_err(drawing)
    }

    fn line(&self, points: Vec<(i32, i32)>, style: LineStyle) -> Result<(), PlotError> {
        let points: Vec<_> = points.into_iter().map(|point| self.at(point)).collect();
        self.area.draw(&style.along(points, self.scale)).map_err(drawing)
    }

    /// The colours of a heatmap: neighbours of one colour are one rectangle.
    fn surface(&self, frame: &Frame, heatmap: &Heatmap, row: &Row) -> Result<(), PlotError> {
        let ((left, top), (width, height)) = (self.at((frame.left, frame.top)), self.at((frame.width, frame.height)));
        let grid = heatmap.grid as i32;
        let edge = |length: i32, index: usize| length * index as i32 / grid;
        let colour =
            |point: &HeatmapPoint| viridis(((row.value)(point) - row.range.start) / (row.range.end - row.range.start));
        for (line, points) in heatmap.points.chunks(heatmap.grid).enumerate() {
            let bottom = top + height - edge(height, line);
            let above = top + height - edge(height, line + 1);
            let mut from = 0;
            for same in points.chunk_by(|a, b| colour(a) == colour(b)) {
                let corners = [(left + edge(width, from), above), (left + edge(width, from + same.len()), bottom)];
                self.area.draw(&Rectangle::new(corners, colour(&same[0]).filled())).map_err(drawing)?;
                from += same.len();
            }
        }
        Ok(())
    }

    /// In place of a panel that there is not.
    fn apology(&self, frame: &Frame, why: &str) -> Result<(), PlotError> {
        let (left, top, right, bottom) = (frame.left, frame.top, frame.left + frame.width, frame.top + frame.height);
        self.rectangle([(left, top), (right, bottom)], RGBColor(238, 238, 238).filled())?;
        let lines = wrapped(why, (frame.width / 7) as usize);
        let first = top + frame.height / 2 - LINE * lines.len() as i32 / 2 + LINE / 2;
        for (index, line) in lines.iter().enumerate() {
            self.text(line, 11, (frame.middle(), first + LINE * index as i32), (HPos::Center, VPos::Center))?;
        }
        Ok(())
    }

    /// A box in white within a black one, so that it is seen on every colour. Its corners are never in a gap between dashes.
    fn outline(&self, [(left, top), (right, bottom)]: [(i32, i32); 2], line: LineStyle) -> Result<(), PlotError> {
        let corners = [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)];
        self.line(corners.to_vec(), AROUND)?;
        // A closed path has no first corner without its other half.
        self.line(vec![(right, top), (left, top), (left, bottom)], AROUND)?;
        for side in corners.windows(2) {
            for (from, to) in dashes(side[0], side[1], line.dashes) {
                self.line(vec![from, to], LineStyle { dashes: None, ..line })?;
            }
        }
        Ok(())
    }

    /// The default: a ring in black within a white one.
    fn mark(&self, at: (i32, i32)) -> Result<(), PlotError> {
        for (colour, width) in [(WHITE, 5), (BLACK, 2)] {
            let ring = Circle::new(self.at(at), 5 * self.scale, colour.stroke_width(width * self.scale));
            self.area.draw(&ring).map_err(drawing)?;
        }
        Ok(())
    }

    /// The colours of a row with their values, from `top` on.
    fn colour_bar(&self, left: i32, top: i32, row: &Row) -> Result<(), PlotError> {
        self.text(row.name, 12, (left, top), (HPos::Left, VPos::Top))?;
        let (top, bottom) = (top + 22, top + HEIGHT);
        let (steps, height) = (99, bottom - top);
        for step in 0..=steps {
            let place = |step: i32| bottom * self.scale as i32 - height * self.scale as i32 * step / (steps + 1);
            let (x, right) = (left * self.scale as i32, (left + 16) * self.scale as i32);
            let colour = viridis(f64::from(step) / f64::from(steps));
            let corners = [(x, place(step + 1)), (right, place(step))];
            self.area.draw(&Rectangle::new(corners, colour.filled())).map_err(drawing)?;
        }
        for (value, number) in round_ticks(&row.range, 6) {
            let share = (value - row.range.start) / (row.range.end - row.range.start);
            let y = bottom - (f64::from(height) * share).round() as i32;
            self.line(vec![(left + 16, y), (left + 20, y)], TICK)?;
            self.text(&number, 11, (left + 24, y), (HPos::Left, VPos::Center))?;
        }
        Ok(())
    }
}

/// The dashes between two ends, both of which are in one; the whole line without dashes.
fn dashes(from: (i32, i32), to: (i32, i32), lengths: Option<(u32, u32)>) -> Vec<((i32, i32), (i32, i32))> {
    let Some((dash, gap)) = lengths else { return vec![(from, to)] };
    let ((dash, gap), (dx, dy)) = ((f64::from(dash), f64::from(gap)), (to.0 - from.0, to.1 - from.1));
    let length = f64::from(dx).hypot(f64::from(dy));
    let count = ((length + gap) / (dash + gap)).round().max(1.0);
    let dash = (length - (count - 1.0) * gap) / count;
    let place = |distance: f64| {
        let share = if length > 0.0 { distance / length } else { 0.0 };
        (from.0 + (f64::from(dx) * share).round() as i32, from.1 + (f64::from(dy) * share).round() as i32)
    };
    let begin = |index: u32| f64::from(index) * (dash + gap);
    (0..count as u32).map(|index| (place(begin(index)), place(begin(index) + dash))).collect()
}

/// Lines of at most so many letters, unless a word is longer.
fn wrapped(text: &str, letters: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.len() + 1 + word.len() <= letters => *line = format!("{line} {word}"),
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::super::svg;
    use super::*;
    use crate::fixture;

    fn panels(heatmap: Heatmap) -> HeatmapPanels {
        let returns = common_returns(std::iter::once(&heatmap));
        let (title, axes) = (vec!["Pendulum".to_owned()], heatmap.axes.clone());
        let column = HeatmapColumn { caption: "trained on D".into(), content: Ok(heatmap) };
        HeatmapPanels { title, axes, returns, columns: vec![column] }
    }

    #[test]
    fn a_perfect_policy_has_the_top_colour_everywhere() {
        let shown = svg(&panels(fixture::heatmap(5, |_, _| (-120.0, 100.0)))).unwrap();
        // A line of a panel is as wide as the panel: each surface's five are of one colour.
        let whole_lines = |line: &&str| line.contains(&format!("h{WIDEST}v"));
        let surfaces: Vec<&str> = shown.lines().filter(whole_lines).collect();
        assert_eq!(surfaces.len(), 2, "mean return and success");
        for surface in surfaces {
            assert!(surface.starts_with("<path fill=\"#FDE725\"") && surface.matches('M').count() == 5, "{surface}");
        }
    }

    #[test]
    fn a_point_has_the_colour_of_its_share_of_the_scale() {
        let heatmap = fixture::heatmap(2, |mass, length| (mass, if length > 1.0 { 75.0 } else { 0.0 }));
        let shown = svg(&panels(heatmap)).unwrap();
        let colour = |share: f64| {
            let RGBColor(r, g, b) = viridis(share);
            format!("#{r:02X}{g:02X}{b:02X}")
        };
        let (half, left, top) = (WIDEST / 2, LEFT, 10 + LINE + CAPTION);
        let (right, low) = (left + half, top + HEIGHT / 2);
        let has = |share: f64, path: &str| {
            let line = format!("<path fill=\"{}\" shape-rendering=\"crispEdges\" d=\"{path}\"/>", colour(share));
            assert!(shown.contains(&line), "no {line} in {shown}");
        };
        // From below: small masses are left, and have the lowest return.
        has(0.0, &format!("M{left} {low}h165v110h-165zM{left} {top}h165v110h-165z"));
        has(1.0, &format!("M{right} {low}h165v110h-165zM{right} {top}h165v110h-165z"));
        // Great lengths are above.
        has(0.75, &format!("M{left} {}h330v110h-330z", top + HEIGHT + GAP));
    }

    #[test]
    fn a_scale_is_that_of_all_and_never_empty() {
        let [a, b] = [-5.0, 3.0].map(|value| fixture::heatmap(2, |mass, _| (value + mass, 0.0)));
        assert_eq!(common_returns([&a, &b].into_iter()), -4.25..4.25);
        assert_eq!(common_returns(std::iter::once(&fixture::heatmap(2, |_, _| (7.0, 0.0)))), 6.0..7.0);
        assert_eq!(common_returns(std::iter::empty()), 0.0..1.0);
    }

    #[test]
    fn both_ends_of_a_dashed_line_are_in_a_dash() {
        for length in [0, 3, 12, 50, 253] {
            let all = dashes((10, 20), (10 + length, 20), Some((7, 5)));
            assert_eq!((all[0].0, all[all.len() - 1].1), ((10, 20), (10 + length, 20)));
            let gaps = all.windows(2).map(|pair| pair[1].0.0 - pair[0].1.0);
            assert!(gaps.into_iter().all(|gap| (4..=6).contains(&gap)), "{all:?}");
        }
        assert_eq!(dashes((1, 2), (3, 4), None), [((1, 2), (3, 4))]);
    }
}
