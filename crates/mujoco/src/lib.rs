//! Safe bindings to the parts of Debian's MuJoCo 2.2.2 that perturb needs.
//!
//! - [`Model`]: a compiled model. It is compiled from MJCF, MuJoCo's XML format, or copied from another model.
//! - [`Simulation`]: a copy of a model, which may be edited, and the physical state that MuJoCo computes for it.
//! - [`ModelField`], [`Index`], [`Flags`] and [`DataField`]: the names of the arrays of models and simulations.
//! - [`ModelRenderer`]: draws pictures of a model without a display.
//! - [`Error`], [`Warning`]: MuJoCo's failures. Fatal errors are returned instead of ending the process, and warnings
//!   are reported as errors.
//!
//! ```
//! use perturb_mujoco::{ElementKind, Model, Simulation};
//!
//! let model = Model::from_xml("<mujoco><worldbody><body name='ball'><freejoint/><geom size='.1'/></body></worldbody></mujoco>")?;
//! let ball = model.id(ElementKind::Body, "ball")?;
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
//! Different models and simulations may be used in different threads at the same time. Outside `mjModel` and `mjData`,
//! MuJoCo's engine has only three kinds of state. The C code in `shim.c` installs error handlers for each thread and
//! call. Callbacks are never set by this crate. The addresses of OpenGL's functions are used only for drawing. The MJCF
//! compiler and drawing are not thread-safe, so this crate guards them by mutexes.
//!
//! # Fatal errors
//!
//! By default MuJoCo ends the process at a fatal error. In this crate each call runs under `setjmp` in `shim.c`, and
//! the error handler jumps back to that place. The jump crosses only C frames of MuJoCo's engine, never Rust frames or
//! those of the MJCF compiler, which is C++. The interrupted call leaves `mjData` in an undefined state. So the
//! [`Simulation`] refuses all further calls, and the caller must make a new one.

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
pub use fields::{DataField, Flags, Index, ModelField, Options};
pub use model::{ElementKind, Model, ModelArray};
pub use render::{Camera, CameraView, ModelRenderer};
