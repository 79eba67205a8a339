//! Results and records for tests, as if cells had been done.

use super::folder::{CellResult, CellState, Training};
use super::plan::{Cell, Plan};
use super::selection::Results;
use crate::TestResult;
use crate::records::{Ending, EpisodeRecord};
use crate::results::Counters;

/// A result with success rates, %, on D, R and E, and the same mean return on all.
pub fn result(cell: &Cell, [d, r, e]: [f64; 3], mean_return: f64) -> CellResult {
    let common = &cell.config.common;
    let test = |success_percent: f64| TestResult {
        episodes: 1000,
        success_percent,
        success_percent_95: [0.0, 100.0],
        mean_return,
        mean_length: 1.0,
    };
    CellResult {
        format_version: CellResult::FORMAT_VERSION,
        id: cell.id.clone(),
        training: Training {
            environment: common.environment.clone(),
            environment_revision: 1,
            model_hash: String::new(),
            version: common.version,
            set: None,
            method: cell.method(),
            configuration: cell.configuration.clone(),
            run: cell.run,
            seed: common.seed,
            counters: Counters::default(),
            settings: cell.config.table(),
        },
        results: [("D".into(), test(d)), ("R".into(), test(r)), ("E".into(), test(e))].into(),
        marks: Default::default(),
        agreement: None,
        commit: "0.1.0 (0123456789ab)".into(),
        earlier_commits: Vec::new(),
        command: "perturb train …".into(),
    }
}

/// Cells that `known` has no rates and mean return of are missing.
pub fn results(plan: &Plan, known: impl Fn(&Cell) -> Option<([f64; 3], f64)>) -> Results<'_> {
    let state = |cell: &Cell| match known(cell) {
        Some((rates, mean_return)) => CellState::Done(Box::new(result(cell, rates, mean_return))),
        None => CellState::Missing,
    };
    Results { plan, states: plan.cells.iter().map(state).collect() }
}

/// The `index`th episode of a test on `set`, which had one requested parameter, and achieved so many steps.
pub fn episode(set: &str, index: u32, requested: f64, steps: u32, success: bool) -> EpisodeRecord {
    EpisodeRecord {
        set: set.into(),
        seed: 7,
        environment_index: index,
        episode_index: 0,
        requested: vec![requested],
        applied: vec![requested],
        model_hash: String::new(),
        episode_return: f64::from(steps),
        length: steps,
        success,
        ending: Ending::Terminated,
        achieved: Some(f64::from(steps)),
        also_achieved: None,
    }
}
