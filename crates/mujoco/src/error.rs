//! Errors and warnings of MuJoCo.

use std::fmt;

/// A failure of MuJoCo, or a wrong use of it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The loaded MuJoCo library and the headers with which this crate was compiled have different versions.
    #[error("the MuJoCo library is version {library}, the headers {header}; install libmujoco-dev and build again")]
    Version {
        /// The headers' version, e.g. 222 for 2.2.2.
        header: i32,
        /// The library's version, in the same form.
        library: i32,
    },
    /// The MJCF text cannot be compiled into a model.
    #[error("the model cannot be compiled: {reason}")]
    Compile {
        /// MuJoCo's message, usually with the line of the text.
        reason: String,
    },
    /// The model has no element with this name.
    #[error("the model has no {kind} named {name:?}")]
    UnknownName {
        /// The kind of element, as MJCF calls it, e.g. "joint".
        kind: &'static str,
        /// The name that was requested.
        name: String,
    },
    /// MuJoCo raised a fatal error. The simulation that was being computed can no longer be used.
    #[error("MuJoCo raised a fatal error: {message}")]
    Fatal {
        /// MuJoCo's message.
        message: String,
    },
    /// The simulation is unusable because an earlier fatal error left it in an undefined state.
    #[error("the simulation is unusable after a fatal error; make another")]
    Poisoned,
    /// OpenGL is not available, so nothing can be drawn.
    #[error("OpenGL without a display is missing: {reason}; install the Debian packages libegl1 and libgl1-mesa-dri")]
    NoOpenGl {
        /// The error of the dynamic loader, or the EGL call that failed.
        reason: String,
        /// Whether the EGL library is installed. If it is, another attempt may succeed.
        is_installed: bool,
    },
    /// MuJoCo raised a warning, so the simulated state is not reliable. MuJoCo may have replaced it with the initial
    /// state.
    #[error("the simulation diverged: {warning}; reset it")]
    Diverged {
        /// MuJoCo's warning.
        warning: Warning,
    },
}

/// A warning of MuJoCo.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Warning {
    /// The inertia matrix is nearly singular.
    Inertia,
    /// There are more contacts than the model's `nconmax` allows; the excess was dropped.
    ContactsFull,
    /// There are more constraint rows than the model's `njmax` allows; the excess was dropped.
    ConstraintsFull,
    /// The scene has no space for all visual geoms.
    VisualGeomsFull,
    /// A position is not finite or too large.
    BadPosition,
    /// A velocity is not finite or too large.
    BadVelocity,
    /// An acceleration is not finite or too large.
    BadAcceleration,
    /// A control is not finite or too large.
    BadControl,
}

impl Warning {
    /// All warnings, in the order of MuJoCo's `mjtWarning`.
    pub const ALL: [Self; 8] = [
        Self::Inertia,
        Self::ContactsFull,
        Self::ConstraintsFull,
        Self::VisualGeomsFull,
        Self::BadPosition,
        Self::BadVelocity,
        Self::BadAcceleration,
        Self::BadControl,
    ];
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Inertia => "nearly singular inertia matrix",
            Self::ContactsFull => "too many contacts",
            Self::ConstraintsFull => "too many constraint rows",
            Self::VisualGeomsFull => "too many visual geoms",
            Self::BadPosition => "bad number in the positions",
            Self::BadVelocity => "bad number in the velocities",
            Self::BadAcceleration => "bad number in the accelerations",
            Self::BadControl => "bad number in the controls",
        })
    }
}
