//! Draws pictures of MuJoCo models, by MuJoCo and OpenGL.
//!
//! The models that run the physics have no colours, textures and lights, which would make each simulation larger. So
//! pictures show a second model: the same MJCF with scenery added. The second model gets the positions of the physics.
//! If parameters edit lengths, the second model also gets the edited lengths. Other parameters (power, density,
//! friction) are not visible.

use super::{Error, Size};
use crate::scene::{Look, ModelView, PosedModel, Scenery};
use perturb_mujoco::{self as mujoco, Camera, ElementKind};
use std::ptr;

const END_OF_MODEL: &str = "</mujoco>";
/// Height in m by which a robot may rise or sink before the camera follows. So hops of the robot are visible.
const FREE_RISE: f64 = 0.6;

/// The models that were drawn so far, reused for later pictures.
#[derive(Default)]
pub(super) struct Models {
    drawn: Vec<ShownModel>,
    /// The error if the OpenGL library is not installed, which does not change while the server runs. Other failures,
    /// such as too few file descriptors, may be temporary and are not stored.
    missing: Option<String>,
}

/// A model with its scenery, ready to be drawn.
struct ShownModel {
    look: &'static Look,
    renderer: mujoco::ModelRenderer,
    /// The MJCF with edited lengths that the renderer now shows; `None` for the lengths of `look`.
    edited: Option<String>,
    /// The body that the camera follows, and its position in the model's initial pose, in m. `None` if the camera
    /// follows no body.
    followed: Option<(usize, [f64; 3])>,
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
        let shown = &mut self.drawn[index];
        if shown.edited != model.edited {
            let files = files(model.look);
            let edited = mujoco::Model::from_files(model.edited.as_deref().unwrap_or(model.look.mjcf), &files)?;
            shown.renderer.simulation().set_model(&edited)?;
            shown.edited.clone_from(&model.edited);
        }
        shown.draw(&model.qpos, size)
    }
}

/// Returns the names and contents of the files that a look's MJCF uses.
fn files(look: &Look) -> Vec<(&str, &[u8])> {
    look.files.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())).collect()
}

impl ShownModel {
    fn new(look: &'static Look, size: Size) -> Result<Self, mujoco::Error> {
        let compile = |reason: String| mujoco::Error::Compile { reason };
        let files = files(look);
        let (own, _) = look.mjcf.rsplit_once(END_OF_MODEL).ok_or_else(|| compile("the model has no end".into()))?;
        let scenery = look.scenery.map_or("", |scenery| scenery.mjcf);
        let model = mujoco::Model::from_files(&format!("{own}{scenery}{END_OF_MODEL}"), &files)?;
        let followed = match look.view {
            ModelView::Beside { followed, .. } => Some(model.id(ElementKind::Body, followed)?),
            ModelView::Placed { followed, .. } => followed,
            ModelView::Camera(_) => None,
        };
        let mut painted = Vec::new();
        if let Some(Scenery { hidden, colours, .. }) = look.scenery {
            for (geom, rgb) in colours {
                painted.push((model.id(ElementKind::Geom, geom)?, *rgb, 1.0));
            }
            painted.push((model.id(ElementKind::Geom, hidden)?, [0.0; 3], 0.0));
        }
        let mut renderer = mujoco::ModelRenderer::new(model, (size.width, size.height))?;
        let simulation = renderer.simulation();
        let followed = followed.map(|body| (body, simulation.xpos(body)));
        let rgba = simulation.geom_rgba_mut();
        for (geom, rgb, opacity) in painted {
            rgba[4 * geom..][..3].copy_from_slice(&rgb);
            rgba[4 * geom + 3] = opacity;
        }
        Ok(Self { look, renderer, edited: None, followed })
    }

    fn draw(&mut self, qpos: &[f64], size: Size) -> Result<Vec<u8>, mujoco::Error> {
        let simulation = self.renderer.simulation();
        simulation.qpos_mut().copy_from_slice(qpos);
        simulation.kinematics()?;
        let moved = self.followed.map(|(body, initial)| (simulation.xpos(body), initial));
        let view = match self.look.view {
            ModelView::Camera(number) => mujoco::CameraView::Fixed(number),
            ModelView::Beside { distance, height, .. } => {
                let ([x, _, z], [_, _, initial_z]) = moved.unwrap_or_default();
                let rise = z - initial_z;
                let look_at = [x, 0.0, height + rise - rise.clamp(-FREE_RISE, FREE_RISE)];
                mujoco::CameraView::Free(Camera { look_at, distance, azimuth: 90.0, elevation: -12.0 })
            }
            ModelView::Placed { look_at, distance, azimuth, elevation, .. } => {
                let (now, initial) = moved.unwrap_or_default();
                let look_at = std::array::from_fn(|i| look_at[i] + now[i] - initial[i]);
                mujoco::CameraView::Free(Camera { look_at, distance, azimuth, elevation })
            }
        };
        self.renderer.draw(view, (size.width, size.height))
    }
}
