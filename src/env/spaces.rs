//! What an environment looks like from outside: observations, actions, rewards, success.

use super::{Environment, Error, Parameter};

/// A named entry of a vector, with its unit and range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Channel {
    /// Unique within its list.
    pub name: &'static str,
    /// SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
    /// Least possible value; may be `-inf`.
    pub low: f64,
    /// Greatest possible value; may be `+inf`.
    pub high: f64,
}

impl Channel {
    /// A channel of the given name, unit and range `[low, high]`.
    pub const fn new(name: &'static str, unit: &'static str, low: f64, high: f64) -> Self {
        Self { name, unit, low, high }
    }

    /// A channel without bounds.
    pub const fn unbounded(name: &'static str, unit: &'static str) -> Self {
        Self::new(name, unit, f64::NEG_INFINITY, f64::INFINITY)
    }
}

/// The actions that an environment takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ActionSpace {
    /// One of `n` choices; each has a name that says what it does.
    Discrete(&'static [&'static str]),
    /// A vector of A numbers. The environment clips them to the channels' ranges.
    Continuous(&'static [Channel]),
}

/// One environment's action.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Action<'a> {
    /// A choice, below the space's `n`.
    Discrete(u32),
    /// `[A]`, finite.
    Continuous(&'a [f32]),
}

/// A term of the reward.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RewardTerm {
    /// Unique within its environment.
    pub name: &'static str,
    /// The term's formula.
    pub description: &'static str,
}

/// A quantity that receipts report as read back from the physics.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quantity {
    /// Unique within its environment.
    pub name: &'static str,
    /// SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
}

/// When an episode counts as a success (the paper, section "Experimental methodology").
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SuccessRule {
    /// The episode lasted at least this many steps.
    Lasted(u32),
    /// The goal held after some step up to and including this one.
    ReachedWithin(u32),
    /// The goal held after each of the episode's last steps, this many.
    HeldForLast(u32),
}

impl SuccessRule {
    /// The number of steps that the rule speaks of.
    pub const fn steps(self) -> u32 {
        match self {
            Self::Lasted(n) | Self::ReachedWithin(n) | Self::HeldForLast(n) => n,
        }
    }
}

/// Everything that is fixed about an environment.
#[derive(Debug, Clone, Copy)]
pub struct EnvironmentSpec {
    /// The name to open it by.
    pub name: &'static str,
    /// Raised by every change of dynamics, reward or observation.
    pub revision: u32,
    /// One sentence.
    pub description: &'static str,
    /// Makes one with default parameters; fails with [`Error::Model`] if its model cannot be loaded.
    pub make: fn() -> Result<Box<dyn Environment>, Error>,
    /// The parameters that can be changed.
    pub parameters: &'static [Parameter],
    /// The entries of an observation, `[O]`.
    pub observation: &'static [Channel],
    /// The actions.
    pub action: ActionSpace,
    /// The entries of an exact initial state, `[S]`.
    pub state: &'static [Channel],
    /// The reward is the sum of these, in order.
    pub reward_terms: &'static [RewardTerm],
    /// What receipts read back from the physics.
    pub applied: &'static [Quantity],
    /// An episode is truncated after this many steps.
    pub step_limit: u32,
    /// Simulated seconds in one step.
    pub control_timestep: f64,
    /// What a step costs on one core, in µs, roughly: the pool cuts batches by it. Results never depend on it.
    pub step_cost: f64,
    /// When an episode is a success.
    pub success: SuccessRule,
    /// The same, as a sentence.
    pub success_description: &'static str,
}
