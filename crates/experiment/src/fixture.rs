//! Made-up results of cells for tests, and the test fixtures of `perturb-records`.
#![allow(dead_code, unused_imports, reason = "each crate that includes it needs a part")]

use perturb_checkpoint::Counters;
use perturb_experiment::{Cell, CellResult, CellState, Plan, Results, Training};
use perturb_records::TestResult;

#[path = "../../records/src/fixture.rs"]
mod records;

pub use self::records::{assessed, episode, heatmap};

/// Returns a result of `cell` with the success rates `[d, r, e]` (%) on the test sets D, R and E, and one mean return
/// for all.
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

/// Returns the results of a plan. A cell is done if `known` returns its success rates and mean return, and missing
/// otherwise.
pub fn results(plan: &Plan, known: impl Fn(&Cell) -> Option<([f64; 3], f64)>) -> Results<'_> {
    let state = |cell: &Cell| match known(cell) {
        Some((rates, mean_return)) => CellState::Done(Box::new(result(cell, rates, mean_return))),
        None => CellState::Missing,
    };
    Results { plan, states: plan.cells.iter().map(state).collect() }
}
