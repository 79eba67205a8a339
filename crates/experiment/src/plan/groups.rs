//! Divides cells into groups. One process trains the cells of a group together.
//!
//! The cells of a group have the same environment, architecture and kind of observation, so their steps can be one
//! batch. All cells that share a batch wait for the slowest one, so cells with different [collection
//! modes](CollectionMode) are in separate groups. Cells with disturbances are in separate groups too. A cell's result
//! does not depend on its group.

use std::ops::Range;

use perturb_protocol::disturbance::is_disturbance;
use perturb_settings::sets::Context;
use perturb_settings::{Architecture, CollectionMode, Observe, TrainConfig};

use super::{Cell, Plan, distinct};

/// Maximal number of values in the contexts of a group. Together they take half of the mebibyte that a request to open
/// environments may have.
const MAX_CONTEXT_VALUES: usize = (1 << 19) / size_of::<f64>();

/// Limits on the size and number of groups.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grouping {
    /// Maximum number of cells in a group, at least 1.
    pub max_cells: usize,
    /// Number of processes that run groups in parallel, at least 1. Cells of one [kind](Cell::kind) are divided into a
    /// multiple of this number of groups if there are enough of them, so that all processes are busy until the end.
    pub at_a_time: usize,
}

impl Grouping {
    /// Default maximum number of cells in a group. Larger groups save little time, because a step's fixed cost is
    /// already shared by many cells.
    pub const USUAL: usize = 36;
    /// A single group for each [kind](Cell::kind) of cells, without a limit on its size.
    pub const BY_KIND: Self = Self { max_cells: usize::MAX, at_a_time: 1 };

    /// Divides `cells` cells of one kind into groups whose sizes differ by at most one. Returns their ranges.
    fn cut(self, cells: usize) -> impl Iterator<Item = Range<usize>> {
        let groups = cells.div_ceil(self.max_cells.max(1)).next_multiple_of(self.at_a_time.max(1)).min(cells);
        (0..groups).map(move |group| group * cells / groups..(group + 1) * cells / groups)
    }
}

impl Cell {
    /// Returns the kind of the cell: environment, architecture, kind of observation, collection mode, and whether it
    /// has disturbances. Only cells of the same kind can be in one group.
    pub fn kind(&self) -> (&str, Architecture, Observe, CollectionMode, bool) {
        let TrainConfig { common, .. } = &self.config;
        let is_disturbed = common.parameter_names().any(is_disturbance);
        (&common.environment, common.architecture, common.observe, self.config.rollouts(), is_disturbed)
    }

    /// Returns the number of values in all contexts of the training.
    fn context_values(&self) -> usize {
        self.config.common.contexts.iter().map(Context::len).sum()
    }
}

impl Plan {
    /// Divides `cells`, ascending indices in the plan, into groups. Each group has successive cells of one kind. Groups
    /// are ordered by kind in the plan's order, and depend only on the plan and the arguments.
    pub fn groups(&self, cells: &[usize], grouping: Grouping) -> Vec<Vec<usize>> {
        let mut groups: Vec<Vec<usize>> = Vec::new();
        for kind in distinct(cells.iter().map(|&cell| self.cells[cell].kind())) {
            let of_kind: Vec<usize> = cells.iter().copied().filter(|&cell| self.cells[cell].kind() == kind).collect();
            let values = of_kind.iter().map(|&cell| self.cells[cell].context_values()).max().unwrap_or_default();
            let max_cells = grouping.max_cells.min(MAX_CONTEXT_VALUES / values.max(1));
            let grouping = Grouping { max_cells, ..grouping };
            groups.extend(grouping.cut(of_kind.len()).map(|range| of_kind[range].to_vec()));
        }
        groups
    }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case::one_process(36, 1, 5, &[5])]
    #[case::enough_for_all_processes(36, 2, 5, &[2, 3])]
    #[case::not_more_than_cells(36, 8, 3, &[1, 1, 1])]
    #[case::no_larger_than_asked_for(36, 1, 100, &[33, 33, 34])]
    #[case::all_processes_to_the_end(36, 2, 100, &[25, 25, 25, 25])]
    #[case::alone(1, 2, 3, &[1, 1, 1])]
    #[case::by_kind(usize::MAX, 1, 100, &[100])]
    #[case::none(36, 2, 0, &[])]
    fn cells_of_a_kind_are_cut_evenly(
        #[case] most: usize,
        #[case] at_a_time: usize,
        #[case] cells: usize,
        #[case] sizes: &[usize],
    ) {
        let ranges: Vec<Range<usize>> = Grouping { max_cells: most, at_a_time }.cut(cells).collect();
        assert_eq!(ranges.iter().map(Range::len).collect::<Vec<_>>(), sizes);
        assert!(ranges.into_iter().flatten().eq(0..cells));
    }

    #[test]
    fn group_has_no_more_contexts_than_a_request() {
        let text = "environments = ['CartPole']\nversions = ['many']\nruns = 50\n[sets.many]\nfile = 'many.csv'
            [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
        for (rows, size) in [(16, 50), (1024, 32)] {
            let csv_file = |_: &str| Ok(format!("force,length\n{}", "7,0.5\n".repeat(rows)).into_bytes());
            let plan = Plan::parse_with("plan.toml", text.into(), std::path::Path::new(""), &csv_file).unwrap();
            let groups = plan.groups(&(0..50).collect::<Vec<_>>(), Grouping::BY_KIND);
            assert!(groups.iter().all(|group| group.len() <= size) && groups.len() == 50_usize.div_ceil(size));
        }
    }

    #[test]
    fn group_has_one_environment_and_architecture() {
        let text = "environments = ['CartPole', 'Hopper']\nversions = ['D']\nruns = 2
            [[algorithm]]\nname = 'a2c'\narchitectures = ['ff', 'rc']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']
            settings = { n_steps = 63, n_minibatches = 1 }";
        let plan = Plan::parse("test", text.into()).unwrap();
        let all: Vec<usize> = (0..plan.cells.len()).collect();
        // Each environment has two cells of A2C with FF, two of A2C with RC, and two of PPO with FF.
        let groups = plan.groups(&all, Grouping { max_cells: 3, at_a_time: 1 });
        assert_eq!(groups, [vec![0, 1], vec![4, 5], vec![2, 3], vec![6, 7], vec![10, 11], vec![8, 9]]);
        assert_eq!(
            plan.cells[groups[1][0]].kind(),
            ("CartPole", Architecture::Ff, Observe::State, CollectionMode::Short, false)
        );
        let left = plan.groups(&[1, 5, 8, 11], Grouping { max_cells: 36, at_a_time: 1 });
        assert_eq!(left, [vec![1, 5], vec![8], vec![11]]);
    }

    #[test]
    fn cells_with_long_rollouts_are_groups_of_their_own() {
        let text = "environments = ['CartPole']\nversions = ['D']\nruns = 1
            [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\ngrid = { n_steps = [32, 64, 128] }
            [[algorithm]]\nname = 'epopt-a2c'\narchitectures = ['ff']\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']
            [[algorithm]]\nname = 'random'\narchitectures = ['ff']";
        let plan = Plan::parse("test", text.into()).unwrap();
        let all: Vec<usize> = (0..plan.cells.len()).collect();
        assert_eq!(plan.groups(&all, Grouping::BY_KIND), [vec![0, 4], vec![1, 2, 3], vec![5]]);
    }

    #[test]
    fn cells_of_a_group_see_the_same() {
        let text = "environments = ['CartPole']\nversions = ['D']\nruns = 2
            [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\ngrid = { observe = ['state', 'parameters'] }";
        let plan = Plan::parse("test", text.into()).unwrap();
        let groups = plan.groups(&[0, 1, 2, 3], Grouping::BY_KIND);
        assert_eq!(groups, [vec![0, 1], vec![2, 3]], "a session's observations have one length");
        let methods: Vec<String> = plan.methods().iter().map(ToString::to_string).collect();
        assert_eq!(methods, ["ppo ff", "ppo ff (sees parameters)"], "each is a row of its own, and selected by itself");
    }
}
