//! Finds the elements of a model by the names and patterns in a task's file.

use super::{
    error::{Result, escaped, listed},
    table::Value,
};
use perturb_mujoco::{ElementKind, Index, Model};
use perturb_protocol::names::did_you_mean;

/// The names of all elements of a model, by kind. An element without a name is called by its index, such as `#3`.
#[derive(Debug)]
pub(super) struct Elements {
    names: Vec<(ElementKind, Vec<String>)>,
}

const KINDS: [ElementKind; 10] = [
    ElementKind::Body,
    ElementKind::Joint,
    ElementKind::Geom,
    ElementKind::Site,
    ElementKind::Actuator,
    ElementKind::Sensor,
    ElementKind::Tendon,
    ElementKind::Pair,
    ElementKind::Camera,
    ElementKind::Keyframe,
];

impl Elements {
    pub(super) fn new(model: &Model) -> Self {
        let name = |kind, id| model.name(kind, id).map_or_else(|| format!("#{id}"), str::to_owned);
        let names = |kind| (0..model.count(kind)).map(|id| name(kind, id)).collect();
        Self { names: KINDS.map(|kind| (kind, names(kind))).into() }
    }

    /// The names of all elements of a kind, in the model's order.
    pub(super) fn names(&self, kind: ElementKind) -> &[String] {
        self.names.iter().find(|(known, _)| *known == kind).map_or(&[], |(_, names)| names)
    }

    /// The name of the element with this index.
    pub(super) fn name(&self, kind: ElementKind, id: usize) -> &str {
        self.names(kind).get(id).map_or("", String::as_str)
    }

    /// Returns the index of the element whose name is the text `value`.
    pub(super) fn find(&self, kind: ElementKind, value: &Value<'_>) -> Result<usize> {
        let name = value.text()?;
        self.names(kind).iter().position(|known| known == name).ok_or_else(|| self.unknown(kind, name, value))
    }

    /// Returns the indices of the elements that `value` names: a name, a pattern with `*` and `?`, or a list of names
    /// and patterns. The indices are in the order of the list, and within a pattern in the model's order. A pattern
    /// never matches the world body.
    pub(super) fn select(&self, kind: ElementKind, value: &Value<'_>) -> Result<Vec<usize>> {
        let mut selected = Vec::new();
        for pattern in value.texts()? {
            let names = self.names(kind).iter().enumerate();
            let is_pattern = pattern.contains(['*', '?']);
            let first = usize::from(is_pattern && kind == ElementKind::Body);
            let hits = names.skip(first).filter(|(_, name)| matches(pattern, name)).map(|(id, _)| id);
            let hits: Vec<usize> = hits.collect();
            if hits.is_empty() {
                return Err(self.unknown(kind, pattern, value));
            }
            if let Some(&twice) = hits.iter().find(|id| selected.contains(*id)) {
                let name = escaped(self.name(kind, twice));
                return Err(value.error(format_args!("{} {name:?} is named twice; name it once", kind.name())));
            }
            selected.extend(hits);
        }
        Ok(selected)
    }

    fn unknown(&self, kind: ElementKind, name: &str, value: &Value<'_>) -> super::error::Error {
        let names = self.names(kind).iter().map(String::as_str);
        let hint = did_you_mean(name, names.clone());
        let kind = kind.name();
        value.error(format_args!("the model has no {kind} {:?}{hint}; it has {}", escaped(name), listed(names)))
    }
}

/// Returns the name of an actuator. If the actuator has no name, returns the name of the joint that it drives.
pub(super) fn actuator_name(model: &Model, elements: &Elements, actuator: usize) -> String {
    let name = elements.name(ElementKind::Actuator, actuator);
    match actuated_joint(model, actuator) {
        Some(joint) if name.starts_with('#') => elements.name(ElementKind::Joint, joint).to_owned(),
        _ => name.to_owned(),
    }
}

/// Returns the index of the joint that an actuator drives; `None` if it drives another kind of element.
pub(super) fn actuated_joint(model: &Model, actuator: usize) -> Option<usize> {
    let drives_a_joint = matches!(model.index_array(Index::ActuatorTransmission)[actuator], 0 | 1);
    drives_a_joint.then(|| model.index_array(Index::ActuatorTarget)[2 * actuator] as usize)
}

/// Whether a name matches a pattern, in which `*` matches any text and `?` any single character.
fn matches(pattern: &str, name: &str) -> bool {
    let (pattern, name): (Vec<char>, Vec<char>) = (pattern.chars().collect(), name.chars().collect());
    let (mut p, mut n) = (0, 0);
    // The index in the pattern of the last star that was read, and the index in the name up to which that star matches.
    // After a mismatch, the star is extended by one more character.
    let mut star: Option<(usize, usize)> = None;
    while n < name.len() {
        match pattern.get(p) {
            Some('*') => {
                star = Some((p, n));
                p += 1;
            }
            Some(&c) if c == '?' || c == name[n] => {
                p += 1;
                n += 1;
            }
            _ => {
                let Some((at, met)) = star else { return false };
                star = Some((at, met + 1));
                p = at + 1;
                n = met + 1;
            }
        }
    }
    pattern[p..].iter().all(|&c| c == '*')
}

#[cfg(test)]
mod tests {
    use super::matches;

    #[test]
    fn patterns_match_whole_names() {
        for (pattern, name, fits) in [
            ("*", "", true),
            ("*", "foot", true),
            ("foot", "foot", true),
            ("foot", "foot_left", false),
            ("foot*", "foot_left", true),
            ("*_joint", "leg_left_joint", true),
            ("*_joint", "leg_left_joints", false),
            ("a*b*c", "axxbyybzc", true),
            ("a*b*c", "axxbyybz", false),
            ("hip_?", "hip_1", true),
            ("hip_?", "hip_10", false),
            ("?", "é", true),
        ] {
            assert_eq!(matches(pattern, name), fits, "{pattern} {name}");
        }
    }
}
