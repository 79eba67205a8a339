//! The environments of a server, found by name.

use perturb_protocol::names::{EnvironmentName, is_spelled};

use super::{EnvironmentSpec, Error, shorten};

/// The environments of a server, in a fixed order. No two of them have the same name.
#[derive(Debug, Clone, Default)]
pub struct Catalogue(Vec<&'static EnvironmentSpec>);

impl Catalogue {
    /// Creates a catalogue of the environments `specs`, in this order. The names must differ from each other.
    pub(crate) fn new(specs: Vec<&'static EnvironmentSpec>) -> Self {
        Self(specs)
    }

    /// Adds an environment at the end.
    ///
    /// # Errors
    /// [`Error::NameTaken`] if the catalogue already has an environment of the same name. Names that differ only in
    /// case, hyphens and underscores count as equal.
    pub fn with(mut self, spec: &'static EnvironmentSpec) -> Result<Self, Error> {
        let taken = self.names().find(|name| is_spelled(spec.name, name));
        if let Some(taken) = taken {
            return Err(Error::NameTaken { name: spec.name, taken });
        }
        self.0.push(spec);
        Ok(self)
    }

    /// Returns the descriptions of all environments, in order.
    pub fn specs(&self) -> impl Iterator<Item = &'static EnvironmentSpec> {
        self.0.iter().copied()
    }

    /// Returns the names of all environments, in order.
    pub fn names(&self) -> impl Iterator<Item = &'static str> {
        self.specs().map(|spec| spec.name)
    }

    /// Finds an environment by its name or its Gymnasium id, in any [spelling](perturb_protocol::names).
    ///
    /// # Errors
    /// [`Error::UnknownEnvironment`] if no environment has this name, or if the id names another revision than the
    /// server's.
    pub fn find(&self, name: &str) -> Result<&'static EnvironmentSpec, Error> {
        let known = self.0.iter().map(|spec| (spec.name, spec.revision));
        Ok(self.0[EnvironmentName::new(&shorten(name)).find(known)?])
    }
}
