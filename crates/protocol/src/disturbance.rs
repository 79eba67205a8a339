//! The names and defaults of disturbances: parameters such as noise or delay that any environment can have in addition
//! to its own parameters. They mean the same in every environment.

/// Names of the disturbances whose default value is 0.
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
/// Names of the disturbances that control whether and when the physics change within an episode.
pub const CHANGES: [&str; 3] = ["change_at", "change_every", "change_probability"];
/// Prefix of the names of parameters that hold after a change of the physics: `changed_mass` replaces `mass`.
pub const CHANGED: &str = "changed_";
/// Name of the factor that scales the actions of all actuators. `action_scale_NAME` scales those of one actuator. The
/// default is 1.
const ACTION_SCALE: &str = "action_scale";

/// Name of the mean number of steps between two pushes. It has no effect while the size `push` is 0.
const PUSH_INTERVAL: &str = "push_interval";
/// Default mean interval between two pushes, in steps.
pub const DEFAULT_PUSH_INTERVAL: f64 = 100.0;

/// Whether the parameter with this name is a disturbance.
pub fn is_disturbance(name: &str) -> bool {
    default_value(name).is_some() || name.starts_with(CHANGED)
}

/// Returns the value at which a disturbance has no effect. Returns `None` for all other parameters, and for those with
/// the prefix [`CHANGED`], which have no such value.
pub fn default_value(name: &str) -> Option<f64> {
    let is_scale = name.strip_prefix(ACTION_SCALE).is_some_and(|rest| rest.is_empty() || rest.starts_with('_'));
    if name == PUSH_INTERVAL {
        return Some(DEFAULT_PUSH_INTERVAL);
    }
    if is_scale { Some(1.0) } else { NAMES.contains(&name).then_some(0.0) }
}
