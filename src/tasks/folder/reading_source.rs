//! Finds the numbers of the simulation that the TOML description of a reading selects.

use super::{
    elements::{Elements, actuator_name},
    error::{Result, escaped},
    number::{Number, NumberDescription, PointSource, entry},
    table::{TomlTable, Value},
};
use perturb_mujoco::{DataField as Array, ElementKind, Flags, Index, Model, ModelField};

/// The allowed values of the key `get` for a joint. The constants below list the allowed values for other kinds of
/// elements.
const OF_A_JOINT: &[&str] = &["position", "velocity", "sin", "cos", "scaled", "actuation", "constraint"];
const OF_A_BODY: &[&str] = &[
    "position",
    "com",
    "velocity",
    "angular_velocity",
    "roll",
    "pitch",
    "yaw",
    "up",
    "contact_force",
    "spatial_inertia",
    "spatial_velocity",
];
const OF_A_SITE: &[&str] = &["position"];
const OF_A_GEOM: &[&str] = &["position", "touching"];
const OF_AN_ACTUATOR: &[&str] = &["control", "force", "activation"];
const OF_TWO_POINTS: &[&str] = &["vector", "distance"];

/// The TOML table of a reading, and the model to whose elements the table refers.
pub(super) struct Source<'a> {
    pub(super) table: &'a TomlTable<'a>,
    pub(super) model: &'a Model,
    pub(super) elements: &'a Elements,
}

/// Numbers with their names, units and ranges.
pub(super) type Numbers = Vec<(Number, NumberDescription)>;

const AXES: [&str; 3] = ["x", "y", "z"];
const FREE_POSITION: [&str; 7] = ["x", "y", "z", "qw", "qx", "qy", "qz"];
const FREE_VELOCITY: [&str; 6] = ["vx", "vy", "vz", "wx", "wy", "wz"];
const SPATIAL: [&str; 6] = ["rx", "ry", "rz", "tx", "ty", "tz"];
const INERTIA: [&str; 10] = ["xx", "yy", "zz", "xy", "xz", "yz", "mx", "my", "mz", "m"];

/// MuJoCo's number of the joint type `free`.
const FREE: i32 = 0;
/// MuJoCo's number of the joint type `ball`.
const BALL: i32 = 1;
/// MuJoCo's number of the joint type `slide`.
const SLIDE: i32 = 2;

impl Source<'_> {
    /// Returns the numbers that a key such as `joint` selects by its `value`.
    pub(super) fn numbers(&self, subject: &str, value: &Value<'_>) -> Result<Numbers> {
        match subject {
            "joint" => self.joints(value),
            "body" => self.bodies(value),
            "site" => self.points(ElementKind::Site, value),
            "geom" => self.points(ElementKind::Geom, value),
            "com" => self.centre(value),
            "from" => self.between(value),
            "sensor" => self.sensors(value),
            "actuator" => self.actuators(value),
            "action" => self.actions(value, false),
            "previous_action" => self.actions(value, true),
            "constant" => Ok(vec![(Number::Constant(value.number()?), entry("constant", "", "constant".into(), "1"))]),
            _ => Ok(vec![(Number::Time, entry("time", "", "time".into(), "s"))]),
        }
    }

    /// Returns the value of the key `get`, which must be in `known`. Without the key returns `default`, if there is
    /// one.
    fn get(&self, subject: &str, known: &[&'static str], default: Option<&'static str>) -> Result<&'static str> {
        let Some(value) = self.table.get("get") else {
            let problem =
                || self.table.error(format_args!("get is missing; of a {subject} there are {}", known.join(", ")));
            return default.ok_or_else(problem);
        };
        let text = value.text()?;
        let found = known.iter().find(|&&get| get == text);
        found.copied().ok_or_else(|| {
            value.error(format_args!("{:?} is unknown; of a {subject} there are {}", escaped(text), known.join(", ")))
        })
    }

    /// Refuses the key `get`. Call this method for subjects that have only one quantity.
    fn no_get(&self, subject: &str) -> Result<()> {
        match self.table.get("get") {
            None => Ok(()),
            Some(value) => Err(value.error(format_args!("a reading of {subject} has no get; leave it out"))),
        }
    }

    fn joints(&self, value: &Value<'_>) -> Result<Numbers> {
        let get = self.get("joint", OF_A_JOINT, None)?;
        let (model, mut joints) = (self.model, self.elements.select(ElementKind::Joint, value)?);
        if let Some(without) = self.table.get("without") {
            let names = without.texts()?;
            joints.retain(|&joint| !names.contains(&self.elements.name(ElementKind::Joint, joint)));
        }
        let mut numbers = Numbers::new();
        for joint in joints {
            let name = self.elements.name(ElementKind::Joint, joint);
            let kind = model.index_array(Index::JointType)[joint];
            let position = model.index_array(Index::JointPosition)[joint] as usize;
            let velocity = model.index_array(Index::JointVelocity)[joint] as usize;
            let positions: &[&str] = match kind {
                FREE => &FREE_POSITION,
                BALL => &FREE_POSITION[3..],
                _ => &[""],
            };
            let velocities: &[&str] = match kind {
                FREE => &FREE_VELOCITY,
                BALL => &FREE_VELOCITY[3..],
                _ => &[""],
            };
            // A free or ball joint has several positions and several velocities, and each of them has a name. Other
            // joints have one position and one velocity, without names.
            let (parts, first) = if get == "position" { (positions, position) } else { (velocities, velocity) };
            if matches!(get, "sin" | "cos" | "scaled") && parts.len() > 1 {
                let problem =
                    format!("joint {:?} has more than one position, of which there is no {get}", escaped(name));
                return Err(value.error(problem));
            }
            if get == "scaled" && model.flags(Flags::JointLimited)[joint] == 0 {
                let problem = format!("joint {:?} has no range to be scaled; read its position", escaped(name));
                return Err(value.error(problem));
            }
            for (i, part) in parts.iter().enumerate() {
                let at = first + i;
                let number = match get {
                    "position" => Number::Array(Array::Positions, at, 1),
                    "velocity" => Number::Array(Array::Velocities, at, 1),
                    "sin" => Number::Sin(position),
                    "cos" => Number::Cos(position),
                    "scaled" => Number::Scaled(joint, position),
                    "actuation" => Number::Array(Array::DofActuation, at, 1),
                    _ => Number::Array(Array::DofConstraint, at, 1),
                };
                let suffix = match (get, part.is_empty()) {
                    ("position", true) => String::new(),
                    ("position", false) | ("velocity", false) => format!("_{part}"),
                    (_, true) => format!("_{get}"),
                    (_, false) => format!("_{part}_{get}"),
                };
                let mut entry = entry(name, part, format!("{name}{suffix}"), joint_unit(get, kind, part));
                if matches!(get, "sin" | "cos") {
                    (entry.low, entry.high) = (-1.0, 1.0);
                }
                entry.kind = "joint";
                numbers.push((number, entry));
            }
        }
        Ok(numbers)
    }

    fn bodies(&self, value: &Value<'_>) -> Result<Numbers> {
        let get = self.get("body", OF_A_BODY, None)?;
        let mut numbers = Numbers::new();
        for body in self.elements.select(ElementKind::Body, value)? {
            let name = self.elements.name(ElementKind::Body, body);
            let mut push = |number, part: &str, suffix: String, unit| {
                let mut entry = entry(name, part, format!("{name}_{suffix}"), unit);
                entry.kind = "body";
                numbers.push((number, entry));
            };
            let array = |array, width: usize, i: usize| Number::Array(array, width * body + i, 1);
            match get {
                "position" => AXES.iter().enumerate().for_each(|(i, axis)| {
                    push(array(Array::BodyPositions, 3, i), axis, (*axis).into(), "m");
                }),
                "com" => AXES.iter().enumerate().for_each(|(i, axis)| {
                    push(array(Array::BodyCentres, 3, i), axis, format!("com_{axis}"), "m");
                }),
                "velocity" => AXES.iter().enumerate().for_each(|(i, axis)| {
                    push(Number::BodyVelocity(body, 3 + i), axis, format!("velocity_{axis}"), "m/s");
                }),
                "angular_velocity" => AXES.iter().enumerate().for_each(|(i, axis)| {
                    push(Number::BodyVelocity(body, i), axis, format!("angular_velocity_{axis}"), "rad/s");
                }),
                "roll" => push(Number::Angle(body, 0), "", "roll".into(), "rad"),
                "pitch" => push(Number::Angle(body, 1), "", "pitch".into(), "rad"),
                "yaw" => push(Number::Angle(body, 2), "", "yaw".into(), "rad"),
                "up" => push(array(Array::BodyRotations, 9, 8), "", "up".into(), "1"),
                "contact_force" => SPATIAL.iter().enumerate().for_each(|(i, part)| {
                    let unit = if i < 3 { "N m" } else { "N" };
                    push(array(Array::BodyExternalForces, 6, i), part, format!("contact_force_{part}"), unit);
                }),
                "spatial_inertia" => INERTIA.iter().enumerate().for_each(|(i, part)| {
                    let unit = ["kg m²", "kg m", "kg"][usize::from(i >= 6) + usize::from(i == 9)];
                    push(array(Array::BodyInertias, 10, i), part, format!("spatial_inertia_{part}"), unit);
                }),
                _ => SPATIAL.iter().enumerate().for_each(|(i, part)| {
                    let unit = if i < 3 { "rad/s" } else { "m/s" };
                    push(array(Array::BodyVelocities, 6, i), part, format!("spatial_velocity_{part}"), unit);
                }),
            }
        }
        Ok(numbers)
    }

    fn points(&self, kind: ElementKind, value: &Value<'_>) -> Result<Numbers> {
        let known = if kind == ElementKind::Site { OF_A_SITE } else { OF_A_GEOM };
        let get = self.get(kind.name(), known, None)?;
        let array = if kind == ElementKind::Site { Array::SitePositions } else { Array::GeomPositions };
        let mut numbers = Numbers::new();
        for id in self.elements.select(kind, value)? {
            let name = self.elements.name(kind, id);
            if get == "touching" {
                let mut entry = entry(name, "", format!("{name}_touching"), "1");
                (entry.low, entry.high, entry.kind) = (0.0, 1.0, kind.name());
                numbers.push((Number::Touching(id), entry));
                continue;
            }
            for (i, axis) in AXES.iter().enumerate() {
                let mut entry = entry(name, axis, format!("{name}_{axis}"), "m");
                entry.kind = kind.name();
                numbers.push((Number::Array(array, 3 * id + i, 1), entry));
            }
        }
        Ok(numbers)
    }

    fn centre(&self, value: &Value<'_>) -> Result<Numbers> {
        self.no_get("com")?;
        let bodies = self.elements.select(ElementKind::Body, value)?;
        let mass: f64 = bodies.iter().map(|&body| self.model.field(ModelField::BodyMass)[body]).sum();
        if mass <= 0.0 {
            return Err(value.error("these bodies have no mass, so they have no centre of mass"));
        }
        let number = |(i, axis): (usize, &&str)| {
            (Number::Centre(bodies.clone(), i), entry("com", axis, format!("com_{axis}"), "m"))
        };
        Ok(AXES.iter().enumerate().map(number).collect())
    }

    fn between(&self, value: &Value<'_>) -> Result<Numbers> {
        let get = self.get("pair of points", OF_TWO_POINTS, Some("vector"))?;
        let to = self.table.require("to", "{ body = \"target\" }")?;
        let (from, to) = (self.point(value)?, self.point(&to)?);
        if get == "distance" {
            let mut entry = entry("distance", "", "distance".into(), "m");
            entry.low = 0.0;
            return Ok(vec![(Number::Distance(from, to), entry)]);
        }
        let number = |(i, axis): (usize, &&str)| {
            (Number::Between(from, to, i), entry("vector", axis, format!("vector_{axis}"), "m"))
        };
        Ok(AXES.iter().enumerate().map(number).collect())
    }

    /// Reads a point, written for instance `{ body = "name" }`.
    fn point(&self, value: &Value<'_>) -> Result<PointSource> {
        let table = value.table()?;
        table.only(&["body", "site", "geom"])?;
        let (kind, name) = table.one_of(&["body", "site", "geom"])?;
        let (kind, array) = match kind {
            "body" => (ElementKind::Body, Array::BodyPositions),
            "site" => (ElementKind::Site, Array::SitePositions),
            _ => (ElementKind::Geom, Array::GeomPositions),
        };
        Ok(PointSource { array, id: self.elements.find(kind, &name)? })
    }

    fn sensors(&self, value: &Value<'_>) -> Result<Numbers> {
        self.no_get("a sensor")?;
        let mut numbers = Numbers::new();
        for sensor in self.elements.select(ElementKind::Sensor, value)? {
            let name = self.elements.name(ElementKind::Sensor, sensor);
            let first = self.model.index_array(Index::SensorAddress)[sensor] as usize;
            let length = self.model.index_array(Index::SensorDimension)[sensor] as usize;
            for i in 0..length {
                let part = if length == 1 { String::new() } else { i.to_string() };
                let channel = if length == 1 { name.to_owned() } else { format!("{name}_{i}") };
                let mut entry = entry(name, &part, channel, "1");
                entry.kind = "sensor";
                numbers.push((Number::Array(Array::Sensors, first + i, 1), entry));
            }
        }
        Ok(numbers)
    }

    fn actuators(&self, value: &Value<'_>) -> Result<Numbers> {
        let get = self.get("actuator", OF_AN_ACTUATOR, None)?;
        let model = self.model;
        let mut numbers = Numbers::new();
        for actuator in self.elements.select(ElementKind::Actuator, value)? {
            let name = actuator_name(model, self.elements, actuator);
            let number = match get {
                "control" => Number::Array(Array::Controls, actuator, 1),
                "force" => Number::Array(Array::ActuatorForces, actuator, 1),
                _ => match activation(model, actuator) {
                    Some(at) => Number::Array(Array::Activations, at, 1),
                    None => {
                        let problem = format!("actuator {:?} has no dynamics, so it has no activation", escaped(&name));
                        return Err(value.error(problem));
                    }
                },
            };
            let mut entry = entry(&name, "", format!("{name}_{get}"), if get == "force" { "N" } else { "1" });
            entry.kind = "actuator";
            numbers.push((number, entry));
        }
        Ok(numbers)
    }

    fn actions(&self, value: &Value<'_>, previous: bool) -> Result<Numbers> {
        self.no_get("an action")?;
        let number = |actuator: usize| {
            let name = actuator_name(self.model, self.elements, actuator);
            let prefix = if previous { "previous_action" } else { "action" };
            let number = if previous { Number::PreviousAction(actuator) } else { Number::Action(actuator) };
            (number, entry(&name, "", format!("{prefix}_{name}"), "1"))
        };
        Ok(self.elements.select(ElementKind::Actuator, value)?.into_iter().map(number).collect())
    }

    /// Removes all numbers except the components along the axes in a text such as "xz".
    pub(super) fn only_axes(&self, axes: &Value<'_>, all: &mut Numbers) -> Result<()> {
        let text = axes.text()?;
        let wrong =
            || axes.error(format_args!("{:?} names no axes; expected for instance \"x\" or \"xz\"", escaped(text)));
        if text.is_empty() || text.chars().any(|c| !"xyz".contains(c)) {
            return Err(wrong());
        }
        let axis = |entry: &NumberDescription| entry.name.rsplit_once('.').map(|(_, axis)| axis.to_owned());
        if !all.iter().any(|(_, entry)| axis(entry).is_some_and(|axis| AXES.contains(&axis.as_str()))) {
            return Err(axes.error("what is read has no axes; leave them out"));
        }
        all.retain(|(_, entry)| axis(entry).is_some_and(|axis| text.contains(&axis)));
        Ok(())
    }
}

fn joint_unit(get: &str, kind: i32, part: &str) -> &'static str {
    let is_length = kind == SLIDE || (kind == FREE && matches!(part, "x" | "y" | "z" | "vx" | "vy" | "vz"));
    match (get, is_length) {
        ("position", _) if part.starts_with('q') => "1",
        ("position", true) => "m",
        ("position", false) => "rad",
        ("velocity", true) => "m/s",
        ("velocity", false) => "rad/s",
        ("actuation" | "constraint", true) => "N",
        ("actuation" | "constraint", false) => "N m",
        _ => "1",
    }
}

/// Returns the index of an actuator's activation; `None` if the actuator has no dynamics. Each actuator with dynamics
/// has one activation, in the model's order.
fn activation(model: &Model, actuator: usize) -> Option<usize> {
    let dynamics = model.index_array(Index::ActuatorDynamics);
    (dynamics[actuator] != 0).then(|| dynamics[..actuator].iter().filter(|&&kind| kind != 0).count())
}
