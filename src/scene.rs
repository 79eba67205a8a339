//! The content of an environment's picture, as data. Environments make it, and renderers draw it without knowing the
//! environment.

/// The coordinates [x, y] of a point, m; y points upwards. An infinite coordinate means the edge of the picture.
pub type ScenePoint = [f64; 2];

/// A colour: red, green, blue, each 0 … 255.
pub type Colour = [u8; 3];

/// Colours that colour-blind people can distinguish (Okabe and Ito, 2008), and greys.
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
    /// A drawing of shapes in a plane.
    Drawing(Drawing),
    /// A picture of a MuJoCo model.
    #[cfg(feature = "mujoco")]
    Model(PosedModel),
}

/// A drawing of shapes in a plane. Coordinates may be very large.
#[derive(Debug, Clone)]
pub struct Drawing {
    /// The lower left corner of the rectangle that must be visible.
    pub low: ScenePoint,
    /// The upper right corner of the rectangle that must be visible.
    pub high: ScenePoint,
    /// The shapes, from back to front.
    pub shapes: Vec<Shape>,
}

/// A shape, drawn in a single colour.
#[derive(Debug, Clone)]
pub enum Shape {
    /// A filled polygon.
    Polygon {
        /// The corners in order.
        corners: Vec<ScenePoint>,
        /// The colour of the inside.
        colour: Colour,
    },
    /// A filled disc.
    Disc {
        /// The centre.
        centre: ScenePoint,
        /// The radius, m.
        radius: f64,
        /// The colour of the inside.
        colour: Colour,
    },
    /// A line through points, with round ends.
    Line {
        /// The points in order.
        points: Vec<ScenePoint>,
        /// The width, m.
        width: f64,
        /// The colour of the line.
        colour: Colour,
    },
    /// A dashed line through points.
    Dashes {
        /// The points in order.
        points: Vec<ScenePoint>,
        /// The width of the dashes, m.
        width: f64,
        /// The colour of the dashes.
        colour: Colour,
    },
    /// The graph of a function, as a line.
    Graph {
        /// The function.
        graph: Graph,
        /// The width, m.
        width: f64,
        /// The colour of the line.
        colour: Colour,
    },
    /// The area below the graph of a function.
    Ground {
        /// The function, whose graph is the upper edge of the area.
        graph: Graph,
        /// The colour of the area.
        colour: Colour,
    },
}

/// A function of x, and the range of x that is drawn.
#[derive(Debug, Clone, Copy)]
pub struct Graph {
    /// Returns the height at x, m; x is in m, too.
    pub height: fn(f64) -> f64,
    /// The minimum of x, m.
    pub from: f64,
    /// The maximum of x, m; may be infinite.
    pub to: f64,
}

impl Drawing {
    /// Makes an empty drawing. At least the rectangle from `low` to `high` will be visible.
    pub fn new(low: ScenePoint, high: ScenePoint) -> Self {
        Self { low, high, shapes: Vec::new() }
    }

    /// Adds a filled polygon.
    pub fn polygon(&mut self, corners: &[ScenePoint], colour: Colour) {
        self.shapes.push(Shape::Polygon { corners: corners.to_vec(), colour });
    }

    /// Adds a filled rectangle, given its lower left and upper right corners.
    pub fn rectangle(&mut self, [x0, y0]: ScenePoint, [x1, y1]: ScenePoint, colour: Colour) {
        self.polygon(&[[x0, y0], [x1, y0], [x1, y1], [x0, y1]], colour);
    }

    /// Adds a filled disc. `radius` is in m.
    pub fn disc(&mut self, centre: ScenePoint, radius: f64, colour: Colour) {
        self.shapes.push(Shape::Disc { centre, radius, colour });
    }

    /// Adds a line through `points`, with round ends. `width` is in m.
    pub fn line(&mut self, points: &[ScenePoint], width: f64, colour: Colour) {
        self.shapes.push(Shape::Line { points: points.to_vec(), width, colour });
    }

    /// Adds a dashed line through `points`. `width` is in m.
    pub fn dashes(&mut self, points: &[ScenePoint], width: f64, colour: Colour) {
        self.shapes.push(Shape::Dashes { points: points.to_vec(), width, colour });
    }

    /// Adds the graph of a function as a line. `width` is in m.
    pub fn graph(&mut self, graph: Graph, width: f64, colour: Colour) {
        self.shapes.push(Shape::Graph { graph, width, colour });
    }

    /// Adds the filled area below the graph of a function.
    pub fn ground(&mut self, graph: Graph, colour: Colour) {
        self.shapes.push(Shape::Ground { graph, colour });
    }

    /// Adds a rod, a thick line with a bright outline that makes it stand out from the background.
    pub fn rod(&mut self, from: ScenePoint, to: ScenePoint, width: f64, colour: Colour) {
        self.line(&[from, to], 1.25 * width, colour::BACKGROUND);
        self.line(&[from, to], width, colour);
    }

    /// Adds a joint: a dark disc with a bright centre.
    pub fn joint(&mut self, at: ScenePoint, radius: f64) {
        self.disc(at, radius, colour::DARK);
        self.disc(at, 0.45 * radius, colour::BACKGROUND);
    }
}

/// Returns the point at `distance` m from `from`, in the direction `angle`, rad, measured from the x axis.
#[expect(clippy::disallowed_methods, reason = "a picture need not be the same everywhere")]
pub fn polar(from: ScenePoint, distance: f64, angle: f64) -> ScenePoint {
    let (sin, cos) = angle.sin_cos();
    [from[0] + distance * cos, from[1] + distance * sin]
}

/// A MuJoCo model in a certain pose.
#[cfg(feature = "mujoco")]
#[derive(Debug, Clone)]
pub struct PosedModel {
    /// The model and how it is drawn; the same for all pictures of the environment.
    pub look: &'static Look,
    /// The edited MJCF; `None` if the episode's lengths are those of the original model.
    pub edited: Option<String>,
    /// The generalised positions, `[Q]`.
    pub qpos: Vec<f64>,
}

/// A MuJoCo model with everything that is needed to draw it.
#[cfg(feature = "mujoco")]
#[derive(Debug, Clone, Copy)]
pub struct Look {
    /// The environment's name.
    pub name: &'static str,
    /// The model's MJCF text.
    pub mjcf: &'static str,
    /// The files that the MJCF refers to: name and content of each.
    pub files: &'static [(String, Vec<u8>)],
    /// Ground, light and colours that are added for pictures; `None` if the model has its own.
    pub scenery: Option<Scenery>,
    /// The camera from which the model is drawn.
    pub view: ModelView,
}

/// Ground, light and colours that are added for pictures to a MuJoCo model without them.
#[cfg(feature = "mujoco")]
#[derive(Debug, Clone, Copy)]
pub struct Scenery {
    /// MJCF elements that are added after the model's own: ground, light, sky.
    pub mjcf: &'static str,
    /// The name of the geom that the added ground replaces.
    pub hidden: &'static str,
    /// The names of geoms, each with its colour: red, green, blue, each 0 … 1.
    pub colours: &'static [(&'static str, [f32; 3])],
}

/// The camera from which a MuJoCo model is drawn.
#[cfg(feature = "mujoco")]
#[derive(Debug, Clone, Copy)]
pub enum ModelView {
    /// A camera that follows a robot along x and looks at it from the side.
    Beside {
        /// The name of the body that the camera follows.
        followed: &'static str,
        /// The distance of the camera from the body, m.
        distance: f64,
        /// The height that the camera looks at, m.
        height: f64,
    },
    /// The camera with this index among the model's own cameras.
    Camera(usize),
    /// A camera that looks at a point.
    Placed {
        /// The point that the camera looks at, m.
        look_at: [f64; 3],
        /// The distance of the camera from this point, m.
        distance: f64,
        /// The horizontal direction of view, as an angle from the x axis, counter-clockwise seen from above, degrees.
        azimuth: f64,
        /// The vertical direction of view, as an angle above the horizon; negative if the camera looks down, degrees.
        elevation: f64,
        /// The index of the body with which the point moves; `None` for a fixed point.
        followed: Option<usize>,
    },
}
