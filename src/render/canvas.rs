//! A picture in the making: shapes in metres, y upwards.

use super::Size;
use tiny_skia::{Color, FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, Stroke, StrokeDash, Transform};

/// A point in m.
pub(super) type Point = [f64; 2];

/// A colour: red, green, blue.
pub(super) type Colour = [u8; 3];

/// Colours that colour-blind people tell apart (Okabe and Ito, 2008), and greys.
pub(super) mod colour {
    use super::Colour;

    pub(in crate::render) const BACKGROUND: Colour = [247, 249, 251];
    pub(in crate::render) const GROUND: Colour = [214, 219, 224];
    pub(in crate::render) const FAINT: Colour = [172, 180, 188];
    pub(in crate::render) const DARK: Colour = [52, 60, 68];
    pub(in crate::render) const BLUE: Colour = [0, 114, 178];
    pub(in crate::render) const SKY_BLUE: Colour = [86, 180, 233];
    pub(in crate::render) const ORANGE: Colour = [230, 159, 0];
    pub(in crate::render) const VERMILLION: Colour = [213, 94, 0];
    pub(in crate::render) const GREEN: Colour = [0, 158, 115];
    pub(in crate::render) const PALE_GREEN: Colour = [224, 240, 234];
}

/// Farther from the picture, in pixels, nothing is drawn exactly: absurd numbers must not overflow.
const FAR: f64 = 1e5;
/// No line is thinner, in pixels.
const THINNEST: f64 = 1.0;

/// A picture in the making.
pub(super) struct Canvas {
    pixmap: Pixmap,
    /// Pixels in a metre.
    scale: f64,
    /// The picture's lower left and upper right corner.
    pub(super) low: Point,
    pub(super) high: Point,
}

impl Canvas {
    /// A blank picture that shows at least the rectangle from `low` to `high`, in its middle, as large as can be. None
    /// for a size of zero.
    pub(super) fn new(size: Size, low: Point, high: Point) -> Option<Self> {
        let (width, height) = (f64::from(size.width), f64::from(size.height));
        let mut pixmap = Pixmap::new(size.width.into(), size.height.into())?;
        pixmap.fill(paint(colour::BACKGROUND));
        let scale = (width / (high[0] - low[0])).min(height / (high[1] - low[1]));
        let (x, y) = ((low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0);
        let half = [width / scale / 2.0, height / scale / 2.0];
        Some(Self { pixmap, scale, low: [x - half[0], y - half[1]], high: [x + half[0], y + half[1]] })
    }

    /// The pixels, `[height, width, 3]`.
    pub(super) fn into_rgb(self) -> Vec<u8> {
        let rgb = |pixel: &[u8; 4]| [pixel[0], pixel[1], pixel[2]]; // all are opaque
        self.pixmap.data().as_chunks::<4>().0.iter().flat_map(rgb).collect()
    }

    /// A filled polygon.
    pub(super) fn polygon(&mut self, corners: &[Point], colour: Colour) {
        if let Some(path) = self.path(corners, true) {
            self.fill(&path, colour);
        }
    }

    /// A filled rectangle, by its lower left and upper right corner.
    pub(super) fn rectangle(&mut self, [x0, y0]: Point, [x1, y1]: Point, colour: Colour) {
        self.polygon(&[[x0, y0], [x1, y0], [x1, y1], [x0, y1]], colour);
    }

    /// A filled disc of a radius in m.
    pub(super) fn disc(&mut self, centre: Point, radius: f64, colour: Colour) {
        let (x, y) = self.pixel(centre);
        if let Some(path) = PathBuilder::from_circle(x, y, (radius * self.scale).max(THINNEST) as f32) {
            self.fill(&path, colour);
        }
    }

    /// A line through points, with round ends, of a width in m.
    pub(super) fn line(&mut self, points: &[Point], width: f64, colour: Colour) {
        self.stroke(points, width, colour, None);
    }

    /// A dashed line through points, of a width in m.
    pub(super) fn dashes(&mut self, points: &[Point], width: f64, colour: Colour) {
        let dash = (4.0 * width * self.scale).max(4.0 * THINNEST) as f32;
        self.stroke(points, width, colour, StrokeDash::new(vec![dash, dash], 0.0));
    }

    fn stroke(&mut self, points: &[Point], width: f64, colour: Colour, dash: Option<StrokeDash>) {
        let Some(path) = self.path(points, false) else { return };
        let width = (width * self.scale).max(THINNEST) as f32;
        let line_cap = if dash.is_some() { LineCap::Butt } else { LineCap::Round };
        let stroke = Stroke { width, line_cap, line_join: LineJoin::Round, dash, ..Stroke::default() };
        self.pixmap.stroke_path(&path, &solid(colour), &stroke, Transform::identity(), None);
    }

    fn fill(&mut self, path: &Path, colour: Colour) {
        self.pixmap.fill_path(path, &solid(colour), FillRule::Winding, Transform::identity(), None);
    }

    fn path(&self, points: &[Point], close: bool) -> Option<Path> {
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

    fn pixel(&self, [x, y]: Point) -> (f32, f32) {
        let clamp = |pixels: f64| pixels.clamp(-FAR, FAR) as f32;
        (clamp((x - self.low[0]) * self.scale), clamp((self.high[1] - y) * self.scale))
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
