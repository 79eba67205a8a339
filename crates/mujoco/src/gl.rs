//! OpenGL contexts without a display, created by EGL.
//!
//! libEGL is loaded when the first context is created, so that programs that draw nothing run without it. The library
//! and its displays stay open until the process ends, because graphics drivers do not survive being unloaded.

use crate::Error;
use khronos_egl as egl;
use std::{
    ffi::{c_int, c_uint, c_void},
    mem, ptr,
    sync::OnceLock,
};

type Egl = egl::DynamicInstance<egl::EGL1_4>;

const LIBRARY: &str = "libEGL.so.1";
/// Maximal number of graphics cards on which a context is tried.
const MAX_DEVICES: usize = 32;

// The EGL registry defines these numbers for EGL_EXT_platform_device and EGL_MESA_platform_surfaceless.
const PLATFORM_DEVICE: c_uint = 0x313F;
const PLATFORM_SURFACELESS: c_uint = 0x31DD;
#[rustfmt::skip]
const CONFIG: [egl::Int; 15] = [
    egl::SURFACE_TYPE, egl::PBUFFER_BIT,
    egl::RENDERABLE_TYPE, egl::OPENGL_BIT,
    egl::RED_SIZE, 8,
    egl::GREEN_SIZE, 8,
    egl::BLUE_SIZE, 8,
    egl::DEPTH_SIZE, 24,
    egl::STENCIL_SIZE, 8,
    egl::NONE,
];
/// Attributes of a surface of one pixel. It exists only because a context can be made current only with a surface.
/// Pictures are drawn into another buffer.
const SURFACE: [egl::Int; 5] = [egl::WIDTH, 1, egl::HEIGHT, 1, egl::NONE];
/// Attributes of a context: none, which selects the compatibility profile that MuJoCo needs.
const CONTEXT: [egl::Int; 1] = [egl::NONE];

type GetPlatformDisplay = unsafe extern "system" fn(c_uint, *mut c_void, *const c_int) -> egl::EGLDisplay;
type QueryDevices = unsafe extern "system" fn(c_int, *mut *mut c_void, *mut c_int) -> egl::Boolean;

fn library() -> Result<&'static Egl, Error> {
    static EGL: OnceLock<Egl> = OnceLock::new();
    match EGL.get() {
        Some(egl) => Ok(egl),
        None => open(LIBRARY).map(|egl| EGL.get_or_init(|| egl)),
    }
}

fn open(name: &str) -> Result<Egl, Error> {
    // SAFETY: this loads the system's EGL library, whose initialisers any program may run. The library's functions have
    // the types of the EGL registry.
    unsafe { Egl::load_required_from_filename(name) }.map_err(|error| {
        let reason = error.to_string();
        // The dynamic loader reports a missing file with these words. After other errors, such as too little memory,
        // another attempt may succeed.
        let is_installed = !reason.contains("No such file or directory");
        Error::NoOpenGl { reason, is_installed }
    })
}

/// Returns the EGL displays that need no screen, in the order in which to try them: each graphics card, the software
/// renderer, then the default display.
fn displays(egl: &Egl) -> Vec<egl::Display> {
    let mut displays = Vec::new();
    // `Egl::get_platform_display` would panic if EGL knows a platform but has no display for it.
    if let Some(function) = egl.get_proc_address("eglGetPlatformDisplayEXT") {
        // SAFETY: this is the extension's function, and the type is the one in the EGL registry.
        let get_platform_display = unsafe { mem::transmute::<extern "system" fn(), GetPlatformDisplay>(function) };
        let (mut devices, mut n) = ([ptr::null_mut(); MAX_DEVICES], 0);
        if let Some(function) = egl.get_proc_address("eglQueryDevicesEXT") {
            // SAFETY: this is the extension's function, and the type is the one in the EGL registry.
            let query_devices = unsafe { mem::transmute::<extern "system" fn(), QueryDevices>(function) };
            // SAFETY: the array has space for the number of devices that is passed.
            unsafe { query_devices(MAX_DEVICES as c_int, devices.as_mut_ptr(), &raw mut n) };
        }
        let devices = devices.iter().take(usize::try_from(n).unwrap_or(0)).map(|&device| (PLATFORM_DEVICE, device));
        for (platform, native) in devices.chain([(PLATFORM_SURFACELESS, ptr::null_mut())]) {
            // SAFETY: for PLATFORM_DEVICE the device comes from EGL. For PLATFORM_SURFACELESS it must be null. The null
            // pointer to attributes means that there are none.
            let display = unsafe { get_platform_display(platform, native, ptr::null()) };
            if display != egl::NO_DISPLAY {
                // SAFETY: the display comes from EGL.
                displays.push(unsafe { egl::Display::from_ptr(display) });
            }
        }
    }
    // SAFETY: EGL allows a request for the default display at any time.
    displays.extend(unsafe { egl.get_display(egl::DEFAULT_DISPLAY) });
    displays
}

/// An OpenGL context without a display. It can only be used in the thread that created it.
pub(crate) struct Gl {
    egl: &'static Egl,
    // Surface and context are valid as long as this value, and the display is valid until the process ends. They are
    // raw pointers, so this type is not `Send`.
    display: egl::Display,
    surface: egl::Surface,
    context: Option<egl::Context>,
}

impl Gl {
    /// Creates a context on the first usable graphics card, otherwise in the software renderer, and makes it current.
    ///
    /// # Errors
    /// [`Error::NoOpenGl`] if no display has a usable context.
    pub(crate) fn new() -> Result<Self, Error> {
        let egl = library()?;
        let mut reason = "EGL has no display".to_owned();
        for display in displays(egl) {
            match Self::on(egl, display) {
                Ok(gl) => return Ok(gl),
                Err(failed) => reason = failed,
            }
        }
        Err(Error::NoOpenGl { reason, is_installed: true })
    }

    fn on(egl: &'static Egl, display: egl::Display) -> Result<Self, String> {
        let failed = |what| move |error: egl::Error| format!("{what} failed with EGL's error 0x{:x}", error.native());
        egl.initialize(display).map_err(failed("eglInitialize"))?;
        egl.bind_api(egl::OPENGL_API).map_err(failed("eglBindAPI"))?;
        let config = egl.choose_first_config(display, &CONFIG).map_err(failed("eglChooseConfig"))?;
        let config = config.ok_or("EGL has no configuration for pictures")?;
        let surface =
            egl.create_pbuffer_surface(display, config, &SURFACE).map_err(failed("eglCreatePbufferSurface"))?;
        let mut gl = Self { egl, display, surface, context: None }; // from here on `drop` cleans up
        gl.context = Some(egl.create_context(display, config, None, &CONTEXT).map_err(failed("eglCreateContext"))?);
        gl.make_current().map_err(failed("eglMakeCurrent"))?;
        Ok(gl)
    }

    /// Makes this the current context: later OpenGL calls of this thread use it.
    pub(crate) fn make_current(&self) -> Result<(), egl::Error> {
        self.egl.make_current(self.display, Some(self.surface), Some(self.surface), self.context)
    }
}

impl Drop for Gl {
    fn drop(&mut self) {
        // Failures are ignored, because they do no harm and `drop` cannot report them.
        let _ = self.egl.make_current(self.display, None, None, None);
        if let Some(context) = self.context {
            let _ = self.egl.destroy_context(self.display, context);
        }
        let _ = self.egl.destroy_surface(self.display, self.surface);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_library_is_named_with_the_packages_that_bring_one() {
        let Err(error) = open("libEGL-that-is-not-there.so.1") else { panic!("it was opened") };
        assert!(matches!(error, Error::NoOpenGl { is_installed: false, .. }), "{error:?}");
        let message = error.to_string();
        assert!(message.contains("libEGL-that-is-not-there.so.1"), "{message}");
        assert!(message.contains("libegl1 and libgl1-mesa-dri"), "{message}");
    }

    #[test]
    fn a_library_that_is_not_egl_is_refused() {
        let Err(error) = open("libm.so.6") else { panic!("it was taken for EGL") };
        assert!(error.to_string().contains("eglChooseConfig"), "{error}");
        assert!(matches!(error, Error::NoOpenGl { is_installed: true, .. }), "{error:?}");
    }
}
