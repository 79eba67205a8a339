//! Draws pictures of a model into memory.

use crate::{ElementKind, Error, Model, Simulation, gl::Gl, model::last_error, sys};
use std::{
    ffi::c_int,
    mem::{self, MaybeUninit},
    sync::{Mutex, MutexGuard, PoisonError},
};

/// Minimal number of visual geoms that a scene has space for. A picture needs one visual geom for each geom of the
/// model, and more for decorations.
const MIN_SCENE_GEOMS: usize = 200;
/// Maximal number of visual geoms that a scene has space for.
const MAX_SCENE_GEOMS: usize = 20_000;

/// The position and direction of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// The point in the middle of the picture, in m, world frame.
    pub look_at: [f64; 3],
    /// The distance from the camera to `look_at`, in m.
    pub distance: f64,
    /// The horizontal direction of view in degrees: 0 is along +x, 90 along +y.
    pub azimuth: f64,
    /// The angle of the direction of view above the horizontal plane, in degrees. Negative if the camera looks down.
    pub elevation: f64,
}

/// The camera of a picture: a camera of the model, or a free camera at any position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CameraView {
    /// A camera with this position and direction.
    Free(Camera),
    /// The model's camera with this index.
    Fixed(usize),
}

/// Draws pictures of one model into memory. It can only be used in the thread that created it, because it has an OpenGL
/// context.
pub struct ModelRenderer {
    gl: Gl,
    simulation: Simulation,
    option: Box<sys::mjvOption>,
    /// The geoms to draw. Comes from mjv_makeScene for the model; `drop` frees it.
    scene: Box<sys::mjvScene>,
    /// MuJoCo's drawing context. Comes from mjr_makeContext for the model, with `gl` current; `drop` frees it. Before
    /// that it is an empty default context.
    context: Box<sys::mjrContext>,
    /// Width and height of the context's picture buffer, in pixels. (0, 0) while `context` is an empty default.
    size: (u16, u16),
}

/// A thread holds this mutex while it uses OpenGL through MuJoCo. MuJoCo stores the addresses of OpenGL's functions in
/// global variables, and writes them whenever it creates a context.
static DRAWING: Mutex<()> = Mutex::new(());

fn exclusive() -> MutexGuard<'static, ()> {
    DRAWING.lock().unwrap_or_else(PoisonError::into_inner) // a poisoned mutex is harmless: it guards no data
}

impl ModelRenderer {
    /// Creates a renderer of `model` in its initial pose. `size` is the expected width and height of the pictures in
    /// pixels. Larger pictures are possible, but the first larger picture takes longer.
    ///
    /// # Errors
    /// [`Error::NoOpenGl`] without a usable OpenGL, [`Error::Fatal`] if OpenGL lacks a feature that MuJoCo needs.
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
        // From here on `drop` frees scene and context. It may also free them while they are empty defaults.
        let mut renderer = Self { gl, simulation, option, scene, context, size: (0, 0) };
        // SAFETY: the model is valid, and the scene is an empty default.
        check(unsafe {
            sys::perturb_mjv_make_scene(
                renderer.simulation.model().as_ptr(),
                &raw mut *renderer.scene,
                scene_geoms(renderer.simulation.model()),
            )
        })?;
        renderer.replace_context(size)?;
        Ok(renderer)
    }

    /// The simulation that is drawn. Edit it to change the model or its pose, and call [`Simulation::kinematics`]
    /// before drawing.
    pub fn simulation(&mut self) -> &mut Simulation {
        &mut self.simulation
    }

    /// Draws a picture of this width and height in pixels, with the poses that the simulation last computed. Returns
    /// its pixels, `[height, width, 3]`: red, green and blue in 0 … 255, top row first.
    ///
    /// # Errors
    /// [`Error::Fatal`]. The renderer must not be used afterwards.
    pub fn draw(&mut self, view: CameraView, (width, height): (u16, u16)) -> Result<Vec<u8>, Error> {
        let (most_wide, most_high) = self.size;
        if width > most_wide || height > most_high {
            self.replace_context((width.max(most_wide), height.max(most_high)))?;
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
                if number >= self.simulation.model().count(ElementKind::Camera) {
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
        // SAFETY: model, data and scene belong together and are valid. `&mut self` excludes other users of them.
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
        // SAFETY: the context was made in `gl`, which is current. `pixels` has the size of the picture, and the
        // context's buffer is at least as large.
        check(unsafe {
            sys::perturb_mjr_draw(
                &raw mut *self.scene,
                &raw const *self.context,
                width.into(),
                height.into(),
                pixels.as_mut_ptr(),
            )
        })?;
        // OpenGL's first row is the lowest, so the order of rows is reversed.
        let (upper, lower) = pixels.split_at_mut(row * usize::from(height / 2));
        for (a, b) in upper.chunks_exact_mut(row).zip(lower.rchunks_exact_mut(row)) {
            a.swap_with_slice(b);
        }
        Ok(pixels)
    }

    /// Replaces the drawing context by one whose picture buffer has this width and height in pixels.
    fn replace_context(&mut self, size: (u16, u16)) -> Result<(), Error> {
        let _drawing = self.enter()?;
        // SAFETY: `gl` is current. The context is an empty default or was made in `gl`, and freeing makes it an empty
        // default again. Making a context writes the buffer's size into the model, of which `&mut self` excludes other
        // users.
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

    /// Makes the OpenGL context current. The returned guard keeps other threads from using MuJoCo's OpenGL functions.
    fn enter(&self) -> Result<MutexGuard<'static, ()>, Error> {
        let guard = exclusive();
        match self.gl.make_current() {
            Ok(()) => Ok(guard),
            Err(_) => Err(Error::Fatal { message: "eglMakeCurrent failed".into() }),
        }
    }
}

impl Drop for ModelRenderer {
    fn drop(&mut self) {
        let drawing = self.enter();
        // SAFETY: the context was made in `gl`, which is current, and the scene was made for the model. Both are freed
        // once. If the context is incomplete or `gl` cannot be made current, the driver frees the context when `gl` is
        // dropped.
        unsafe {
            if drawing.is_ok() && self.size != (0, 0) {
                sys::perturb_mjr_free_context(&raw mut *self.context);
            }
            sys::mjv_freeScene(&raw mut *self.scene);
        }
    }
}

/// Returns the number of visual geoms for which a scene needs space: two for each geom and site, and some for the
/// decorations of each joint, actuator and tendon.
fn scene_geoms(model: &Model) -> c_int {
    let count = |kind| model.count(kind);
    let decorations = 4 * (count(ElementKind::Joint) + count(ElementKind::Actuator)) + 50 * count(ElementKind::Tendon);
    let all = 2 * (count(ElementKind::Geom) + count(ElementKind::Site)) + decorations;
    all.clamp(MIN_SCENE_GEOMS, MAX_SCENE_GEOMS) as c_int
}

fn check(failed: c_int) -> Result<(), Error> {
    if failed == 0 { Ok(()) } else { Err(last_error()) }
}
