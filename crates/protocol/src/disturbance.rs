//! The names of disturbances: parameters that every environment can have in addition to its own, with the same meaning in
//! all.

/// Disturbances with 0 as their default.
const NAMES: [&str; 10] = [
    "action_delay",
    "action_hold",
    "action_noise",
    "push",
    "sensor_delay",
    "sensor_noise",
    "sensor_dropout",
    "change_at",
    "change_every",
    "change_probability",
];
/// The names of the disturbances that say whether and when the physics change within an episode.
pub const CHANGES: [&str; 3] = ["change_at", "change_every", "change_probability"];
/// The beginning of the names of the parameters after a change, before the parameter's own name.
pub const CHANGED: &str = "changed_";
/// The scale of all actuators, whose default is 1. With `_` and an actuator's name behind it: the scale of that actuator.
const ACTION_SCALE: &str = "action_scale";

/// The mean number of steps between pushes. There are no pushes as long as their size is 0.
const PUSH_INTERVAL: &str = "push_interval";
/// The default of the mean interval of pushes, in steps.
pub const DEFAULT_PUSH_INTERVAL: f64 = 100.0;

/// Whether a parameter of this name is a disturbance.
pub fn is_disturbance(name: &str) -> bool {
    default_value(name).is_some() || name.starts_with(CHANGED)
}

/// The value of a disturbance that disturbs nothing; `None` for other parameters, and for those after a change, which do
/// nothing where nothing changes.
pub fn default_value(name: &str) -> Option<f64> {
    let is_scale = name.strip_prefix(ACTION_SCALE).is_some_and(|rest| rest.is_empty() || rest.starts_with('_'));
    if name == PUSH_INTERVAL {
        return Some(DEFAULT_PUSH_INTERVAL);
    }
    if is_scale { Some(1.0) } else { NAMES.contains(&name).then_some(0.0) }
}
