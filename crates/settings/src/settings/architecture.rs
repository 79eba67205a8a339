//! Network architectures of policies.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The network architecture of a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Architecture {
    /// Feed-forward: two separate multilayer perceptrons, for policy and value, each with two hidden layers of 64 tanh
    /// units.
    Ff,
    /// Recurrent: two hidden layers of 256 tanh units, an LSTM with 256 units, and two linear heads for policy and
    /// value.
    Rc,
}

impl Architecture {
    /// All architectures.
    pub const ALL: [Self; 2] = [Self::Ff, Self::Rc];
    /// The names of the architectures in settings and on the command line.
    pub const NAMES: [&str; 2] = ["ff", "rc"];
}

impl fmt::Display for Architecture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(Self::NAMES[*self as usize])
    }
}
