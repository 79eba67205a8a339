//! The trait of environments, and the description that each gives of itself.

use super::{
    Action, ActionSpace, Channel, Distribution, Draw, Error, Interval, Parameter, Quantity, RewardTerm, Stream,
    Success, Version, shorten,
};
use crate::scene::Scene;
use perturb_protocol::region::Region;
use std::fmt;

/// Makes an environment with default parameters.
pub type MakeEnvironment = dyn Fn() -> Result<Box<dyn Environment>, Error> + Send + Sync;

/// The pushes that an environment can take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PushSpec {
    /// The description of the parameter that is their size, as in "impulse of a push on the torso".
    pub description: &'static str,
    /// The unit of their size.
    pub unit: &'static str,
    /// The axes along which they act, ascending: 0 to 2 for x, y and z. An analytic task has one, its coordinate.
    pub axes: &'static [usize],
}

/// The fixed description of an environment.
#[derive(Clone, Copy)]
pub struct EnvironmentSpec {
    /// The name to open it by.
    pub name: &'static str,
    /// The revision, which is raised by every change of dynamics, reward or observation.
    pub revision: u32,
    /// A description in one sentence.
    pub description: &'static str,
    /// Makes an environment with default parameters; fails with [`Error::Model`] if its model cannot be loaded.
    pub make: &'static MakeEnvironment,
    /// The parameters that can be changed.
    pub parameters: &'static [Parameter],
    /// The entries of an observation, `[O]`.
    pub observation: &'static [Channel],
    /// The actions.
    pub action: ActionSpace,
    /// The entries of an exact initial state, `[S]`.
    pub state: &'static [Channel],
    /// The terms of the reward, in order. The reward is their sum.
    pub reward_terms: &'static [RewardTerm],
    /// The quantities that receipts read back from the physics.
    pub applied: &'static [Quantity],
    /// The number of steps after which an episode is truncated.
    pub step_limit: u32,
    /// Simulated seconds in one step.
    pub control_timestep: f64,
    /// The approximate time of a step on one core, µs. The pool cuts batches by it; results do not depend on it.
    pub step_cost: f64,
    /// The pushes that the environment can take; `None` if it cannot be pushed.
    pub push: Option<PushSpec>,
    /// The success rule of the paper's text.
    pub success: Success,
    /// The success rule of the paper's published code; `None` if it is the same.
    pub code_success: Option<Success>,
    /// The two parameters that heat maps have along x and along y by default.
    pub heatmap_axes: Option<[&'static str; 2]>,
}

impl fmt::Debug for EnvironmentSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, revision, .. } = self;
        f.debug_struct("EnvironmentSpec").field("name", name).field("revision", revision).finish_non_exhaustive()
    }
}

impl EnvironmentSpec {
    /// Returns the distributions of a version, one for each parameter. R+E has those of R, then those of E, as in
    /// [`Settings::distributions`](super::Settings::distributions).
    pub fn distributions(&self, version: Version) -> Vec<Distribution> {
        let of = |&part: &Version| self.parameters.iter().map(move |parameter| parameter.distribution(part));
        version.parts().iter().flat_map(of).collect()
    }

    /// Returns the parameter values that can be drawn from `distributions`, one for each parameter in each box.
    pub fn region(&self, distributions: &[Distribution]) -> Region {
        let names = || self.parameters.iter().map(|parameter| parameter.name.to_owned());
        let boxes = distributions.chunks(self.parameters.len().max(1));
        Region::new(boxes.map(|each| names().zip(each.iter().cloned()).collect()).collect())
    }
}

/// Checks that values from `low` to `high` lie within the parameter's physical range. NaN does not.
///
/// # Errors
/// [`Error::OutOfRange`].
pub fn check_bounds(spec: &EnvironmentSpec, parameter: &Parameter, (low, high): (f64, f64)) -> Result<(), Error> {
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

/// Checks that a distribution lies within the parameter's physical range, and that each of its intervals has a whole
/// number where the parameter needs one.
///
/// # Errors
/// [`Error::OutOfRange`], [`Error::NotWhole`].
pub fn check_distribution(
    spec: &EnvironmentSpec,
    parameter: &Parameter,
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

/// Replaces in `base` (one distribution a parameter, in the spec's order, of one box or of several) those that
/// `overrides` names, in every box.
///
/// # Errors
/// [`Error::UnknownParameter`] and [`Error::OutOfRange`]; `base` is unchanged then.
pub fn resolve<'a>(
    spec: &'static EnvironmentSpec,
    base: &mut [Distribution],
    overrides: impl IntoIterator<Item = (&'a str, Distribution)>,
) -> Result<(), Error> {
    let mut replaced = Vec::new();
    for (name, distribution) in overrides {
        let position = spec.parameters.iter().position(|p| p.name == name).ok_or_else(|| Error::UnknownParameter {
            environment: spec.name,
            name: shorten(name),
            known: spec.parameters.iter().map(|p| p.name).collect::<Vec<_>>().join(", "),
        })?;
        let parameter = &spec.parameters[position];
        check_distribution(spec, parameter, &distribution)?;
        replaced.push((position, distribution));
    }
    for (position, distribution) in replaced {
        base.chunks_exact_mut(spec.parameters.len()).for_each(|of_box| of_box[position] = distribution.clone());
    }
    Ok(())
}

/// The result of one step, besides the reward.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transition {
    /// Whether the task ended the episode. Step limits are applied by [`Episodes`](super::Episodes).
    pub terminated: bool,
    /// Whether the goal holds after this step, which [`Achievement::FirstGoal`](super::Achievement::FirstGoal) and
    /// [`Achievement::LastGoals`](super::Achievement::LastGoals) count.
    pub goal: bool,
    /// Whether the physics diverged: the state is not finite. Implies `terminated`.
    pub diverged: bool,
}

/// The physics and the task of one environment, without episodes, limits or randomness of its own.
///
/// After construction the parameters are the defaults and the state is some valid state; callers set parameters and
/// reset before they step. Every method is deterministic: the same calls give the same bytes.
pub trait Environment: Send {
    /// Returns the environment's description.
    fn spec(&self) -> &'static EnvironmentSpec;

    /// Applies parameters, in the spec's order, always starting from the unchanged model. The caller ensures that each
    /// is within its bounds. The state is undefined until the next reset.
    fn set_parameters(&mut self, values: &[f64]);

    /// Reads back from the physics the values of [`EnvironmentSpec::applied`], in order.
    fn applied(&self, out: &mut [f64]);

    /// The SHA-256 of the model's files in hexadecimal, or `""` without a model.
    fn model_hash(&self) -> &str {
        ""
    }

    /// Returns the value that the episode achieved so far, if the spec's [`Achievement`](super::Achievement) is the
    /// environment's own.
    fn achieved(&self) -> Option<f64> {
        None
    }

    /// Sets the address of an episode's random numbers and the number of its past steps, before the episode begins or
    /// is loaded. Environments that draw no numbers after a reset ignore it.
    fn set_address(&mut self, _draw: Draw, _steps: u32) {}

    /// Writes the action with the least effect, `[A]`, or the number of the choice. By default each entry is 0, or the
    /// end of its range that is nearest to 0. Of an odd number of choices it is the middle one, otherwise the first.
    fn neutral_action(&self, out: &mut [f32]) {
        match self.spec().action {
            ActionSpace::Discrete(names) => out.fill(if names.len() % 2 == 1 { (names.len() / 2) as f32 } else { 0.0 }),
            ActionSpace::Continuous(channels) => {
                for (entry, channel) in out.iter_mut().zip(channels) {
                    *entry = 0.0_f64.clamp(channel.low, channel.high) as f32;
                }
            }
        }
    }

    /// Pushes the physics during the next step, by an impulse along x, y and z in the unit of [`EnvironmentSpec::push`].
    fn push(&mut self, _impulse: [f64; 3]) {}

    /// Draws an initial state.
    fn reset(&mut self, stream: &mut Stream);

    /// Starts from an exact state, `[S]`. The caller ensures that it is finite.
    fn reset_to(&mut self, state: &[f64]);

    /// Writes the current observation, `[O]`.
    fn observe(&self, out: &mut [f32]);

    /// Returns the content of a picture of the current state; `None` after the physics diverged.
    fn scene(&self) -> Option<Scene>;

    /// Advances by one control step and writes the reward's terms, in the spec's order.
    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition;

    /// Appends the complete dynamic state: all that the next step depends on besides the parameters.
    fn save(&self, out: &mut Vec<f64>);

    /// Returns an upper bound of the additional numbers that [`Environment::save`] may append with other parameters.
    fn max_saved_growth(&self) -> usize {
        0
    }

    /// Loads a state that [`Environment::save`] wrote, after the same parameters were set.
    ///
    /// # Errors
    /// [`Error::Snapshot`] if the length or a value is impossible; the state is undefined then.
    fn load(&mut self, state: &[f64]) -> Result<(), Error>;
}
