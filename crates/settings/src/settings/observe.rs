//! The quantities that a policy observes.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The quantities that a policy observes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Observe {
    /// Only the environment's observation.
    #[default]
    State,
    /// The environment's observation and the parameters of the current episode. It serves as a reference for policies
    /// that have to infer the parameters.
    Parameters,
}

impl Observe {
    /// The names of these choices in settings and on the command line.
    pub const NAMES: [&'static str; 2] = ["state", "parameters"];

    /// Returns whether this is the default.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Returns whether the policy observes the parameters.
    pub fn sees_parameters(self) -> bool {
        self == Self::Parameters
    }

    /// Returns a note for reports; `None` for the default.
    pub fn note(self) -> Option<&'static str> {
        self.sees_parameters().then_some("sees parameters")
    }
}

impl fmt::Display for Observe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(Self::NAMES[*self as usize])
    }
}
