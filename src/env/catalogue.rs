//! The environments that a server has, by name.

use perturb_protocol::names::EnvironmentName;

use super::{EnvironmentSpec, Error, shorten};

/// Environments in a fixed order. Each has a name of its own.
#[derive(Debug, Clone, Default)]
pub struct Catalogue(Vec<&'static EnvironmentSpec>);

impl Catalogue {
    /// The same catalogue with one more environment, at its end.
    ///
    /// # Panics
    /// If an environment has its name already.
    #[must_use]
    pub fn with(mut self, spec: &'static EnvironmentSpec) -> Self {
        assert!(self.names().all(|name| name != spec.name), "there are two environments {}", spec.name);
        self.0.push(spec);
        self
    }

    /// All of them.
    pub fn specs(&self) -> impl Iterator<Item = &'static EnvironmentSpec> {
        self.0.iter().copied()
    }

    /// Their names.
    pub fn names(&self) -> impl Iterator<Item = &'static str> {
        self.specs().map(|spec| spec.name)
    }

    /// The environment of that name, or of that id in Gymnasium, however it is [spelled](perturb_protocol::names).
    ///
    /// # Errors
    /// [`Error::UnknownEnvironment`].
    pub fn find(&self, name: &str) -> Result<&'static EnvironmentSpec, Error> {
        let known = self.0.iter().map(|spec| (spec.name, spec.revision));
        Ok(self.0[EnvironmentName::new(&shorten(name)).find(known)?])
    }
}
