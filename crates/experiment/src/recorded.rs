//! The recorded episodes of the policies in a report.

use std::collections::{BTreeMap, BTreeSet};

use perturb_records::Records;
use perturb_records::outcomes::PolicyOutcomes;

use crate::folder::CellResult;
use crate::selection::{MethodResults, Reported};

/// The recorded episodes of selected policies, by cell id.
#[derive(Clone, Debug, Default)]
pub struct Recorded {
    wanted: BTreeSet<String>,
    policies: BTreeMap<String, PolicyOutcomes>,
}

impl Recorded {
    /// Returns an empty collection, which accepts records of the selected cells in `selections`.
    pub fn new(selections: &[MethodResults<'_>]) -> Self {
        let runs = selections.iter().flat_map(|selection| selection.runs.values());
        let selected = runs.flat_map(|run| run.selected.values().flatten()).filter_map(Reported::cell);
        Self { wanted: selected.map(|selected| selected.cell.id.clone()).collect(), policies: BTreeMap::new() }
    }

    /// Returns whether the cell with this id was selected.
    pub fn wants(&self, cell: &str) -> bool {
        self.wanted.contains(cell)
    }

    /// Stores the outcomes of a cell's `records` if the cell was selected. Ignores other cells.
    pub fn add(&mut self, result: &CellResult, records: &Records) {
        if self.wants(&result.id) {
            let names = result.results.keys().map(String::as_str);
            self.policies.insert(result.id.clone(), PolicyOutcomes::new(records, names));
        }
    }

    /// Returns two numbers: selected cells with recorded episodes, and all selected cells.
    pub fn count(&self) -> (usize, usize) {
        (self.policies.len(), self.wanted.len())
    }

    /// Returns the recorded episodes of a reported policy; `None` if there are none.
    pub fn policy<'a>(&'a self, reported: &Reported<'a>) -> Option<&'a PolicyOutcomes> {
        match reported {
            Reported::Cell(selected) => self.policies.get(&selected.cell.id),
            Reported::External(_, policy) => Some(policy.outcomes()),
        }
    }
}
