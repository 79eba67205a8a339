//! Hopper's and HalfCheetah's pictures, by MuJoCo and OpenGL.
//!
//! The models that run the physics have no colours, no textures and no lights, which would make each environment larger.
//! So pictures are of a model of their own: the same MJCF, with scenery. Only positions pass from one to the other; the
//! parameters (power, density, friction) cannot be seen.

use super::{Error, Size};
use perturb_mujoco::{self as mujoco, Camera, Kind, Model};

/// Follows the robot's own elements in its MJCF. The floor of the physics ends 40 m from the start, as a picture; the
/// ground here does not. The line is where the task is done.
const SCENERY: &str = include_str!("../../models/scenery.xml");
const END_OF_MODEL: &str = "</mujoco>";

/// How one robot is shown.
struct Look {
    name: &'static str,
    /// The camera's distance, m.
    distance: f64,
    /// The height that the camera looks at, m.
    height: f64,
    /// Geoms and their colours: red, green, blue.
    colours: &'static [(&'static str, [f32; 3])],
}

const GREY: [f32; 3] = [0.36, 0.40, 0.44];
const BLUE: [f32; 3] = [0.0, 0.447, 0.698];
const SKY_BLUE: [f32; 3] = [0.337, 0.706, 0.914];
const ORANGE: [f32; 3] = [0.902, 0.624, 0.0];
const VERMILLION: [f32; 3] = [0.835, 0.369, 0.0];

const LOOKS: [Look; 2] = [
    Look {
        name: "Hopper",
        distance: 3.0,
        height: 0.75,
        colours: &[("torso", BLUE), ("thigh", SKY_BLUE), ("leg", ORANGE), ("foot", VERMILLION)],
    },
    Look {
        name: "HalfCheetah",
        distance: 3.0,
        height: 0.55,
        colours: &[
            ("torso", GREY),
            ("head", GREY),
            ("bthigh", BLUE),
            ("bshin", BLUE),
            ("bfoot", SKY_BLUE),
            ("fthigh", VERMILLION),
            ("fshin", VERMILLION),
            ("ffoot", ORANGE),
        ],
    },
];

/// The robot may rise or sink by so many m before the camera follows, so that a hop looks like one.
const FREE_RISE: f64 = 0.6;

/// The robots that were drawn so far.
#[derive(Default)]
pub(super) struct Robots {
    drawn: Vec<Robot>,
    /// That there is no OpenGL, once that is known: it does not come while the server runs.
    missing: Option<String>,
}

struct Robot {
    look: &'static Look,
    renderer: mujoco::Renderer,
    torso: usize,
    /// The torso's height at the initial positions, m.
    initial_height: f64,
}

impl Robots {
    /// The robot of that name and model, at these positions, `[Q]`.
    pub(super) fn draw(&mut self, name: &'static str, mjcf: &str, qpos: &[f64], size: Size) -> Result<Vec<u8>, Error> {
        if let Some(reason) = &self.missing {
            return Err(Error::Missing { environment: name, reason: reason.clone() });
        }
        self.try_draw(name, mjcf, qpos, size).map_err(|error| match error {
            mujoco::Error::NoOpenGl { .. } => {
                let reason = self.missing.insert(error.to_string()).clone();
                Error::Missing { environment: name, reason }
            }
            _ => Error::Failed { environment: name, reason: error.to_string() },
        })
    }

    fn try_draw(&mut self, name: &str, mjcf: &str, qpos: &[f64], size: Size) -> Result<Vec<u8>, mujoco::Error> {
        let index = match self.drawn.iter().position(|robot| robot.look.name == name) {
            Some(index) => index,
            None => {
                self.drawn.push(Robot::new(name, mjcf, size)?);
                self.drawn.len() - 1
            }
        };
        self.drawn[index].draw(qpos, size)
    }
}

impl Robot {
    fn new(name: &str, mjcf: &str, size: Size) -> Result<Self, mujoco::Error> {
        let compile = |reason: String| mujoco::Error::Compile { reason };
        let look = LOOKS.iter().find(|look| look.name == name);
        let look = look.ok_or_else(|| compile(format!("nothing says how to show {name}")))?;
        let (robot, _) = mjcf.rsplit_once(END_OF_MODEL).ok_or_else(|| compile("the model has no end".into()))?;
        let model = Model::from_xml(&format!("{robot}{SCENERY}{END_OF_MODEL}"))?;
        let (torso, floor) = (model.id(Kind::Body, "torso")?, model.id(Kind::Geom, "floor")?);
        let colours = look.colours.iter().map(|(geom, rgb)| Ok((model.id(Kind::Geom, geom)?, rgb)));
        let colours = colours.collect::<Result<Vec<_>, mujoco::Error>>()?;
        let mut renderer = mujoco::Renderer::new(model, (size.width, size.height))?;
        let simulation = renderer.simulation();
        let initial_height = simulation.xpos(torso)[2];
        let rgba = simulation.geom_rgba_mut();
        for (geom, rgb) in colours {
            rgba[4 * geom..][..3].copy_from_slice(rgb);
        }
        rgba[4 * floor + 3] = 0.0; // the scenery's ground is in its place
        Ok(Self { look, renderer, torso, initial_height })
    }

    fn draw(&mut self, qpos: &[f64], size: Size) -> Result<Vec<u8>, mujoco::Error> {
        let simulation = self.renderer.simulation();
        simulation.qpos_mut().copy_from_slice(qpos);
        simulation.kinematics()?;
        let [x, _, z] = simulation.xpos(self.torso);
        let rise = z - self.initial_height;
        let camera = Camera {
            look_at: [x, 0.0, self.look.height + rise - rise.clamp(-FREE_RISE, FREE_RISE)],
            distance: self.look.distance,
            azimuth: 90.0,
            elevation: -12.0,
        };
        self.renderer.draw(&camera, (size.width, size.height))
    }
}
