//! The selected policies that have recorded episodes.

use std::collections::BTreeSet;

use perturb_experiment::{MethodResults, Recorded};
use perturb_records::TrainedOn;
use perturb_records::outcomes::{Outcomes, PolicyOutcomes};
use perturb_settings::Method;

/// The policies of a method that were trained on something, those that were selected and have recorded episodes.
#[derive(Clone)]
pub(super) struct PolicyGroup<'a> {
    pub(super) environment: &'a str,
    pub(super) method: &'a Method,
    pub(super) trained_on: TrainedOn<'a>,
    pub(super) policies: Vec<&'a PolicyOutcomes>,
}

impl<'a> PolicyGroup<'a> {
    /// Returns the tests of each run.
    pub(super) fn tests(&self, tested_on: &'a str) -> impl Iterator<Item = &'a Outcomes> + use<'a> {
        self.policies.clone().into_iter().filter_map(move |policy| policy.test(tested_on))
    }
}

/// All that have recorded episodes, by environment, in the order of `selections`.
pub(super) fn trained<'a>(selections: &'a [MethodResults<'a>], recorded: &'a Recorded) -> Vec<Vec<PolicyGroup<'a>>> {
    let of_selection = |selection: &'a MethodResults<'a>| {
        // A run of an agent that was trained elsewhere may lack what another one has.
        let all: BTreeSet<TrainedOn<'a>> =
            selection.runs.values().flat_map(|run| run.selected.keys().copied()).collect();
        all.into_iter().map(|trained_on| {
            let selected = selection.runs.values().filter_map(|run| run.trained_on(trained_on));
            let policies = selected.filter_map(|selected| recorded.policy(&selected)).collect();
            PolicyGroup { environment: selection.environment, method: &selection.method, trained_on, policies }
        })
    };
    let of_environment = |selections: &'a [MethodResults<'a>]| {
        selections.iter().flat_map(of_selection).filter(|trained| !trained.policies.is_empty()).collect()
    };
    selections.chunk_by(|a, b| a.environment == b.environment).map(of_environment).collect()
}
