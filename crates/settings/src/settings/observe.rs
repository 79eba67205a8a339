//! The observation of a policy.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The observation of a policy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Observe {
    /// The environment's observation.
    #[default]
    State,
    /// The parameters of the running episode, too. Serves as a reference for policies that have to infer their environment.
    Parameters,
}

impl Observe {
    /// The names in settings and options.
    pub const NAMES: [&'static str; 2] = ["state", "parameters"];

    /// Whether this is the default observation.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Whether parameters are observed.
    pub fn sees_parameters(self) -> bool {
        self == Self::Parameters
    }

    /// A note for reports; `None` for the default observation.
    pub fn note(self) -> Option<&'static str> {
        self.sees_parameters().then_some("sees parameters")
    }
}

impl fmt::Display for Observe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(Self::NAMES[*self as usize])
    }
}
