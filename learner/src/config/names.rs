//! The names of algorithms and architectures.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::policy::{ActionKind, PolicySpec};

/// Which algorithm learns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum AlgorithmName {
    /// Advantage actor-critic.
    A2c,
    /// Proximal policy optimisation.
    Ppo,
    /// A2C on the worst episodes of many.
    EpoptA2c,
    /// PPO on the worst episodes of many.
    EpoptPpo,
    /// A2C over trials of several episodes.
    Rl2A2c,
    /// PPO over trials of several episodes.
    Rl2Ppo,
}

/// The algorithm that updates the policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Base {
    /// Advantage actor-critic.
    A2c,
    /// Proximal policy optimisation.
    Ppo,
}

/// What is wrapped around it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wrapper {
    /// Nothing.
    Plain,
    /// EPOpt.
    Epopt,
    /// RL².
    Rl2,
}

impl AlgorithmName {
    /// All, in the order in which they are listed.
    pub const ALL: [AlgorithmName; 6] = [
        AlgorithmName::A2c,
        AlgorithmName::Ppo,
        AlgorithmName::EpoptA2c,
        AlgorithmName::EpoptPpo,
        AlgorithmName::Rl2A2c,
        AlgorithmName::Rl2Ppo,
    ];

    /// As it is typed.
    pub fn as_str(self) -> &'static str {
        match self {
            AlgorithmName::A2c => "a2c",
            AlgorithmName::Ppo => "ppo",
            AlgorithmName::EpoptA2c => "epopt-a2c",
            AlgorithmName::EpoptPpo => "epopt-ppo",
            AlgorithmName::Rl2A2c => "rl2-a2c",
            AlgorithmName::Rl2Ppo => "rl2-ppo",
        }
    }

    /// What updates the policy.
    pub fn base(self) -> Base {
        match self {
            AlgorithmName::A2c | AlgorithmName::EpoptA2c | AlgorithmName::Rl2A2c => Base::A2c,
            AlgorithmName::Ppo | AlgorithmName::EpoptPpo | AlgorithmName::Rl2Ppo => Base::Ppo,
        }
    }

    /// What is wrapped around it.
    pub fn wrapper(self) -> Wrapper {
        match self {
            AlgorithmName::A2c | AlgorithmName::Ppo => Wrapper::Plain,
            AlgorithmName::EpoptA2c | AlgorithmName::EpoptPpo => Wrapper::Epopt,
            AlgorithmName::Rl2A2c | AlgorithmName::Rl2Ppo => Wrapper::Rl2,
        }
    }

    /// The architecture that is trained if none is named: RL² has only one.
    pub fn default_architecture(self) -> Architecture {
        match self.wrapper() {
            Wrapper::Rl2 => Architecture::Rc,
            Wrapper::Plain | Wrapper::Epopt => Architecture::Ff,
        }
    }
}

impl fmt::Display for AlgorithmName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

/// Which networks the policy has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Architecture {
    /// Feed-forward: two separate multilayer perceptrons, 64-64, tanh.
    Ff,
    /// Recurrent: one multilayer perceptron, 256-256, tanh, an LSTM of 256, two linear heads.
    Rc,
}

impl Architecture {
    /// The shape of a policy for inputs of `input_size` numbers.
    pub fn spec(self, input_size: usize, action: ActionKind) -> PolicySpec {
        let (width, lstm) = match self {
            Architecture::Ff => (64, None),
            Architecture::Rc => (256, Some(256)),
        };
        PolicySpec { observation_size: input_size, action, hidden: vec![width, width], lstm }
    }
}

impl fmt::Display for Architecture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Architecture::Ff => "ff",
            Architecture::Rc => "rc",
        })
    }
}
