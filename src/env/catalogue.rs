//! Every environment there is, by name.

use super::{Environment, EnvironmentSpec, Error, shorten};
use crate::classic;
#[cfg(feature = "mujoco")]
use crate::locomotion;

type Make = fn() -> Result<Box<dyn Environment>, Error>;

const CATALOGUE: &[(&EnvironmentSpec, Make)] = &[
    (&classic::CART_POLE, || Ok(Box::new(classic::CartPole::new()))),
    (&classic::MOUNTAIN_CAR, || Ok(Box::new(classic::MountainCar::new()))),
    (&classic::ACROBOT, || Ok(Box::new(classic::Acrobot::new()))),
    (&classic::PENDULUM, || Ok(Box::new(classic::Pendulum::new()))),
    #[cfg(feature = "mujoco")]
    (&locomotion::HALF_CHEETAH, || Ok(Box::new(locomotion::half_cheetah()?))),
    #[cfg(feature = "mujoco")]
    (&locomotion::HOPPER, || Ok(Box::new(locomotion::hopper()?))),
];

/// The specs of all environments, in the catalogue's order.
pub fn specs() -> impl Iterator<Item = &'static EnvironmentSpec> {
    CATALOGUE.iter().map(|(spec, _)| *spec)
}

/// The names of all environments, in the catalogue's order.
pub fn names() -> impl Iterator<Item = &'static str> {
    specs().map(|spec| spec.name)
}

/// The spec of the environment of that name.
///
/// # Errors
/// [`Error::UnknownEnvironment`].
pub fn find(name: &str) -> Result<&'static EnvironmentSpec, Error> {
    entry(name).map(|(spec, _)| *spec)
}

/// A new environment of that name, with default parameters.
///
/// # Errors
/// [`Error::UnknownEnvironment`], or [`Error::Model`] if its model cannot be loaded.
pub fn make(name: &str) -> Result<Box<dyn Environment>, Error> {
    entry(name)?.1()
}

fn entry(name: &str) -> Result<&'static (&'static EnvironmentSpec, Make), Error> {
    CATALOGUE
        .iter()
        .find(|(spec, _)| spec.name == name)
        .ok_or_else(|| Error::UnknownEnvironment { name: shorten(name), known: names().collect::<Vec<_>>().join(", ") })
}
