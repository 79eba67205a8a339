//! Errors and warnings of MuJoCo.

use std::fmt;

/// A failure of MuJoCo or of its use.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The library that was loaded is not the one whose headers were compiled against.
    #[error("the MuJoCo library is version {library}, the headers {header}; install libmujoco-dev and build again")]
    Version {
        /// The headers' version, e.g. 222 for 2.2.2.
        header: i32,
        /// The library's version.
        library: i32,
    },
    /// The MJCF text cannot be compiled into a model.
    #[error("the model cannot be compiled: {reason}")]
    Compile {
        /// MuJoCo's message, with the line.
        reason: String,
    },
    /// The model has no element of this name.
    #[error("the model has no {kind} named {name:?}")]
    UnknownName {
        /// The kind of element.
        kind: &'static str,
        /// The name that was requested.
        name: String,
    },
    /// MuJoCo raised a fatal error. The data it worked on is unusable from now on.
    #[error("MuJoCo raised a fatal error: {message}")]
    Fatal {
        /// MuJoCo's message.
        message: String,
    },
    /// An earlier fatal error left the data in an undefined state.
    #[error("the simulation is unusable after a fatal error; make another")]
    Poisoned,
    /// There is no OpenGL to draw with.
    #[error("OpenGL without a display is missing: {reason}; install the Debian packages libegl1 and libgl1-mesa-dri")]
    NoOpenGl {
        /// The call that failed.
        reason: String,
        /// Whether the library is installed, so that another attempt may succeed.
        is_installed: bool,
    },
    /// The state cannot be trusted any more. MuJoCo may have put the initial state in its place.
    #[error("the simulation diverged: {warning}; reset it")]
    Diverged {
        /// MuJoCo's warning.
        warning: Warning,
    },
}

/// MuJoCo's warnings, in MuJoCo's order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Warning {
    /// The inertia matrix is nearly singular.
    Inertia,
    /// More contacts than the model's `nconmax`; the rest were dropped.
    ContactsFull,
    /// More constraint rows than the model's `njmax`; the rest were dropped.
    ConstraintsFull,
    /// More visual geoms than there is room for.
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
    /// All warnings, in the order of `mjtWarning`.
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
