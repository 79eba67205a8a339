//! A compiled model.

use crate::{Error, sys};
use std::{
    ffi::{CStr, CString, c_char, c_int},
    ptr::{self, NonNull},
    slice,
    sync::{Mutex, OnceLock, PoisonError},
};

/// A kind of named model element.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A body; number 0 is the world.
    Body,
    /// A joint.
    Joint,
    /// A geom.
    Geom,
    /// An actuator.
    Actuator,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Body => "body",
            Self::Joint => "joint",
            Self::Geom => "geom",
            Self::Actuator => "actuator",
        }
    }

    fn object(self) -> sys::mjtObj {
        match self {
            Self::Body => sys::mjtObj__mjOBJ_BODY,
            Self::Joint => sys::mjtObj__mjOBJ_JOINT,
            Self::Geom => sys::mjtObj__mjOBJ_GEOM,
            Self::Actuator => sys::mjtObj__mjOBJ_ACTUATOR,
        }
    }
}

/// A compiled model, immutable. A [`Simulation`](crate::Simulation) owns and edits one.
#[derive(Debug)]
pub struct Model {
    // Made by mj_loadXML or mj_copyModel, owned, freed in drop. Its sizes and index arrays never change.
    pointer: NonNull<sys::mjModel>,
}

// SAFETY: mjModel is plain memory without ties to a thread, and `Model` owns it alone.
unsafe impl Send for Model {}
// SAFETY: through `&Model` nothing is written: the accessors read, and mj_copyModel and mj_name2id take it as const.
unsafe impl Sync for Model {}

/// A floating-point array of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct FloatArray {
    /// MuJoCo's name of the field, e.g. `body_mass`.
    pub name: &'static str,
    /// Its elements, row-major; single precision is widened.
    pub values: Vec<f64>,
}

impl Model {
    /// Compiles MJCF text. Takes about half a millisecond; one at a time in the process.
    ///
    /// The text is trusted: MJCF can include other files.
    ///
    /// # Errors
    /// [`Error::Version`], and [`Error::Compile`] with MuJoCo's reason.
    pub fn from_xml(xml: &str) -> Result<Self, Error> {
        static LOADING: Mutex<()> = Mutex::new(());
        check_library()?;
        let size = c_int::try_from(xml.len())
            .map_err(|_| Error::Compile { reason: "the text is longer than 2 GB".to_owned() })?;
        let mut message = [0u8; 1024];
        // The mutex guards no data that a panic could leave half-written.
        let _loading = LOADING.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: `xml` and `message` are valid for the given sizes during the call, and `xml` is only read. The mutex
        // keeps other threads out of MuJoCo's compiler, and only this function calls it.
        let pointer = unsafe {
            sys::perturb_mj_load(
                xml.as_ptr().cast::<c_char>(),
                size,
                message.as_mut_ptr().cast::<c_char>(),
                message.len() as c_int,
            )
        };
        NonNull::new(pointer)
            .map(|pointer| Self { pointer })
            .ok_or_else(|| Error::Compile { reason: text_of(&message) })
    }

    /// A copy that shares nothing with this model.
    ///
    /// # Errors
    /// [`Error::Fatal`] without memory.
    pub fn try_clone(&self) -> Result<Self, Error> {
        // SAFETY: the pointer is a valid model for the lifetime of `self`; the result is a new one, or null.
        let pointer = unsafe { sys::perturb_mj_copy_model(self.pointer.as_ptr()) };
        NonNull::new(pointer).map(|pointer| Self { pointer }).ok_or_else(last_error)
    }

    /// The number of the element of that kind and name.
    ///
    /// # Errors
    /// [`Error::UnknownName`].
    pub fn id(&self, kind: Kind, name: &str) -> Result<usize, Error> {
        let unknown = || Error::UnknownName { kind: kind.name(), name: name.to_owned() };
        let c_name = CString::new(name).map_err(|_| unknown())?;
        // SAFETY: a valid model and a terminated string, both only read.
        let id = unsafe { sys::mj_name2id(self.pointer.as_ptr(), kind.object() as c_int, c_name.as_ptr()) };
        usize::try_from(id).map_err(|_| unknown())
    }

    /// The number of generalised coordinates, Q.
    pub fn n_q(&self) -> usize {
        self.raw().nq as usize
    }

    /// The number of degrees of freedom, V.
    pub fn n_v(&self) -> usize {
        self.raw().nv as usize
    }

    /// The number of controls, U.
    pub fn n_u(&self) -> usize {
        self.raw().nu as usize
    }

    /// The number of activations.
    pub fn n_act(&self) -> usize {
        self.raw().na as usize
    }

    /// The number of bodies, B, the world included.
    pub fn n_body(&self) -> usize {
        self.raw().nbody as usize
    }

    /// The number of joints, J.
    pub fn n_joint(&self) -> usize {
        self.raw().njnt as usize
    }

    /// The number of geoms, G.
    pub fn n_geom(&self) -> usize {
        self.raw().ngeom as usize
    }

    /// The length of a [state](crate::Simulation::state).
    pub fn n_state(&self) -> usize {
        1 + self.n_q() + 2 * self.n_v() + self.n_act() + self.n_u()
    }

    /// The length of [constants](crate::Simulation::constants).
    pub fn n_constants(&self) -> usize {
        self.constants().into_iter().map(|(_, length)| length).sum()
    }

    /// The timestep in seconds.
    pub fn timestep(&self) -> f64 {
        self.raw().opt.timestep
    }

    /// Masses in kg, `[B]`.
    pub fn body_mass(&self) -> &[f64] {
        self.array(self.raw().body_mass, self.n_body())
    }

    /// Principal moments of inertia in kg m², `[B, 3]`.
    pub fn body_inertia(&self) -> &[f64] {
        self.array(self.raw().body_inertia, 3 * self.n_body())
    }

    /// Sliding, torsional and rolling friction, `[G, 3]`.
    pub fn geom_friction(&self) -> &[f64] {
        self.array(self.raw().geom_friction, 3 * self.n_geom())
    }

    /// Where each joint's coordinates begin in `qpos`, `[J]`.
    pub fn joint_qpos_address(&self) -> impl ExactSizeIterator<Item = usize> {
        self.array(self.raw().jnt_qposadr, self.n_joint()).iter().map(|&id| id as usize)
    }

    /// Where each joint's velocities begin in `qvel`, `[J]`.
    pub fn joint_dof_address(&self) -> impl ExactSizeIterator<Item = usize> {
        self.array(self.raw().jnt_dofadr, self.n_joint()).iter().map(|&id| id as usize)
    }

    /// Each joint's limits in rad or m, `[J]`.
    pub fn joint_range(&self) -> impl ExactSizeIterator<Item = (f64, f64)> {
        self.array(self.raw().jnt_range, 2 * self.n_joint()).chunks_exact(2).map(|range| (range[0], range[1]))
    }

    /// Every floating-point array, and the statistics as `stat`; for comparing models.
    pub fn float_arrays(&self) -> Vec<FloatArray> {
        let mut arrays = Vec::new();
        for index in 0.. {
            let (mut name, mut elements, mut count, mut size) = (ptr::null(), ptr::null(), 0, 0);
            // SAFETY: a valid model; the four outputs are written whenever the result is not zero.
            let more = unsafe {
                sys::perturb_mj_array(
                    self.pointer.as_ptr(),
                    index,
                    &raw mut name,
                    &raw mut elements,
                    &raw mut count,
                    &raw mut size,
                )
            };
            if more == 0 {
                break;
            }
            let count = count as usize;
            let values = match size {
                8 => self.array(elements.cast::<f64>().cast_mut(), count).to_vec(),
                4 => self.array(elements.cast::<f32>().cast_mut(), count).iter().map(|&x| f64::from(x)).collect(),
                _ => continue,
            };
            // SAFETY: the name is a string literal of the shim.
            let name = unsafe { CStr::from_ptr::<'static>(name) }.to_str().unwrap_or_default();
            arrays.push(FloatArray { name, values });
        }
        arrays
    }

    /// The floating-point arrays that edits of masses, inertias and friction change, or mj_setConst from them, with
    /// their lengths.
    pub(crate) fn constants(&self) -> [(*mut f64, usize); 9] {
        let (m, bodies, dofs) = (self.raw(), self.n_body(), self.n_v());
        // SAFETY: the pointer is a valid model for the lifetime of `self`; only an address is taken. The statistics are
        // plain numbers of one type.
        let stat = unsafe { &raw mut (*self.pointer.as_ptr()).stat }.cast::<f64>();
        [
            (m.body_mass, bodies),
            (m.body_inertia, 3 * bodies),
            (m.geom_friction, 3 * self.n_geom()),
            (m.body_subtreemass, bodies),
            (m.body_invweight0, 2 * bodies),
            (m.dof_invweight0, dofs),
            (m.dof_M0, dofs),
            (m.actuator_acc0, self.n_u()),
            (stat, size_of::<sys::mjStatistic>() / size_of::<f64>()),
        ]
    }

    pub(crate) fn raw(&self) -> &sys::mjModel {
        // SAFETY: the pointer is a valid model for the lifetime of `self`, and is not written through a `&Model`.
        unsafe { self.pointer.as_ref() }
    }

    pub(crate) fn as_ptr(&self) -> *mut sys::mjModel {
        self.pointer.as_ptr()
    }

    /// `start` must be a field of this model with `length` elements.
    fn array<T>(&self, start: *mut T, length: usize) -> &[T] {
        if length == 0 {
            return &[]; // the pointer may be null
        }
        // SAFETY: the caller passes a field of this model with the length that MuJoCo allocated it with; the sizes
        // never change, and the memory lives and is not written as long as `self` is borrowed.
        unsafe { slice::from_raw_parts(start, length) }
    }
}

impl Drop for Model {
    fn drop(&mut self) {
        // SAFETY: the pointer came from mj_loadXML or mj_copyModel, is owned by `self`, and is freed once.
        unsafe { sys::mj_deleteModel(self.pointer.as_ptr()) }
    }
}

/// The error that this thread's last failed call left.
pub(crate) fn last_error() -> Error {
    // SAFETY: the shim returns a terminated string of this thread, which lives until the thread's next failure.
    let message = unsafe { CStr::from_ptr(sys::perturb_mj_last_error()) };
    Error::Fatal { message: message.to_string_lossy().trim().to_owned() }
}

/// Compares the versions of header and library, once, and silences the log file.
fn check_library() -> Result<(), Error> {
    static CHECKED: OnceLock<Result<(), Error>> = OnceLock::new();
    CHECKED
        .get_or_init(|| {
            // SAFETY: takes and touches nothing.
            let library = unsafe { sys::mj_version() };
            check_version(sys::mjVERSION_HEADER as i32, library)?;
            // SAFETY: writes one global, once, before any other call: every other call needs a model, which only
            // `from_xml` makes, after this.
            unsafe { sys::perturb_mj_silence() };
            Ok(())
        })
        .clone()
}

fn check_version(header: i32, library: i32) -> Result<(), Error> {
    if header == library { Ok(()) } else { Err(Error::Version { header, library }) }
}

fn text_of(message: &[u8]) -> String {
    let text = CStr::from_bytes_until_nul(message).unwrap_or_default();
    text.to_string_lossy().split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_library_of_another_version_is_refused() {
        assert_eq!(check_version(222, 222), Ok(()));
        assert_eq!(check_version(222, 237), Err(Error::Version { header: 222, library: 237 }));
        assert_eq!(check_library(), Ok(()));
    }
}
