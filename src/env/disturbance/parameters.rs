//! The disturbances of an environment as parameters, and their current values.

use crate::env::{ActionSpec, EnvironmentSpec, ParameterSpec};
use perturb_protocol::disturbance::{CHANGED, DEFAULT_PUSH_INTERVAL};

/// Maximal delay of actions or observations, in steps.
const MAX_DELAY: usize = 100;
/// Maximal total of numbers in all delayed actions of an environment. It limits the size of snapshots. A delay of one
/// step is possible even if an action has more numbers.
const MAX_LATE_ACTION_NUMBERS: usize = 2048;
/// Maximal total of numbers in all delayed observations of an environment. It limits the size of snapshots. A delay of
/// one step is possible even if an observation has more numbers.
const MAX_LATE_OBSERVATION_NUMBERS: usize = 8192;
/// Maximal number of actuators that have their own scale: the first actuators of the environment. The common scale
/// applies to all actuators.
const MAX_SCALED_ACTUATORS: usize = 32;
/// Maximal value of the noise parameters and of the action scales, dimensionless.
const MAX_FACTOR: f64 = 10.0;
/// Maximal size of a push, in the unit of [`PushSpec::unit`](crate::env::PushSpec::unit).
const MAX_PUSH: f64 = 1000.0;
/// Maximal mean number of steps between two pushes.
const MAX_PUSH_INTERVAL: f64 = 1e6;
/// Maximal number of steps before or between changes of the physics.
const MAX_CHANGE_STEPS: f64 = 1e6;
/// The names of the noise of actions, and of the noise of observations.
pub(super) const NOISE_PARAMETERS: [&str; 2] = ["action_noise", "sensor_noise"];
/// The name of the scale of all actuators, and the prefix of the names of the scales of single actuators.
const ACTION_SCALE: &str = "action_scale";

/// The kind of a disturbance, which determines how its value is applied.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DisturbanceKind {
    ActionDelay,
    ActionHold,
    ActionNoise,
    ActionScale,
    /// The scale of the actuator with this index.
    ActuatorScale(usize),
    Push,
    PushInterval,
    SensorDelay,
    SensorNoise,
    SensorDropout,
    ChangeAt,
    ChangeEvery,
    ChangeProbability,
    /// The value that the environment's own parameter with this index has after a change of the physics.
    Changed(usize),
}

/// The disturbances of one environment.
pub(super) struct DisturbanceSet {
    entries: Vec<(DisturbanceKind, ParameterSpec)>,
    /// A, the number of entries of a continuous action; 1 if actions are discrete.
    pub(super) action_width: usize,
}

/// The current values of the disturbances, decoded from parameters.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct DisturbanceValues {
    pub(super) action_delay: usize,
    pub(super) action_hold: f64,
    pub(super) action_noise: f64,
    /// The scale of each actuator, `[A]`: the scale of all actuators times the actuator's own scale.
    pub(super) action_scales: Vec<f64>,
    /// The size of pushes; 0 for none.
    pub(super) push: f64,
    /// The mean number of steps between two pushes. Each step has a push with the probability 1 / `push_interval`.
    pub(super) push_interval: f64,
    pub(super) sensor_delay: usize,
    pub(super) sensor_noise: f64,
    pub(super) sensor_dropout: f64,
    /// The number of steps of an episode after which the physics change once; 0 for never.
    pub(super) change_at: u32,
    /// The number of steps between two changes of the physics; 0 for never.
    pub(super) change_every: u32,
    pub(super) change_probability: f64,
    /// The values of the environment's own parameters after a change, in the order of `EnvironmentSpec::parameters`.
    pub(super) changed: Vec<f64>,
}

impl DisturbanceValues {
    /// Whether the physics can change within an episode.
    pub(super) fn is_changing(&self) -> bool {
        self.change_at > 0 || self.change_every > 0 || self.change_probability > 0.0
    }
}

/// Returns the disturbances that change the physics within an episode. For each parameter `x` of the environment there
/// is a disturbance `changed_x`, the value of `x` after a change. Each version draws it from the same distribution as
/// `x`.
fn changes(spec: &EnvironmentSpec) -> Vec<(DisturbanceKind, ParameterSpec)> {
    if spec.parameters.is_empty() {
        return Vec::new();
    }
    let steps =
        |name, description| ParameterSpec::new(name, "1", description, (0.0, MAX_CHANGE_STEPS)).off(0.0).integer();
    let probability = "probability that the physics change between two steps";
    let mut entries = vec![
        (DisturbanceKind::ChangeAt, steps("change_at", "number of steps after which the physics change; 0: never")),
        (DisturbanceKind::ChangeEvery, steps("change_every", "number of steps between changes; 0: never")),
        (
            DisturbanceKind::ChangeProbability,
            ParameterSpec::new("change_probability", "1", probability, (0.0, 1.0)).off(0.0),
        ),
    ];
    entries.extend(spec.parameters.iter().enumerate().map(|(place, parameter)| {
        let name: &'static str = String::leak(format!("{CHANGED}{}", parameter.name));
        let description: &'static str = String::leak(format!("{} after a change", parameter.description));
        (DisturbanceKind::Changed(place), ParameterSpec { name, description, applied: name, ..*parameter })
    }));
    entries
}

impl DisturbanceSet {
    /// Returns the disturbances of an environment. Leaves out names that the environment itself uses for a parameter or
    /// quantity.
    pub(super) fn new(spec: &EnvironmentSpec) -> Self {
        let share = |name, description, most| ParameterSpec::new(name, "1", description, (0.0, most));
        let steps = |name, description, most: usize| share(name, description, most as f64).off(0.0).integer();
        let (action_width, actuators) = match spec.action {
            ActionSpec::Discrete(_) => (1, None),
            ActionSpec::Continuous(channels) => (channels.len(), Some(channels)),
        };
        let most_delay = |numbers: usize, width: usize| MAX_DELAY.min(numbers / width.max(1)).max(1);
        let mut entries = vec![
            (
                DisturbanceKind::ActionDelay,
                steps(
                    "action_delay",
                    "steps by which actions act late",
                    most_delay(MAX_LATE_ACTION_NUMBERS, action_width),
                ),
            ),
            (
                DisturbanceKind::ActionHold,
                share("action_hold", "probability that the last action acts again", 1.0).off(0.0),
            ),
        ];
        // A discrete action has no magnitude, so it has neither noise nor a scale.
        if let Some(channels) = actuators {
            let noise = share("action_noise", "standard deviation of actions, as a share of their range", MAX_FACTOR);
            entries.push((DisturbanceKind::ActionNoise, noise.off(0.0)));
            let scale = |name, description| (share(name, description, MAX_FACTOR)).off(1.0);
            entries.push((DisturbanceKind::ActionScale, scale(ACTION_SCALE, "factor on all actions")));
            // A single actuator needs no factor of its own.
            let own = if channels.len() > 1 { MAX_SCALED_ACTUATORS } else { 0 };
            entries.extend(channels.iter().take(own).enumerate().map(|(place, channel)| {
                let name: &'static str = String::leak(format!("{ACTION_SCALE}_{}", channel.name));
                let description: &'static str = String::leak(format!("factor on the action of {}", channel.name));
                (DisturbanceKind::ActuatorScale(place), scale(name, description))
            }));
        }
        if let Some(push) = spec.push {
            let size = ParameterSpec::new("push", push.unit, push.description, (0.0, MAX_PUSH)).off(0.0);
            let bounds = (1.0, MAX_PUSH_INTERVAL);
            let interval = ParameterSpec::new("push_interval", "1", "mean number of steps between pushes", bounds);
            entries.extend([
                (DisturbanceKind::Push, size),
                (DisturbanceKind::PushInterval, interval.off(DEFAULT_PUSH_INTERVAL)),
            ]);
        }
        entries.extend([
            (
                DisturbanceKind::SensorDelay,
                steps(
                    "sensor_delay",
                    "steps by which observations are late",
                    most_delay(MAX_LATE_OBSERVATION_NUMBERS, spec.observation.len()),
                ),
            ),
            (
                DisturbanceKind::SensorNoise,
                share("sensor_noise", "standard deviation of observations, as a share of their scales", MAX_FACTOR)
                    .off(0.0),
            ),
            (
                DisturbanceKind::SensorDropout,
                share("sensor_dropout", "probability that an observed number is lost", 1.0).off(0.0),
            ),
        ]);
        entries.extend(changes(spec));
        let is_free = |name: &str| {
            spec.parameters.iter().all(|own| own.name != name) && spec.applied.iter().all(|own| own.name != name)
        };
        entries.retain(|(_, parameter)| is_free(parameter.name));
        Self { entries, action_width }
    }

    /// Replaces each disturbance by the parameter of the same name in `declared`, if there is one. In versions R and E
    /// such a parameter may draw other values than the default.
    pub(super) fn declare(&mut self, declared: &[ParameterSpec]) {
        for (_, parameter) in &mut self.entries {
            if let Some(own) = declared.iter().find(|own| own.name == parameter.name) {
                *parameter = *own;
            }
        }
    }

    /// Returns the disturbances as parameters, in order.
    pub(super) fn parameters(&self) -> impl Iterator<Item = ParameterSpec> + '_ {
        self.entries.iter().map(|(_, parameter)| *parameter)
    }

    /// Returns two maxima for an environment: the total of numbers in all delayed actions, and the total of numbers in
    /// all delayed observations. Each observation has `observation_size` numbers.
    pub(super) fn max_late_numbers(&self, observation_size: usize) -> (usize, usize) {
        let longest = |wanted: DisturbanceKind| {
            let entry = self.entries.iter().find(|(kind, _)| *kind == wanted);
            entry.map_or(0, |(_, parameter)| parameter.bounds.high as usize)
        };
        let actions = longest(DisturbanceKind::ActionDelay) * self.action_width;
        (actions, longest(DisturbanceKind::SensorDelay) * observation_size)
    }

    /// Returns the values at which no disturbance has an effect.
    pub(super) fn defaults(&self) -> DisturbanceValues {
        let is_changed = |kind: &DisturbanceKind| matches!(kind, DisturbanceKind::Changed(_));
        DisturbanceValues {
            action_delay: 0,
            action_hold: 0.0,
            action_noise: 0.0,
            action_scales: vec![1.0; self.action_width],
            push: 0.0,
            push_interval: DEFAULT_PUSH_INTERVAL,
            sensor_delay: 0,
            sensor_noise: 0.0,
            sensor_dropout: 0.0,
            change_at: 0,
            change_every: 0,
            change_probability: 0.0,
            changed: self.entries.iter().filter(|(kind, _)| is_changed(kind)).map(|(_, own)| own.default).collect(),
        }
    }

    /// Sets the value of each disturbance from `numbers`, in order. Each number must be within its bounds.
    pub(super) fn set(&self, values: &mut DisturbanceValues, numbers: &[f64]) {
        values.action_scales.fill(1.0);
        for (&(kind, _), &number) in self.entries.iter().zip(numbers) {
            match kind {
                DisturbanceKind::ActionDelay => values.action_delay = number as usize,
                DisturbanceKind::ActionHold => values.action_hold = number,
                DisturbanceKind::ActionNoise => values.action_noise = number,
                DisturbanceKind::ActionScale => values.action_scales.iter_mut().for_each(|scale| *scale *= number),
                DisturbanceKind::ActuatorScale(place) => values.action_scales[place] *= number,
                DisturbanceKind::Push => values.push = number,
                DisturbanceKind::PushInterval => values.push_interval = number,
                DisturbanceKind::SensorDelay => values.sensor_delay = number as usize,
                DisturbanceKind::SensorNoise => values.sensor_noise = number,
                DisturbanceKind::SensorDropout => values.sensor_dropout = number,
                DisturbanceKind::ChangeAt => values.change_at = number as u32,
                DisturbanceKind::ChangeEvery => values.change_every = number as u32,
                DisturbanceKind::ChangeProbability => values.change_probability = number,
                DisturbanceKind::Changed(place) => values.changed[place] = number,
            }
        }
    }

    /// Writes the values of the disturbances to `out`, in order, as read back from `values`. `numbers` are the values
    /// that were set. Scales are copied from `numbers`, because `values` has only products of two scales. `changed(i)`
    /// returns the changed value of parameter `i`, or `None` if the physics cannot change.
    pub(super) fn read(
        &self,
        values: &DisturbanceValues,
        numbers: &[f64],
        changed: impl Fn(usize) -> Option<f64>,
        out: &mut [f64],
    ) {
        for ((&(kind, _), &number), out) in self.entries.iter().zip(numbers).zip(out) {
            *out = match kind {
                DisturbanceKind::ActionDelay => values.action_delay as f64,
                DisturbanceKind::ActionHold => values.action_hold,
                DisturbanceKind::ActionNoise => values.action_noise,
                DisturbanceKind::ActionScale | DisturbanceKind::ActuatorScale(_) => number,
                DisturbanceKind::Push => values.push,
                DisturbanceKind::PushInterval => values.push_interval,
                DisturbanceKind::SensorDelay => values.sensor_delay as f64,
                DisturbanceKind::SensorNoise => values.sensor_noise,
                DisturbanceKind::SensorDropout => values.sensor_dropout,
                DisturbanceKind::ChangeAt => values.change_at.into(),
                DisturbanceKind::ChangeEvery => values.change_every.into(),
                DisturbanceKind::ChangeProbability => values.change_probability,
                DisturbanceKind::Changed(place) => changed(place).unwrap_or(number),
            };
        }
    }
}
