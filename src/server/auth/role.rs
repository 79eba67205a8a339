//! Roles: the parameter values that a token may draw from.

use crate::env::{EnvironmentSpec, Version, disturbance};
use perturb_protocol::region::Region;
use std::fmt;

/// The parameter values that the sessions of the tokens with this role may draw from.
#[derive(Debug, Clone, PartialEq)]
pub struct Role {
    pub(super) name: String,
    /// A draw must lie within the union of these sets; `None` allows any draw.
    pub(super) draws: Option<Vec<DrawSet>>,
    /// A draw must not overlap any of these sets.
    pub(super) never: Vec<DrawSet>,
}

/// Parameter values with a name.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum DrawSet {
    /// The parameter values of this version, in whichever environment.
    Version(Version),
    /// A set that the file of tokens defines for one environment.
    Own { name: String, environment: &'static str, region: Region },
}

impl DrawSet {
    /// The parameter values for an environment, if the set has some for it.
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

    /// Checks that the role allows draws from a region of an environment.
    ///
    /// # Errors
    /// If it does not: the reason, as a part of a sentence.
    pub fn check(&self, spec: &EnvironmentSpec, region: &Region) -> Result<(), String> {
        // Versions are defined without disturbances. So a session with disturbances is compared with the same sets, and
        // cannot bypass what a role may never draw.
        let spec = disturbance::undisturbed(spec);
        let overlaps = |set: &&DrawSet| set.region(spec).is_some_and(|never| region.overlaps(&never));
        if let Some(never) = self.never.iter().find(overlaps) {
            return Err(format!("it may never draw from {never}, and this region overlaps that set"));
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
