//! Simulations: a model and the data that MuJoCo computes for it.

use crate::{DataField, Error, Model, ModelField, Warning, model::last_error, sys};
use std::{
    ffi::c_int,
    ptr::{self, NonNull},
    slice,
};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum SimulationStatus {
    Sound,
    /// MuJoCo raised this warning. Calls that compute are refused until the next reset.
    Diverged(Warning),
    /// A fatal error interrupted a computation. The simulation can never be used again.
    Poisoned,
}

/// A physics simulation: a model, which may be edited, and its current state with all quantities computed from it.
///
/// A new simulation is in the model's initial state, as after [`reset`](Self::reset). [`new`](Self::new),
/// [`reset`](Self::reset) and [`set_state`](Self::set_state) do not compute the quantities that follow from the state,
/// such as poses and contacts. Call [`step1`](Self::step1), [`motion`](Self::motion) or [`forward`](Self::forward)
/// before reading such quantities.
///
/// One simulation can serve several environments in turn, each with its own [`state`](Self::state) and
/// [`constants`](Self::constants). Results depend only on state and constants, not on earlier computations.
#[derive(Debug)]
pub struct Simulation {
    model: Model,
    // Comes from mj_makeData for `model`. `self` owns it, and `drop` frees it. The model is never replaced by one of
    // other sizes.
    data: NonNull<sys::mjData>,
    /// The pairs of geoms that can touch, for [`Simulation::step_without_search`]. They point to arrays of `model`.
    /// `self` owns them, and `drop` frees them. `None` if the model needs MuJoCo's search for nearby geoms.
    pairs: Option<NonNull<sys::perturb_mj_pairs>>,
    status: SimulationStatus,
}

// SAFETY: mjData and the pairs are plain memory without ties to a thread, and only `Simulation` owns them. A call uses
// the error handler of the calling thread, and removes it before it returns.
unsafe impl Send for Simulation {}
// SAFETY: nothing is written through `&Simulation`. Its methods only read, and mj_objectVelocity takes const pointers.
unsafe impl Sync for Simulation {}

impl Simulation {
    /// Creates a simulation of `model` in its initial state.
    ///
    /// # Errors
    /// [`Error::Fatal`] if there is not enough memory.
    pub fn new(model: Model) -> Result<Self, Error> {
        let data = make_data(&model)?;
        // SAFETY: the model is valid, and the function only reads it. The pairs point into the model's memory, which
        // does not move and lives as long as the pairs. The function returns new memory or null.
        let pairs = NonNull::new(unsafe { sys::perturb_mj_make_pairs(model.as_ptr()) });
        Ok(Self { model, data, pairs, status: SimulationStatus::Sound })
    }

    /// The model, including edits such as those by [`field_mut`](Self::field_mut).
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Replaces the model, with its edits, by a copy of `source`, which must have the same sizes. Keeps the state. All
    /// computed quantities are undefined until they are computed again.
    ///
    /// # Errors
    /// [`Error::Fatal`], [`Error::Poisoned`].
    ///
    /// # Panics
    /// If a size differs, see [`Model::has_sizes_of`].
    pub fn set_model(&mut self, source: &Model) -> Result<(), Error> {
        assert!(self.model.has_sizes_of(source), "the model has other sizes");
        if self.status == SimulationStatus::Poisoned {
            return Err(Error::Poisoned);
        }
        // SAFETY: both models are valid and have the same sizes. `&mut self` excludes other users of the model that is
        // written. Its arrays do not move, so the pairs' pointers into them remain valid.
        let failed = unsafe { sys::perturb_mj_set_model(self.model.as_ptr(), source.as_ptr()) };
        self.poison_if(failed)
    }

    // ---- model edits

    /// Copies to `out` the model's masses, inertias and friction coefficients, and all arrays that [`set_const`]
    /// derives from them: [`Model::n_constants`] numbers.
    ///
    /// [`set_const`]: Self::set_const
    pub fn constants(&self, out: &mut [f64]) {
        assert_eq!(out.len(), self.model.n_constants(), "the constants of another model");
        let mut rest = out;
        for (start, length) in self.model.constants() {
            let part = rest.split_off_mut(..length).unwrap_or_default();
            part.copy_from_slice(self.array(start, length));
        }
    }

    /// Restores the arrays that [`constants`](Self::constants) copied from this or another simulation of the same
    /// model.
    pub fn set_constants(&mut self, constants: &[f64]) {
        assert_eq!(constants.len(), self.model.n_constants(), "the constants of another model");
        let mut rest = constants;
        for (start, length) in self.model.constants() {
            self.array_mut(start, length).copy_from_slice(rest.split_off(..length).unwrap_or_default());
        }
    }

    /// Copies the values of `fields` to `out`, one field after the other: [`Model::n_fields`] numbers.
    pub fn fields(&self, fields: &[ModelField], out: &mut [f64]) {
        assert_eq!(out.len(), self.model.n_fields(fields), "the fields of another model");
        let mut rest = out;
        for field in fields {
            let values = self.model.field(*field);
            rest.split_off_mut(..values.len()).unwrap_or_default().copy_from_slice(values);
        }
    }

    /// Restores the values that [`fields`](Self::fields) copied from this or another simulation of the same model.
    pub fn set_fields(&mut self, fields: &[ModelField], values: &[f64]) {
        assert_eq!(values.len(), self.model.n_fields(fields), "the fields of another model");
        let mut rest = values;
        for field in fields {
            let own = self.field_mut(*field);
            own.copy_from_slice(rest.split_off(..own.len()).unwrap_or_default());
        }
    }

    /// The values of a field of the model, for editing. Call [`set_const`](Self::set_const) after editing masses,
    /// inertias, armatures or gears.
    pub fn field_mut(&mut self, field: ModelField) -> &mut [f64] {
        let (start, length) = self.model.pointer_and_length(field);
        self.array_mut(start, length)
    }

    /// The masses of the bodies in kg, `[n_body]`. After editing them call [`set_const`](Self::set_const).
    pub fn body_mass_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.model.raw().body_mass, self.model.n_body());
        self.array_mut(start, length)
    }

    /// The principal moments of inertia of the bodies in kg m², `[n_body, 3]`. After editing them call
    /// [`set_const`](Self::set_const).
    pub fn body_inertia_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.model.raw().body_inertia, 3 * self.model.n_body());
        self.array_mut(start, length)
    }

    /// The sliding, torsional and rolling friction coefficients of the geoms, `[n_geom, 3]`, for editing.
    pub fn geom_friction_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.model.raw().geom_friction, 3 * self.model.n_geom());
        self.array_mut(start, length)
    }

    /// The colours of the geoms, for editing: red, green, blue and opacity in 0 … 1, `[n_geom, 4]`.
    pub fn geom_rgba_mut(&mut self) -> &mut [f32] {
        let (start, length) = (self.model.raw().geom_rgba, 4 * self.model.n_geom());
        self.array_mut(start, length)
    }

    /// Recomputes the arrays of the model that follow from edited arrays, such as the masses of subtrees. Overwrites
    /// the positions, so reset or set the state afterwards. Also overwrites [`ModelField::Statistic`], even if the MJCF
    /// text sets it explicitly.
    ///
    /// # Errors
    /// [`Error::Fatal`], [`Error::Poisoned`].
    pub fn set_const(&mut self) -> Result<(), Error> {
        if self.status == SimulationStatus::Poisoned {
            return Err(Error::Poisoned);
        }
        // SAFETY: `data` belongs to `model`, and no fatal error has damaged it. `&mut self` excludes other users of
        // both.
        let failed = unsafe { sys::perturb_mj_set_const(self.model.as_ptr(), self.data.as_ptr()) };
        self.poison_if(failed)
    }

    // ---- computation

    /// Sets the model's initial state. Clears all else, including warnings and applied forces, so that a diverged
    /// simulation can be used again.
    ///
    /// # Errors
    /// [`Error::Fatal`], [`Error::Poisoned`].
    pub fn reset(&mut self) -> Result<(), Error> {
        if self.status == SimulationStatus::Poisoned {
            return Err(Error::Poisoned);
        }
        // SAFETY: `data` belongs to `model`, and no fatal error has damaged it. `&mut self` excludes other users of
        // both.
        let failed = unsafe { sys::perturb_mj_reset(self.model.as_ptr(), self.data.as_ptr()) };
        self.poison_if(failed)?;
        self.status = SimulationStatus::Sound;
        Ok(())
    }

    /// Computes all quantities that depend on positions and velocities, such as poses, contacts and passive forces.
    /// This is the first half of a timestep, before the controls are applied.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn step1(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_step1)
    }

    /// Applies the controls, and advances positions, velocities and time by one timestep. Call [`step1`](Self::step1)
    /// first. Quantities that `step1` computed, such as poses and contacts, are not updated to the new state.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn step2(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_step2)
    }

    /// Advances by one timestep: [`step1`](Self::step1), then [`step2`](Self::step2). Afterwards the poses and contacts
    /// still belong to the state before the timestep.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn step(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_step)
    }

    /// Advances by one timestep with the same bytes as [`step`](Self::step). It is faster if every possible contact is
    /// between a geom of the world and a geom of another body. It then checks these pairs of geoms directly, without
    /// MuJoCo's search for nearby geoms, which compares the bounding boxes of all pairs.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn step_without_search(&mut self) -> Result<(), Error> {
        let Some(pairs) = self.pairs else { return self.step() };
        // SAFETY: the pairs belong to this model, and `&mut self` excludes other users.
        self.run_with(|model, data| unsafe { sys::perturb_mj_step_pairs(model, pairs.as_ptr(), data) })
    }

    /// Whether [`step_without_search`](Self::step_without_search) is faster than [`step`](Self::step) for this model.
    pub fn has_pairs(&self) -> bool {
        self.pairs.is_some()
    }

    /// Checks that positions and velocities are finite, and computes the poses and velocities of the bodies. This is a
    /// part of [`step1`](Self::step1). Contacts and forces keep their earlier values.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn motion(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_motion)
    }

    /// Computes all quantities of the current state, including accelerations, without advancing the time.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn forward(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_forward)?;
        // mj_forward does not check that its numbers are finite; only MuJoCo's steps do.
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
        self.status = SimulationStatus::Diverged(warning);
        Err(Error::Diverged { warning })
    }

    /// Computes only the poses of bodies, geoms, cameras and lights at the current positions.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn kinematics(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_kinematics)
    }

    /// Computes [`DataField::BodyExternalForces`]. [`step`](Self::step) and [`forward`](Self::forward) compute them
    /// only if a sensor of the model needs them.
    ///
    /// # Errors
    /// [`Error::Diverged`], [`Error::Fatal`], [`Error::Poisoned`].
    pub fn external_forces(&mut self) -> Result<(), Error> {
        self.run(sys::perturb_mj_rne_post_constraint)
    }

    /// Sets [`DataField::BodyExternalForces`] to 0, its value after [`reset`](Self::reset).
    pub fn clear_external_forces(&mut self) {
        let (start, length) = DataField::BodyExternalForces.pointer_and_length(self.raw(), self.model.raw());
        self.array_mut(start, length).fill(0.0);
    }

    /// Whether a fatal error made the simulation unusable.
    pub fn is_poisoned(&self) -> bool {
        self.status == SimulationStatus::Poisoned
    }

    /// The number of times that MuJoCo raised `warning` since the last reset.
    pub fn warnings(&self, warning: Warning) -> usize {
        self.raw().warning[warning as usize].number as usize
    }

    fn run(&mut self, call: unsafe extern "C" fn(*const sys::mjModel, *mut sys::mjData) -> c_int) -> Result<(), Error> {
        // SAFETY: `call` is a function of shim.c. It requires a model and its data, and `run_with` passes both.
        self.run_with(|model, data| unsafe { call(model, data) })
    }

    /// Calls a function of `shim.c` with the model and its data, and returns the function's error or MuJoCo's warning.
    /// Returns an error without a call if the simulation has diverged or is poisoned. `&mut self` excludes other users
    /// of model and data.
    fn run_with(&mut self, call: impl FnOnce(*const sys::mjModel, *mut sys::mjData) -> c_int) -> Result<(), Error> {
        match self.status {
            SimulationStatus::Sound => {}
            SimulationStatus::Diverged(warning) => return Err(Error::Diverged { warning }),
            SimulationStatus::Poisoned => return Err(Error::Poisoned),
        }
        let failed = call(self.model.as_ptr(), self.data.as_ptr());
        self.poison_if(failed)?;
        // If a number is not finite or too large, MuJoCo returns no error. It resets the state and counts a warning.
        match Warning::ALL.into_iter().find(|&warning| self.warnings(warning) != 0) {
            None => Ok(()),
            Some(warning) => {
                self.status = SimulationStatus::Diverged(warning);
                Err(Error::Diverged { warning })
            }
        }
    }

    fn poison_if(&mut self, failed: c_int) -> Result<(), Error> {
        if failed == 0 {
            return Ok(());
        }
        self.status = SimulationStatus::Poisoned;
        Err(last_error())
    }

    // ---- state

    /// Copies the complete state to `out`, [`Model::n_state`] numbers: time in s, positions `[n_q]`, velocities
    /// `[n_v]`, activations `[n_act]`, the constraint solver's starting point `[n_v]`, controls `[n_u]`. All later
    /// results depend only on this state and the model.
    pub fn state(&self, out: &mut [f64]) {
        assert_eq!(out.len(), self.model.n_state(), "the state of another model");
        out[0] = self.time();
        let mut rest = &mut out[1..];
        for (start, length) in self.state_arrays() {
            let part = rest.split_off_mut(..length).unwrap_or_default();
            part.copy_from_slice(self.array(start, length));
        }
    }

    /// Restores a state that [`state`](Self::state) copied from this or another simulation of the same model. A
    /// diverged simulation is reset first, and can be used again.
    ///
    /// # Errors
    /// [`Error::Fatal`], [`Error::Poisoned`].
    pub fn set_state(&mut self, state: &[f64]) -> Result<(), Error> {
        assert_eq!(state.len(), self.model.n_state(), "the state of another model");
        if self.status != SimulationStatus::Sound {
            self.reset()?; // a sound simulation has no warnings to clear, and its steps overwrite all else
        }
        // SAFETY: `data` is valid for the lifetime of `self`, and `&mut self` excludes other users.
        unsafe { (*self.data.as_ptr()).time = state[0] };
        let mut rest = &state[1..];
        for (start, length) in self.state_arrays() {
            self.array_mut(start, length).copy_from_slice(rest.split_off(..length).unwrap_or_default());
        }
        Ok(())
    }

    /// Pointers to the arrays that make up the state, and their lengths.
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

    /// The simulated time since the initial state, in s.
    pub fn time(&self) -> f64 {
        self.raw().time
    }

    /// The generalised positions, `[n_q]`, in m and rad. Orientations of free and ball joints are unit quaternions.
    pub fn qpos(&self) -> &[f64] {
        self.array(self.raw().qpos, self.model.n_q())
    }

    /// The generalised positions, `[n_q]`, for editing.
    pub fn qpos_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.raw().qpos, self.model.n_q());
        self.array_mut(start, length)
    }

    /// The generalised velocities, `[n_v]`, in m/s and rad/s.
    pub fn qvel(&self) -> &[f64] {
        self.array(self.raw().qvel, self.model.n_v())
    }

    /// The generalised velocities, `[n_v]`, for editing.
    pub fn qvel_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.raw().qvel, self.model.n_v());
        self.array_mut(start, length)
    }

    /// The generalised accelerations, `[n_v]`, in m/s² and rad/s², of the last [`step2`](Self::step2) or
    /// [`forward`](Self::forward).
    pub fn qacc(&self) -> &[f64] {
        self.array(self.raw().qacc, self.model.n_v())
    }

    /// The controls of the actuators, `[n_u]`.
    pub fn ctrl(&self) -> &[f64] {
        self.array(self.raw().ctrl, self.model.n_u())
    }

    /// The controls of the actuators, `[n_u]`, for editing.
    pub fn ctrl_mut(&mut self) -> &mut [f64] {
        let (start, length) = (self.raw().ctrl, self.model.n_u());
        self.array_mut(start, length)
    }

    /// Sets an external force on a body's centre of mass, in N, world frame. It acts until it is set again or the
    /// simulation is reset. It is not part of the [state](Self::state).
    ///
    /// # Panics
    /// If `body` is not below the number of bodies.
    pub fn set_force(&mut self, body: usize, force: [f64; 3]) {
        let (start, length) = (self.raw().xfrc_applied, 6 * self.model.n_body());
        self.array_mut(start, length)[6 * body..][..3].copy_from_slice(&force);
    }

    // ---- quantities that step1 computes

    /// The values of an array that MuJoCo computed.
    pub fn reading(&self, reading: DataField) -> &[f64] {
        let (start, length) = reading.pointer_and_length(self.raw(), self.model.raw());
        self.array(start, length)
    }

    /// The position of a body's centre of mass in m, world frame.
    ///
    /// # Panics
    /// If `body` is not below the number of bodies.
    pub fn xipos(&self, body: usize) -> [f64; 3] {
        let all = self.array(self.raw().xipos, 3 * self.model.n_body());
        [all[3 * body], all[3 * body + 1], all[3 * body + 2]]
    }

    /// The position of the origin of a body's frame in m, world frame.
    ///
    /// # Panics
    /// If `body` is not below the number of bodies.
    pub fn xpos(&self, body: usize) -> [f64; 3] {
        let all = self.array(self.raw().xpos, 3 * self.model.n_body());
        [all[3 * body], all[3 * body + 1], all[3 * body + 2]]
    }

    /// The rotation matrix from a body's frame to the world frame, `[3, 3]`, row-major.
    ///
    /// # Panics
    /// If `body` is not below the number of bodies.
    pub fn xmat(&self, body: usize) -> &[f64] {
        &self.array(self.raw().xmat, 9 * self.model.n_body())[9 * body..9 * body + 9]
    }

    /// The velocity of a body at its centre of mass, world frame: angular velocity `[3]` in rad/s, then linear velocity
    /// `[3]` in m/s.
    ///
    /// # Panics
    /// If `body` is not below the number of bodies.
    pub fn body_velocity(&self, body: usize) -> [f64; 6] {
        assert!(body < self.model.n_body(), "body {body} of {}", self.model.n_body());
        let mut velocity = [0.0; 6];
        // SAFETY: `data` belongs to `model`, and the function only reads both. The body exists, and the result has
        // space for six numbers. The only fatal error of this function is an unknown kind of object, and a body is a
        // known kind.
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

    /// The indices of the two geoms of each contact.
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

    /// Returns an array of the data or of the model as a slice. `start` must point to the array's first element, and
    /// the array must have `length` elements.
    fn array<T>(&self, start: *mut T, length: usize) -> &[T] {
        if length == 0 {
            return &[]; // the pointer may be null
        }
        // SAFETY: the caller passes an array of the data or of the model, with at most the length that MuJoCo
        // allocated. mj_makeData or mj_loadXML initialised the array. It lives and is not changed as long as `self` is
        // borrowed.
        unsafe { slice::from_raw_parts(start, length) }
    }

    /// Returns an array of the data or of the model as a slice for editing. `start` must point to the array's first
    /// element, and the array must have `length` elements.
    fn array_mut<T>(&mut self, start: *mut T, length: usize) -> &mut [T] {
        if length == 0 {
            return &mut []; // the pointer may be null
        }
        // SAFETY: the array is valid for the reasons given in `array`, and `&mut self` excludes other users. The
        // callers expose only floating-point arrays. Users may write any value into these arrays, because MuJoCo uses
        // none of the values as an index.
        unsafe { slice::from_raw_parts_mut(start, length) }
    }
}

impl Drop for Simulation {
    fn drop(&mut self) {
        // SAFETY: the data came from mj_makeData, `self` owns them, and they are freed once. mj_deleteData frees two
        // buffers, whose addresses do not change even in a fatal error. `self` also owns the pairs, and MuJoCo keeps no
        // pointer to them.
        unsafe {
            sys::mj_deleteData(self.data.as_ptr());
            sys::perturb_mj_free_pairs(self.pairs.map_or(ptr::null_mut(), NonNull::as_ptr));
        }
    }
}

fn make_data(model: &Model) -> Result<NonNull<sys::mjData>, Error> {
    // SAFETY: the model is valid, and the function only reads it. It returns new data or null.
    NonNull::new(unsafe { sys::perturb_mj_make_data(model.as_ptr()) }).ok_or_else(last_error)
}
