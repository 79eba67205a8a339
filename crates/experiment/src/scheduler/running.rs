//! Describes each running group of cells in one line.

use std::collections::HashMap;
use std::fmt;

use super::CellEvent;
use crate::plan::Cell;

/// The running cells of one group. On this machine, a group runs in one process. On a cluster, a group has all running
/// cells of one kind.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunningGroup {
    /// Environment and architecture of the cells, with a note if their policies see the parameters.
    pub kind: String,
    /// The ids of the cells, at least one, each with its last event.
    pub cells: Vec<(String, CellEvent)>,
}

/// Format: "CartPole ff, 36 cells: 33 in training after 120 to 480 episodes, 3 in tests". For a single cell: its id and
/// last event.
impl fmt::Display for RunningGroup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let [(id, event)] = &self.cells[..] {
            return write!(f, "{id}: {event}");
        }
        let events = || self.cells.iter().map(|(_, event)| event);
        let episodes: Vec<u64> = events()
            .filter_map(|event| if let CellEvent::Training { episodes, .. } = event { Some(*episodes) } else { None })
            .collect();
        let testing = events().filter(|event| matches!(event, CellEvent::Testing { .. })).count();
        let beginning = events().filter(|event| matches!(event, CellEvent::Server { .. })).count();
        let mut parts = Vec::new();
        if let (Some(least), Some(most)) = (episodes.iter().min(), episodes.iter().max()) {
            let range = if least == most { most.to_string() } else { format!("{least} to {most}") };
            parts.push(format!("{} in training after {range} episodes", episodes.len()));
        }
        for (number, what) in [(testing, "in tests"), (beginning, "to begin")] {
            if number > 0 {
                parts.push(format!("{number} {what}"));
            }
        }
        write!(f, "{}, {} cells: {}", self.kind, self.cells.len(), parts.join(", "))
    }
}

/// Collects running groups in the order of their first cells.
#[derive(Default)]
pub(super) struct Running {
    pub(super) groups: Vec<RunningGroup>,
    /// Index in `groups` by group number.
    places: HashMap<usize, usize>,
}

impl Running {
    /// Adds a running cell with its last event. `group` is the number of its group; `None` for a cell that runs alone.
    pub(super) fn add(&mut self, cell: &Cell, group: Option<usize>, event: &CellEvent) {
        let entry = (cell.id.clone(), event.clone());
        if let Some(&place) = group.and_then(|number| self.places.get(&number)) {
            return self.groups[place].cells.push(entry);
        }
        if let Some(number) = group {
            self.places.insert(number, self.groups.len());
        }
        let (environment, architecture, observe, ..) = cell.kind();
        let sees = observe.note().map_or_else(String::new, |sees| format!(" ({sees})"));
        self.groups.push(RunningGroup { kind: format!("{environment} {architecture}{sees}"), cells: vec![entry] });
    }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    fn training(episodes: u64) -> CellEvent {
        CellEvent::Training { episodes, timesteps: 9, saved: 0 }
    }

    fn testing() -> CellEvent {
        CellEvent::Testing { set: "D".into(), episodes: 3 }
    }

    #[rstest]
    #[case::alone(&[training(7)], "a: 7 episodes of training")]
    #[case::alike(&[training(7), training(7)], "Hopper ff, 2 cells: 2 in training after 7 episodes")]
    #[case::all_there_is(
        &[training(9), CellEvent::Server { address: "unix:/x".into() }, testing(), training(4)],
        "Hopper ff, 4 cells: 2 in training after 4 to 9 episodes, 1 in tests, 1 to begin"
    )]
    fn a_group_is_one_line(#[case] events: &[CellEvent], #[case] line: &str) {
        let cells = events.iter().map(|event| ("a".to_owned(), event.clone())).collect();
        assert_eq!(RunningGroup { kind: "Hopper ff".into(), cells }.to_string(), line);
    }
}
