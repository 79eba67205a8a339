//! When an episode is a success.

use super::Quantity;

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
    /// The most successive steps after all of which the goal held.
    LongestGoals,
    /// What the environment says: [`Environment::achieved`](super::Environment::achieved).
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
            Achievement::LongestGoals => Quantity { name: "steps_in_a_row", unit: "1" },
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
