//! A model and the data that MuJoCo computes on it.

use crate::{Error, Field, Model, Reading, Warning, model::last_error, sys};
use std::{
    ffi::c_int,
    ptr::{self, NonNull},
    slice,
};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Status {
    Sound,
    /// MuJoCo refuses to compute until the next reset.
    Diverged(Warning),
    /// A fatal error interrupted MuJoCo in the middle. The data stay unusable.
    Poisoned,
}

/// A simulation: a model of its own, editable, and its data.
///
/// After construction and after [`reset`](Self::reset) the state is the model's initial one, after
/// [`set_state`](Self::set_state) the one that was given, and nothing derived from it (poses, contacts) is computed
/// before [`step1`](Self::step1), [`motion`](Self::motion) or [`forward`](Self::forward).
///
/// One simulation serves any number of states: what follows depends on [`state`](Self::state) and
/// [`constants`](Self::constants) alone, not on what was simulated before.
#[derive(Debug)]
pub struct Simulation {
    model: Model,
    // Made by mj_makeData for `model`, owned, freed in drop. The model is never replaced by one of other sizes.
    data: NonNull<sys::mjData>,
    /// The pairs of geoms that can touch, made for `model`, whose arrays they share; owned, freed in drop. `None` if the
    /// model needs the search for near geoms.
    pairs: Option<NonNull<sys::perturb_mj_pairs>>,
    status: Status,
}

// SAFETY: mjData and the pairs are plain memory without ties to a thread; `Simulation` owns them alone. The error handler
// of a call is that of the calling thread, and is removed before the call returns.
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
        // SAFETY: a valid model, only read; its memory stays where it is as long as `model` lives, which is as long as the
        // pairs do; the result is new, or null.
        let pairs = NonNull::new(unsafe { sys::perturb_mj_make_pairs(model.as_ptr()) });
        Ok(Self { model, data, pairs, status: Status::Sound })
    }

    /// The model as edited.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Replaces the model by a copy of another one of the same sizes, with its edits. What was computed is undefined then;
    /// the state is not.
    ///
    /// # Errors
    /// [`Error::Fatal`], [`Error::Poisoned`].
    ///
    /// # Panics
    /// If a size differs.
    pub fn set_model(&mut self, source: &Model) -> Result<(), Error> {
        assert!(self.model.has_sizes_of(source), "the model has other sizes");
        if self.status == Status::Poisoned {
            return Err(Error::Poisoned);
        }
        // SAFETY: two valid models of the same sizes, of which `&mut self` lends the one that is written to nobody else. Its
        // arrays stay where they are, so that the pairs' addresses remain valid.
        let failed = unsafe { sys::perturb_mj_set_model(self.model.as_ptr(), source.as_ptr()) };
        self.poison_if(failed)
    }

    // ---- model edits

    /// Writes the constants that the edits below change, with everything that follows from them: [`Model::n_constants`]
    /// numbers.
    pub fn constants(&self, out: &mut [f64]) {
        assert_eq!(out.len(), self.model.n_constants(), "the constants of another model");
        let mut rest = out;
        for (start, length) in self.model.constants() {
            let part = rest.split_off_mut(..length).unwrap_or_default();
            part.copy_from_slice(self.array(start, length));
        }
    }

    /// Restores what [`constants`](Self::constants) wrote, for this or another simulation of the same model.
    pub fn set_constants(&mut self, constants: &[f64]) {
        assert_eq!(constants.len(), self.model.n_constants(), "the constants of another model");
        let mut rest = constants;
        for (start, length) in self.model.constants() {
            self.array_mut(start, length).copy_from_slice(rest.split_off(..length).unwrap_or_default());
        }
    }

    /// Copies fields of the model, one after the other: [`Model::n_fields`] numbers.
    pub fn fields(&self, fields: &[Field], out: &mut [f64]) {
        assert_eq!(out.len(), self.model.n_fields(fields), "the fields of another model");
        let mut rest = out;
        for field in fields {
            let values = self.model.field(*field);
            rest.split_off_mut(..values.len()).unwrap_or_default().copy_from_slice(values);
        }
    }

    /// Restores what [`fields`](Self::fields) wrote, for this or another simulation of the same model.
    pub fn set_fields(&mut self, fields: &[Field], values: &[f64]) {
        assert_eq!(values.len(), self.model.n_fields(fields), "the fields of another model");
        let mut rest = values;
        for field in fields {
            let own = self.field_mut(*field);
            own.copy_from_slice(rest.split_off(..own.len()).unwrap_or_default());
        }
    }

    /// Returns a field of the model for editing. Follow edits of masses, inertias, armatures and gears by
    /// [`set_const`](Self::set_const).
    pub fn field_mut(&mut self, field: Field) -> &mut [f64] {
        let (start, length) = self.model.place(field);
        self.array_mut(start, length)
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

    /// Recomputes what follows from the edited arrays. It overwrites the positions: reset or set the state afterwards.
    /// It also overwrites [`Field::Statistic`], which a model may have given by an element of its own.
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

    /// Applies the controls and advances positions, velocities and time by one timestep. Poses, contacts and everything
    /// else that [`step1`](Self::step1) computes keep their earlier values.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn step2(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_step2)
    }

    /// Advances by one timestep: [`step1`](Self::step1), then [`step2`](Self::step2). So contacts are those before the
    /// timestep.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn step(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_step)
    }

    /// Does what [`step`](Self::step) does, to the same bytes, but faster if only the world's geoms can touch others.
    /// MuJoCo then need not search for geoms that are near each other, for which it compares the bounding boxes of all
    /// pairs.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn step_without_search(&mut self) -> Result<(), Error> {
        let Some(pairs) = self.pairs else { return self.step() };
        // SAFETY: the pairs are those of this model, which `&mut self` lends to nobody else.
        self.run_with(|model, data| unsafe { sys::perturb_mj_step_pairs(model, pairs.as_ptr(), data) })
    }

    /// Tells whether [`step_without_search`](Self::step_without_search) omits the search.
    pub fn has_pairs(&self) -> bool {
        self.pairs.is_some()
    }

    /// Checks positions and velocities, and computes the poses and the velocities of bodies. This is a part of
    /// [`step1`](Self::step1): contacts and forces are not computed, and keep their earlier values.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn motion(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_motion)
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

    /// Computes the external forces on bodies, which neither [`step`](Self::step) nor [`forward`](Self::forward) does
    /// unless a sensor needs them: [`Reading::BodyExternalForces`].
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn external_forces(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_rne_post_constraint)
    }

    /// Sets the external forces on bodies to 0, as after [`reset`](Self::reset).
    pub fn clear_external_forces(&mut self) {
        let (start, length) = Reading::BodyExternalForces.place(self.raw(), self.model.raw());
        self.array_mut(start, length).fill(0.0);
    }

    /// Tells whether a fatal error made the simulation unusable.
    pub fn is_poisoned(&self) -> bool {
        self.status == Status::Poisoned
    }

    /// Returns the number of times that MuJoCo raised a warning since the last reset.
    pub fn warnings(&self, warning: Warning) -> usize {
        self.raw().warning[warning as usize].number as usize
    }

    fn run(&mut self, call: unsafe extern "C" fn(*const sys::mjModel, *mut sys::mjData) -> c_int) -> Result<(), Error> {
        // SAFETY: `call` is one of the shim's, which want what `run_with` gives.
        self.run_with(|model, data| unsafe { call(model, data) })
    }

    /// Calls the shim with the model and data that belong to it and are sound; `&mut self` excludes other users.
    fn run_with(&mut self, call: impl FnOnce(*const sys::mjModel, *mut sys::mjData) -> c_int) -> Result<(), Error> {
        match self.status {
            Status::Sound => {}
            Status::Diverged(warning) => return Err(Error::Diverged { warning }),
            Status::Poisoned => return Err(Error::Poisoned),
        }
        let failed = call(self.model.as_ptr(), self.data.as_ptr());
        self.poison_if(failed)?;
        // MuJoCo reports a bad number only by resetting the state and counting a warning.
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

    /// Writes the complete state, [`Model::n_state`] numbers: time in s, positions `[Q]`, velocities `[V]`, activations
    /// `[n_act]`, the constraint solver's starting point `[V]`, controls `[U]`. All later results depend on the state and
    /// the model alone.
    pub fn state(&self, out: &mut [f64]) {
        assert_eq!(out.len(), self.model.n_state(), "the state of another model");
        out[0] = self.time();
        let mut rest = &mut out[1..];
        for (start, length) in self.state_arrays() {
            let part = rest.split_off_mut(..length).unwrap_or_default();
            part.copy_from_slice(self.array(start, length));
        }
    }

    /// Restores what [`state`](Self::state) wrote, for this or another simulation of the same model. Forgets everything
    /// else, divergence included.
    ///
    /// # Errors
    /// [`Error::Fatal`], [`Error::Poisoned`].
    pub fn set_state(&mut self, state: &[f64]) -> Result<(), Error> {
        assert_eq!(state.len(), self.model.n_state(), "the state of another model");
        if self.status != Status::Sound {
            self.reset()?; // a sound simulation has no warnings to be forgotten, and its steps overwrite all else
        }
        // SAFETY: `data` is valid for the lifetime of `self`, and `&mut self` excludes other users.
        unsafe { (*self.data.as_ptr()).time = state[0] };
        let mut rest = &state[1..];
        for (start, length) in self.state_arrays() {
            self.array_mut(start, length).copy_from_slice(rest.split_off(..length).unwrap_or_default());
        }
        Ok(())
    }

    /// The state's arrays in the data, with their lengths.
    fn state_arrays(&self) -> [(*mut f64, usize); 5] {
        let (data, model) = (self.raw(), &self.model);
        [
            (data.qpos, model.n_q()),
            (data.qvel, model.n_v()),
            (data.act, model.n_act()),
            (data.qacc_warmstart, model.n_v()),
            (data.ctrl, model.n_u()),
        ]
    }

    /// Simulated seconds.
    pub fn time(&self) -> f64 {
        self.raw().time
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

    /// Controls, `[U]`.
    pub fn ctrl(&self) -> &[f64] {
        self.array(self.raw().ctrl, self.model.n_u())
    }

    /// Controls, `[U]`.
    pub fn ctrl_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.raw().ctrl, self.model.n_u());
        self.array_mut(start, length)
    }

    /// Sets the force on the centre of mass of a body in N, in the world's frame, until it is set again. It is no part of
    /// the [state](Self::state).
    pub fn set_force(&mut self, body: usize, force: [f64; 3]) {
        let (start, length) = (self.raw().xfrc_applied, 6 * self.model.n_body());
        self.array_mut(start, length)[6 * body..][..3].copy_from_slice(&force);
    }

    // ---- what step1 computed

    /// An array that MuJoCo computed.
    pub fn reading(&self, reading: Reading) -> &[f64] {
        let (start, length) = reading.place(self.raw(), self.model.raw());
        self.array(start, length)
    }

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
        // two buffers that this frees are as mj_makeData left them. So do the pairs, of which MuJoCo keeps nothing.
        unsafe {
            sys::mj_deleteData(self.data.as_ptr());
            sys::perturb_mj_free_pairs(self.pairs.map_or(ptr::null_mut(), NonNull::as_ptr));
        }
    }
}

fn make_data(model: &Model) -> Result<NonNull<sys::mjData>, Error> {
    // SAFETY: a valid model, only read; the result is new, or null.
    NonNull::new(unsafe { sys::perturb_mj_make_data(model.as_ptr()) }).ok_or_else(last_error)
}
