//! Pictures of a model.

use crate::{Error, Kind, Model, Simulation, gl::Gl, model::last_error, sys};
use std::{
    ffi::c_int,
    mem::{self, MaybeUninit},
    sync::{Mutex, MutexGuard, PoisonError},
};

/// Minimal number of geoms that a scene has space for. A model needs one for each of its geoms, and some for decorations.
const MIN_SCENE_GEOMS: usize = 200;
/// Maximal number of geoms that a scene has space for.
const MAX_SCENE_GEOMS: usize = 20_000;

/// The position and direction of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// The point in the middle of the picture, m, world frame.
    pub look_at: [f64; 3],
    /// The camera's distance from that point, m.
    pub distance: f64,
    /// The direction of view, turned from +x about +z, degrees.
    pub azimuth: f64,
    /// The direction's slope, negative if it looks down, degrees.
    pub elevation: f64,
}

/// A camera of the model, or one that is placed for a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CameraView {
    /// A placed camera.
    Free(Camera),
    /// The model's camera of this number.
    Fixed(usize),
}

/// Draws one model into memory. It belongs to its thread, as its OpenGL context does.
pub struct Renderer {
    gl: Gl,
    simulation: Simulation,
    option: Box<sys::mjvOption>,
    /// Made by mjv_makeScene for the model, freed in drop.
    scene: Box<sys::mjvScene>,
    /// Made by mjr_makeContext for the model in `gl`, freed in drop; a default one before.
    context: Box<sys::mjrContext>,
    /// The size of the context's buffer, pixels; (0, 0) while there is no context to be freed.
    size: (u16, u16),
}

/// MuJoCo keeps the addresses of OpenGL's functions in global variables, which each context writes anew.
static DRAWING: Mutex<()> = Mutex::new(());

fn exclusive() -> MutexGuard<'static, ()> {
    DRAWING.lock().unwrap_or_else(PoisonError::into_inner) // it guards nothing that a panic could leave half-written
}

impl Renderer {
    /// Prepares for drawing `model`, at its initial positions, in pictures of about this size in pixels.
    ///
    /// # Errors
    /// [`Error::NoOpenGl`], and [`Error::Fatal`] if OpenGL cannot do what MuJoCo needs.
    pub fn new(model: Model, size: (u16, u16)) -> Result<Self, Error> {
        let gl = Gl::new()?;
        let mut option = Box::new(MaybeUninit::zeroed());
        let mut scene = Box::new(MaybeUninit::zeroed());
        let mut context = Box::new(MaybeUninit::zeroed());
        // SAFETY: the three structs are plain data for which zeros are valid, and the functions set their defaults.
        let (option, scene, context) = unsafe {
            sys::mjv_defaultOption(option.as_mut_ptr());
            sys::mjv_defaultScene(scene.as_mut_ptr());
            sys::mjr_defaultContext(context.as_mut_ptr());
            (option.assume_init(), scene.assume_init(), context.assume_init())
        };
        let mut simulation = Simulation::new(model)?;
        simulation.kinematics()?;
        // From here on `drop` frees what was made; the defaults may be freed too.
        let mut renderer = Self { gl, simulation, option, scene, context, size: (0, 0) };
        // SAFETY: a valid model and a default scene.
        check(unsafe {
            sys::perturb_mjv_make_scene(
                renderer.simulation.model().as_ptr(),
                &raw mut *renderer.scene,
                scene_geoms(renderer.simulation.model()),
            )
        })?;
        renderer.make_room(size)?;
        Ok(renderer)
    }

    /// Returns the simulation that is drawn. Edit it to change the model or its positions.
    pub fn simulation(&mut self) -> &mut Simulation {
        &mut self.simulation
    }

    /// A picture of the model at the poses that were computed last: `[height, width, 3]`, red, green, blue, the
    /// uppermost row first. After an error draw with another renderer.
    ///
    /// # Errors
    /// [`Error::Fatal`].
    pub fn draw(&mut self, view: CameraView, (width, height): (u16, u16)) -> Result<Vec<u8>, Error> {
        let (most_wide, most_high) = self.size;
        if width > most_wide || height > most_high {
            self.make_room((width.max(most_wide), height.max(most_high)))?;
        }
        let mut camera = match view {
            CameraView::Free(Camera { look_at, distance, azimuth, elevation }) => sys::mjvCamera {
                type_: sys::mjtCamera__mjCAMERA_FREE as c_int,
                fixedcamid: -1,
                trackbodyid: -1,
                lookat: look_at,
                distance,
                azimuth,
                elevation,
            },
            CameraView::Fixed(number) => {
                if number >= self.simulation.model().count(Kind::Camera) {
                    return Err(Error::Fatal { message: format!("the model has no camera number {number}") });
                }
                sys::mjvCamera {
                    type_: sys::mjtCamera__mjCAMERA_FIXED as c_int,
                    fixedcamid: number as c_int,
                    trackbodyid: -1,
                    lookat: [0.0; 3],
                    distance: 1.0,
                    azimuth: 0.0,
                    elevation: 0.0,
                }
            }
        };
        // SAFETY: model, data and scene belong together and are valid; `&mut self` excludes other users.
        check(unsafe {
            sys::perturb_mjv_update_scene(
                self.simulation.model().as_ptr(),
                self.simulation.as_ptr(),
                &raw const *self.option,
                &raw mut camera,
                &raw mut *self.scene,
            )
        })?;
        let row = 3 * usize::from(width);
        let mut pixels = vec![0; row * usize::from(height)];
        let _drawing = self.enter()?;
        // SAFETY: the context was made in `gl`, which is current; the picture has room for its pixels, and the buffer
        // at least its size.
        check(unsafe {
            sys::perturb_mjr_draw(
                &raw mut *self.scene,
                &raw const *self.context,
                width.into(),
                height.into(),
                pixels.as_mut_ptr(),
            )
        })?;
        // OpenGL counts rows from below.
        let (upper, lower) = pixels.split_at_mut(row * usize::from(height / 2));
        for (a, b) in upper.chunks_exact_mut(row).zip(lower.rchunks_exact_mut(row)) {
            a.swap_with_slice(b);
        }
        Ok(pixels)
    }

    /// Replaces the context by one with a buffer of this size.
    fn make_room(&mut self, size: (u16, u16)) -> Result<(), Error> {
        let _drawing = self.enter()?;
        // SAFETY: `gl` is current; the context is a default one or was made in it, and is a default one again after it
        // was freed. Making one writes the size into the model, of which `&mut self` excludes other users.
        unsafe {
            if mem::take(&mut self.size) != (0, 0) {
                check(sys::perturb_mjr_free_context(&raw mut *self.context))?;
            }
            let model = self.simulation.model().as_ptr();
            check(sys::perturb_mjr_make_context(model, &raw mut *self.context, size.0.into(), size.1.into()))?;
        }
        self.size = size;
        Ok(())
    }

    /// Makes the OpenGL context current and keeps other threads out.
    fn enter(&self) -> Result<MutexGuard<'static, ()>, Error> {
        let guard = exclusive();
        match self.gl.make_current() {
            Ok(()) => Ok(guard),
            Err(_) => Err(Error::Fatal { message: "eglMakeCurrent failed".into() }),
        }
    }
}

impl Drop for Renderer {
    fn drop(&mut self) {
        let drawing = self.enter();
        // SAFETY: the context was made in `gl`, which is current, the scene for the model; both are freed once. A context
        // that was made by half, or cannot be made current, is left to the end of `gl`.
        unsafe {
            if drawing.is_ok() && self.size != (0, 0) {
                sys::perturb_mjr_free_context(&raw mut *self.context);
            }
            sys::mjv_freeScene(&raw mut *self.scene);
        }
    }
}

/// Number of geoms that a scene has space for: one for each geom and site, and some for each joint, actuator and tendon.
fn scene_geoms(model: &Model) -> c_int {
    let count = |kind| model.count(kind);
    let decorations = 4 * (count(Kind::Joint) + count(Kind::Actuator)) + 50 * count(Kind::Tendon);
    let all = 2 * (count(Kind::Geom) + count(Kind::Site)) + decorations;
    all.clamp(MIN_SCENE_GEOMS, MAX_SCENE_GEOMS) as c_int
}

fn check(failed: c_int) -> Result<(), Error> {
    if failed == 0 { Ok(()) } else { Err(last_error()) }
}
