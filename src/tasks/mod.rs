//! The built-in environments, each in a module of its own, and their catalogue. The module `folder` loads environments
//! that users define by an MJCF model and a TOML file.
//!
//! Each analytic environment (`acrobot`, `cart_pole`, `mountain_car`, `pendulum`) has its specification, constants,
//! state and dynamics in `mod.rs`, and the content of its pictures in `drawing.rs`. `hopper` and `half_cheetah` have
//! only a specification and the description of a robot. The module `locomotion` simulates these two robots.

mod analytic;
#[cfg(feature = "mujoco")]
pub mod folder;
#[cfg(feature = "mujoco")]
pub mod locomotion;
#[cfg(feature = "mujoco")]
mod shared;

pub mod acrobot;
pub mod cart_pole;
#[cfg(feature = "mujoco")]
pub mod half_cheetah;
#[cfg(feature = "mujoco")]
pub mod hopper;
pub mod mountain_car;
pub mod pendulum;

use crate::env::Catalogue;
#[cfg(feature = "mujoco")]
use std::path::PathBuf;

/// Returns the catalogue of the built-in environments.
pub fn catalogue() -> Catalogue {
    let analytic = [&cart_pole::SPEC, &mountain_car::SPEC, &acrobot::SPEC, &pendulum::SPEC];
    #[cfg(feature = "mujoco")]
    let robots = [&half_cheetah::SPEC, &hopper::SPEC];
    #[cfg(not(feature = "mujoco"))]
    let robots = [];
    Catalogue::new(analytic.into_iter().chain(robots).collect())
}

/// Returns the catalogue of the built-in environments, followed by the environments in `folders`, in order.
///
/// # Errors
/// [`folder::LoadError`] if a folder is not valid, or its environment has the same name as an earlier one.
#[cfg(feature = "mujoco")]
pub fn catalogue_with(folders: &[PathBuf]) -> Result<Catalogue, folder::LoadError> {
    let mut catalogue = catalogue();
    for path in folders {
        let refuse = |problem: &dyn std::fmt::Display| folder::LoadError::new(path, problem);
        let spec = folder::load(path).map_err(|error| refuse(&error))?.spec();
        catalogue = catalogue.with(spec).map_err(|error| refuse(&error))?;
    }
    Ok(catalogue)
}
