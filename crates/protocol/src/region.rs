//! Regions of the parameter space from which environments draw, and whether two regions overlap.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::disturbance::{CHANGED, CHANGES, default_value, is_disturbance};
use crate::version::Version;
use crate::{Distribution, DistributionError, proto};

/// Maximal number of boxes of a region in a message. A region has a box for each context.
const MAX_SHOWN_BOXES: usize = 4;

/// A region of the parameter space: a union of boxes. A box has a set of values for each parameter. The region of
/// version R+E has two boxes, the box of R and the box of E. The region of a list of contexts has the boxes of its
/// contexts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "WrittenRegion", into = "WrittenRegion")]
pub struct Region(Vec<ParameterBox>);

/// A box in the parameter space: the set of values of each parameter, by the parameter's name.
pub type ParameterBox = BTreeMap<String, Distribution>;

/// A region as it is stored in files: each set of values as the text of [`Distribution::written`], which is exact.
type WrittenRegion = Vec<BTreeMap<String, String>>;

impl From<Region> for WrittenRegion {
    fn from(region: Region) -> Self {
        let written =
            |values: ParameterBox| values.into_iter().map(|(name, values)| (name, values.written())).collect();
        region.0.into_iter().map(written).collect()
    }
}

impl TryFrom<WrittenRegion> for Region {
    type Error = DistributionError;

    fn try_from(written: WrittenRegion) -> Result<Self, DistributionError> {
        let values = |(name, values): (String, String)| Ok((name, values.parse()?));
        let boxes = written.into_iter().map(|values_of| values_of.into_iter().map(values).collect());
        Ok(Self(boxes.collect::<Result<_, _>>()?))
    }
}

impl Region {
    /// Creates a region from its boxes.
    pub fn new(boxes: Vec<ParameterBox>) -> Self {
        Self(boxes)
    }

    /// Returns the region from which an environment draws its parameters in a `version`. The sets of values in `own`
    /// replace those of the version. If `own` names a disturbance, all disturbances become part of the region.
    pub fn from_version(environment: &proto::Environment, version: Version, own: &ParameterBox) -> Self {
        let environment = environment.with_parameters(own.keys().map(String::as_str));
        let of_part = |part: &Version| {
            let values = |parameter: &proto::Parameter| {
                let of_version = match part {
                    Version::D | Version::RE => None, // R+E has R and E as parts
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

    /// The boxes whose union is the region.
    pub fn boxes(&self) -> &[ParameterBox] {
        &self.0
    }

    /// Returns the boxes of the physical parameters. If the physics can change within an episode, there are two boxes
    /// for each box of the region: before the change, and after it, where the set of `changed_mass` replaces that of
    /// `mass`. The disturbances that say when the physics change are left out.
    fn physics(&self) -> Vec<ParameterBox> {
        let is_never = |values: &Distribution| values.range() == (0.0, 0.0);
        let of_box = |values: &ParameterBox| {
            let is_changing = CHANGES.iter().any(|name| values.get(*name).is_some_and(|values| !is_never(values)));
            let is_kept = |name: &str| !CHANGES.contains(&name) && !name.starts_with(CHANGED);
            let mut before = values.clone();
            before.retain(|name, _| is_kept(name));
            let mut after = before.clone();
            for (name, values) in values {
                if let Some(own) = name.strip_prefix(CHANGED).and_then(|name| after.get_mut(name)) {
                    *own = values.clone();
                }
            }
            if is_changing { vec![before, after] } else { vec![before] }
        };
        self.0.iter().flat_map(of_box).collect()
    }

    /// Whether each box of this region is inside a box of one of `others`. A disturbance that is missing from a box
    /// counts as its default value. If the physics can change within an episode, the values before and after the change
    /// are compared separately.
    pub fn is_within<'a>(&self, others: impl IntoIterator<Item = &'a Self>) -> bool {
        let is_in = |own: &ParameterBox, other: &ParameterBox| {
            all_parameters(own, other, Distribution::is_within, default_value)
        };
        let others: Vec<ParameterBox> = others.into_iter().flat_map(Self::physics).collect();
        self.physics().iter().all(|own| others.iter().any(|other| is_in(own, other)))
    }

    /// Whether this region and `other` have values in common, see [`Distribution::overlaps`]. A disturbance that is
    /// missing from one of two boxes is not compared. Therefore, a region that names no disturbances overlaps the same
    /// region with any disturbances.
    pub fn overlaps(&self, other: &Self) -> bool {
        let others = other.physics();
        let overlap = |own, other| all_parameters(own, other, Distribution::overlaps, |_| None);
        self.physics().iter().any(|own| others.iter().any(|other| overlap(own, other)))
    }
}

/// Compares two boxes: whether `holds` is true for every parameter, given the parameter's set of values in each box.
/// Returns false if a parameter that is not a disturbance is in only one box. If a disturbance is in only one box,
/// `lacking` returns its value in the other box, or `None` to ignore the disturbance.
fn all_parameters(
    one: &ParameterBox,
    other: &ParameterBox,
    holds: fn(&Distribution, &Distribution) -> bool,
    lacking: fn(&str) -> Option<f64>,
) -> bool {
    let holds_for = |name: &String| {
        let value = || lacking(name).map(Distribution::fixed);
        match (one.get(name), other.get(name)) {
            (Some(own), Some(others)) => holds(own, others),
            (None, None) => true,
            _ if !is_disturbance(name) => false,
            (Some(own), None) => value().is_none_or(|others| holds(own, &others)),
            (None, Some(others)) => value().is_none_or(|own| holds(&own, others)),
        }
    };
    one.keys().chain(other.keys()).all(holds_for)
}

impl fmt::Display for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, values) in self.0.iter().take(MAX_SHOWN_BOXES).enumerate() {
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
        match self.0.len().saturating_sub(MAX_SHOWN_BOXES) {
            0 => Ok(()),
            others => write!(f, ", or {others} others"),
        }
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
        Region::from_version(&environment(), version, &own)
    }

    #[test]
    fn versions_contain_and_overlap_each_other_as_in_the_paper() {
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
    fn mixture_of_r_and_e_is_in_neither() {
        let mixed = region(Version::R, &[("length", "0.2..0.3")]);
        let r = region(Version::R, &[]);
        let e = region(Version::E, &[]);
        assert!(!mixed.is_within([&r, &e]) && !mixed.overlaps(&r) && !mixed.overlaps(&e));
        assert_eq!(mixed.to_string(), "length [0.2, 0.3], mass [0.5, 2]");
    }

    #[test]
    fn disturbances_do_not_lead_around_a_region() {
        use Version::{D, E, R};
        let late = |version, delay: &str| {
            let Region(mut boxes) = region(version, &[]);
            boxes.iter_mut().for_each(|values| {
                values.insert("action_delay".into(), delay.parse().unwrap());
            });
            Region(boxes)
        };
        assert!(late(E, "3").overlaps(&region(E, &[])) && region(E, &[]).overlaps(&late(E, "3")));
        assert!(!late(R, "3").overlaps(&region(E, &[])) && !late(E, "3").overlaps(&late(E, "4")));
        assert!(late(R, "0").is_within([&region(R, &[])]) && !late(R, "0..3").is_within([&region(R, &[])]));
        assert!(region(D, &[]).is_within([&late(R, "0..3")]) && !region(D, &[]).is_within([&late(R, "1..3")]));
    }

    #[test]
    fn changes_within_an_episode_do_not_lead_around_a_region() {
        use Version::{E, R};
        let changing = |version, values: &[(&str, &str)]| {
            let Region(mut boxes) = region(version, &[]);
            for own in &mut boxes {
                own.extend(values.iter().map(|(name, values)| ((*name).to_owned(), values.parse().unwrap())));
            }
            Region(boxes)
        };
        let at_once = |at: &str| changing(R, &[("change_at", at), ("changed_mass", "0.2"), ("changed_length", "0.2")]);
        assert!(at_once("1").overlaps(&region(E, &[])) && region(E, &[]).overlaps(&at_once("0..1")));
        assert!(!at_once("0").overlaps(&region(E, &[])), "nothing changes");
        assert!(!at_once("1").is_within([&region(R, &[])]) && at_once("0").is_within([&region(R, &[])]));
        assert!(at_once("1").is_within([&region(R, &[]), &region(E, &[])]));
        let within = changing(R, &[("change_every", "9"), ("changed_mass", "1"), ("changed_length", "0.6..0.7")]);
        assert!(within.is_within([&region(R, &[])]) && !within.overlaps(&region(E, &[])));
    }

    #[test]
    fn regions_of_other_parameters_have_nothing_in_common() {
        let other = Region::new(vec![ParameterBox::from([("power".to_owned(), Distribution::fixed(1.0))])]);
        let r = region(Version::R, &[]);
        assert!(!other.is_within([&r]) && !r.overlaps(&other) && !r.is_within([]));
    }
}
