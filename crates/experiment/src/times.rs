//! What finished cells took.

use std::collections::HashMap;

use perturb_settings::Method;

use crate::plan::Cell;

/// What finished cells took.
#[derive(Debug, Default)]
pub(crate) struct Times<'a> {
    by_pair: HashMap<(&'a str, Method), Mean>,
    all: Mean,
}

#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    sum: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, number: f64) {
        self.sum += number;
        self.count += 1.0;
    }

    fn get(self) -> Option<f64> {
        (self.count > 0.0).then(|| self.sum / self.count)
    }
}

impl<'a> Times<'a> {
    pub(crate) fn add(&mut self, cell: &'a Cell, seconds: f64) {
        self.by_pair.entry((&cell.config.common.environment, cell.method())).or_default().add(seconds);
        self.all.add(seconds);
    }

    /// What cells of the same environment and learner took; `None` before the first.
    pub(crate) fn of_pair(&self, cell: &Cell) -> Option<f64> {
        self.by_pair.get(&(cell.config.common.environment.as_str(), cell.method()))?.get()
    }

    /// How many cells there are.
    pub(crate) fn cells(&self) -> usize {
        self.all.count as usize
    }
}
