//! Mean success rates of finished cells, for display during a run.

use std::collections::BTreeMap;

use perturb_text::count;

use crate::folder::CellResult;
use crate::plan::Cell;

/// Mean success rates of all finished cells with the same environment, method and training distribution. The mean is
/// over settings and runs.
#[derive(Clone, Debug, PartialEq)]
pub struct Rate {
    /// Environment, method and training distribution of the cells, see [`Cell::described`].
    pub kind: String,
    /// The number of finished cells.
    pub cells: usize,
    /// Name of each test set with its mean success rate, %.
    pub success: Vec<(String, f64)>,
}

/// Collects [`Rate`]s. The key of a rate is the index in the plan of the first cell that was added to it.
#[derive(Debug, Default)]
pub(crate) struct Rates(BTreeMap<usize, (Rate, Vec<f64>)>);

impl Rates {
    /// Adds the result of a finished cell.
    pub(crate) fn add(&mut self, cell: &Cell, result: &CellResult) {
        let kind = cell.described();
        let known = self.0.iter().find(|(_, (rate, _))| rate.kind == kind).map(|(&index, _)| index);
        let names = || cell.tests.sets.iter().map(|set| (set.name.clone(), 0.0)).collect();
        let new = || (Rate { kind: kind.clone(), cells: 0, success: names() }, Vec::new());
        let (rate, sums) = self.0.entry(known.unwrap_or(cell.index)).or_insert_with(new);
        rate.cells += 1;
        sums.resize(rate.success.len(), 0.0);
        for ((name, mean), sum) in rate.success.iter_mut().zip(sums) {
            *sum += result.results.get(name).map_or(f64::NAN, |test| test.success_percent);
            *mean = *sum / rate.cells as f64;
        }
    }

    /// Returns the rates in the order of their keys.
    pub(crate) fn list(&self) -> Vec<Rate> {
        self.0.values().map(|(rate, _)| rate.clone()).collect()
    }
}

/// Format: "CartPole ppo ff, trained on R: D 100.0, E 64.1 % (3 cells)".
impl std::fmt::Display for Rate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let rates: Vec<String> = self.success.iter().map(|(name, percent)| format!("{name} {percent:.1}")).collect();
        write!(f, "{}: {} % ({})", self.kind, rates.join(", "), count(self.cells, "cell"))
    }
}
