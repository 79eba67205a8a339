//! Roles: the parameter values that a token's sessions may draw.

use crate::env::{EnvironmentSpec, Version, disturbance};
use perturb_protocol::region::Region;
use std::fmt;

/// A role of tokens. A role limits the parameter values that the tokens' sessions may draw.
#[derive(Debug, Clone, PartialEq)]
pub struct TokenRole {
    pub(super) name: String,
    /// The sets that a session may draw from. A region is a union of boxes. A session may draw from it only if each of
    /// these boxes is inside one box of one of these sets. `None` for no limit.
    pub(super) draws: Option<Vec<DrawSet>>,
    /// A session may not draw from a region that overlaps any of these sets.
    pub(super) never: Vec<DrawSet>,
}

/// A named set of parameter values.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum DrawSet {
    /// The values of a version (D, R, E or R+E), in every environment.
    Version(Version),
    /// A set that the token file defines for one environment.
    Own { name: String, environment: &'static str, region: Region },
}

impl DrawSet {
    /// Returns the set's region in the parameter space of an environment, or `None` if the set is for another
    /// environment.
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

impl TokenRole {
    /// The role's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Checks that sessions with this role may draw from a region of an environment's parameter space.
    ///
    /// # Errors
    /// The reason, as a part of a sentence, if the sessions may not draw from the region.
    pub fn check(&self, spec: &EnvironmentSpec, region: &Region) -> Result<(), String> {
        // The regions of versions are computed without disturbances, and `overlaps` ignores a disturbance that only one
        // of two regions has. Otherwise a session with a disturbance could circumvent `never`.
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
        Err(if names.is_empty() {
            "it may not draw from any region".into()
        } else {
            format!("it may draw only from {}", names.join(" and "))
        })
    }
}
