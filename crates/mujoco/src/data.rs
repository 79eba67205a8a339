//! A model and the data that MuJoCo computes on it.

use crate::{Error, Model, Warning, model::last_error, sys};
use std::{ffi::c_int, ptr::NonNull, slice};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Status {
    Sound,
    /// Until the next reset.
    Diverged(Warning),
    /// A fatal error interrupted MuJoCo in the middle: until the data is replaced.
    Poisoned,
}

/// A simulation: a model of its own, editable, and its data.
///
/// After construction and after [`reset`](Self::reset) the state is the model's initial one, and nothing derived from
/// it (poses, contacts) is computed before [`step1`](Self::step1) or [`forward`](Self::forward).
#[derive(Debug)]
pub struct Simulation {
    model: Model,
    // Made by mj_makeData for `model`, owned, freed in drop. The model is never replaced by one of other sizes.
    data: NonNull<sys::mjData>,
    status: Status,
}

// SAFETY: mjData is plain memory without ties to a thread; `Simulation` owns it alone. The error handler of a call is
// that of the calling thread, and is removed before the call returns.
unsafe impl Send for Simulation {}
// SAFETY: through `&Simulation` nothing is written: the accessors read, and mj_objectVelocity takes all as const.
unsafe impl Sync for Simulation {}

impl Simulation {
    /// A simulation of `model`.
    ///
    /// # Errors
    /// [`Error::Fatal`] without memory.
    pub fn new(model: Model) -> Result<Self, Error> {
        let data = make_data(&model)?;
        Ok(Self { model, data, status: Status::Sound })
    }

    /// The model as edited.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Replaces the data by new ones, at the initial state: the way back after a fatal error.
    ///
    /// # Errors
    /// [`Error::Fatal`] without memory; the old data stay.
    pub fn renew(&mut self) -> Result<(), Error> {
        let data = make_data(&self.model)?;
        // SAFETY: the old data came from mj_makeData, are owned by `self`, and are not used after this.
        unsafe { sys::mj_deleteData(self.data.as_ptr()) };
        (self.data, self.status) = (data, Status::Sound);
        Ok(())
    }

    // ---- model edits

    /// Takes over all numbers of `model`, a copy or the origin of this simulation's.
    ///
    /// # Errors
    /// [`Error::ModelMismatch`] if its sizes differ, [`Error::Fatal`].
    pub fn assign_model(&mut self, model: &Model) -> Result<(), Error> {
        // SAFETY: two valid models, only read.
        if unsafe { sys::perturb_mj_same_sizes(self.model.as_ptr(), model.as_ptr()) } == 0 {
            return Err(Error::ModelMismatch);
        }
        // SAFETY: two valid models of equal sizes; `&mut self` excludes other users of the destination, and `model`
        // cannot be this simulation's own, which is borrowed mutably.
        let failed = unsafe { sys::perturb_mj_assign_model(self.model.as_ptr(), model.as_ptr()) };
        if failed == 0 { Ok(()) } else { Err(last_error()) }
    }

    /// Masses in kg, `[B]`. Follow an edit by [`set_const`](Self::set_const).
    pub fn body_mass_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.model.raw().body_mass, self.model.n_body());
        self.array_mut(start, length)
    }

    /// Principal moments of inertia in kg m², `[B, 3]`. Follow an edit by [`set_const`](Self::set_const).
    pub fn body_inertia_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.model.raw().body_inertia, 3 * self.model.n_body());
        self.array_mut(start, length)
    }

    /// Sliding, torsional and rolling friction, `[G, 3]`.
    pub fn geom_friction_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.model.raw().geom_friction, 3 * self.model.n_geom());
        self.array_mut(start, length)
    }

    /// Colours: red, green, blue and opacity in 0 … 1, `[G, 4]`.
    pub fn geom_rgba_mut(&mut self) -> &mut [f32] {
        let (start, length) = (self.model.raw().geom_rgba, 4 * self.model.n_geom());
        self.array_mut(start, length)
    }

    /// Recomputes what follows from the edited arrays. It overwrites the positions: reset afterwards.
    ///
    /// # Errors
    /// [`Error::Fatal`], [`Error::Poisoned`].
    pub fn set_const(&mut self) -> Result<(), Error> {
        if self.status == Status::Poisoned {
            return Err(Error::Poisoned);
        }
        // SAFETY: `data` belongs to `model` and is sound; `&mut self` excludes other users of both.
        let failed = unsafe { sys::perturb_mj_set_const(self.model.as_ptr(), self.data.as_ptr()) };
        self.poison_if(failed)
    }

    // ---- computation

    /// Sets the initial state and forgets everything else, divergence included.
    ///
    /// # Errors
    /// [`Error::Fatal`], [`Error::Poisoned`].
    pub fn reset(&mut self) -> Result<(), Error> {
        if self.status == Status::Poisoned {
            return Err(Error::Poisoned);
        }
        // SAFETY: as in `set_const`.
        let failed = unsafe { sys::perturb_mj_reset(self.model.as_ptr(), self.data.as_ptr()) };
        self.poison_if(failed)?;
        self.status = Status::Sound;
        Ok(())
    }

    /// Computes what depends on positions and velocities: poses, contacts, passive forces.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn step1(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_step1)
    }

    /// Applies the controls and advances positions, velocities and time by one timestep. Poses, contacts and all else
    /// that [`step1`](Self::step1) computes stay those before.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn step2(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_step2)
    }

    /// Computes everything at the current state, accelerations included, without advancing.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn forward(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_forward)?;
        // Unlike the steps, MuJoCo's forward looks at no number itself.
        let finite = |values: &[f64]| values.iter().all(|value| value.is_finite());
        let warning = if !finite(self.qpos()) {
            Warning::BadPosition
        } else if !finite(self.qvel()) {
            Warning::BadVelocity
        } else if !finite(self.qacc()) {
            Warning::BadAcceleration
        } else {
            return Ok(());
        };
        self.status = Status::Diverged(warning);
        Err(Error::Diverged { warning })
    }

    /// Computes the poses of bodies, geoms and lights at the current positions, and nothing else.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn kinematics(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_kinematics)
    }

    /// How often MuJoCo raised a warning since the last reset.
    pub fn warnings(&self, warning: Warning) -> usize {
        self.raw().warning[warning as usize].number as usize
    }

    fn run(&mut self, call: unsafe extern "C" fn(*const sys::mjModel, *mut sys::mjData) -> c_int) -> Result<(), Error> {
        match self.status {
            Status::Sound => {}
            Status::Diverged(warning) => return Err(Error::Diverged { warning }),
            Status::Poisoned => return Err(Error::Poisoned),
        }
        // SAFETY: `call` is one of the shim's; `data` belongs to `model` and is sound; `&mut self` excludes other users.
        let failed = unsafe { call(self.model.as_ptr(), self.data.as_ptr()) };
        self.poison_if(failed)?;
        // MuJoCo answers a bad number by resetting the state and counting a warning, nothing else.
        match Warning::ALL.into_iter().find(|&warning| self.warnings(warning) != 0) {
            None => Ok(()),
            Some(warning) => {
                self.status = Status::Diverged(warning);
                Err(Error::Diverged { warning })
            }
        }
    }

    fn poison_if(&mut self, failed: c_int) -> Result<(), Error> {
        if failed == 0 {
            return Ok(());
        }
        self.status = Status::Poisoned;
        Err(last_error())
    }

    // ---- state

    /// Simulated seconds.
    pub fn time(&self) -> f64 {
        self.raw().time
    }

    /// Sets the simulated seconds.
    pub fn set_time(&mut self, time: f64) {
        // SAFETY: `data` is valid for the lifetime of `self`, and `&mut self` excludes other users.
        unsafe { (*self.data.as_ptr()).time = time };
    }

    /// Positions, `[Q]`.
    pub fn qpos(&self) -> &[f64] {
        self.array(self.raw().qpos, self.model.n_q())
    }

    /// Positions, `[Q]`.
    pub fn qpos_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.raw().qpos, self.model.n_q());
        self.array_mut(start, length)
    }

    /// Velocities, `[V]`.
    pub fn qvel(&self) -> &[f64] {
        self.array(self.raw().qvel, self.model.n_v())
    }

    /// Velocities, `[V]`.
    pub fn qvel_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.raw().qvel, self.model.n_v());
        self.array_mut(start, length)
    }

    /// Accelerations of the last [`step2`](Self::step2) or [`forward`](Self::forward), `[V]`.
    pub fn qacc(&self) -> &[f64] {
        self.array(self.raw().qacc, self.model.n_v())
    }

    /// Where the constraint solver starts, `[V]`: part of the state.
    pub fn qacc_warmstart(&self) -> &[f64] {
        self.array(self.raw().qacc_warmstart, self.model.n_v())
    }

    /// Where the constraint solver starts, `[V]`.
    pub fn qacc_warmstart_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.raw().qacc_warmstart, self.model.n_v());
        self.array_mut(start, length)
    }

    /// The actuators' activations, `[n_act]`.
    pub fn act(&self) -> &[f64] {
        self.array(self.raw().act, self.model.n_act())
    }

    /// The actuators' activations, `[n_act]`.
    pub fn act_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.raw().act, self.model.n_act());
        self.array_mut(start, length)
    }

    /// Controls, `[U]`.
    pub fn ctrl(&self) -> &[f64] {
        self.array(self.raw().ctrl, self.model.n_u())
    }

    /// Controls, `[U]`.
    pub fn ctrl_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.raw().ctrl, self.model.n_u());
        self.array_mut(start, length)
    }

    // ---- what step1 computed

    /// The centre of mass of a body in m, world frame.
    ///
    /// # Panics
    /// If `body` is not below the number of bodies.
    pub fn xipos(&self, body: usize) -> [f64; 3] {
        let all = self.array(self.raw().xipos, 3 * self.model.n_body());
        [all[3 * body], all[3 * body + 1], all[3 * body + 2]]
    }

    /// The origin of a body's frame in m, world frame.
    ///
    /// # Panics
    /// If `body` is not below the number of bodies.
    pub fn xpos(&self, body: usize) -> [f64; 3] {
        let all = self.array(self.raw().xpos, 3 * self.model.n_body());
        [all[3 * body], all[3 * body + 1], all[3 * body + 2]]
    }

    /// The rotation matrix of a body's frame, row-major.
    ///
    /// # Panics
    /// If `body` is not below the number of bodies.
    pub fn xmat(&self, body: usize) -> &[f64] {
        &self.array(self.raw().xmat, 9 * self.model.n_body())[9 * body..9 * body + 9]
    }

    /// A body's velocity at its centre of mass, world frame: angular in rad/s, then linear in m/s.
    ///
    /// # Panics
    /// If `body` is not below the number of bodies.
    pub fn body_velocity(&self, body: usize) -> [f64; 6] {
        assert!(body < self.model.n_body(), "body {body} of {}", self.model.n_body());
        let mut velocity = [0.0; 6];
        // SAFETY: `data` belongs to `model`, both only read; the body exists; the result has the six numbers' room. The
        // only fatal error there is an unknown kind of object.
        unsafe {
            sys::mj_objectVelocity(
                self.model.as_ptr(),
                self.data.as_ptr(),
                sys::mjtObj__mjOBJ_BODY as c_int,
                body as c_int,
                velocity.as_mut_ptr(),
                0,
            );
        }
        velocity
    }

    /// The pairs of geoms that touch.
    pub fn contacts(&self) -> impl ExactSizeIterator<Item = (usize, usize)> {
        self.array(self.raw().contact, self.raw().ncon as usize)
            .iter()
            .map(|contact| (contact.geom1 as usize, contact.geom2 as usize))
    }

    pub(crate) fn as_ptr(&self) -> *mut sys::mjData {
        self.data.as_ptr()
    }

    fn raw(&self) -> &sys::mjData {
        // SAFETY: the pointer is valid for the lifetime of `self`, and is not written through a `&Simulation`.
        unsafe { self.data.as_ref() }
    }

    /// `start` must be a field of the data with `length` elements.
    fn array<T>(&self, start: *mut T, length: usize) -> &[T] {
        if length == 0 {
            return &[]; // the pointer may be null
        }
        // SAFETY: the caller passes a field of these data with the length that MuJoCo allocated it with (for contacts:
        // at most); it is initialised by mj_makeData, lives, and is not written as long as `self` is borrowed.
        unsafe { slice::from_raw_parts(start, length) }
    }

    /// `start` must be a field of the data or of the model with `length` elements.
    fn array_mut<T>(&mut self, start: *mut T, length: usize) -> &mut [T] {
        if length == 0 {
            return &mut []; // the pointer may be null
        }
        // SAFETY: as in `array`; `&mut self` excludes other users. The callers expose floating-point arrays only, any
        // value of which is memory-safe: MuJoCo indexes by none of them.
        unsafe { slice::from_raw_parts_mut(start, length) }
    }
}

impl Drop for Simulation {
    fn drop(&mut self) {
        // SAFETY: the data came from mj_makeData, are owned by `self`, and are freed once; also after a fatal error the
        // two buffers that this frees are as mj_makeData left them.
        unsafe { sys::mj_deleteData(self.data.as_ptr()) }
    }
}

fn make_data(model: &Model) -> Result<NonNull<sys::mjData>, Error> {
    // SAFETY: a valid model, only read; the result is new, or null.
    NonNull::new(unsafe { sys::perturb_mj_make_data(model.as_ptr()) }).ok_or_else(last_error)
}
