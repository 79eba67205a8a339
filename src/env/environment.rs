//! The trait that every environment implements, and the description of an environment.

use super::{
    Action, ActionSpec, ChannelSpec, Distribution, Draw, Error, Interval, ParameterSpec, PhiloxStream, QuantitySpec,
    RewardTermSpec, SuccessRuleSpec, Version, shorten,
};
use crate::scene::Scene;
use perturb_protocol::{limits::MAX_INTERVALS, region::Region};
use std::fmt;

/// Maximal size of distributions in a snapshot, in bytes: the distributions of R and of E for 32 parameters and 76
/// disturbances, of 64 intervals each. As many bytes hold 1024 contexts of 12 fixed parameters.
pub(super) const MAX_DISTRIBUTIONS_BYTES: usize = 2 * (32 + 76) * (1 + MAX_INTERVALS * size_of::<(f64, f64)>());

/// A function that creates an environment with default parameters.
pub type MakeEnvironment = dyn Fn() -> Result<Box<dyn Environment>, Error> + Send + Sync;

/// The pushes that the disturbance `push` can apply to an environment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PushSpec {
    /// The description of the parameter `push`, such as "impulse of a push on the torso".
    pub description: &'static str,
    /// The unit of a push's size.
    pub unit: &'static str,
    /// The axes along which pushes act, ascending: 0, 1 and 2 for x, y and z. A task without MuJoCo has one axis, 0,
    /// for its only coordinate.
    pub axes: &'static [usize],
}

/// The description of an environment, which never changes while the server runs.
#[derive(Clone, Copy)]
pub struct EnvironmentSpec {
    /// The name by which clients open the environment.
    pub name: &'static str,
    /// The revision. Every change of dynamics, reward or observation raises it.
    pub revision: u32,
    /// A description in one sentence.
    pub description: &'static str,
    /// Creates an environment with default parameters. Fails with [`Error::Model`] if its model cannot be loaded.
    pub make: &'static MakeEnvironment,
    /// The parameters that can be changed.
    pub parameters: &'static [ParameterSpec],
    /// The entries of an observation, in order.
    pub observation: &'static [ChannelSpec],
    /// The actions that the environment accepts.
    pub action: ActionSpec,
    /// The entries of an exact initial state, which clients may set, in order.
    pub state: &'static [ChannelSpec],
    /// The terms of the reward, in order. The reward is their sum.
    pub reward_terms: &'static [RewardTermSpec],
    /// The physical quantities that receipts report, in order. Their values are read back from the simulation.
    pub applied: &'static [QuantitySpec],
    /// The number of steps after which an episode is truncated.
    pub step_limit: u32,
    /// The simulated time of one step, in s.
    pub control_timestep: f64,
    /// The approximate computing time of a step on one core, in µs. The worker pool uses it to divide batches. Results
    /// do not depend on it.
    pub step_cost: f64,
    /// The pushes that can be applied to the environment; `None` if it cannot be pushed.
    pub push: Option<PushSpec>,
    /// The success rule of the paper's text.
    pub success: SuccessRuleSpec,
    /// The success rule of the paper's published code; `None` if it is the same as `success`.
    pub code_success: Option<SuccessRuleSpec>,
    /// The two parameters that heat maps show along x and y by default.
    pub heatmap_axes: Option<[&'static str; 2]>,
}

impl fmt::Debug for EnvironmentSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, revision, .. } = self;
        f.debug_struct("EnvironmentSpec").field("name", name).field("revision", revision).finish_non_exhaustive()
    }
}

impl EnvironmentSpec {
    /// Returns the distributions of a version, one for each parameter. For R+E returns the distributions of R, then
    /// those of E, in the layout of [`EpisodeSettings::distributions`](super::EpisodeSettings::distributions).
    pub fn distributions(&self, version: Version) -> Vec<Distribution> {
        let of = |&part: &Version| self.parameters.iter().map(move |parameter| parameter.distribution(part));
        version.parts().iter().flat_map(of).collect()
    }

    /// Returns the region of parameter values that can be drawn from `distributions`, which has the layout of
    /// [`EpisodeSettings::distributions`](super::EpisodeSettings::distributions).
    pub fn region(&self, distributions: &[Distribution]) -> Region {
        let names = || self.parameters.iter().map(|parameter| parameter.name.to_owned());
        let boxes = distributions.chunks(self.parameters.len().max(1));
        Region::new(boxes.map(|each| names().zip(each.iter().cloned()).collect()).collect())
    }
}

/// Returns the size of distributions in a snapshot, in bytes, without the number of distributions that precedes them.
pub(crate) fn distributions_bytes<'a>(distributions: impl IntoIterator<Item = &'a Distribution>) -> usize {
    // The number of a distribution's intervals is at most 64, so its encoding takes one byte.
    distributions.into_iter().map(|distribution| 1 + size_of::<(f64, f64)>() * distribution.intervals().len()).sum()
}

/// Checks that the interval from `low` to `high` is within the parameter's physical range.
///
/// # Errors
/// [`Error::OutOfRange`] if it is not, or if an end is NaN.
pub fn check_bounds(spec: &EnvironmentSpec, parameter: &ParameterSpec, (low, high): (f64, f64)) -> Result<(), Error> {
    let bounds = parameter.bounds;
    if low >= bounds.low && high <= bounds.high {
        return Ok(());
    }
    Err(Error::OutOfRange {
        environment: spec.name,
        parameter: parameter.name,
        got: if low >= bounds.low { high } else { low },
        unit: parameter.unit,
        low: bounds.low,
        high: bounds.high,
    })
}

/// Checks that a distribution is within the parameter's physical range. If the parameter takes whole numbers, also
/// checks that each interval contains a whole number.
///
/// # Errors
/// [`Error::OutOfRange`], [`Error::NotWhole`].
pub fn check_distribution(
    spec: &EnvironmentSpec,
    parameter: &ParameterSpec,
    distribution: &Distribution,
) -> Result<(), Error> {
    check_bounds(spec, parameter, distribution.range())?;
    let is_empty = |interval: &&Interval| interval.low.ceil() > interval.high;
    match distribution.intervals().iter().find(is_empty).filter(|_| parameter.is_integer) {
        None => Ok(()),
        Some(interval) => {
            Err(Error::NotWhole { environment: spec.name, parameter: parameter.name, got: interval.to_string() })
        }
    }
}

/// Replaces the distributions of the parameters that `overrides` names, in each box of the parameter space. `base` has
/// the layout of [`EpisodeSettings::distributions`](super::EpisodeSettings::distributions).
///
/// # Errors
/// [`Error::UnknownParameter`], [`Error::OutOfRange`], [`Error::NotWhole`], and [`Error::TooManyDistributions`] if the
/// result is too large for a snapshot. After an error, `base` is unchanged.
pub fn resolve<'a>(
    spec: &'static EnvironmentSpec,
    base: &mut [Distribution],
    overrides: impl IntoIterator<Item = (&'a str, Distribution)>,
) -> Result<(), Error> {
    let mut replaced: Vec<Option<Distribution>> = vec![None; spec.parameters.len()];
    for (name, distribution) in overrides {
        let position = spec.parameters.iter().position(|p| p.name == name).ok_or_else(|| Error::UnknownParameter {
            environment: spec.name,
            name: shorten(name),
            known: spec.parameters.iter().map(|p| p.name).collect::<Vec<_>>().join(", "),
        })?;
        let parameter = &spec.parameters[position];
        check_distribution(spec, parameter, &distribution)?;
        replaced[position] = Some(distribution);
    }
    let result = base.iter().zip(replaced.iter().cycle()).map(|(old, new)| new.as_ref().unwrap_or(old));
    let bytes = distributions_bytes(result);
    if bytes > MAX_DISTRIBUTIONS_BYTES {
        return Err(Error::TooManyDistributions { environment: spec.name, bytes, limit: MAX_DISTRIBUTIONS_BYTES });
    }
    for (old, new) in base.iter_mut().zip(replaced.iter().cycle()) {
        if let Some(new) = new {
            old.clone_from(new);
        }
    }
    Ok(())
}

/// The result of one step of an environment, apart from reward and observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transition {
    /// Whether the task ended the episode. The step limit is not included: [`Episodes`](super::Episodes) applies it.
    pub terminated: bool,
    /// Whether the task's goal is met after this step. [`Achievement::FirstGoal`](super::Achievement::FirstGoal),
    /// [`Achievement::LastGoals`](super::Achievement::LastGoals) and
    /// [`Achievement::LongestGoals`](super::Achievement::LongestGoals) are computed from it.
    pub goal: bool,
    /// Whether the physics diverged, i.e. the state is not finite or cannot be sent as float32. Then `terminated` is
    /// true, too.
    pub diverged: bool,
}

/// The physics and the task of one environment. [`Episodes`](super::Episodes) counts episodes, applies the step limit
/// and draws parameters.
///
/// A new environment has default parameters and an arbitrary valid state. Set parameters and reset before the first
/// step. Every method is deterministic: the same calls give the same bytes.
pub trait Environment: Send {
    /// Returns the environment's description.
    fn spec(&self) -> &'static EnvironmentSpec;

    /// Applies the parameters `values`, in the order of [`EnvironmentSpec::parameters`], to the unmodified model. Each
    /// value must be within its parameter's bounds. The state is undefined until the next reset.
    fn set_parameters(&mut self, values: &[f64]);

    /// Reads the quantities of [`EnvironmentSpec::applied`] from the physics, and writes them to `out`, in order.
    fn applied(&self, out: &mut [f64]);

    /// Returns the SHA-256 of the model's MJCF text in hexadecimal. A task from a folder returns the SHA-256 of the
    /// paths and contents of all files that were read. An environment without a model returns an empty text.
    fn model_hash(&self) -> &str {
        ""
    }

    /// Returns the value that the episode has achieved so far. The value is used only if the success rule compares
    /// [`Achievement::Own`](super::Achievement::Own).
    fn achieved(&self) -> Option<f64> {
        None
    }

    /// Sets the seed, environment index and episode index that determine the episode's random numbers, and the number
    /// of steps that the episode has taken. The method is called before an episode begins or is loaded. Environments
    /// that draw no random numbers during steps ignore this call.
    fn set_address(&mut self, _draw: Draw, _steps: u32) {}

    /// Writes the action with the least effect to `out`: a vector with an entry for each channel, or the index of a
    /// choice. By default each entry is the number in its range that is nearest to 0. The default choice is the middle
    /// choice if the number of choices is odd, otherwise the first choice.
    fn neutral_action(&self, out: &mut [f32]) {
        match self.spec().action {
            ActionSpec::Discrete(names) => out.fill(if names.len() % 2 == 1 { (names.len() / 2) as f32 } else { 0.0 }),
            ActionSpec::Continuous(channels) => {
                for (entry, channel) in out.iter_mut().zip(channels) {
                    *entry = 0.0_f64.clamp(channel.low, channel.high) as f32;
                }
            }
        }
    }

    /// Applies an external impulse during the next step: its components along x, y and z, in the unit of
    /// [`EnvironmentSpec::push`].
    fn push(&mut self, _impulse: [f64; 3]) {}

    /// Begins an episode in a random initial state, drawn from `stream`.
    fn reset(&mut self, stream: &mut PhiloxStream);

    /// Begins an episode in the given state, which has the entries of [`EnvironmentSpec::state`]. All entries must be
    /// finite.
    fn reset_to(&mut self, state: &[f64]);

    /// Writes the current observation to `out`, which has the entries of [`EnvironmentSpec::observation`].
    fn observe(&self, out: &mut [f32]);

    /// Draws random numbers of the next step that do not depend on its action, so that the step itself is faster. The
    /// results of the next step are the same without this call.
    fn draw_ahead(&mut self) {}

    /// Returns the scene to draw for a picture of the current state; `None` after the physics diverged.
    fn scene(&self) -> Option<Scene>;

    /// Advances by one control step. Writes the terms of the reward to `reward_terms`, in the order of
    /// [`EnvironmentSpec::reward_terms`].
    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition;

    /// Appends the complete dynamic state to `out`. The state, the parameters, the address (see
    /// [`Environment::set_address`]) and the actions together determine all later steps of the episode.
    fn save(&self, out: &mut Vec<f64>);

    /// Returns an upper bound of the number of additional entries that [`Environment::save`] would append if the
    /// parameters changed.
    fn max_saved_growth(&self) -> usize {
        0
    }

    /// Loads a state that [`Environment::save`] appended. The caller must have set the parameters with which the state
    /// was saved.
    ///
    /// # Errors
    /// [`Error::Snapshot`] if the length or a value is impossible. After an error, the state is undefined.
    fn load(&mut self, state: &[f64]) -> Result<(), Error>;
}
