//! Sets of parameter values: what is drawn from, what may be, and whether two meet.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::version::Version;
use crate::{Distribution, DistributionError, proto};

/// The values of all parameters that may come together: a box, each parameter in its own set whatever the others are, or
/// several boxes, as R+E is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub struct Region(Vec<Box>);

/// One set of values for each parameter, by name.
pub type Box = BTreeMap<String, Distribution>;

/// A region in a file: sets of values as [`Distribution::written`], which loses no digit of them.
type Written = Vec<BTreeMap<String, String>>;

impl From<Region> for Written {
    fn from(region: Region) -> Self {
        let written = |values: Box| values.into_iter().map(|(name, values)| (name, values.written())).collect();
        region.0.into_iter().map(written).collect()
    }
}

impl TryFrom<Written> for Region {
    type Error = DistributionError;

    fn try_from(written: Written) -> Result<Self, DistributionError> {
        let values = |(name, values): (String, String)| Ok((name, values.parse()?));
        let boxes = written.into_iter().map(|values_of| values_of.into_iter().map(values).collect());
        Ok(Self(boxes.collect::<Result<_, _>>()?))
    }
}

impl Region {
    /// Of these boxes.
    pub fn new(boxes: Vec<Box>) -> Self {
        Self(boxes)
    }

    /// What `version` of an environment draws from, but for the parameters that have sets of their own.
    pub fn of(environment: &proto::Environment, version: Version, own: &Box) -> Self {
        let of_part = |part: &Version| {
            let values = |parameter: &proto::Parameter| {
                let of_version = match part {
                    Version::D | Version::RE => None, // which is of the two others
                    Version::R => parameter.random.as_ref(),
                    Version::E => parameter.extreme.as_ref(),
                };
                let of_version = || of_version.and_then(|values| values.try_into().ok());
                let own = own.get(&parameter.name).cloned();
                own.or_else(of_version).unwrap_or_else(|| Distribution::fixed(parameter.default_value))
            };
            environment.parameters.iter().map(|parameter| (parameter.name.clone(), values(parameter))).collect()
        };
        Self(version.parts().iter().map(of_part).collect())
    }

    /// Its boxes.
    pub fn boxes(&self) -> &[Box] {
        &self.0
    }

    /// Whether everything in it is in one of the boxes of `others`.
    pub fn is_within<'a>(&self, others: impl IntoIterator<Item = &'a Self> + Clone) -> bool {
        let is_in = |own: &Box, other: &Box| pairs(own, other, Distribution::is_within);
        self.0.iter().all(|own| others.clone().into_iter().flat_map(Self::boxes).any(|other| is_in(own, other)))
    }

    /// Whether some of it is in `other`, see [`Distribution::overlaps`].
    pub fn overlaps(&self, other: &Self) -> bool {
        self.0.iter().any(|own| other.0.iter().any(|other| pairs(own, other, Distribution::overlaps)))
    }
}

/// Whether all parameters' sets are so; boxes of other parameters never are.
fn pairs(one: &Box, other: &Box, are: fn(&Distribution, &Distribution) -> bool) -> bool {
    one.len() == other.len() && one.iter().all(|(name, own)| other.get(name).is_some_and(|others| are(own, others)))
}

impl fmt::Display for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, values) in self.0.iter().enumerate() {
            for (j, (name, values)) in values.iter().enumerate() {
                let before = if j > 0 {
                    ", "
                } else if i > 0 {
                    ", or "
                } else {
                    ""
                };
                write!(f, "{before}{name} {values}")?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Interval;

    fn environment() -> proto::Environment {
        let drawn = |intervals: &[(f64, f64)]| {
            let intervals = intervals.iter().map(|&(low, high)| Interval::new(low, high)).collect();
            Some(proto::Distribution { intervals })
        };
        let parameter = |name: &str| proto::Parameter {
            name: name.into(),
            default_value: 1.0,
            random: drawn(&[(0.5, 2.0)]),
            extreme: drawn(&[(0.1, 0.5), (2.0, 3.0)]),
            ..Default::default()
        };
        proto::Environment { parameters: vec![parameter("length"), parameter("mass")], ..Default::default() }
    }

    fn region(version: Version, own: &[(&str, &str)]) -> Region {
        let own = own.iter().map(|(name, values)| ((*name).to_owned(), values.parse().unwrap())).collect();
        Region::of(&environment(), version, &own)
    }

    #[test]
    fn the_versions_are_in_each_other_as_the_paper_has_them() {
        use Version::{D, E, R, RE};
        let is_within = |one, other| region(one, &[]).is_within([&region(other, &[])]);
        assert!(is_within(D, R) && is_within(R, RE) && is_within(E, RE) && is_within(E, E));
        assert!(!is_within(R, D) && !is_within(D, E) && !is_within(RE, R) && !is_within(RE, E));
        assert!(region(RE, &[]).is_within([&region(R, &[]), &region(E, &[])]), "each of its boxes is in one of both");
        let overlaps = |one, other| region(one, &[]).overlaps(&region(other, &[]));
        assert!(overlaps(D, R) && overlaps(RE, E) && overlaps(E, E) && overlaps(R, D));
        assert!(!overlaps(R, E) && !overlaps(E, R) && !overlaps(D, E), "R and E share but ends of intervals");
    }

    #[test]
    fn one_parameter_of_e_beside_one_of_r_is_neither() {
        let mixed = region(Version::R, &[("length", "0.2..0.3")]);
        let (r, e) = (region(Version::R, &[]), region(Version::E, &[]));
        assert!(!mixed.is_within([&r, &e]) && !mixed.overlaps(&r) && !mixed.overlaps(&e));
        assert_eq!(mixed.to_string(), "length [0.2, 0.3], mass [0.5, 2]");
    }

    #[test]
    fn regions_of_other_parameters_have_nothing_in_common() {
        let other = Region::new(vec![Box::from([("power".to_owned(), Distribution::fixed(1.0))])]);
        let r = region(Version::R, &[]);
        assert!(!other.is_within([&r]) && !r.overlaps(&other) && !r.is_within([]));
    }
}
