//! The names of algorithms and architectures.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Which algorithm learns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Architecture {
    /// Feed-forward: two separate multilayer perceptrons, 64-64, tanh.
    Ff,
    /// Recurrent: one multilayer perceptron, 256-256, tanh, an LSTM of 256, two linear heads.
    Rc,
}

impl fmt::Display for Architecture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Architecture::Ff => "ff",
            Architecture::Rc => "rc",
        })
    }
}

/// A text that names none of what there is.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no {what} `{got}`; expected one of {known}")]
pub struct UnknownName {
    what: &'static str,
    got: String,
    known: String,
}

/// The one of `all` that is called `text`.
fn named<T: fmt::Display + Copy>(what: &'static str, all: &[T], text: &str) -> Result<T, UnknownName> {
    all.iter().copied().find(|one| one.to_string() == text).ok_or_else(|| UnknownName {
        what,
        got: text.to_owned(),
        known: all.iter().map(T::to_string).collect::<Vec<_>>().join(", "),
    })
}

impl FromStr for AlgorithmName {
    type Err = UnknownName;

    fn from_str(text: &str) -> Result<Self, UnknownName> {
        named("algorithm", &Self::ALL, text)
    }
}

impl FromStr for Architecture {
    type Err = UnknownName;

    fn from_str(text: &str) -> Result<Self, UnknownName> {
        named("architecture", &[Self::Ff, Self::Rc], text)
    }
}
