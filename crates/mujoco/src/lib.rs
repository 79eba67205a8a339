//! Safe bindings to Debian's MuJoCo 2.2.2, as far as perturb needs them.
//!
//! - [`Model`]: a compiled model; loaded from MJCF text, copied, read.
//! - [`Simulation`]: a model of its own and the data that MuJoCo computes on it; stepped, edited, read.
//! - [`Field`], [`Index`], [`Flags`] and [`Reading`]: the arrays of models and simulations, by name.
//! - [`Renderer`]: pictures of a model, drawn without a display.
//! - [`Error`], [`Warning`]: failures of MuJoCo. None ends the process, and none is ignored.
//!
//! ```
//! use perturb_mujoco::{Kind, Model, Simulation};
//!
//! let model = Model::from_xml("<mujoco><worldbody><body name='ball'><freejoint/><geom size='.1'/></body></worldbody></mujoco>")?;
//! let ball = model.id(Kind::Body, "ball")?;
//! let mut simulation = Simulation::new(model)?;
//! simulation.step1()?;
//! simulation.step2()?;
//! simulation.step1()?; // poses are those of the new state
//! assert!(simulation.xipos(ball)[2] < 0.0);
//! # Ok::<(), perturb_mujoco::Error>(())
//! ```
//!
//! # Threads
//!
//! MuJoCo's engine keeps no state outside `mjModel` and `mjData`, except its error handlers, which the shim installs per
//! thread and per call, its callbacks, which nothing here sets, and the addresses of OpenGL's functions. Only the compiler
//! of MJCF and drawing are not thread-safe; both are serialised.
//!
//! # Fatal errors
//!
//! Each call runs under `setjmp` in `shim.c`, and the handler jumps back there: across frames of MuJoCo's C engine
//! only, never of Rust, nor of the C++ compiler. What the interrupted call left in `mjData` is undefined, so
//! [`Simulation`] refuses all further calls; another takes its place.

mod data;
mod error;
mod fields;
mod gl;
mod model;
mod render;
#[allow(unreachable_pub)]
mod sys;

pub use data::Simulation;
pub use error::{Error, Warning};
pub use fields::{Field, Flags, Index, Options, Reading};
pub use model::{FloatArray, Kind, Model};
pub use render::{Camera, CameraView, Renderer};
