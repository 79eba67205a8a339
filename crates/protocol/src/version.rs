//! The versions of an environment: D, R and E of Packer et al. (2018), and the mixture R+E.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::proto;

/// A version of an environment: it selects the distributions from which the environment's parameters are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub enum Version {
    /// Default: every parameter has its default value.
    D,
    /// Random: parameters are drawn from intervals around their defaults.
    R,
    /// Extreme: parameters are drawn from outside the intervals of R.
    E,
    /// R or E: each trial draws all its parameters from R or all from E, with probability 1/2.
    #[serde(rename = "R+E")]
    RE,
}

/// The error for a text that is not the name of a version.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no version `{0}`; expected D, R, E or R+E")]
pub struct UnknownVersion(String);

impl Version {
    /// The versions of Packer et al. (2018), in the order of their paper.
    pub const ALL: [Version; 3] = [Version::D, Version::R, Version::E];
    /// All versions: those of [`Version::ALL`], and R+E.
    pub const KNOWN: [Version; 4] = [Version::D, Version::R, Version::E, Version::RE];
    /// The names of the versions, in the order of [`Version::KNOWN`].
    pub const NAMES: [&str; 4] = ["D", "R", "E", "R+E"];

    /// The versions from which a trial is drawn with equal probability: R and E for R+E, otherwise only the version
    /// itself.
    pub fn parts(self) -> &'static [Version] {
        match self {
            Version::D => &[Version::D],
            Version::R => &[Version::R],
            Version::E => &[Version::E],
            Version::RE => &[Version::R, Version::E],
        }
    }

    /// The name for ids and file names, which consist of letters, digits, `.`, `-` and `_`. R+E is called `R-or-E`, a
    /// name that user-defined parameter sets may not have.
    pub fn file_name(self) -> &'static str {
        if self == Version::RE { "R-or-E" } else { Self::NAMES[self as usize] }
    }

    /// The version as a protocol value.
    pub fn to_proto(self) -> proto::Version {
        match self {
            Version::D => proto::Version::Default,
            Version::R => proto::Version::Random,
            Version::E => proto::Version::Extreme,
            Version::RE => proto::Version::RandomOrExtreme,
        }
    }

    /// The version of a protocol value; `None` if it is unspecified.
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

    /// Parses a name such as `R+E`. Case does not matter.
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
