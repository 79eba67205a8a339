//! The recorded episodes of the policies in a report.

use std::collections::{BTreeMap, BTreeSet};

use perturb_records::Records;
use perturb_records::outcomes::PolicyOutcomes;

use crate::folder::CellResult;
use crate::selection::{MethodResults, Reported};

/// The recorded episodes of selected policies, by their cells' ids.
#[derive(Clone, Debug, Default)]
pub struct Recorded {
    wanted: BTreeSet<String>,
    policies: BTreeMap<String, PolicyOutcomes>,
}

impl Recorded {
    /// Returns an empty collection for the cells in `selections`.
    pub fn new(selections: &[MethodResults<'_>]) -> Self {
        let runs = selections.iter().flat_map(|selection| selection.runs.values());
        let selected = runs.flat_map(|run| run.selected.values().flatten()).filter_map(Reported::cell);
        Self { wanted: selected.map(|selected| selected.cell.id.clone()).collect(), policies: BTreeMap::new() }
    }

    /// Returns whether a cell was selected.
    pub fn wants(&self, cell: &str) -> bool {
        self.wanted.contains(cell)
    }

    /// Keeps the required part of a cell's `records`, if the cell was selected.
    pub fn add(&mut self, result: &CellResult, records: &Records) {
        if self.wants(&result.id) {
            let names = result.results.keys().map(String::as_str);
            self.policies.insert(result.id.clone(), PolicyOutcomes::new(records, names));
        }
    }

    /// Returns the number of selected cells that have recorded episodes, and the number of selected cells.
    pub fn count(&self) -> (usize, usize) {
        (self.policies.len(), self.wanted.len())
    }

    /// Returns the recorded episodes of the reported policy; `None` if there are none.
    pub fn policy<'a>(&'a self, reported: &Reported<'a>) -> Option<&'a PolicyOutcomes> {
        match reported {
            Reported::Cell(selected) => self.policies.get(&selected.cell.id),
            Reported::External(_, policy) => Some(policy.outcomes()),
        }
    }
}
