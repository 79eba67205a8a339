//! The terms of a task's reward.

use super::{
    elements::{Elements, actuated_joint},
    error::{Result, escaped},
    number::{Stage, StepActions, scaled},
    reading::Reading,
    rules::leaked,
    table::{TomlTable, Value},
};
use crate::env::RewardTermSpec;
use perturb_mujoco::{ElementKind, Flags, Index, Model, Simulation};

/// The keys of a term that say what kind it is. Each term has exactly one of them.
pub(super) const KINDS: [&str; 10] =
    ["value", "rate", "squared", "norm", "within", "near", "power", "limits", "healthy", "constant"];
/// The other keys of a term.
pub(super) const OPTIONS: [&str; 12] = [
    "name",
    "description",
    "weight",
    "mean",
    "target",
    "at_least",
    "at_most",
    "range",
    "margin",
    "shape",
    "sigma",
    "otherwise",
];
/// Maximal absolute value of a term. An action may have any f32 value, and the reward may contain the action's square,
/// but must still be finite.
const MAX_TERM: f64 = 1e30;
/// The natural logarithm of 0.1.
const LN_0_1: f64 = -std::f64::consts::LN_10;
/// Absolute scaled position above which a joint counts as at its limit. The joint's range is scaled to ±1.
const AT_LIMIT: f64 = 0.99;

/// A term of the reward.
#[derive(Debug, Clone)]
pub(super) struct Term {
    pub(super) about: RewardTermSpec,
    kind: TermKind,
    weight: f64,
    mean: bool,
    target: Vec<f64>,
    at_least: Option<f64>,
    at_most: Option<f64>,
}

#[derive(Debug, Clone)]
enum TermKind {
    Value(Reading),
    /// The change of a reading per second: (reading, index of its first number in [`StepValues::before`]).
    Rate(Reading, usize),
    Squared(Reading),
    Norm(Reading),
    Within {
        reading: Reading,
        low: f64,
        high: f64,
        margin: f64,
        shape: MarginShape,
    },
    Near {
        reading: Reading,
        sigma: f64,
    },
    /// The product |action × joint velocity| of each actuator: (actuator, index of its joint in `qvel`).
    Power(Vec<(usize, usize)>),
    /// The number of joints at a limit: (joint, index in `qpos`).
    Limits(Vec<(usize, usize)>),
    Healthy {
        otherwise: f64,
    },
    Constant,
}

/// The function by which [`TermKind::Within`] decreases with the distance from the range.
#[derive(Debug, Clone, Copy)]
enum MarginShape {
    /// A linear decrease from 1 at the range to 0 at the margin. Beyond the margin the value is 0.
    Linear,
    /// The function exp(ln(0.1) × (distance / margin)²), as in dm_control's `tolerance`. The value is 0.1 at the
    /// margin.
    Gaussian,
}

/// The values of a step that terms use in addition to the simulation.
pub(super) struct StepValues<'a> {
    pub(super) context: StepActions<'a>,
    pub(super) healthy: bool,
    /// The simulated time of a step, in s.
    pub(super) seconds: f64,
    /// The numbers that terms need from the previous step, in the order of the terms. In the first step they are those
    /// of the initial state. [`Term::remembered`] returns the reading by which a term reads its numbers.
    pub(super) before: &'a [f64],
}

impl Term {
    /// Reads a term from its TOML table. `n_remembered` is the total number of values that earlier terms remember.
    pub(super) fn new(table: &TomlTable<'_>, model: &Model, elements: &Elements, n_remembered: usize) -> Result<Self> {
        let name = table.require("name", "\"forward\"")?;
        let name = identifier(&name, name.text()?)?;
        let table = &table.clone().at(format!("reward {name}"));
        table.only(&[&KINDS[..], &OPTIONS].concat())?;
        let (key, value) = table.one_of(&KINDS)?;
        let reading = || Reading::new(&value.table()?, model, elements);
        // Options that do not fit the kind of term are refused.
        for (option, kinds) in [
            ("target", &["squared", "norm", "near"][..]),
            ("range", &["within"]),
            ("margin", &["within"]),
            ("shape", &["within"]),
            ("sigma", &["near"]),
            ("otherwise", &["healthy"]),
            ("mean", &["value", "rate", "squared", "power", "limits"]),
        ] {
            if let Some(value) = table.get(option).filter(|_| !kinds.contains(&key)) {
                return Err(value.error(format_args!("{option} goes with {}, not with {key}", kinds.join(", "))));
            }
        }
        // The kinds `healthy` and `constant` have their value in place of a weight.
        let mut weight = table.number("weight")?;
        let kind = match key {
            "value" => TermKind::Value(reading()?),
            "rate" => TermKind::Rate(reading()?, n_remembered),
            "squared" => TermKind::Squared(reading()?),
            "norm" => TermKind::Norm(reading()?),
            "within" => {
                let (low, high) = table.require("range", "[0.0, 1.0]")?.interval()?;
                let margin = table.number("margin")?.unwrap_or(0.0);
                if margin < 0.0 {
                    return Err(table.error(format_args!("margin is {margin}; expected 0 or more")));
                }
                let shape = match table.get("shape").map(|value| Ok((value.text()?, value))).transpose()? {
                    None | Some(("linear", _)) => MarginShape::Linear,
                    Some(("gaussian", _)) => MarginShape::Gaussian,
                    Some((other, value)) => {
                        let problem =
                            format!("{:?} is not a shape; expected \"linear\" or \"gaussian\"", escaped(other));
                        return Err(value.error(problem));
                    }
                };
                TermKind::Within { reading: reading()?, low, high, margin, shape }
            }
            "near" => {
                let sigma = table.require("sigma", "0.1")?;
                let width = sigma.number()?;
                if width <= 0.0 {
                    return Err(sigma.error(format_args!("{width} is not above 0")));
                }
                TermKind::Near { reading: reading()?, sigma: width }
            }
            "power" => TermKind::Power(power(&value, model, elements)?),
            "limits" => TermKind::Limits(limits(&value, model, elements)?),
            "healthy" | "constant" => {
                if let Some(value) = table.get("weight") {
                    return Err(value.error(format_args!("{key} is the term's value itself; leave weight out")));
                }
                weight = Some(value.number()?);
                if key == "healthy" {
                    TermKind::Healthy { otherwise: table.number("otherwise")?.unwrap_or(0.0) }
                } else {
                    TermKind::Constant
                }
            }
            _ => return Err(value.error("this kind of term is unknown")),
        };
        let weight = weight.unwrap_or(1.0);
        let mut term = Self {
            about: RewardTermSpec { name: leaked(name), description: "" },
            target: target(table, kind.reading())?,
            kind,
            weight,
            mean: table.flag("mean")?.unwrap_or(false),
            at_least: table.number("at_least")?,
            at_most: table.number("at_most")?,
        };
        // The limits hold for the absolute value, so they must not be negative.
        for (key, limit) in [("at_least", term.at_least), ("at_most", term.at_most)] {
            if let Some(limit) = limit.filter(|&limit| limit < 0.0) {
                return Err(
                    table.error(format_args!("{key} is {limit}; it limits the term's absolute value: give 0 or more"))
                );
            }
        }
        if let (Some(least), Some(most)) = (term.at_least, term.at_most)
            && least > most
        {
            return Err(table.error(format_args!("at_least {least} is above at_most {most}")));
        }
        term.about.description = match table.text("description")? {
            Some(description) => leaked(description),
            None => leaked(&term.formula(key)),
        };
        Ok(term)
    }

    /// Returns the term's formula as text, the default of its description.
    fn formula(&self, key: &str) -> String {
        let names = self.kind.reading().map_or_else(String::new, |reading| {
            let channels: Vec<&str> = reading.entries().iter().map(|entry| entry.channel.as_str()).collect();
            match channels[..] {
                [one] => one.to_owned(),
                [first, .., last] => format!("{first} … {last}"),
                [] => String::new(),
            }
        });
        let weight = self.weight;
        let target = match self.target[..] {
            [] => String::new(),
            [target] => format!(" less {target}"),
            _ => " less its target".into(),
        };
        let sum = if self.mean { "mean" } else { "sum" };
        match &self.kind {
            TermKind::Value(_) => format!("{weight} × {sum} of {names}"),
            TermKind::Rate(..) => format!("{weight} × change of {names} per second"),
            TermKind::Squared(_) => format!("{weight} × {sum} of squares of {names}{target}"),
            TermKind::Norm(_) => format!("{weight} × length of {names}{target}"),
            TermKind::Within { low, high, margin, shape, .. } => {
                let outside = match shape {
                    _ if *margin == 0.0 => String::new(),
                    MarginShape::Linear => {
                        format!(", decreasing linearly to 0 at a distance of {margin} from this range")
                    }
                    MarginShape::Gaussian => {
                        format!(", decreasing as a Gaussian to a tenth at a distance of {margin} from this range")
                    }
                };
                format!("{weight} while {names} is within [{low}, {high}]{outside}")
            }
            TermKind::Near { sigma, .. } => format!("{weight} × exp(-|{names}{target}|² / {sigma}²)"),
            TermKind::Power(_) => format!("{weight} × {sum} of |action × joint velocity|"),
            TermKind::Limits(_) => format!("{weight} × {sum} of joints beyond 99 % of their range"),
            TermKind::Healthy { otherwise } => format!("{weight} while healthy, else {otherwise}"),
            TermKind::Constant => format!("{weight} ({key})"),
        }
    }

    /// Returns the reading whose numbers the term needs from the previous step; `None` if it needs none.
    pub(super) fn remembered(&self) -> Option<&Reading> {
        match &self.kind {
            TermKind::Rate(reading, _) => Some(reading),
            _ => None,
        }
    }

    /// Returns the computation that MuJoCo must do before the term can be computed.
    pub(super) fn stage(&self) -> Stage {
        self.kind.reading().map_or(Stage::State, Reading::stage)
    }

    /// Whether the term reads external forces on bodies, which MuJoCo does not compute by default.
    pub(super) fn needs_external_forces(&self) -> bool {
        self.kind.reading().is_some_and(Reading::needs_external_forces)
    }

    /// Computes the term after a step. `numbers` is a buffer that is overwritten.
    pub(super) fn compute(&self, simulation: &Simulation, step: &StepValues<'_>, numbers: &mut Vec<f64>) -> f64 {
        numbers.clear();
        if let Some(reading) = self.kind.reading() {
            reading.read(simulation, &step.context, numbers);
        }
        let value = match &self.kind {
            TermKind::Value(_) => self.total(numbers.iter().copied()),
            TermKind::Rate(reading, first) => {
                let before = &step.before[*first..first + reading.len()];
                self.total(numbers.iter().zip(before).map(|(now, before)| (now - before) / step.seconds))
            }
            TermKind::Squared(_) => self.total(self.differences(numbers).map(|x| x * x)),
            TermKind::Norm(_) => self.differences(numbers).map(|x| x * x).sum::<f64>().sqrt(),
            TermKind::Within { low, high, margin, shape, .. } => {
                let outside = numbers.iter().map(|&x| (low - x).max(x - high).max(0.0)).fold(0.0, f64::max);
                match shape {
                    _ if outside == 0.0 => 1.0,
                    _ if *margin == 0.0 => 0.0,
                    MarginShape::Linear => (1.0 - outside / margin).max(0.0),
                    MarginShape::Gaussian => libm::exp(LN_0_1 * (outside / margin) * (outside / margin)),
                }
            }
            TermKind::Near { sigma, .. } => {
                libm::exp(-self.differences(numbers).map(|x| x * x).sum::<f64>() / (sigma * sigma))
            }
            TermKind::Power(joints) => {
                let qvel = simulation.qvel();
                let action = step.context.action;
                self.total(joints.iter().map(|&(actuator, dof)| (f64::from(action[actuator]) * qvel[dof]).abs()))
            }
            TermKind::Limits(joints) => {
                let (model, qpos) = (simulation.model(), simulation.qpos());
                let beyond = |&(joint, at): &(usize, usize)| scaled(model, joint, qpos[at]).abs() > AT_LIMIT;
                self.total(joints.iter().map(|joint| f64::from(u8::from(beyond(joint)))))
            }
            TermKind::Healthy { otherwise } => return if step.healthy { self.weight } else { *otherwise },
            TermKind::Constant => 1.0,
        };
        self.limited(self.weight * value)
    }

    /// Returns the term's value in a step whose physics diverged.
    pub(super) fn diverged(&self) -> f64 {
        match self.kind {
            TermKind::Healthy { otherwise } => otherwise,
            _ => 0.0,
        }
    }

    /// Returns the sum of the numbers, or their mean if the term has `mean`.
    fn total(&self, numbers: impl ExactSizeIterator<Item = f64>) -> f64 {
        let n = numbers.len() as f64;
        let sum: f64 = numbers.sum();
        if self.mean { sum / n } else { sum }
    }

    /// Returns the numbers minus the term's target.
    fn differences<'a>(&'a self, numbers: &'a [f64]) -> impl ExactSizeIterator<Item = f64> + 'a {
        let target = |i: usize| self.target.get(i).or(self.target.first()).copied().unwrap_or(0.0);
        numbers.iter().enumerate().map(move |(i, x)| x - target(i))
    }

    /// Limits the absolute value to `at_least` … `at_most`.
    fn limited(&self, value: f64) -> f64 {
        let (least, most) = (self.at_least.unwrap_or(0.0), self.at_most.unwrap_or(MAX_TERM).min(MAX_TERM));
        if value.is_nan() { value } else { value.signum() * value.abs().min(most).max(least) }
    }
}

impl TermKind {
    fn reading(&self) -> Option<&Reading> {
        match self {
            Self::Value(reading)
            | Self::Rate(reading, _)
            | Self::Squared(reading)
            | Self::Norm(reading)
            | Self::Within { reading, .. }
            | Self::Near { reading, .. } => Some(reading),
            Self::Power(_) | Self::Limits(_) | Self::Healthy { .. } | Self::Constant => None,
        }
    }
}

/// Reads the key `target`: one number for all numbers of the reading, or a list with a number for each.
fn target(table: &TomlTable<'_>, reading: Option<&Reading>) -> Result<Vec<f64>> {
    let Some(value) = table.get("target") else { return Ok(Vec::new()) };
    if !value.is_list() {
        return Ok(vec![value.number()?]);
    }
    let (target, n) = (value.numbers()?, reading.map_or(0, Reading::len));
    if target.len() == n {
        Ok(target)
    } else {
        Err(value.error(format_args!(
            "the target has {} numbers, but {n} are read; give one, or one for each",
            target.len()
        )))
    }
}

/// Reads the actuators of a table such as `{ actuator = "*" }`. Each must drive a hinge or slide. Returns for each
/// actuator its index, and the index of its joint in `qvel`.
fn power(value: &Value<'_>, model: &Model, elements: &Elements) -> Result<Vec<(usize, usize)>> {
    let table = value.table()?;
    table.only(&["actuator"])?;
    let actuators = elements.select(ElementKind::Actuator, &table.require("actuator", "\"*\"")?)?;
    let place = |actuator| {
        let joint = actuated_joint(model, actuator).filter(|&joint| model.index_array(Index::JointType)[joint] > 1);
        let joint = joint.ok_or_else(|| {
            let name = escaped(elements.name(ElementKind::Actuator, actuator));
            value.error(format_args!("actuator {name:?} does not drive a hinge or slide; name those that do"))
        })?;
        Ok((actuator, model.index_array(Index::JointVelocity)[joint] as usize))
    };
    actuators.into_iter().map(place).collect()
}

/// Reads the joints of a table such as `{ joint = "*" }`. Skips joints other than hinges and slides with a range.
/// Returns for each joint its index in the model, and its index in `qpos`.
fn limits(value: &Value<'_>, model: &Model, elements: &Elements) -> Result<Vec<(usize, usize)>> {
    let table = value.table()?;
    table.only(&["joint"])?;
    let joints = elements.select(ElementKind::Joint, &table.require("joint", "\"*\"")?)?;
    let limited =
        |&joint: &usize| model.flags(Flags::JointLimited)[joint] != 0 && model.index_array(Index::JointType)[joint] > 1;
    let places: Vec<(usize, usize)> = joints
        .into_iter()
        .filter(limited)
        .map(|joint| (joint, model.index_array(Index::JointPosition)[joint] as usize))
        .collect();
    if places.is_empty() {
        Err(value.error("none of these joints is a hinge or slide with a range"))
    } else {
        Ok(places)
    }
}

/// Checks the name of a term, parameter or quantity: a letter, then letters, digits and underscores, at most 64 in all.
pub(super) fn identifier<'a>(value: &Value<'_>, name: &'a str) -> Result<&'a str> {
    const MAX_CHARS: usize = 64;
    let starts = name.starts_with(|c: char| c.is_ascii_alphabetic());
    let plain = name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    if starts && plain && name.len() <= MAX_CHARS {
        return Ok(name);
    }
    let problem = "is not a valid name; expected a letter, then letters, digits and underscores, at most 64 characters";
    Err(value.error(format_args!("{:?} {problem}", escaped(name))))
}
