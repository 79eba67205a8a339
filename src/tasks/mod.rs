//! The environments, one folder each, and their catalogue.
//!
//! A folder has everything of its environment. The files have the same parts in the same order: spec with parameters,
//! derived quantities, reset, dynamics, reward and termination; and what a picture shows.

mod analytic;
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

/// Every environment there is.
pub fn catalogue() -> Catalogue {
    let catalogue = Catalogue::default()
        .with(&cart_pole::SPEC)
        .with(&mountain_car::SPEC)
        .with(&acrobot::SPEC)
        .with(&pendulum::SPEC);
    #[cfg(feature = "mujoco")]
    let catalogue = catalogue.with(&half_cheetah::SPEC).with(&hopper::SPEC);
    catalogue
}
