//! An OpenGL context without a display, through EGL.
//!
//! libEGL is opened when the first context is made, so that programs run without it. Drivers do not survive being
//! unloaded: the library stays, and so do the displays, which the process shares.

use crate::Error;
use libloading::Library;
use std::{
    ffi::{CStr, c_char, c_int, c_uint, c_void},
    mem, ptr,
    sync::OnceLock,
};

const LIBRARY: &str = "libEGL.so.1";
/// More than any machine has graphics cards.
const MOST_DEVICES: usize = 32;

// Of the EGL registry (EGL 1.5, EGL_EXT_platform_device, EGL_MESA_platform_surfaceless).
const PLATFORM_DEVICE: c_uint = 0x313F;
const PLATFORM_SURFACELESS: c_uint = 0x31DD;
const OPENGL_API: c_uint = 0x30A2;
const NONE: c_int = 0x3038;
#[rustfmt::skip]
const CONFIG: [c_int; 15] = [
    0x3033, 0x0001, // EGL_SURFACE_TYPE: EGL_PBUFFER_BIT
    0x3040, 0x0008, // EGL_RENDERABLE_TYPE: EGL_OPENGL_BIT
    0x3024, 8,      // EGL_RED_SIZE
    0x3023, 8,      // EGL_GREEN_SIZE
    0x3022, 8,      // EGL_BLUE_SIZE
    0x3025, 24,     // EGL_DEPTH_SIZE
    0x3026, 8,      // EGL_STENCIL_SIZE
    NONE,
];
/// A surface of one pixel: every context may be made current with one, and pictures are drawn elsewhere.
const SURFACE: [c_int; 5] = [0x3057, 1, 0x3056, 1, NONE]; // EGL_WIDTH, EGL_HEIGHT

type Handle = *mut c_void;
type GetPlatformDisplay = unsafe extern "C" fn(c_uint, Handle, *const c_int) -> Handle;
type QueryDevices = unsafe extern "C" fn(c_int, *mut Handle, *mut c_int) -> c_uint;

/// The functions of EGL that are needed.
struct Egl {
    get_display: unsafe extern "C" fn(Handle) -> Handle,
    get_platform_display: Option<GetPlatformDisplay>,
    query_devices: Option<QueryDevices>,
    initialize: unsafe extern "C" fn(Handle, *mut c_int, *mut c_int) -> c_uint,
    bind_api: unsafe extern "C" fn(c_uint) -> c_uint,
    choose_config: unsafe extern "C" fn(Handle, *const c_int, *mut Handle, c_int, *mut c_int) -> c_uint,
    create_pbuffer_surface: unsafe extern "C" fn(Handle, Handle, *const c_int) -> Handle,
    create_context: unsafe extern "C" fn(Handle, Handle, Handle, *const c_int) -> Handle,
    make_current: unsafe extern "C" fn(Handle, Handle, Handle, Handle) -> c_uint,
    destroy_surface: unsafe extern "C" fn(Handle, Handle) -> c_uint,
    destroy_context: unsafe extern "C" fn(Handle, Handle) -> c_uint,
    get_error: unsafe extern "C" fn() -> c_int,
}

impl Egl {
    fn get() -> Result<&'static Self, Error> {
        static EGL: OnceLock<Egl> = OnceLock::new();
        match EGL.get() {
            Some(egl) => Ok(egl),
            None => Self::open(LIBRARY).map(|egl| EGL.get_or_init(|| egl)),
        }
    }

    fn open(name: &str) -> Result<Self, Error> {
        let missing = |error: libloading::Error| Error::NoOpenGl { reason: error.to_string() };
        // SAFETY: the initialisers that run are those of the system's EGL library, which any program may load.
        let library = unsafe { Library::new(name) }.map_err(missing)?;
        // The library's function of that name, and that type by the EGL registry.
        macro_rules! function {
            ($name:literal) => {
                // SAFETY: the field that it is put into has the type of the EGL registry's function.
                *unsafe { library.get($name) }.map_err(missing)?
            };
        }
        let get_proc_address: unsafe extern "C" fn(*const c_char) -> *const c_void = function!(b"eglGetProcAddress\0");
        // SAFETY: a terminated string.
        let extension = |name: &CStr| unsafe { get_proc_address(name.as_ptr()) };
        let (platform, devices) = (extension(c"eglGetPlatformDisplayEXT"), extension(c"eglQueryDevicesEXT"));
        let egl = Self {
            get_display: function!(b"eglGetDisplay\0"),
            // SAFETY: a null pointer, which is `None`, or the extension's function of the EGL registry's type.
            get_platform_display: unsafe { mem::transmute::<*const c_void, Option<GetPlatformDisplay>>(platform) },
            // SAFETY: a null pointer, which is `None`, or the extension's function of the EGL registry's type.
            query_devices: unsafe { mem::transmute::<*const c_void, Option<QueryDevices>>(devices) },
            initialize: function!(b"eglInitialize\0"),
            bind_api: function!(b"eglBindAPI\0"),
            choose_config: function!(b"eglChooseConfig\0"),
            create_pbuffer_surface: function!(b"eglCreatePbufferSurface\0"),
            create_context: function!(b"eglCreateContext\0"),
            make_current: function!(b"eglMakeCurrent\0"),
            destroy_surface: function!(b"eglDestroySurface\0"),
            destroy_context: function!(b"eglDestroyContext\0"),
            get_error: function!(b"eglGetError\0"),
        };
        mem::forget(library); // its functions are used as long as the process lives
        Ok(egl)
    }

    /// Displays that need no screen, the likeliest first: each graphics card and the software renderer, then whatever
    /// the platform offers.
    fn displays(&self) -> Vec<Handle> {
        let mut displays = Vec::new();
        if let Some(get_platform_display) = self.get_platform_display {
            let (mut devices, mut n) = ([ptr::null_mut(); MOST_DEVICES], 0);
            if let Some(query_devices) = self.query_devices {
                // SAFETY: room for as many devices as it is told of.
                unsafe { query_devices(MOST_DEVICES as c_int, devices.as_mut_ptr(), &raw mut n) };
            }
            for &device in devices.iter().take(usize::try_from(n).unwrap_or(0)) {
                // SAFETY: a device that EGL named; no attributes.
                displays.push(unsafe { get_platform_display(PLATFORM_DEVICE, device, ptr::null()) });
            }
            // SAFETY: this platform takes a null display; no attributes.
            displays.push(unsafe { get_platform_display(PLATFORM_SURFACELESS, ptr::null_mut(), ptr::null()) });
        }
        // SAFETY: null is EGL_DEFAULT_DISPLAY.
        displays.push(unsafe { (self.get_display)(ptr::null_mut()) });
        displays.retain(|display| !display.is_null());
        displays
    }

    /// What failed.
    fn failed(&self, what: &str) -> String {
        // SAFETY: it reads this thread's last error.
        let error = unsafe { (self.get_error)() };
        format!("{what} failed with EGL's error 0x{error:x}")
    }
}

/// An OpenGL context without a display. It belongs to the thread that made it.
pub(crate) struct Gl {
    egl: &'static Egl,
    // Of `egl`, valid as long as this lives; the display for ever. Raw pointers keep it on its thread.
    display: Handle,
    surface: Handle,
    context: Handle,
}

impl Gl {
    /// A context on a graphics card if there is one that can be used, else in software.
    ///
    /// # Errors
    /// [`Error::NoOpenGl`].
    pub(crate) fn new() -> Result<Self, Error> {
        let egl = Egl::get()?;
        let mut reason = "EGL has no display".to_owned();
        for display in egl.displays() {
            match Self::on(egl, display) {
                Ok(gl) => return Ok(gl),
                Err(failed) => reason = failed,
            }
        }
        Err(Error::NoOpenGl { reason })
    }

    fn on(egl: &'static Egl, display: Handle) -> Result<Self, String> {
        let (mut config, mut n) = (ptr::null_mut(), 0);
        // SAFETY: a display of this EGL, which may be initialised many times; null for versions that nobody wants.
        if unsafe { (egl.initialize)(display, ptr::null_mut(), ptr::null_mut()) } == 0 {
            return Err(egl.failed("eglInitialize"));
        }
        // SAFETY: it sets this thread's interface.
        if unsafe { (egl.bind_api)(OPENGL_API) } == 0 {
            return Err(egl.failed("eglBindAPI"));
        }
        // SAFETY: an initialised display, attributes that end with NONE, room for one configuration.
        let chosen = unsafe { (egl.choose_config)(display, CONFIG.as_ptr(), &raw mut config, 1, &raw mut n) };
        if chosen == 0 || n == 0 {
            return Err(egl.failed("eglChooseConfig"));
        }
        // SAFETY: a configuration of this display, attributes that end with NONE.
        let surface = unsafe { (egl.create_pbuffer_surface)(display, config, SURFACE.as_ptr()) };
        if surface.is_null() {
            return Err(egl.failed("eglCreatePbufferSurface"));
        }
        // SAFETY: as before; no context to share with, and no attributes: the compatibility profile, which MuJoCo needs.
        let context = unsafe { (egl.create_context)(display, config, ptr::null_mut(), ptr::null()) };
        // From here on `drop` cleans up; it may be given a null context.
        let gl = Self { egl, display, surface, context };
        if gl.context.is_null() || !gl.make_current() {
            return Err(egl.failed("eglCreateContext or eglMakeCurrent"));
        }
        Ok(gl)
    }

    /// Makes OpenGL's calls of this thread use this context.
    pub(crate) fn make_current(&self) -> bool {
        // SAFETY: display, surface and context belong together and live; `self` is on the thread that made them.
        unsafe { (self.egl.make_current)(self.display, self.surface, self.surface, self.context) != 0 }
    }
}

impl Drop for Gl {
    fn drop(&mut self) {
        // SAFETY: all were made on this display and are not used after this; EGL answers a null context by an error,
        // which nobody reads.
        unsafe {
            (self.egl.make_current)(self.display, ptr::null_mut(), ptr::null_mut(), ptr::null_mut());
            (self.egl.destroy_context)(self.display, self.context);
            (self.egl.destroy_surface)(self.display, self.surface);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_library_is_named_with_the_packages_that_bring_one() {
        let Err(error) = Egl::open("libEGL-that-is-not-there.so.1") else { panic!("it was opened") };
        let message = error.to_string();
        assert!(message.contains("libEGL-that-is-not-there.so.1"), "{message}");
        assert!(message.contains("libegl1 and libgl1-mesa-dri"), "{message}");
    }

    #[test]
    fn a_library_that_is_not_egl_is_refused() {
        let Err(error) = Egl::open("libm.so.6") else { panic!("it was taken for EGL") };
        assert!(error.to_string().contains("eglGetProcAddress"), "{error}");
    }
}
