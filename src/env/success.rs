//! Success rules of episodes.

use super::QuantitySpec;

/// A success rule: it compares a value that the episode achieved with a threshold. An episode without such a value is
/// not a success. Source: the paper, section "Experimental methodology".
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SuccessRuleSpec {
    /// The rule, as a sentence.
    pub description: &'static str,
    /// The value that is compared with the threshold.
    pub achievement: Achievement,
    /// The direction of the comparison.
    pub comparison: SuccessComparison,
    /// The threshold, in the unit of [`SuccessRuleSpec::quantity`].
    pub threshold: f64,
}

/// A value of an episode that a success rule can compare.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Achievement {
    /// The number of steps of the episode.
    Length,
    /// The number of the first step, from 1, after which the task's goal was met. No value if it was never met.
    FirstGoal,
    /// How many steps in a row, up to the episode's last one, ended with the task's goal met.
    LastGoals,
    /// The largest number of successive steps of the episode that ended with the task's goal met.
    LongestGoals,
    /// A quantity of the environment's own, which [`Environment::achieved`](super::Environment::achieved) returns.
    Own(QuantitySpec),
}

/// The direction in which a success rule compares the achieved value with the threshold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SuccessComparison {
    /// An episode succeeds if the achieved value is the threshold or more.
    AtLeast,
    /// An episode succeeds if the achieved value is the threshold or less.
    AtMost,
}

impl SuccessRuleSpec {
    /// Returns the name and unit of the compared value.
    pub const fn quantity(&self) -> QuantitySpec {
        match self.achievement {
            Achievement::Own(quantity) => quantity,
            Achievement::LongestGoals => QuantitySpec { name: "steps_in_a_row", unit: "1" },
            _ => QuantitySpec { name: "steps", unit: "1" },
        }
    }

    /// Whether an episode that achieved this value is a success. False for `None`.
    pub fn holds(&self, achieved: Option<f64>) -> bool {
        achieved.is_some_and(|achieved| match self.comparison {
            SuccessComparison::AtLeast => achieved >= self.threshold,
            SuccessComparison::AtMost => achieved <= self.threshold,
        })
    }
}
