//! The numbers of a model that parameters edit, and how each is set, scaled and read back.

use super::{
    elements::{Elements, actuator_name},
    error::{Error, Result, escaped},
    table::{TomlTable, Value},
};
use perturb_mujoco::{ElementKind, Flags, Index, Model, ModelField, Simulation};

/// The editable elements: the key in the file, the kind, and the editable fields.
pub(super) const EDITABLE: [(&str, ElementKind, &[&str]); 6] = [
    ("body", ElementKind::Body, &["mass", "length", "size", "position"]),
    ("geom", ElementKind::Geom, &["friction", "friction_torsion", "friction_roll", "radius"]),
    ("pair", ElementKind::Pair, &["friction"]),
    ("joint", ElementKind::Joint, &["damping", "armature", "frictionloss", "stiffness", "range"]),
    ("actuator", ElementKind::Actuator, &["gear", "kp", "kv", "forcerange"]),
    ("tendon", ElementKind::Tendon, &["stiffness", "damping"]),
];
/// The options of the model that can be edited.
pub(super) const OPTIONS: &[&str] = &["gravity", "wind", "density", "viscosity"];
/// The keys by which an edit names the numbers that it changes.
pub(super) const KEYS: [&str; 10] =
    ["body", "geom", "pair", "joint", "actuator", "tendon", "option", "field", "axis", "end"];

/// The number of entries in an actuator's gain. The actuator's bias has the same number.
const N_GAIN: usize = 10;
/// The number of entries in an actuator's gear.
const N_GEAR: usize = 6;

/// A value of the model that an edit changes. The fields of variants are indices of elements, if not described
/// otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Target {
    /// A single number: (array, index).
    Number(ModelField, usize),
    /// Two consecutive numbers that get the same value: (array, index of the first).
    Twins(ModelField, usize),
    /// Both ends of a range that is symmetric about 0: (array, index of the lower end). The value is the upper end.
    Symmetric(ModelField, usize),
    /// Both ends of a range, which are scaled together: (array, index of the lower end).
    Ends(ModelField, usize),
    /// The mass of a body. Its inertia changes in proportion.
    Mass(usize),
    /// The first number of an actuator's gear. The other numbers change in proportion.
    Gear(usize),
    /// The gain `kp` of a position servo. The servo's bias changes with the gain.
    PositionGain(usize),
    /// The gain `kv` of a velocity servo. The servo's bias changes with the gain.
    VelocityGain(usize),
    /// The damping `kv` of an actuator with an affine bias.
    ActuatorDamping(usize),
    /// The length of a body, defined by its longest capsule or cylinder: (body, geom).
    Length(usize, usize),
    /// The size of a body in all directions, which can only be scaled: (body, one of its geoms).
    Size(usize, usize),
    /// The radius of a sphere, a capsule or a cylinder.
    Radius(usize),
    /// A coordinate of a body's position relative to its parent: (body, axis).
    Position(usize, usize),
}

/// The targets of an edit: a field, such as the mass, of one or more elements of the same kind, or an option of the
/// model.
#[derive(Debug, Clone)]
pub(super) struct Targets {
    pub(super) all: Vec<Target>,
    /// The key of the kind of elements, such as `body`, or `option`.
    pub(super) subject: &'static str,
    /// The name of the field, or of the option.
    pub(super) field: &'static str,
    /// The indices of the elements; empty for an option.
    pub(super) ids: Vec<usize>,
    /// The names of the elements, or the name of the option.
    pub(super) names: Vec<String>,
}

/// The way in which a parameter's value changes a target: it replaces, multiplies, or is added to the target's value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Change {
    Set,
    Scale,
    Add,
}

impl Targets {
    /// Reads the targets of an edit from its TOML table.
    pub(super) fn new(table: &TomlTable<'_>, model: &Model, elements: &Elements, change: Change) -> Result<Self> {
        let subjects = ["body", "geom", "pair", "joint", "actuator", "tendon", "option"];
        let (subject, value) = table.one_of(&subjects)?;
        if subject == "option" {
            return Self::option(table, &value);
        }
        let (subject, kind, fields) = *EDITABLE
            .iter()
            .find(|(key, ..)| *key == subject)
            .ok_or_else(|| value.error(format_args!("{subject} cannot be edited")))?;
        // The field must be editable for this kind of element, and `axis` and `end` must fit the field.
        let field_value = table.require("field", &format!("{:?}", fields[0]))?;
        let name = field_value.text()?;
        let field = fields.iter().copied().find(|&field| field == name).ok_or_else(|| {
            let known = fields.join(", ");
            field_value.error(format_args!("{:?} is unknown; of a {subject} there are {known}", escaped(name)))
        })?;
        if let Some(axis) = table.get("axis").filter(|_| field != "position") {
            return Err(axis.error("axis goes with the options gravity and wind, and with the position of a body"));
        }
        if let Some(end) = table.get("end").filter(|_| !matches!(field, "range" | "forcerange")) {
            return Err(end.error("end goes with the fields range and forcerange"));
        }
        // Each element adds one target; a joint may add one for each of its degrees of freedom.
        let ids = elements.select(kind, &value)?;
        let mut all = Vec::new();
        for &id in &ids {
            let shown = match kind {
                ElementKind::Actuator => actuator_name(model, elements, id),
                _ => elements.name(kind, id).to_owned(),
            };
            let refuse = |problem: &str| value.error(format_args!("{subject} {:?} {problem}", escaped(&shown)));
            match (subject, field) {
                ("body", "mass") => all.push(mass(model, id).ok_or_else(|| refuse("has no mass, or is the world"))?),
                ("body", "length") => {
                    let refused =
                        || refuse("has no capsule and no cylinder, so it has no length; use field = \"size\"");
                    all.push(length(model, id).ok_or_else(refused)?);
                }
                ("body", "size") if change != Change::Scale => {
                    return Err(refuse("has a size that can only be scaled; use by = \"scale\""));
                }
                ("body", "size") => {
                    let refused = || refuse("has no geom of its own that could be scaled; use field = \"position\"");
                    all.push(size(model, id).ok_or_else(refused)?);
                }
                ("body", _) if id == 0 => return Err(refuse("has no position")),
                ("body", _) => all.push(Target::Position(id, axis(table, "position")?)),
                ("geom", "radius") => {
                    let refused = || refuse("is not a sphere, capsule or cylinder, so it has no radius");
                    all.push(radius(model, id).ok_or_else(refused)?);
                }
                ("geom", _) => all.push(Target::Number(ModelField::GeomFriction, 3 * id + friction_column(field))),
                ("pair", _) => all.push(Target::Twins(ModelField::PairFriction, 5 * id)),
                ("joint", "stiffness") => all.push(Target::Number(ModelField::JointStiffness, id)),
                ("joint", "range") => all.push(range(table, ModelField::JointRange, 2 * id, change)?),
                ("joint", _) => {
                    let array = match field {
                        "damping" => ModelField::DofDamping,
                        "armature" => ModelField::DofArmature,
                        _ => ModelField::DofFrictionLoss,
                    };
                    all.extend(degrees_of_freedom(model, id).map(|dof| Target::Number(array, dof)));
                }
                ("actuator", "forcerange") => all.push(range(table, ModelField::ActuatorForceRange, 2 * id, change)?),
                ("actuator", "gear") => {
                    let is_zero = model.field(ModelField::ActuatorGear)[N_GEAR * id] == 0.0;
                    if is_zero {
                        return Err(refuse("has a gear whose first number is 0"));
                    }
                    all.push(Target::Gear(id));
                }
                ("actuator", "kp") => {
                    let refused = || refuse("is not a position servo, so it has no kp");
                    all.push(position_gain(model, id).ok_or_else(refused)?);
                }
                ("actuator", _) => {
                    let refused = || refuse("is not a velocity servo, so it has no kv");
                    all.push(velocity_gain(model, id).ok_or_else(refused)?);
                }
                (_, "stiffness") => all.push(Target::Number(ModelField::TendonStiffness, id)),
                _ => all.push(Target::Number(ModelField::TendonDamping, id)),
            }
        }
        let names = ids.iter().map(|&id| elements.name(kind, id).to_owned()).collect();
        let targets = Self { all, subject, field, ids, names };
        if targets.all.iter().any(|target| !target.is_consistent(model)) {
            let problem =
                "the model's range is not symmetric, which set and add need; say end = \"upper\" or end = \"lower\"";
            return Err(value.error(problem));
        }
        Ok(targets)
    }

    fn option(table: &TomlTable<'_>, value: &Value<'_>) -> Result<Self> {
        let name = value.text()?;
        let option = OPTIONS.iter().copied().find(|&option| option == name).ok_or_else(|| {
            value.error(format_args!("{:?} is unknown; of options there are {}", escaped(name), OPTIONS.join(", ")))
        })?;
        for key in ["field", "end"] {
            if let Some(value) = table.get(key) {
                return Err(value.error(format_args!("an option has no {key}; leave it out")));
            }
        }
        let has_axes = matches!(option, "gravity" | "wind");
        let axis = match table.get("axis").filter(|_| !has_axes) {
            Some(axis) => return Err(axis.error(format_args!("{option} has no axes; leave axis out"))),
            None if has_axes => axis(table, option)?,
            None => 0,
        };
        let field = match option {
            "gravity" => ModelField::Gravity,
            "wind" => ModelField::Wind,
            "density" => ModelField::Density,
            _ => ModelField::Viscosity,
        };
        let all = vec![Target::Number(field, axis)];
        Ok(Self { all, subject: "option", field: option, ids: Vec::new(), names: vec![option.to_owned()] })
    }

    /// Returns the minimum of the physically possible values of the targets, and whether the minimum itself is
    /// excluded. Returns `None` if there is no minimum. Masses, lengths, sizes and radii must be positive, and most
    /// other values must not be negative.
    pub(super) fn minimum(&self) -> Option<(f64, bool)> {
        match (self.subject, self.field) {
            ("body", "position") => None,
            ("body", _) | ("geom", "radius") => Some((0.0, true)),
            ("option", "gravity" | "wind") | ("actuator", "gear") | ("joint", "range") => None,
            ("actuator", "forcerange") if matches!(self.all[..], [Target::Number(..), ..]) => None,
            _ => Some((0.0, false)),
        }
    }
}

/// Reads the key `axis`: 0 for x, 1 for y, 2 for z.
fn axis(table: &TomlTable<'_>, of: &str) -> Result<usize> {
    let axis = table.get("axis").ok_or_else(|| table.error(format_args!("{of} has three axes; give axis = \"z\"")))?;
    let text = axis.text()?;
    let found = ["x", "y", "z"].iter().position(|&known| known == text);
    found.ok_or_else(|| axis.error(format_args!("{:?} is not an axis; expected x, y or z", escaped(text))))
}

/// MuJoCo's number of the geom type `sphere`.
const SPHERE: i32 = 2;
/// MuJoCo's number of the geom type `capsule`.
const CAPSULE: i32 = 3;
/// MuJoCo's number of the geom type `cylinder`.
const CYLINDER: i32 = 5;
/// MuJoCo's number of the geom type `box`.
const BOX: i32 = 6;

/// Returns the geoms of a body, each with its type.
fn geoms(model: &Model, body: usize) -> impl Iterator<Item = (usize, i32)> + '_ {
    let types = model.index_array(Index::GeomType).iter().copied().enumerate();
    types.filter(move |(geom, _)| model.index_array(Index::GeomBody)[*geom] as usize == body)
}

fn length(model: &Model, body: usize) -> Option<Target> {
    let long = geoms(model, body).filter(|(_, kind)| matches!(*kind, CAPSULE | CYLINDER)).map(|(geom, _)| geom);
    let half = |geom: &usize| model.field(ModelField::GeomSize)[3 * geom + 1];
    // Among equally long geoms the first counts.
    let longest = long.reduce(|a, b| if half(&b) > half(&a) { b } else { a })?;
    (body > 0).then_some(Target::Length(body, longest))
}

fn size(model: &Model, body: usize) -> Option<Target> {
    let first = geoms(model, body).find(|(_, kind)| (SPHERE..=BOX).contains(kind))?;
    (body > 0).then_some(Target::Size(body, first.0))
}

fn radius(model: &Model, geom: usize) -> Option<Target> {
    matches!(model.index_array(Index::GeomType)[geom], SPHERE | CAPSULE | CYLINDER).then_some(Target::Radius(geom))
}

fn friction_column(field: &str) -> usize {
    match field {
        "friction" => 0,
        "friction_torsion" => 1,
        _ => 2,
    }
}

fn mass(model: &Model, body: usize) -> Option<Target> {
    (model.field(ModelField::BodyMass)[body] > 0.0).then_some(Target::Mass(body))
}

/// Returns the indices of a joint's degrees of freedom.
pub(super) fn degrees_of_freedom(model: &Model, joint: usize) -> std::ops::Range<usize> {
    let starts = model.index_array(Index::JointVelocity);
    let end = starts.get(joint + 1).map_or(model.n_v(), |&next| next as usize);
    starts[joint] as usize..end
}

fn range(table: &TomlTable<'_>, field: ModelField, first: usize, change: Change) -> Result<Target> {
    match (table.text("end")?, change) {
        (Some("lower"), _) => Ok(Target::Number(field, first)),
        (Some("upper"), _) => Ok(Target::Number(field, first + 1)),
        (Some(other), _) => {
            let problem = format!("end is {:?}; expected \"lower\" or \"upper\"", escaped(other));
            Err(table.error(problem))
        }
        (None, Change::Scale) => Ok(Target::Ends(field, first)),
        (None, Change::Set | Change::Add) => Ok(Target::Symmetric(field, first)),
    }
}

/// MuJoCo's number for an affine bias of an actuator.
const AFFINE: i32 = 1;

fn position_gain(model: &Model, actuator: usize) -> Option<Target> {
    let gain = model.field(ModelField::ActuatorGain)[N_GAIN * actuator];
    let bias = model.field(ModelField::ActuatorBias)[N_GAIN * actuator + 1];
    let is_servo = model.index_array(Index::ActuatorGainType)[actuator] == 0
        && model.index_array(Index::ActuatorBiasType)[actuator] == AFFINE
        && gain != 0.0
        && bias == -gain;
    is_servo.then_some(Target::PositionGain(actuator))
}

fn velocity_gain(model: &Model, actuator: usize) -> Option<Target> {
    let gain = model.field(ModelField::ActuatorGain)[N_GAIN * actuator];
    let bias = &model.field(ModelField::ActuatorBias)[N_GAIN * actuator..][..3];
    if model.index_array(Index::ActuatorBiasType)[actuator] != AFFINE || bias[2] == 0.0 {
        None
    } else if bias[1] == 0.0 && bias[2] == -gain {
        Some(Target::VelocityGain(actuator))
    } else {
        Some(Target::ActuatorDamping(actuator))
    }
}

impl Target {
    /// Returns the place of the target's value in the model: the array, and the index of the number in the array.
    pub(super) fn place(self) -> (ModelField, usize) {
        match self {
            Self::Number(field, at) | Self::Twins(field, at) => (field, at),
            Self::Symmetric(field, at) | Self::Ends(field, at) => (field, at + 1),
            Self::Mass(body) => (ModelField::BodyMass, body),
            Self::Gear(actuator) => (ModelField::ActuatorGear, N_GEAR * actuator),
            Self::PositionGain(actuator) | Self::VelocityGain(actuator) => {
                (ModelField::ActuatorGain, N_GAIN * actuator)
            }
            Self::ActuatorDamping(actuator) => (ModelField::ActuatorBias, N_GAIN * actuator + 2),
            Self::Length(_, geom) => (ModelField::GeomSize, 3 * geom + 1),
            Self::Size(_, geom) | Self::Radius(geom) => (ModelField::GeomSize, 3 * geom),
            Self::Position(body, axis) => (ModelField::BodyPosition, 3 * body + axis),
        }
    }

    /// Whether the model must be compiled again to change the value, since it is a length, size, radius or position.
    pub(super) fn is_recompiled(self) -> bool {
        matches!(self, Self::Length(..) | Self::Size(..) | Self::Radius(_) | Self::Position(..))
    }

    /// Returns the arrays that an edit of this target changes, without those that MuJoCo derives from them.
    pub(super) fn fields(self) -> Vec<ModelField> {
        match self {
            Self::Mass(_) => vec![ModelField::BodyMass, ModelField::BodyInertia],
            Self::PositionGain(_) | Self::VelocityGain(_) => vec![ModelField::ActuatorGain, ModelField::ActuatorBias],
            _ => vec![self.place().0],
        }
    }

    /// Whether MuJoCo must compute derived constants again after an edit, see [`Simulation::set_const`].
    pub(super) fn changes_constants(self) -> bool {
        matches!(self.place().0, ModelField::BodyMass | ModelField::DofArmature | ModelField::ActuatorGear)
    }

    /// Whether the ends of a [`Target::Symmetric`] have the same absolute value. True for other targets.
    fn is_consistent(self, model: &Model) -> bool {
        match self {
            Self::Symmetric(field, at) => model.field(field)[at] == -model.field(field)[at + 1],
            _ => true,
        }
    }

    /// Returns the value in a model.
    pub(super) fn value(self, model: &Model) -> f64 {
        let (field, at) = self.place();
        let value = model.field(field)[at];
        match self {
            Self::ActuatorDamping(_) => -value,
            Self::Length(..) => 2.0 * value,
            _ => value,
        }
    }

    /// Sets the value in the model of a simulation. Numbers that change in proportion are computed from their values in
    /// the unedited model `pristine`.
    pub(super) fn set(self, pristine: &Model, simulation: &mut Simulation, value: f64) {
        let (field, at) = self.place();
        let own = self.value(pristine);
        simulation.field_mut(field)[at] = if matches!(self, Self::ActuatorDamping(_)) { -value } else { value };
        match self {
            Self::Number(..) | Self::ActuatorDamping(_) => {}
            Self::Length(..) | Self::Size(..) | Self::Radius(_) | Self::Position(..) => {} // set by another compilation
            Self::Twins(..) => simulation.field_mut(field)[at + 1] = value,
            Self::Symmetric(..) => simulation.field_mut(field)[at - 1] = -value,
            // Ranges with two ends are only scaled, never set.
            Self::Ends(..) => {}
            Self::Mass(body) => {
                let factor = value / own;
                let inertia = &pristine.field(ModelField::BodyInertia)[3 * body..][..3];
                for (moment, own) in
                    simulation.field_mut(ModelField::BodyInertia)[3 * body..][..3].iter_mut().zip(inertia)
                {
                    *moment = own * factor;
                }
            }
            Self::Gear(_) => {
                let factor = value / own;
                let gear = &pristine.field(field)[at + 1..][..N_GEAR - 1];
                for (number, own) in simulation.field_mut(field)[at + 1..][..N_GEAR - 1].iter_mut().zip(gear) {
                    *number = own * factor;
                }
            }
            Self::PositionGain(actuator) => {
                simulation.field_mut(ModelField::ActuatorBias)[N_GAIN * actuator + 1] = -value
            }
            Self::VelocityGain(actuator) => {
                simulation.field_mut(ModelField::ActuatorBias)[N_GAIN * actuator + 2] = -value
            }
        }
    }

    /// Sets the value, and the numbers that change in proportion, to their values in `pristine` times a factor.
    pub(super) fn scale(self, pristine: &Model, simulation: &mut Simulation, factor: f64) {
        let (field, at) = self.place();
        let mut multiply =
            |field: ModelField, at: usize| simulation.field_mut(field)[at] = pristine.field(field)[at] * factor;
        multiply(field, at);
        match self {
            Self::Number(..) | Self::ActuatorDamping(_) => {}
            Self::Length(..) | Self::Size(..) | Self::Radius(_) | Self::Position(..) => {} // set by another compilation
            Self::Twins(..) => multiply(field, at + 1),
            Self::Symmetric(..) | Self::Ends(..) => multiply(field, at - 1),
            Self::Mass(body) => (0..3).for_each(|i| multiply(ModelField::BodyInertia, 3 * body + i)),
            Self::Gear(_) => (1..N_GEAR).for_each(|i| multiply(field, at + i)),
            Self::PositionGain(actuator) => multiply(ModelField::ActuatorBias, N_GAIN * actuator + 1),
            Self::VelocityGain(actuator) => multiply(ModelField::ActuatorBias, N_GAIN * actuator + 2),
        }
    }

    /// Returns the value in `model` divided by the value in `pristine`.
    pub(super) fn factor(self, pristine: &Model, model: &Model) -> f64 {
        let (field, at) = self.place();
        let own = pristine.field(field)[at];
        match self {
            // The upper end of a range may be 0. The factor is computed from the lower end then.
            Self::Ends(..) if own == 0.0 => model.field(field)[at - 1] / pristine.field(field)[at - 1],
            _ => model.field(field)[at] / own,
        }
    }

    /// Whether the value in `pristine` is 0, so that scaling has no effect.
    pub(super) fn is_zero(self, pristine: &Model) -> bool {
        let (field, at) = self.place();
        let lower = matches!(self, Self::Ends(..)).then(|| pristine.field(field)[at - 1]);
        pristine.field(field)[at] == 0.0 && lower.is_none_or(|lower| lower == 0.0)
    }
}

/// Whether the joint or actuator with this index has limits, so that its range has an effect.
pub(super) fn is_limited(model: &Model, subject: &str, id: usize) -> bool {
    match subject {
        "joint" => model.flags(Flags::JointLimited)[id] != 0,
        _ => model.flags(Flags::ActuatorForceLimited)[id] != 0,
    }
}

/// Creates the error that an edit cannot have an effect, for the reason `why`.
pub(super) fn without_effect(table: &TomlTable<'_>, why: impl std::fmt::Display) -> Error {
    table.error(format_args!("it has no effect: {why}"))
}
