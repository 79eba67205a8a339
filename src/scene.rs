//! The content of an environment's picture, as data. Environments describe it; renderers know no environment.

/// A point in m, y upwards. An infinite coordinate is the picture's edge.
pub type Point = [f64; 2];

/// Red, green, blue.
pub type Colour = [u8; 3];

/// Colours that colour-blind people tell apart (Okabe and Ito, 2008), and greys.
#[allow(missing_docs, reason = "their names say it")]
pub mod colour {
    use super::Colour;

    pub const BACKGROUND: Colour = [247, 249, 251];
    pub const GROUND: Colour = [214, 219, 224];
    pub const FAINT: Colour = [172, 180, 188];
    pub const DARK: Colour = [52, 60, 68];
    pub const BLUE: Colour = [0, 114, 178];
    pub const SKY_BLUE: Colour = [86, 180, 233];
    pub const ORANGE: Colour = [230, 159, 0];
    pub const VERMILLION: Colour = [213, 94, 0];
    pub const GREEN: Colour = [0, 158, 115];
    pub const PALE_GREEN: Colour = [224, 240, 234];
}

/// The content of a picture.
#[derive(Debug, Clone)]
pub enum Scene {
    /// Shapes in a plane.
    Drawing(Drawing),
    /// A MuJoCo model.
    #[cfg(feature = "mujoco")]
    Model(PosedModel),
}

/// Shapes, from back to front. Numbers may be very large.
#[derive(Debug, Clone)]
pub struct Drawing {
    /// The lower left corner of the rectangle that must be visible.
    pub low: Point,
    /// The upper right corner of that rectangle.
    pub high: Point,
    /// The shapes, from back to front.
    pub shapes: Vec<Shape>,
}

/// A shape of one colour.
#[derive(Debug, Clone)]
pub enum Shape {
    /// A filled polygon.
    Polygon {
        /// The corners in order.
        corners: Vec<Point>,
        /// The colour of the inside.
        colour: Colour,
    },
    /// A filled disc.
    Disc {
        /// The centre.
        centre: Point,
        /// The radius, m.
        radius: f64,
        /// The colour of the inside.
        colour: Colour,
    },
    /// A line through points, with round ends.
    Line {
        /// The points in order.
        points: Vec<Point>,
        /// The width, m.
        width: f64,
        /// The colour.
        colour: Colour,
    },
    /// A dashed line through points.
    Dashes {
        /// The points in order.
        points: Vec<Point>,
        /// The width, m.
        width: f64,
        /// The colour.
        colour: Colour,
    },
    /// The line of a graph.
    Graph {
        /// The line's course.
        graph: Graph,
        /// The width, m.
        width: f64,
        /// The colour.
        colour: Colour,
    },
    /// The area below a graph.
    Ground {
        /// The upper edge.
        graph: Graph,
        /// The colour.
        colour: Colour,
    },
}

/// A height as a function of x.
#[derive(Debug, Clone, Copy)]
pub struct Graph {
    /// The height at x, both in m.
    pub height: fn(f64) -> f64,
    /// The minimum of x, m.
    pub from: f64,
    /// The maximum of x, m; may be infinite.
    pub to: f64,
}

impl Drawing {
    /// Makes a blank drawing, of which at least the rectangle from `low` to `high` must be visible.
    pub fn new(low: Point, high: Point) -> Self {
        Self { low, high, shapes: Vec::new() }
    }

    /// Adds a filled polygon.
    pub fn polygon(&mut self, corners: &[Point], colour: Colour) {
        self.shapes.push(Shape::Polygon { corners: corners.to_vec(), colour });
    }

    /// Adds a filled rectangle, by its lower left and upper right corner.
    pub fn rectangle(&mut self, [x0, y0]: Point, [x1, y1]: Point, colour: Colour) {
        self.polygon(&[[x0, y0], [x1, y0], [x1, y1], [x0, y1]], colour);
    }

    /// Adds a filled disc of a radius in m.
    pub fn disc(&mut self, centre: Point, radius: f64, colour: Colour) {
        self.shapes.push(Shape::Disc { centre, radius, colour });
    }

    /// Adds a line through points, with round ends, of a width in m.
    pub fn line(&mut self, points: &[Point], width: f64, colour: Colour) {
        self.shapes.push(Shape::Line { points: points.to_vec(), width, colour });
    }

    /// Adds a dashed line through points, of a width in m.
    pub fn dashes(&mut self, points: &[Point], width: f64, colour: Colour) {
        self.shapes.push(Shape::Dashes { points: points.to_vec(), width, colour });
    }

    /// Adds the line of a graph, of a width in m.
    pub fn graph(&mut self, graph: Graph, width: f64, colour: Colour) {
        self.shapes.push(Shape::Graph { graph, width, colour });
    }

    /// Fills the area below a graph.
    pub fn ground(&mut self, graph: Graph, colour: Colour) {
        self.shapes.push(Shape::Ground { graph, colour });
    }

    /// Adds a rod with a bright outline that sets it off from what is behind.
    pub fn rod(&mut self, from: Point, to: Point, width: f64, colour: Colour) {
        self.line(&[from, to], 1.25 * width, colour::BACKGROUND);
        self.line(&[from, to], width, colour);
    }

    /// Adds a joint: a dark disc with a bright middle.
    pub fn joint(&mut self, at: Point, radius: f64) {
        self.disc(at, radius, colour::DARK);
        self.disc(at, 0.45 * radius, colour::BACKGROUND);
    }
}

/// Returns the point at a distance from `from`, in the direction of an angle from +x, rad.
#[expect(clippy::disallowed_methods, reason = "a picture need not be the same everywhere")]
pub fn polar(from: Point, distance: f64, angle: f64) -> Point {
    let (sin, cos) = angle.sin_cos();
    [from[0] + distance * cos, from[1] + distance * sin]
}

/// A MuJoCo model at certain positions.
#[cfg(feature = "mujoco")]
#[derive(Debug, Clone)]
pub struct PosedModel {
    /// The model and its look, which do not change.
    pub look: &'static Look,
    /// The MJCF with other lengths, if they are not those of the look.
    pub edited: Option<String>,
    /// The positions, `[Q]`.
    pub qpos: Vec<f64>,
}

/// The look of a MuJoCo model in pictures.
#[cfg(feature = "mujoco")]
#[derive(Debug, Clone, Copy)]
pub struct Look {
    /// The environment's name.
    pub name: &'static str,
    /// The model, as MJCF.
    pub mjcf: &'static str,
    /// The files that the MJCF names, with their bytes.
    pub files: &'static [(String, Vec<u8>)],
    /// Ground, light and colours that pictures add; `None` if the model has its own.
    pub scenery: Option<Scenery>,
    /// The camera.
    pub view: ModelView,
}

/// Ground, light and colours that pictures add to a MuJoCo model that has none.
#[cfg(feature = "mujoco")]
#[derive(Debug, Clone, Copy)]
pub struct Scenery {
    /// Elements that follow the model's own: ground, light, sky.
    pub mjcf: &'static str,
    /// The geom that the scenery replaces.
    pub hidden: &'static str,
    /// Geoms and their colours: red, green, blue, in 0 … 1.
    pub colours: &'static [(&'static str, [f32; 3])],
}

/// The camera of a MuJoCo model's pictures.
#[cfg(feature = "mujoco")]
#[derive(Debug, Clone, Copy)]
pub enum ModelView {
    /// Beside a robot that runs along x.
    Beside {
        /// The body that the camera follows.
        followed: &'static str,
        /// The camera's distance, m.
        distance: f64,
        /// The height that the camera looks at, m.
        height: f64,
    },
    /// By the model's camera of this number.
    Camera(usize),
    /// By a camera that is placed.
    Placed {
        /// The point that the camera looks at, m.
        look_at: [f64; 3],
        /// The camera's distance from that point, m.
        distance: f64,
        /// The direction of view, turned from +x about +z, degrees.
        azimuth: f64,
        /// The direction's slope, negative if it looks down, degrees.
        elevation: f64,
        /// The body that the point moves with.
        followed: Option<usize>,
    },
}
