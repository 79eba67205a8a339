//! The three versions of every environment.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::proto;

/// Where an environment's parameters come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Version {
    /// Default: fixed values.
    D,
    /// Random: drawn from intervals around the defaults.
    R,
    /// Extreme: drawn from sets outside those intervals.
    E,
}

/// A text that names no version.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no version `{0}`; expected D, R or E")]
pub struct UnknownVersion(String);

impl Version {
    /// All, in the paper's order.
    pub const ALL: [Version; 3] = [Version::D, Version::R, Version::E];

    /// The protocol's name for it.
    pub fn to_proto(self) -> proto::Version {
        match self {
            Version::D => proto::Version::Default,
            Version::R => proto::Version::Random,
            Version::E => proto::Version::Extreme,
        }
    }

    /// What the protocol's name stands for; `None` if none was given.
    pub fn from_proto(version: proto::Version) -> Option<Self> {
        Version::ALL.into_iter().find(|known| known.to_proto() == version)
    }
}

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Version::D => "D",
            Version::R => "R",
            Version::E => "E",
        })
    }
}

impl FromStr for Version {
    type Err = UnknownVersion;

    /// The letter, large or small.
    fn from_str(text: &str) -> Result<Self, UnknownVersion> {
        let named = |version: &Version| version.to_string().eq_ignore_ascii_case(text);
        Version::ALL.into_iter().find(named).ok_or_else(|| UnknownVersion(text.into()))
    }
}
