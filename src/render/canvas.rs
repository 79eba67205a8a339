//! Draws the shapes of a [`Drawing`], whose coordinates are in m, as anti-aliased pixels. Uses the library tiny-skia.

use super::Size;
use crate::scene::{Colour, Drawing, Graph, ScenePoint, Shape, colour};
use tiny_skia::{Color, FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, Stroke, StrokeDash, Transform};

/// Number of straight segments by which the graph of a function is drawn.
const SMOOTH: usize = 64;
/// Maximal absolute pixel coordinate. Larger coordinates are clamped, so that they do not overflow.
const FAR: f64 = 1e5;
/// Minimal width of lines and radius of discs, in pixels.
const THINNEST: f64 = 1.0;

/// Draws a picture. Returns its pixels, `[height, width, 3]`: red, green and blue, top row first.
pub(super) fn draw(drawing: &Drawing, size: Size) -> Vec<u8> {
    let mut canvas = Canvas::new(size, drawing.low, drawing.high);
    for shape in &drawing.shapes {
        canvas.add(shape);
    }
    let rgb = |pixel: &[u8; 4]| [pixel[0], pixel[1], pixel[2]]; // drops the opacity, which is always 255
    canvas.pixmap.data().as_chunks::<4>().0.iter().flat_map(rgb).collect()
}

/// A picture that is being drawn.
struct Canvas {
    pixmap: Pixmap,
    /// Number of pixels per metre.
    scale: f64,
    /// The lower left corner of the picture, in m.
    low: ScenePoint,
    /// The upper right corner of the picture, in m.
    high: ScenePoint,
}

impl Canvas {
    /// Creates a blank picture. The rectangle from `low` to `high` is in the middle of the picture, and as large as
    /// fits.
    fn new(size: Size, low: ScenePoint, high: ScenePoint) -> Self {
        let (width, height) = (f64::from(size.width), f64::from(size.height));
        let mut pixmap = Pixmap::new(size.width.into(), size.height.into()).expect("sizes are at least 16");
        pixmap.fill(paint(colour::BACKGROUND));
        let scale = (width / (high[0] - low[0])).min(height / (high[1] - low[1]));
        let (x, y) = ((low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0);
        let half = [width / scale / 2.0, height / scale / 2.0];
        Self { pixmap, scale, low: [x - half[0], y - half[1]], high: [x + half[0], y + half[1]] }
    }

    fn add(&mut self, shape: &Shape) {
        match *shape {
            Shape::Polygon { ref corners, colour } => self.fill(self.path(corners, true), colour),
            Shape::Disc { centre, radius, colour } => {
                let (x, y) = self.pixel(centre);
                let radius = self.pixels(radius);
                self.fill(PathBuilder::from_circle(x, y, radius), colour);
            }
            Shape::Line { ref points, width, colour } => self.stroke(points, width, colour, None),
            Shape::Dashes { ref points, width, colour } => {
                let dash = 4.0 * self.pixels(width);
                self.stroke(points, width, colour, StrokeDash::new(vec![dash, dash], 0.0));
            }
            Shape::Graph { graph, width, colour } => self.stroke(&self.points(graph), width, colour, None),
            Shape::Ground { graph, colour } => {
                let mut corners = self.points(graph);
                corners.extend([[graph.to, f64::NEG_INFINITY], [graph.from, f64::NEG_INFINITY]]);
                self.fill(self.path(&corners, true), colour);
            }
        }
    }

    fn stroke(&mut self, points: &[ScenePoint], width: f64, colour: Colour, dash: Option<StrokeDash>) {
        let Some(path) = self.path(points, false) else { return };
        let width = self.pixels(width);
        let line_cap = if dash.is_some() { LineCap::Butt } else { LineCap::Round };
        let stroke = Stroke { width, line_cap, line_join: LineJoin::Round, dash, ..Stroke::default() };
        self.pixmap.stroke_path(&path, &solid(colour), &stroke, Transform::identity(), None);
    }

    fn fill(&mut self, path: Option<Path>, colour: Colour) {
        let Some(path) = path else { return };
        self.pixmap.fill_path(&path, &solid(colour), FillRule::Winding, Transform::identity(), None);
    }

    fn path(&self, points: &[ScenePoint], close: bool) -> Option<Path> {
        let mut builder = PathBuilder::new();
        for (i, &point) in points.iter().enumerate() {
            let (x, y) = self.pixel(point);
            if i == 0 { builder.move_to(x, y) } else { builder.line_to(x, y) }
        }
        if close {
            builder.close();
        }
        builder.finish()
    }

    fn pixel(&self, [x, y]: ScenePoint) -> (f32, f32) {
        let clamp = |pixels: f64| pixels.clamp(-FAR, FAR) as f32;
        let (x, y) = (self.within(0, x), self.within(1, y));
        (clamp((x - self.low[0]) * self.scale), clamp((self.high[1] - y) * self.scale))
    }

    /// Converts a length in m to pixels, clamped to a visible width.
    fn pixels(&self, length: f64) -> f32 {
        let pixels = length * self.scale;
        if pixels > THINNEST { pixels.min(FAR) as f32 } else { THINNEST as f32 } // NaN becomes THINNEST, too
    }

    /// Replaces an infinite coordinate along an axis by the edge of the picture.
    fn within(&self, axis: usize, coordinate: f64) -> f64 {
        match coordinate {
            f64::INFINITY => self.high[axis],
            f64::NEG_INFINITY => self.low[axis],
            finite => finite,
        }
    }

    fn points(&self, Graph { height, from, to }: Graph) -> Vec<ScenePoint> {
        let to = self.within(0, to);
        let x = |i: usize| from + (to - from) * i as f64 / SMOOTH as f64;
        (0..=SMOOTH).map(x).map(|x| [x, height(x)]).collect()
    }
}

fn paint([red, green, blue]: Colour) -> Color {
    Color::from_rgba8(red, green, blue, 255)
}

fn solid(colour: Colour) -> Paint<'static> {
    let mut solid = Paint { anti_alias: true, ..Paint::default() };
    solid.set_color(paint(colour));
    solid
}
