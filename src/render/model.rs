//! Pictures of MuJoCo's models, by MuJoCo and OpenGL.
//!
//! The models that run the physics have no colours, no textures and no lights, which would make each simulation larger.
//! So pictures are of a model of their own: the same MJCF, with scenery. Only positions pass from one to the other; the
//! parameters (power, density, friction) cannot be seen.

use super::{Error, Size};
use crate::scene::{Look, PosedModel};
use perturb_mujoco::{self as mujoco, Camera, Kind};
use std::ptr;

const END_OF_MODEL: &str = "</mujoco>";
/// A model may rise or sink by so many m before the camera follows, so that a hop looks like one.
const FREE_RISE: f64 = 0.6;

/// The models that were drawn so far.
#[derive(Default)]
pub(super) struct Models {
    drawn: Vec<ShownModel>,
    /// That there is no library of OpenGL, once that is known: it does not come while the server runs. Anything else that
    /// it lacks, as descriptors, may.
    missing: Option<String>,
}

/// A model with its scenery.
struct ShownModel {
    look: &'static Look,
    renderer: mujoco::Renderer,
    followed: usize,
    /// The followed body's height at the initial positions, m.
    initial_height: f64,
}

impl Models {
    pub(super) fn draw(&mut self, model: &PosedModel, size: Size) -> Result<Vec<u8>, Error> {
        let environment = model.look.name;
        if let Some(reason) = &self.missing {
            return Err(Error::Missing { environment, reason: reason.clone() });
        }
        self.try_draw(model, size).map_err(|error| match error {
            mujoco::Error::NoOpenGl { is_installed, .. } => {
                let reason = error.to_string();
                self.missing = (!is_installed).then(|| reason.clone());
                Error::Missing { environment, reason }
            }
            _ => Error::Failed { environment, reason: error.to_string() },
        })
    }

    fn try_draw(&mut self, model: &PosedModel, size: Size) -> Result<Vec<u8>, mujoco::Error> {
        let index = match self.drawn.iter().position(|shown| ptr::eq(shown.look, model.look)) {
            Some(index) => index,
            None => {
                self.drawn.push(ShownModel::new(model.look, size)?);
                self.drawn.len() - 1
            }
        };
        self.drawn[index].draw(&model.qpos, size)
    }
}

impl ShownModel {
    fn new(look: &'static Look, size: Size) -> Result<Self, mujoco::Error> {
        let compile = |reason: String| mujoco::Error::Compile { reason };
        let (own, _) = look.mjcf.rsplit_once(END_OF_MODEL).ok_or_else(|| compile("the model has no end".into()))?;
        let model = mujoco::Model::from_xml(&format!("{own}{}{END_OF_MODEL}", look.scenery))?;
        let (followed, hidden) = (model.id(Kind::Body, look.followed)?, model.id(Kind::Geom, look.hidden)?);
        let colours = look.colours.iter().map(|(geom, rgb)| Ok((model.id(Kind::Geom, geom)?, rgb)));
        let colours = colours.collect::<Result<Vec<_>, mujoco::Error>>()?;
        let mut renderer = mujoco::Renderer::new(model, (size.width, size.height))?;
        let simulation = renderer.simulation();
        let initial_height = simulation.xpos(followed)[2];
        let rgba = simulation.geom_rgba_mut();
        for (geom, rgb) in colours {
            rgba[4 * geom..][..3].copy_from_slice(rgb);
        }
        rgba[4 * hidden + 3] = 0.0;
        Ok(Self { look, renderer, followed, initial_height })
    }

    fn draw(&mut self, qpos: &[f64], size: Size) -> Result<Vec<u8>, mujoco::Error> {
        let simulation = self.renderer.simulation();
        simulation.qpos_mut().copy_from_slice(qpos);
        simulation.kinematics()?;
        let [x, _, z] = simulation.xpos(self.followed);
        let rise = z - self.initial_height;
        let camera = Camera {
            look_at: [x, 0.0, self.look.camera_height + rise - rise.clamp(-FREE_RISE, FREE_RISE)],
            distance: self.look.camera_distance,
            azimuth: 90.0,
            elevation: -12.0,
        };
        self.renderer.draw(&camera, (size.width, size.height))
    }
}
