//! The numbers that a task can read from a simulation, and how each is computed.

use perturb_mujoco::{DataField as Array, Model, ModelField, Simulation};

/// The computation that MuJoCo must do before a number can be read. Each stage includes the previous one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Stage {
    /// No computation: positions, velocities and actions are always known.
    State,
    /// The computation of poses and velocities of bodies.
    Motion,
    /// The computation of contacts, forces and sensors.
    Forward,
}

/// A number that a task reads from a simulation, or from the action.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Number {
    /// Consecutive numbers of an array: (array, index of the first number, count).
    Array(Array, usize, usize),
    /// The sine of the entry of `qpos` with this index.
    Sin(usize),
    /// The cosine of the entry of `qpos` with this index.
    Cos(usize),
    /// A joint's position, scaled so that its range becomes ±1: (joint, index in `qpos`).
    Scaled(usize, usize),
    /// A component of a body's velocity at its centre of mass: (body, component). Components 0 to 2 are angular, 3 to 5
    /// linear.
    BodyVelocity(usize, usize),
    /// An angle of a body's orientation: (body, angle). Angle 0 is roll, 1 pitch, 2 yaw.
    Angle(usize, usize),
    /// 1 if the geom with this index touches another geom, otherwise 0.
    Touching(usize),
    /// A coordinate of the common centre of mass of several bodies: (bodies, axis).
    Centre(Vec<usize>, usize),
    /// A component of the vector from one point to another: (from, to, axis).
    Between(PointSource, PointSource, usize),
    /// The distance between two points.
    Distance(PointSource, PointSource),
    /// An entry of the action, as it was received.
    Action(usize),
    /// An entry of the previous step's action.
    PreviousAction(usize),
    Constant(f64),
    /// The simulated time since the reset, in s.
    Time,
}

/// A point whose position MuJoCo computes: of a body, a site or a geom.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PointSource {
    pub(super) array: Array,
    pub(super) id: usize,
}

/// The description of a number: its names, unit and range.
#[derive(Debug, Clone)]
pub(super) struct NumberDescription {
    /// The name in `task.toml`, such as `root.x`, by which the keys `without` and `axes` select it.
    pub(super) name: String,
    /// The name of the model element alone, such as `root`.
    pub(super) element: String,
    /// The kind of element. It distinguishes elements of different kinds with the same name.
    pub(super) kind: &'static str,
    /// The name as an entry of the observation.
    pub(super) channel: String,
    pub(super) unit: &'static str,
    pub(super) low: f64,
    pub(super) high: f64,
}

/// The actions that numbers may read in addition to the simulation.
pub(super) struct StepActions<'a> {
    /// The action of the step, as it was received.
    pub(super) action: &'a [f32],
    /// The action of the previous step; zeros after a reset.
    pub(super) previous_action: &'a [f32],
}

/// Returns the channel names of numbers, made unique by prefixes and suffixes where necessary.
pub(super) fn unique_channels<'a>(entries: impl Iterator<Item = &'a NumberDescription>) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    let mut taken = std::collections::BTreeSet::new();
    for entry in entries {
        let mut name = entry.channel.clone();
        if taken.contains(&name) {
            name = format!("{}_{name}", entry.kind);
        }
        let base = name.clone();
        let mut number = 2;
        while !taken.insert(name.clone()) {
            name = format!("{base}_{number}");
            number += 1;
        }
        names.push(name);
    }
    names
}

/// Creates the description of a number without bounds. Its name is `element.part`, or `element` if `part` is empty. Its
/// channel name is made from the text `channel`.
pub(super) fn entry(element: &str, part: &str, channel: String, unit: &'static str) -> NumberDescription {
    let name = if part.is_empty() { element.to_owned() } else { format!("{element}.{part}") };
    NumberDescription {
        name,
        element: element.to_owned(),
        kind: "",
        channel: channel_name(&channel),
        unit,
        low: f64::NEG_INFINITY,
        high: f64::INFINITY,
    }
}

/// Converts a text to a channel name: replaces all characters except letters, digits and `#` by underscores.
pub(super) fn channel_name(text: &str) -> String {
    text.chars().map(|c| if c.is_alphanumeric() || c == '#' { c } else { '_' }).collect()
}

impl Number {
    /// Returns the computation that MuJoCo must do before the number can be read.
    pub(super) fn stage(&self) -> Stage {
        use Array::{
            Activations, BodyCentres, BodyInertias, BodyPositions, BodyRotations, BodyVelocities, Controls,
            GeomPositions, Positions, SitePositions, Velocities,
        };
        match self {
            Self::Array(Positions | Velocities | Controls | Activations, ..)
            | Self::Sin(_)
            | Self::Cos(_)
            | Self::Scaled(..)
            | Self::Action(_)
            | Self::PreviousAction(_)
            | Self::Constant(_)
            | Self::Time => Stage::State,
            Self::Array(
                BodyPositions | BodyRotations | BodyCentres | BodyInertias | BodyVelocities | GeomPositions
                | SitePositions,
                ..,
            )
            | Self::BodyVelocity(..)
            | Self::Angle(..)
            | Self::Centre(..)
            | Self::Between(..)
            | Self::Distance(..) => Stage::Motion,
            Self::Array(..) | Self::Touching(_) => Stage::Forward,
        }
    }

    /// Appends the number, or the numbers of an array, to `out`.
    pub(super) fn read(&self, simulation: &Simulation, context: &StepActions<'_>, out: &mut Vec<f64>) {
        let value = match self {
            Self::Array(array, first, length) => {
                out.extend_from_slice(&simulation.reading(*array)[*first..first + length]);
                return;
            }
            Self::Sin(at) => libm::sin(simulation.qpos()[*at]),
            Self::Cos(at) => libm::cos(simulation.qpos()[*at]),
            Self::Scaled(joint, at) => scaled(simulation.model(), *joint, simulation.qpos()[*at]),
            Self::BodyVelocity(body, i) => simulation.body_velocity(*body)[*i],
            Self::Angle(body, which) => {
                let m = simulation.xmat(*body);
                match which {
                    0 => libm::atan2(m[7], m[8]),
                    1 => libm::asin((-m[6]).clamp(-1.0, 1.0)),
                    _ => libm::atan2(m[3], m[0]),
                }
            }
            Self::Touching(geom) => f64::from(u8::from(simulation.contacts().any(|(a, b)| a == *geom || b == *geom))),
            Self::Centre(bodies, axis) => {
                let (mass, centres) = (simulation.model().body_mass(), simulation.reading(Array::BodyCentres));
                let weighted: f64 = bodies.iter().map(|&body| mass[body] * centres[3 * body + axis]).sum();
                weighted / bodies.iter().map(|&body| mass[body]).sum::<f64>()
            }
            Self::Between(from, to, axis) => to.read(simulation)[*axis] - from.read(simulation)[*axis],
            Self::Distance(from, to) => {
                let (from, to) = (from.read(simulation), to.read(simulation));
                (0..3).map(|i| (to[i] - from[i]) * (to[i] - from[i])).sum::<f64>().sqrt()
            }
            Self::Action(at) => f64::from(context.action[*at]),
            Self::PreviousAction(at) => f64::from(context.previous_action[*at]),
            Self::Constant(value) => *value,
            Self::Time => simulation.time(),
        };
        out.push(value);
    }
}

impl PointSource {
    fn read(self, simulation: &Simulation) -> &[f64] {
        &simulation.reading(self.array)[3 * self.id..][..3]
    }
}

/// Scales a joint's position so that its range becomes ±1.
pub(super) fn scaled(model: &Model, joint: usize, position: f64) -> f64 {
    let range = &model.field(ModelField::JointRange)[2 * joint..][..2];
    2.0 * (position - (range[0] + range[1]) / 2.0) / (range[1] - range[0])
}
