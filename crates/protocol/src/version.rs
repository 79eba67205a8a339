//! The versions of every environment: the paper's three, and two of them together.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::proto;

/// A version of an environment: the distributions of its parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub enum Version {
    /// Default: fixed values.
    D,
    /// Random: drawn from intervals around the defaults.
    R,
    /// Extreme: drawn from sets outside those intervals.
    E,
    /// R or E, each in half of the trials.
    #[serde(rename = "R+E")]
    RE,
}

/// A text that names no version.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no version `{0}`; expected D, R, E or R+E")]
pub struct UnknownVersion(String);

impl Version {
    /// The paper's, in its order.
    pub const ALL: [Version; 3] = [Version::D, Version::R, Version::E];
    /// The paper's versions, and R+E.
    pub const KNOWN: [Version; 4] = [Version::D, Version::R, Version::E, Version::RE];
    /// The names of [`Version::KNOWN`].
    pub const NAMES: [&str; 4] = ["D", "R", "E", "R+E"];

    /// Versions that a trial is drawn from with equal probability: R and E for R+E, else the version itself.
    pub fn parts(self) -> &'static [Version] {
        match self {
            Version::D => &[Version::D],
            Version::R => &[Version::R],
            Version::E => &[Version::E],
            Version::RE => &[Version::R, Version::E],
        }
    }

    /// The name in ids and file names, where only letters, digits, `.`, `-` and `_` are allowed. No parameter set of a user can
    /// have the name of R+E.
    pub fn file_name(self) -> &'static str {
        if self == Version::RE { "R-or-E" } else { Self::NAMES[self as usize] }
    }

    /// The protocol's name for the version.
    pub fn to_proto(self) -> proto::Version {
        match self {
            Version::D => proto::Version::Default,
            Version::R => proto::Version::Random,
            Version::E => proto::Version::Extreme,
            Version::RE => proto::Version::RandomOrExtreme,
        }
    }

    /// The version with this name in the protocol; `None` if it is unspecified.
    pub fn from_proto(version: proto::Version) -> Option<Self> {
        Version::KNOWN.into_iter().find(|known| known.to_proto() == version)
    }
}

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(Self::NAMES[*self as usize])
    }
}

impl FromStr for Version {
    type Err = UnknownVersion;

    /// The name, in large letters or small ones.
    fn from_str(text: &str) -> Result<Self, UnknownVersion> {
        let named = |version: &Version| Version::NAMES[*version as usize].eq_ignore_ascii_case(text);
        Version::KNOWN.into_iter().find(named).ok_or_else(|| UnknownVersion(text.into()))
    }
}

impl TryFrom<String> for Version {
    type Error = UnknownVersion;

    fn try_from(text: String) -> Result<Self, UnknownVersion> {
        text.parse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn version_is_read_from_all_its_names() {
        for version in Version::KNOWN {
            assert_eq!(version.to_string().parse(), Ok(version));
            assert_eq!(version.to_string().to_lowercase().parse(), Ok(version));
            assert_eq!(serde_json::to_value(version).unwrap(), version.to_string());
            let small = serde_json::Value::from(version.to_string().to_lowercase());
            assert_eq!(serde_json::from_value::<Version>(small).unwrap(), version);
            assert_eq!(Version::from_proto(version.to_proto()), Some(version));
            let plain = |c: char| c.is_ascii_alphanumeric() || c == '-';
            assert!(version.file_name().chars().all(plain), "{}", version.file_name());
        }
        assert_eq!("RE".parse::<Version>(), Err(UnknownVersion("RE".into())));
        assert_eq!(Version::from_proto(proto::Version::Unspecified), None);
    }
}
