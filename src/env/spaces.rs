//! What an environment looks like from outside: observations, actions, rewards, success.

use super::{Distribution, Environment, Error, Parameter, Version};

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

/// A quantity that is read back from the physics.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quantity {
    /// Unique within its environment.
    pub name: &'static str,
    /// SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
}

/// When an episode is a success (the paper, section "Experimental methodology"): when it achieved something, and that
/// compares with the threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Success {
    /// The rule, as a sentence.
    pub description: &'static str,
    /// What is compared.
    pub achievement: Achievement,
    /// How it is compared.
    pub comparison: Comparison,
    /// With what.
    pub threshold: f64,
}

/// What an episode can achieve.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Achievement {
    /// Its number of steps.
    Length,
    /// The first step after which the goal held, counted from 1; nothing if it never did.
    FirstGoal,
    /// The number of last steps after all of which the goal held.
    LastGoals,
    /// What the environment says: [`Environment::achieved`].
    Own(Quantity),
}

/// How what was achieved compares with the threshold in a success.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Comparison {
    /// It is the threshold or more.
    AtLeast,
    /// It is the threshold or less.
    AtMost,
}

impl Success {
    /// What is compared.
    pub const fn quantity(&self) -> Quantity {
        match self.achievement {
            Achievement::Own(quantity) => quantity,
            _ => Quantity { name: "steps", unit: "1" },
        }
    }

    /// Whether an episode that achieved this is a success.
    pub fn holds(&self, achieved: Option<f64>) -> bool {
        achieved.is_some_and(|achieved| match self.comparison {
            Comparison::AtLeast => achieved >= self.threshold,
            Comparison::AtMost => achieved <= self.threshold,
        })
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
    pub success: Success,
    /// The two parameters, along x and along y, that show best where a policy works.
    pub heatmap_axes: Option<[&'static str; 2]>,
}

impl EnvironmentSpec {
    /// The distributions of a version, one for each parameter.
    pub fn distributions(&self, version: Version) -> Vec<Distribution> {
        self.parameters.iter().map(|parameter| parameter.distribution(version)).collect()
    }
}
