//! The clean rule of selection: tuning cells select configurations, which are then trained again with other seeds.
//!
//! One configuration is selected for each environment, method and training distribution: the configuration with the
//! highest success rate in its selection tests, averaged over tuning seeds. Ties go to the higher mean return in the
//! same tests, then to the plan's order. A selection is made when each of its tuning cells has a result or has failed.
//! A configuration with some failed cells is ranked by its other cells, whose number is [`Chosen::seeds`]. A
//! configuration without any result cannot be selected.

use std::collections::HashMap;

use perturb_records::statistics::mean;
use perturb_records::{TestResult, TrainedOn};
use perturb_settings::Method;

use crate::folder::{CellState, FolderError};
use crate::plan::{Cell, Plan, SELECTION_TEST};
use crate::states::CellStates;

/// The state of the selection among the configurations of one environment, method and training distribution.
#[derive(Clone, Debug, PartialEq)]
pub struct Tuned<'a> {
    /// The environment's name.
    pub environment: &'a str,
    /// The method: algorithm, architecture and kind of observation.
    pub method: Method,
    /// The training distribution. The selection tests use it too.
    pub trained_on: TrainedOn<'a>,
    /// Number of tuning cells.
    pub cells: usize,
    /// Number of tuning cells with a result.
    pub done: usize,
    /// Number of tuning cells that failed.
    pub failed: usize,
    /// Number of tuning seeds.
    pub seeds: usize,
    /// The selected configuration; `None` while tuning cells are unfinished, or if all tuning cells failed.
    pub chosen: Option<Chosen<'a>>,
}

/// A selected configuration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chosen<'a> {
    /// The configuration's first tuning cell with a result.
    pub cell: &'a Cell,
    /// The success rate in the selection tests, averaged over tuning seeds, %.
    pub success_percent: f64,
    /// The mean return in the selection tests, averaged over tuning seeds.
    pub mean_return: f64,
    /// Number of tuning seeds with a result of this configuration.
    pub seeds: usize,
}

impl Tuned<'_> {
    /// Returns whether every tuning cell has a result or has failed.
    pub fn is_complete(&self) -> bool {
        self.done + self.failed == self.cells
    }
}

/// Returns the progress and the result of the selection among tuning cells, for each environment, method and training
/// distribution in the plan's order. `states` are the states of the plan's cells.
pub fn tuned<'a>(plan: &'a Plan, states: &'a [CellState]) -> Vec<Tuned<'a>> {
    let mut groups: Vec<(Tuned<'a>, Vec<Vec<Candidate<'a>>>)> = Vec::new();
    let mut places = HashMap::new();
    let mut configurations: HashMap<(usize, &str), usize> = HashMap::new();
    for (cell, state) in plan.cells.iter().zip(states).filter(|(cell, _)| cell.tests.selection.is_some()) {
        let (environment, method, trained_on) = kind(cell);
        let place = *places.entry(kind(cell)).or_insert_with(|| {
            let (cells, done, failed, seeds, chosen) = (0, 0, 0, plan.tuning_runs as usize, None);
            let tuned = Tuned { environment, method, trained_on, cells, done, failed, seeds, chosen };
            groups.push((tuned, Vec::new()));
            groups.len() - 1
        });
        let (tuned, candidates) = &mut groups[place];
        tuned.cells += 1;
        tuned.failed += usize::from(matches!(state, CellState::Failed(_)));
        let CellState::Done(result) = state else { continue };
        let Some(test) = result.results.get(SELECTION_TEST) else { continue };
        tuned.done += 1;
        let configuration = *configurations.entry((place, &cell.configuration)).or_insert_with(|| {
            candidates.push(Vec::new());
            candidates.len() - 1
        });
        candidates[configuration].push((cell, test));
    }
    let select = |(tuned, candidates): (Tuned<'a>, Vec<Vec<Candidate<'a>>>)| {
        let chosen = candidates.iter().map(|tests| Chosen::new(tests)).reduce(Chosen::better);
        Tuned { chosen: chosen.filter(|_| tuned.is_complete()), ..tuned }
    };
    groups.into_iter().map(select).collect()
}

/// A tuning cell and its selection test.
type Candidate<'a> = (&'a Cell, &'a TestResult);

impl<'a> Chosen<'a> {
    /// Averages the selection tests of a configuration's tuning cells. There must be at least one cell.
    fn new(tests: &[Candidate<'a>]) -> Self {
        let over_seeds = |figure: fn(&TestResult) -> f64| mean(tests.iter().map(|(_, test)| figure(test)));
        Self {
            cell: tests[0].0,
            success_percent: over_seeds(|test| test.success_percent),
            mean_return: over_seeds(|test| test.mean_return),
            seeds: tests.len(),
        }
    }

    /// Returns the better of two configurations, or `self` if they tie. `self` must come first in the plan.
    fn better(self, other: Self) -> Self {
        let rank = |chosen: &Self| (chosen.success_percent, chosen.mean_return);
        if rank(&other) > rank(&self) { other } else { self }
    }
}

/// Returns the key of the selection that a cell takes part in: environment, method and training distribution.
fn kind(cell: &Cell) -> (&str, Method, TrainedOn<'_>) {
    (&cell.config.common.environment, cell.method(), cell.trained_on())
}

impl Plan {
    /// Returns the plan with its tuning cells followed by the cells of the configurations that they have selected so
    /// far. `states` provides the results of the tuning cells. A plan without tuning cells is returned unchanged.
    ///
    /// # Errors
    /// [`FolderError`] if a state cannot be read.
    pub fn with_selected_cells(&self, states: &dyn CellStates) -> Result<Self, FolderError> {
        self.with_chosen(Some(states), false)
    }

    /// Returns the plan with its final number of cells, for estimates. If a configuration is not selected yet, the
    /// candidates of the first configuration take the place of the cells that the selection will add.
    ///
    /// # Errors
    /// [`FolderError`] if a state cannot be read.
    pub fn with_expected_cells(&self, states: Option<&dyn CellStates>) -> Result<Self, FolderError> {
        self.with_chosen(states, true)
    }

    /// Appends the selected cells to the plan. With `stand_ins`, the candidates of the first configuration take the
    /// place of cells that are not selected yet.
    fn with_chosen(&self, states: Option<&dyn CellStates>, stand_ins: bool) -> Result<Self, FolderError> {
        let mut plan = self.clone();
        if self.candidates.is_empty() {
            return Ok(plan);
        }
        let state = |cell| states.map_or(Ok(CellState::Missing), |states| states.state(cell));
        let states = self.cells.iter().map(state).collect::<Result<Vec<_>, _>>()?;
        for tuned in tuned(self, &states) {
            let known = (tuned.environment, tuned.method, tuned.trained_on);
            let of_kind: Vec<&Cell> = self.candidates.iter().filter(|cell| kind(cell) == known).collect();
            let first = of_kind.first().filter(|_| stand_ins).and_then(|cell| cell.tuned_as.as_ref());
            let chosen = tuned.chosen.map(|chosen| &chosen.cell.configuration).or(first);
            plan.cells.extend(of_kind.into_iter().filter(|cell| cell.tuned_as.as_ref() == chosen).cloned());
        }
        Ok(plan)
    }
}

#[cfg(test)]
#[path = "tuning_tests.rs"]
mod tests;
