//! The architectures of policies.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The policy's network architecture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Architecture {
    /// Feed-forward: two separate multilayer perceptrons, 64-64, tanh.
    Ff,
    /// Recurrent: one multilayer perceptron, 256-256, tanh, an LSTM of 256, two linear heads.
    Rc,
}

impl Architecture {
    /// All architectures.
    pub const ALL: [Self; 2] = [Self::Ff, Self::Rc];
    /// The names in settings and options.
    pub const NAMES: [&str; 2] = ["ff", "rc"];
}

impl fmt::Display for Architecture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(Self::NAMES[*self as usize])
    }
}
