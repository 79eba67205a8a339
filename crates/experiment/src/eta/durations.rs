//! Mean durations of finished cells.

use std::collections::HashMap;

use perturb_settings::Method;

use crate::folder::ExperimentFolder;
use crate::plan::{Cell, Plan};

/// The process times of finished cells, by environment and method. They predict the durations of the remaining cells.
/// Cells that run together in one process share the time of the process equally.
#[derive(Debug, Default)]
pub struct CellDurations<'a> {
    /// Sums by environment and method.
    sums: HashMap<(&'a str, Method), Sum>,
    /// Number of finished cells.
    count: usize,
}

/// The summed process time of finished cells, and the number of these cells.
#[derive(Clone, Copy, Debug, Default)]
struct Sum {
    seconds: f64,
    count: f64,
}

impl<'a> CellDurations<'a> {
    /// Reads the durations of the cells of `plan` that have a result in `folder`.
    pub fn read(plan: &'a Plan, folder: &ExperimentFolder) -> Self {
        let mut durations = Self::default();
        for cell in &plan.cells {
            let place = folder.cell(&cell.id);
            if let Some(timing) = place.timing().filter(|_| place.is_settled(false)) {
                durations.add(cell, timing.seconds);
            }
        }
        durations
    }

    /// Adds a finished cell, which took `seconds` of process time.
    pub(crate) fn add(&mut self, cell: &'a Cell, seconds: f64) {
        let sum = self.sums.entry((&cell.config.common.environment, cell.method())).or_default();
        sum.seconds += seconds;
        sum.count += 1.0;
        self.count += 1;
    }

    /// Returns the mean process time, in seconds, of finished cells with the environment and method of `cell`. Returns
    /// `None` if there are none.
    pub fn seconds(&self, cell: &Cell) -> Option<f64> {
        let sum = self.sums.get(&(cell.config.common.environment.as_str(), cell.method()))?;
        Some(sum.seconds / sum.count)
    }

    /// Returns the number of finished cells.
    pub fn cells(&self) -> usize {
        self.count
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Timing;

    #[test]
    fn durations_are_averaged_by_environment_and_method() {
        let text = "environments = ['CartPole', 'Hopper']\nversions = ['D']\nruns = 3
            [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";
        let plan = Plan::parse("test", text.into()).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(directory.path());
        for (cell, seconds, done) in [(0, 10.0, true), (1, 20.0, true), (2, 900.0, false)] {
            let place = folder.cell(&plan.cells[cell].id);
            place.write_timing(&Timing { seconds }).unwrap();
            if done {
                std::fs::write(place.path().join("result.json"), "x").unwrap();
            }
        }
        let durations = CellDurations::read(&plan, &folder);
        assert_eq!(durations.cells(), 2, "a cell without a result is left out");
        assert_eq!((durations.seconds(&plan.cells[2]), durations.seconds(&plan.cells[3])), (Some(15.0), None));
    }
}
