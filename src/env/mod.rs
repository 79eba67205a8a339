//! Environments: the trait that each implements, what they declare of themselves, and the episodes they run.

mod catalogue;
mod episode;
mod error;
mod parameter;
mod seeding;
mod snapshot;
mod spaces;

pub use catalogue::Catalogue;
pub use episode::{EpisodeEnd, EpisodeId, EpisodeStart, Episodes, Outcome, Receipt, Settings};
pub use error::Error;
pub(crate) use error::shorten;
pub use parameter::{Parameter, check_bounds, resolve};
pub use perturb_protocol::{Distribution, DistributionError, Interval, Version};
pub use seeding::{Purpose, Stream};
pub use spaces::{
    Achievement, Action, ActionSpace, Channel, Comparison, EnvironmentSpec, Quantity, RewardTerm, Success,
};

use crate::scene::Scene;

/// What one step did, besides the reward.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transition {
    /// The task ended the episode. The step limit is not the environment's business.
    pub terminated: bool,
    /// The goal that [`Achievement::FirstGoal`] and [`Achievement::LastGoals`] count holds after this step.
    pub goal: bool,
    /// The physics diverged: the state is not finite. Implies `terminated`.
    pub diverged: bool,
}

/// The physics and the task of one environment, without episodes, limits or randomness of its own.
///
/// After construction the parameters are the defaults and the state is some valid state; callers set parameters and
/// reset before they step. Every method is deterministic: the same calls give the same bytes.
pub trait Environment: Send {
    /// What is fixed about it.
    fn spec(&self) -> &'static EnvironmentSpec;

    /// Applies parameters, in the spec's order, each within its bounds (the caller's duty), always starting from the
    /// pristine model. The state is undefined until the next reset.
    fn set_parameters(&mut self, values: &[f64]);

    /// Reads back from the physics the values of [`EnvironmentSpec::applied`], in order.
    fn applied(&self, out: &mut [f64]);

    /// The SHA-256 of the model in hexadecimal, or `""` without one.
    fn model_hash(&self) -> &str {
        ""
    }

    /// What the episode achieved so far, where the spec's [`Achievement`] is the environment's own.
    fn achieved(&self) -> Option<f64> {
        None
    }

    /// Draws an initial state.
    fn reset(&mut self, stream: &mut Stream);

    /// Starts from an exact state, `[S]`, finite (the caller's duty).
    fn reset_to(&mut self, state: &[f64]);

    /// Writes the current observation, `[O]`.
    fn observe(&self, out: &mut [f32]);

    /// What a picture of the current state shows; none where the physics diverged and no state is left to be shown.
    fn scene(&self) -> Option<Scene>;

    /// Advances by one control step and writes the reward's terms, in the spec's order.
    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition;

    /// Appends the complete dynamic state: all that the next step depends on besides the parameters.
    fn save(&self, out: &mut Vec<f64>);

    /// Takes back what [`Environment::save`] wrote, after the same parameters were set.
    ///
    /// # Errors
    /// [`Error::Snapshot`] if the length or a value is impossible; the state is undefined then.
    fn load(&mut self, state: &[f64]) -> Result<(), Error>;
}
