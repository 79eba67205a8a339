//! Compiled MuJoCo models.

use crate::{
    Error,
    fields::{CONSTANTS, Flags, Index, ModelField, Options},
    sys,
};
use std::{
    ffi::{CStr, CString, c_char, c_int, c_void},
    ptr::{self, NonNull},
    slice,
    sync::{Mutex, OnceLock, PoisonError},
};

/// Maximal number of files that a model may use. MuJoCo's virtual file system has space for 2000 files, and one of them
/// is the model's text.
const MAX_FILES: usize = 1999;
/// File names must be shorter than this, in bytes. MuJoCo has space for 1000.
const MAX_FILE_NAME: usize = 900;

/// A kind of model element that can have a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ElementKind {
    /// A rigid body. Body 0 is the world.
    Body,
    /// A joint, by which a body moves relative to its parent.
    Joint,
    /// A geom: a shape for collisions and pictures, attached to a body.
    Geom,
    /// An actuator.
    Actuator,
    /// A site: a point of interest, attached to a body.
    Site,
    /// A camera.
    Camera,
    /// A sensor.
    Sensor,
    /// A tendon, which connects joints or sites.
    Tendon,
    /// A pair of geoms whose contact parameters the model declares explicitly.
    Pair,
    /// A keyframe: a stored state.
    Keyframe,
}

impl ElementKind {
    /// The name of this kind in MJCF, e.g. "joint".
    pub fn name(self) -> &'static str {
        match self {
            Self::Body => "body",
            Self::Joint => "joint",
            Self::Geom => "geom",
            Self::Actuator => "actuator",
            Self::Site => "site",
            Self::Camera => "camera",
            Self::Sensor => "sensor",
            Self::Tendon => "tendon",
            Self::Pair => "pair",
            Self::Keyframe => "keyframe",
        }
    }

    fn object(self) -> sys::mjtObj {
        match self {
            Self::Body => sys::mjtObj__mjOBJ_BODY,
            Self::Joint => sys::mjtObj__mjOBJ_JOINT,
            Self::Geom => sys::mjtObj__mjOBJ_GEOM,
            Self::Actuator => sys::mjtObj__mjOBJ_ACTUATOR,
            Self::Site => sys::mjtObj__mjOBJ_SITE,
            Self::Camera => sys::mjtObj__mjOBJ_CAMERA,
            Self::Sensor => sys::mjtObj__mjOBJ_SENSOR,
            Self::Tendon => sys::mjtObj__mjOBJ_TENDON,
            Self::Pair => sys::mjtObj__mjOBJ_PAIR,
            Self::Keyframe => sys::mjtObj__mjOBJ_KEY,
        }
    }
}

/// A compiled MuJoCo model: the bodies, joints, geoms and other elements with their parameters. Only a
/// [`Simulation`](crate::Simulation) can edit the model that it owns.
#[derive(Debug)]
pub struct Model {
    // Comes from mj_loadXML or mj_copyModel. `self` owns it, and `drop` frees it. Its sizes and index arrays never
    // change.
    pointer: NonNull<sys::mjModel>,
}

// SAFETY: mjModel is plain memory without ties to a thread, and only `Model` owns it.
unsafe impl Send for Model {}
// SAFETY: nothing is written through `&Model`. Its methods only read, and mj_copyModel and mj_name2id take const
// pointers.
unsafe impl Sync for Model {}

/// A floating-point array of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelArray {
    /// MuJoCo's name of the field, e.g. `body_mass`.
    pub name: &'static str,
    /// The elements, row-major. Single-precision numbers are converted to double precision.
    pub values: Vec<f64>,
}

impl Model {
    /// Compiles MJCF text to a model. Takes about 0.5 ms. Compilations in several threads wait for each other.
    ///
    /// Pass only trusted text, because MJCF can include any file of the disk.
    ///
    /// # Errors
    /// [`Error::Version`] if the MuJoCo library has the wrong version, [`Error::Compile`] with MuJoCo's message.
    pub fn from_xml(xml: &str) -> Result<Self, Error> {
        Self::from_files(xml, &[])
    }

    /// Compiles MJCF text that uses other files, such as meshes. `files` are pairs of a file's name, in lower case and
    /// without a folder, and its content. Compilations in several threads wait for each other.
    ///
    /// Pass only trusted text: MuJoCo reads a file that is not in `files` from the disk.
    ///
    /// # Errors
    /// [`Error::Version`] if the MuJoCo library has the wrong version. [`Error::Compile`] with MuJoCo's message, or if
    /// there are more than 1999 files, or a file is longer than 2 GB.
    pub fn from_files(xml: &str, files: &[(&str, &[u8])]) -> Result<Self, Error> {
        static LOADING: Mutex<()> = Mutex::new(());
        check_library()?;
        let refuse = |reason: &str| Error::Compile { reason: reason.to_owned() };
        let size = c_int::try_from(xml.len()).map_err(|_| refuse("the text is longer than 2 GB"))?;
        if files.len() > MAX_FILES {
            return Err(refuse("there are more than 1999 files"));
        }
        let mut names = Vec::with_capacity(files.len());
        let mut sizes = Vec::with_capacity(files.len());
        for (name, bytes) in files {
            if name.len() >= MAX_FILE_NAME {
                return Err(refuse("the name of a file is longer than 900 bytes"));
            }
            names.push(CString::new(*name).map_err(|_| refuse("the name of a file contains a zero"))?);
            sizes.push(c_int::try_from(bytes.len()).map_err(|_| refuse("a file is longer than 2 GB"))?);
        }
        let name_pointers: Vec<*const c_char> = names.iter().map(|name| name.as_ptr()).collect();
        let data_pointers: Vec<*const c_void> = files.iter().map(|(_, bytes)| bytes.as_ptr().cast()).collect();
        let mut message = [0u8; 1024];
        // The mutex may be poisoned by a panic in another thread. This is harmless, since the mutex guards no data.
        let _loading = LOADING.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: during the call, `xml`, `message`, the three lists and the memory to which they point are valid for
        // the given sizes. The function writes only to `message`. The names are terminated and fit in the virtual file
        // system, which also has space for all files. Only this function calls MuJoCo's compiler, and the mutex lets
        // one thread at a time do it.
        let pointer = unsafe {
            sys::perturb_mj_load(
                xml.as_ptr().cast::<c_char>(),
                size,
                files.len() as c_int,
                name_pointers.as_ptr(),
                data_pointers.as_ptr(),
                sizes.as_ptr(),
                message.as_mut_ptr().cast::<c_char>(),
                message.len() as c_int,
            )
        };
        NonNull::new(pointer)
            .map(|pointer| Self { pointer })
            .ok_or_else(|| Error::Compile { reason: text_of(&message) })
    }

    /// Makes an independent copy of this model.
    ///
    /// # Errors
    /// [`Error::Fatal`] if there is not enough memory.
    pub fn try_clone(&self) -> Result<Self, Error> {
        // SAFETY: the pointer is a valid model for the lifetime of `self`. The function returns a new model or null.
        let pointer = unsafe { sys::perturb_mj_copy_model(self.pointer.as_ptr()) };
        NonNull::new(pointer).map(|pointer| Self { pointer }).ok_or_else(last_error)
    }

    /// Whether this model and `other` have the same sizes: the number of each kind of element, the length of the names,
    /// and the limits of memory.
    pub fn has_sizes_of(&self, other: &Self) -> bool {
        // SAFETY: both models are valid, and the function only reads them.
        unsafe { sys::perturb_mj_same_sizes(self.pointer.as_ptr(), other.pointer.as_ptr()) != 0 }
    }

    /// The index of the element with this kind and name.
    ///
    /// # Errors
    /// [`Error::UnknownName`] if there is no such element.
    pub fn id(&self, kind: ElementKind, name: &str) -> Result<usize, Error> {
        let unknown = || Error::UnknownName { kind: kind.name(), name: name.to_owned() };
        let c_name = CString::new(name).map_err(|_| unknown())?;
        // SAFETY: the model is valid, the string is terminated, and the function only reads both.
        let id = unsafe { sys::mj_name2id(self.pointer.as_ptr(), kind.object() as c_int, c_name.as_ptr()) };
        usize::try_from(id).map_err(|_| unknown())
    }

    /// The name of the element with this kind and index. `None` if it has no name, or if there is no such element.
    pub fn name(&self, kind: ElementKind, id: usize) -> Option<&str> {
        if id >= self.count(kind) {
            return None;
        }
        // SAFETY: the model is valid, and the function only reads it. It returns null or a terminated string that
        // belongs to the model.
        let name = unsafe { sys::mj_id2name(self.pointer.as_ptr(), kind.object() as c_int, id as c_int) };
        if name.is_null() {
            return None;
        }
        // SAFETY: the string belongs to the model, which lives and is not changed as long as `self` is borrowed.
        unsafe { CStr::from_ptr(name) }.to_str().ok().filter(|name| !name.is_empty())
    }

    /// The number of elements of this kind.
    pub fn count(&self, kind: ElementKind) -> usize {
        let m = self.raw();
        (match kind {
            ElementKind::Body => m.nbody,
            ElementKind::Joint => m.njnt,
            ElementKind::Geom => m.ngeom,
            ElementKind::Actuator => m.nu,
            ElementKind::Site => m.nsite,
            ElementKind::Camera => m.ncam,
            ElementKind::Sensor => m.nsensor,
            ElementKind::Tendon => m.ntendon,
            ElementKind::Pair => m.npair,
            ElementKind::Keyframe => m.nkey,
        }) as usize
    }

    /// The number of generalised positions, the length of `qpos`.
    pub fn n_q(&self) -> usize {
        self.raw().nq as usize
    }

    /// The number of degrees of freedom, the length of `qvel`.
    pub fn n_v(&self) -> usize {
        self.raw().nv as usize
    }

    /// The number of controls, one for each actuator.
    pub fn n_u(&self) -> usize {
        self.raw().nu as usize
    }

    /// The number of activations: state variables of actuators that have internal dynamics.
    pub fn n_act(&self) -> usize {
        self.raw().na as usize
    }

    /// The number of bodies, including the world.
    pub fn n_body(&self) -> usize {
        self.raw().nbody as usize
    }

    /// The number of joints.
    pub fn n_joint(&self) -> usize {
        self.raw().njnt as usize
    }

    /// The number of geoms.
    pub fn n_geom(&self) -> usize {
        self.raw().ngeom as usize
    }

    /// The number of elements that [`Simulation::state`](crate::Simulation::state) writes.
    pub fn n_state(&self) -> usize {
        1 + self.n_q() + 2 * self.n_v() + self.n_act() + self.n_u()
    }

    /// The number of elements that [`Simulation::constants`](crate::Simulation::constants) writes.
    pub fn n_constants(&self) -> usize {
        self.constants().into_iter().map(|(_, length)| length).sum()
    }

    /// The simulated time of one timestep, in s.
    pub fn timestep(&self) -> f64 {
        self.raw().opt.timestep
    }

    /// The masses of the bodies in kg, `[n_body]`.
    pub fn body_mass(&self) -> &[f64] {
        self.array(self.raw().body_mass, self.n_body())
    }

    /// The principal moments of inertia of the bodies in kg m², `[n_body, 3]`.
    pub fn body_inertia(&self) -> &[f64] {
        self.array(self.raw().body_inertia, 3 * self.n_body())
    }

    /// The sliding, torsional and rolling friction coefficients of the geoms, `[n_geom, 3]`.
    pub fn geom_friction(&self) -> &[f64] {
        self.array(self.raw().geom_friction, 3 * self.n_geom())
    }

    /// The index in `qpos` of each joint's first position, `[n_joint]`.
    pub fn joint_qpos_address(&self) -> impl ExactSizeIterator<Item = usize> {
        self.array(self.raw().jnt_qposadr, self.n_joint()).iter().map(|&id| id as usize)
    }

    /// The index in `qvel` of each joint's first velocity, `[n_joint]`.
    pub fn joint_dof_address(&self) -> impl ExactSizeIterator<Item = usize> {
        self.array(self.raw().jnt_dofadr, self.n_joint()).iter().map(|&id| id as usize)
    }

    /// The lower and upper limit of each joint in rad or m, `[n_joint]`.
    pub fn joint_range(&self) -> impl ExactSizeIterator<Item = (f64, f64)> {
        self.array(self.raw().jnt_range, 2 * self.n_joint()).chunks_exact(2).map(|range| (range[0], range[1]))
    }

    /// The values of a floating-point array or option.
    pub fn field(&self, field: ModelField) -> &[f64] {
        let (start, length) = self.pointer_and_length(field);
        self.array(start, length)
    }

    /// The total number of elements in `fields`.
    pub fn n_fields(&self, fields: &[ModelField]) -> usize {
        fields.iter().map(|&field| self.pointer_and_length(field).1).sum()
    }

    /// A pointer to the first element of a field, and the number of its elements.
    pub(crate) fn pointer_and_length(&self, field: ModelField) -> (*mut f64, usize) {
        // SAFETY: the pointer is a valid model for the lifetime of `self`, and is not written through a `&Model`.
        unsafe { field.pointer_and_length(self.as_ptr()) }
    }

    /// The values of an integer array: types of elements, or indices of other elements.
    pub fn index_array(&self, index: Index) -> &[i32] {
        let (start, length) = index.pointer_and_length(self.raw());
        self.array(start, length)
    }

    /// The values of an array of flags.
    pub fn flags(&self, flags: Flags) -> &[u8] {
        let (start, length) = flags.pointer_and_length(self.raw());
        self.array(start, length)
    }

    /// The integer options of the model.
    pub fn options(&self) -> Options {
        let opt = &self.raw().opt;
        Options {
            integrator: opt.integrator,
            collision: opt.collision,
            disable_flags: opt.disableflags,
            enable_flags: opt.enableflags,
        }
    }

    /// Returns an upper bound of the memory of a simulation of this model, in bytes. It includes the model and MuJoCo's
    /// data.
    pub fn simulation_bytes(&self) -> usize {
        let m = self.raw();
        let [nv, njmax, nconmax, nstack, nu, nbody, n_m, nemax] =
            [m.nv, m.njmax, m.nconmax, m.nstack, m.nu, m.nbody, m.nM, m.nemax].map(|n| n.max(0) as usize);
        let number = size_of::<f64>();
        // Adds up the largest arrays of mjData: efc_J and its transpose with their column indices, efc_AR with its
        // column indices, contacts, the stack, actuator moments, and the factors of the inertia matrix. All other
        // arrays grow linearly with one size. `linear` is a generous bound for them.
        let jacobian = 2 * njmax.saturating_mul(nv).saturating_mul(number + size_of::<i32>());
        let delassus = njmax.saturating_mul(njmax).saturating_mul(number + size_of::<i32>());
        let contacts = nconmax.saturating_mul(size_of::<sys::mjContact>());
        let moments = nu.saturating_mul(nv).saturating_add(4 * n_m).saturating_mul(number);
        let linear = [njmax, nbody, nv, nemax].iter().sum::<usize>().saturating_mul(100 * number);
        [jacobian, delassus, contacts, nstack.saturating_mul(number), moments, linear, self.model_bytes()]
            .into_iter()
            .fold(0, usize::saturating_add)
    }

    /// The memory of the model itself, in bytes.
    pub fn model_bytes(&self) -> usize {
        size_of::<sys::mjModel>() + self.raw().nbuffer.max(0) as usize
    }

    /// Copies every floating-point array of the model, and its statistics under the name `stat`. Meant for comparing
    /// models.
    pub fn float_arrays(&self) -> Vec<ModelArray> {
        let mut arrays = Vec::new();
        for index in 0.. {
            let (mut name, mut elements, mut count, mut size) = (ptr::null(), ptr::null(), 0, 0);
            // SAFETY: the model is valid. The function writes all four outputs whenever its result is not zero.
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
            // SAFETY: the name is a string literal in `shim.c`, so it is terminated and never freed.
            let name = unsafe { CStr::from_ptr::<'static>(name) }.to_str().unwrap_or_default();
            arrays.push(ModelArray { name, values });
        }
        arrays
    }

    /// Pointers to the arrays that [`Simulation::constants`](crate::Simulation::constants) copies, and their lengths.
    pub(crate) fn constants(&self) -> [(*mut f64, usize); 9] {
        CONSTANTS.map(|field| self.pointer_and_length(field))
    }

    pub(crate) fn raw(&self) -> &sys::mjModel {
        // SAFETY: the pointer is a valid model for the lifetime of `self`, and is not written through a `&Model`.
        unsafe { self.pointer.as_ref() }
    }

    pub(crate) fn as_ptr(&self) -> *mut sys::mjModel {
        self.pointer.as_ptr()
    }

    /// Returns an array of this model as a slice. `start` must point to the array's first element, and the array must
    /// have `length` elements.
    fn array<T>(&self, start: *mut T, length: usize) -> &[T] {
        if length == 0 {
            return &[]; // the pointer may be null
        }
        // SAFETY: the caller passes an array of this model with the length that MuJoCo allocated. Lengths never change.
        // The memory lives and is not changed as long as `self` is borrowed.
        unsafe { slice::from_raw_parts(start, length) }
    }
}

impl Drop for Model {
    fn drop(&mut self) {
        // SAFETY: the pointer came from mj_loadXML or mj_copyModel, `self` owns it, and it is freed once.
        unsafe { sys::mj_deleteModel(self.pointer.as_ptr()) }
    }
}

/// Returns the error of the last call into `shim.c` that failed in this thread.
pub(crate) fn last_error() -> Error {
    // SAFETY: the shim returns a terminated string of this thread, which lives until the thread's next failure.
    let message = unsafe { CStr::from_ptr(sys::perturb_mj_last_error()) };
    Error::Fatal { message: message.to_string_lossy().trim().to_owned() }
}

/// Checks, once in the process, that header and library have the same version. Also stops MuJoCo from writing a log
/// file.
fn check_library() -> Result<(), Error> {
    static CHECKED: OnceLock<Result<(), Error>> = OnceLock::new();
    CHECKED
        .get_or_init(|| {
            // SAFETY: the function has no arguments and only returns a constant.
            let library = unsafe { sys::mj_version() };
            check_version(sys::mjVERSION_HEADER as i32, library)?;
            // SAFETY: the function writes two global variables, once, before any other thread calls MuJoCo. All other
            // calls need a model, and models are compiled only after this check.
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
