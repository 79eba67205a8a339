//! The environments that a server has, by name.

use perturb_protocol::names::{EnvironmentName, is_spelled};

use super::{EnvironmentSpec, Error, shorten};

/// Environments in a fixed order. Each has a name of its own.
#[derive(Debug, Clone, Default)]
pub struct Catalogue(Vec<&'static EnvironmentSpec>);

impl Catalogue {
    /// Makes a catalogue of these environments, whose names must differ.
    pub(crate) fn new(specs: Vec<&'static EnvironmentSpec>) -> Self {
        Self(specs)
    }

    /// Adds one more environment at the end.
    ///
    /// # Errors
    /// [`Error::NameTaken`] if another environment has the same name. Names that differ only in case, hyphens and
    /// underscores are the same.
    pub fn with(mut self, spec: &'static EnvironmentSpec) -> Result<Self, Error> {
        let taken = self.names().find(|name| is_spelled(spec.name, name));
        if let Some(taken) = taken {
            return Err(Error::NameTaken { name: spec.name, taken });
        }
        self.0.push(spec);
        Ok(self)
    }

    /// Returns all environments.
    pub fn specs(&self) -> impl Iterator<Item = &'static EnvironmentSpec> {
        self.0.iter().copied()
    }

    /// Returns the names of all environments.
    pub fn names(&self) -> impl Iterator<Item = &'static str> {
        self.specs().map(|spec| spec.name)
    }

    /// Returns the environment of a name or of an id in Gymnasium, in any [spelling](perturb_protocol::names).
    ///
    /// # Errors
    /// [`Error::UnknownEnvironment`].
    pub fn find(&self, name: &str) -> Result<&'static EnvironmentSpec, Error> {
        let known = self.0.iter().map(|spec| (spec.name, spec.revision));
        Ok(self.0[EnvironmentName::new(&shorten(name)).find(known)?])
    }
}
