//! The environments, one folder each, and their catalogue. Those that a server is given as an MJCF model and a TOML file
//! are in `folder`.
//!
//! A folder has everything of its environment. The files have the same parts in the same order: spec with parameters,
//! derived quantities, reset, dynamics, reward and termination; and what a picture shows.

mod analytic;
#[cfg(feature = "mujoco")]
pub mod folder;
#[cfg(feature = "mujoco")]
pub mod locomotion;

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

/// The environments that are built in.
pub fn catalogue() -> Catalogue {
    let analytic = [&cart_pole::SPEC, &mountain_car::SPEC, &acrobot::SPEC, &pendulum::SPEC];
    #[cfg(feature = "mujoco")]
    let robots = [&half_cheetah::SPEC, &hopper::SPEC];
    #[cfg(not(feature = "mujoco"))]
    let robots = [];
    Catalogue::new(analytic.into_iter().chain(robots).collect())
}

/// The environments that are built in, and those of folders, in order.
///
/// # Errors
/// [`folder::LoadError`] if a folder is refused, or has the name of an environment before it.
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
