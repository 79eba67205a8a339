//! Parameters and outcomes of recorded episodes, by column. Success over parameters and tail risk are computed from
//! them.

mod partition;
mod sweeps;
mod worst;

use std::collections::BTreeMap;

use crate::records::{RecordedParameter, RecordedTest, Records};

use perturb_settings::sets::Contexts;
pub use sweeps::{Bin, SuccessCount, bins, success_within, success_within_both};
pub use worst::{SHARE, conditional_value_at_risk, worst_contexts};

/// The parameters and outcomes of all episodes of a policy's tests.
#[derive(Clone, Debug, PartialEq)]
pub struct PolicyOutcomes {
    /// The parameters, in the order of [`Outcomes::parameters`].
    pub parameters: Vec<RecordedParameter>,
    tests: BTreeMap<String, Outcomes>,
}

/// The parameters and outcomes of the n episodes of a test, in recorded order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcomes {
    /// `[P, n]` requested values of each of the P parameters.
    pub parameters: Vec<Vec<f64>>,
    /// `[n]` index of each episode's context, if the test set is a list of contexts (combinations of parameter values).
    pub contexts: Option<Vec<usize>>,
    /// `[n]` undiscounted returns.
    pub returns: Vec<f64>,
    /// `[n]` whether the episode was a success.
    pub successes: Vec<bool>,
}

impl PolicyOutcomes {
    /// Collects the episodes of the tests on the sets called `names`.
    pub fn new<'a>(records: &Records, names: impl Iterator<Item = &'a str>) -> Self {
        let tests = names.map(|name| (name.to_owned(), Outcomes::new(records, name))).collect();
        Self { parameters: records.about.parameters.clone(), tests }
    }

    /// Returns the episodes of the test on the set called `tested_on`; `None` if there are none.
    pub fn test(&self, tested_on: &str) -> Option<&Outcomes> {
        self.tests.get(tested_on).filter(|outcomes| !outcomes.returns.is_empty())
    }
}

impl Outcomes {
    /// Collects the episodes of the test on the set called `name`. The result is empty if there was no such test.
    pub fn new(records: &Records, name: &str) -> Self {
        let rows = || records.episodes_on(name);
        let parameter =
            |place: usize| rows().map(|row| row.requested.get(place).copied().unwrap_or(f64::NAN)).collect();
        let listed = |test: &RecordedTest| match &test.set.contexts {
            Contexts::Listed(contexts) if test.set.name == name => Some(contexts.len()),
            _ => None,
        };
        let contexts = records.about.tests.iter().find_map(listed);
        Self {
            parameters: (0..records.about.parameters.len()).map(parameter).collect(),
            contexts: contexts.map(|n| rows().map(|row| row.environment_index as usize % n).collect()),
            returns: rows().map(|row| row.episode_return).collect(),
            successes: rows().map(|row| row.success).collect(),
        }
    }
}
