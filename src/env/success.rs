//! Success rules of episodes.

use super::Quantity;

/// A success rule (the paper, section "Experimental methodology"): the value that an episode achieved is compared with
/// a threshold. An episode that achieved no value is no success.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Success {
    /// The rule, as a sentence.
    pub description: &'static str,
    /// The value that is compared.
    pub achievement: Achievement,
    /// The comparison.
    pub comparison: Comparison,
    /// The threshold, in the unit of [`Success::quantity`].
    pub threshold: f64,
}

/// A value that an episode can achieve.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Achievement {
    /// The number of steps.
    Length,
    /// The first step after which the goal held, counted from 1; no value if it never held.
    FirstGoal,
    /// The length, in steps, of the run that ends with the last step and after each step of which the goal held.
    LastGoals,
    /// The length, in steps, of the longest run of steps after each of which the goal held.
    LongestGoals,
    /// The value of [`Environment::achieved`](super::Environment::achieved).
    Own(Quantity),
}

/// The comparison of the achieved value with the threshold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Comparison {
    /// An episode succeeds if the achieved value is the threshold or more.
    AtLeast,
    /// An episode succeeds if the achieved value is the threshold or less.
    AtMost,
}

impl Success {
    /// Returns the quantity that is compared.
    pub const fn quantity(&self) -> Quantity {
        match self.achievement {
            Achievement::Own(quantity) => quantity,
            Achievement::LongestGoals => Quantity { name: "steps_in_a_row", unit: "1" },
            _ => Quantity { name: "steps", unit: "1" },
        }
    }

    /// Tells whether an episode that achieved this value is a success.
    pub fn holds(&self, achieved: Option<f64>) -> bool {
        achieved.is_some_and(|achieved| match self.comparison {
            Comparison::AtLeast => achieved >= self.threshold,
            Comparison::AtMost => achieved <= self.threshold,
        })
    }
}
