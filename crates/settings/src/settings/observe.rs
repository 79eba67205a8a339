//! What a policy gets to see.

use std::fmt;

use serde::{Deserialize, Serialize};

/// What a policy observes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Observe {
    /// The environment's observation.
    #[default]
    State,
    /// The parameters of the running episode, too. A line to compare with: what a policy could do that need not find
    /// out or guess which environment it is in.
    Parameters,
}

impl Observe {
    /// As they are typed.
    pub const NAMES: [&'static str; 2] = ["state", "parameters"];

    /// Whether it is what stands if nothing is said.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Whether parameters are observed.
    pub fn sees_parameters(self) -> bool {
        self == Self::Parameters
    }

    /// What is said of a policy that does not see what is usual.
    pub fn note(self) -> Option<&'static str> {
        self.sees_parameters().then_some("sees parameters")
    }
}

impl fmt::Display for Observe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(Self::NAMES[*self as usize])
    }
}
