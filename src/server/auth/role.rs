//! Roles: the parameter values that a token may draw from.

use crate::env::{EnvironmentSpec, Version, disturbance};
use perturb_protocol::region::Region;
use std::fmt;

/// The parameter values that the sessions of some tokens may draw from.
#[derive(Debug, Clone, PartialEq)]
pub struct Role {
    pub(super) name: String,
    /// Nothing that is not within these; none: anything.
    pub(super) draws: Option<Vec<DrawSet>>,
    /// Nothing that overlaps one of these.
    pub(super) never: Vec<DrawSet>,
}

/// Parameter values with a name.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum DrawSet {
    /// A version of every environment.
    Version(Version),
    /// A set of the file's own.
    Own { name: String, environment: &'static str, region: Region },
}

impl DrawSet {
    /// The values of an environment, if it has some of that one.
    fn region(&self, spec: &EnvironmentSpec) -> Option<Region> {
        match self {
            Self::Version(version) => Some(spec.region(&spec.distributions(*version))),
            Self::Own { environment, region, .. } => (*environment == spec.name).then(|| region.clone()),
        }
    }
}

impl fmt::Display for DrawSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Version(version) => version.fmt(f),
            Self::Own { name, .. } => write!(f, "{name:?}"),
        }
    }
}

impl Role {
    /// The role's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Whether it may draw from that.
    ///
    /// # Errors
    /// Why not, in half a sentence.
    pub fn check(&self, spec: &EnvironmentSpec, region: &Region) -> Result<(), String> {
        // Versions say nothing of disturbances, so that no disturbance leads around what a role may never draw.
        let spec = disturbance::undisturbed(spec);
        let overlaps = |set: &&DrawSet| set.region(spec).is_some_and(|never| region.overlaps(&never));
        if let Some(never) = self.never.iter().find(overlaps) {
            return Err(format!("it may never draw from {never}, which that overlaps"));
        }
        let Some(draws) = &self.draws else { return Ok(()) };
        let within: Vec<Region> = draws.iter().filter_map(|set| set.region(spec)).collect();
        if region.is_within(&within) {
            return Ok(());
        }
        let names: Vec<String> = draws.iter().map(DrawSet::to_string).collect();
        Err(format!("it may draw from {} alone", if names.is_empty() { "nothing".into() } else { names.join(" and ") }))
    }
}
