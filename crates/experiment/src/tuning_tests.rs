use perturb_protocol::Version;
use rstest::rstest;

use super::*;
use crate::fixture;
use crate::folder::ExperimentFolder;
use crate::folder::FailureRecord;
use crate::plan::Selection;
use crate::selection::Results;

/// A plan with two configurations, learning rates 7e-3 (A) and 7e-4 (B), two tuning seeds (4 and 5) and three runs
/// (seeds 6 to 8).
const PLAN: &str = "
environments = ['CartPole', 'Pendulum']
versions = ['D', 'E']
selection = 'clean'
tuning_runs = 2
runs = 3
seed = 4
selection_episodes = 70
[[algorithm]]
name = 'a2c'
architectures = ['ff']
grid = { learning_rate = [7e-3, 7e-4] }
";

fn plan() -> Plan {
    Plan::parse("test", PLAN.into()).unwrap()
}

fn is_a(cell: &Cell) -> bool {
    cell.config.table()["learning_rate"].as_float() == Some(7e-3)
}

/// A function that returns the success rate and the mean return in selection tests. Its arguments are the configuration
/// ("A" or "B") and the seed. The cells' other tests get the opposite results, 100 - success rate and the negated
/// return. So these tests rank A and B the other way round.
type SelectionResultFn = fn(&str, u64) -> Option<(f64, f64)>;

/// Writes the results that `known` returns. Cells for which it returns `None` have failed if `failed` is set, and are
/// missing otherwise.
fn done(plan: &Plan, folder: &ExperimentFolder, known: SelectionResultFn, failed: bool) {
    for cell in &plan.cells {
        let place = folder.cell(&cell.id);
        match known(if is_a(cell) { "A" } else { "B" }, cell.config.common.seed) {
            Some((rate, mean_return)) => {
                let mut result = fixture::result(cell, [100.0 - rate; 3], -mean_return);
                if cell.tests.selection.is_some() {
                    let success_percent = rate;
                    let test = TestResult { success_percent, mean_return, ..result.results["D"].clone() };
                    result.results.insert(SELECTION_TEST.into(), test);
                }
                place.write_result(&result).unwrap();
            }
            None if failed => {
                let failure = FailureRecord {
                    id: cell.id.clone(),
                    reason: "NaN".into(),
                    commit: "x".into(),
                    requires_restart: true,
                };
                place.write_failure(&failure).unwrap();
            }
            None => {}
        }
    }
}

fn place() -> (tempfile::TempDir, ExperimentFolder) {
    let directory = tempfile::tempdir().unwrap();
    let folder = ExperimentFolder::new(directory.path());
    (directory, folder)
}

#[test]
fn tuning_and_reporting_share_neither_seeds_nor_cells() {
    let plan = plan();
    let seeds = |cells: &[Cell]| {
        let seeds = cells.iter().map(|cell| (cell.run, cell.config.common.seed));
        seeds.collect::<std::collections::BTreeSet<_>>().into_iter().collect::<Vec<_>>()
    };
    assert_eq!(seeds(&plan.cells), [(1, 4), (2, 5)]);
    assert_eq!(seeds(&plan.candidates), [(1, 6), (2, 7), (3, 8)]);
    assert!(plan.cells.iter().all(|cell| cell.tests.selection == Some(70) && cell.tuned_as.is_none()));
    assert!(plan.candidates.iter().all(|cell| cell.tests.selection.is_none() && cell.tuned_as.is_some()));
    // The factors are the numbers of environments, versions, configurations and runs.
    assert_eq!((plan.cells.len(), plan.candidates.len()), (2 * 2 * 2 * 2, 2 * 2 * 2 * 3));
    for (index, cell) in plan.cells.iter().chain(&plan.candidates).enumerate() {
        assert_eq!((cell.index, plan.find(&index.to_string()), plan.find(&cell.id)), (index, Some(cell), Some(cell)));
    }
    assert_eq!(plan.counts().all_pairs, 16 * 3, "only cells that are known before the selection");
}

#[test]
fn selection_episodes_have_the_parameters_that_were_trained_on() {
    let own = PLAN.replace("versions = ['D', 'E']", "versions = ['R', 'long']").replace("'CartPole', ", "")
        + "[sets.long]\nversion = 'E'\nlength = '1.2..1.4'";
    let plan = Plan::parse("test", own).unwrap();
    for (cell, (version, own)) in plan.cells.iter().step_by(2).zip([(Version::R, 0), (Version::E, 1)]) {
        let (set, episodes) = cell.selection_test().unwrap();
        assert_eq!((set.name.as_str(), set.version, episodes), (SELECTION_TEST, version, 70));
        assert_eq!((set.drawn(), set.drawn().len()), (cell.config.common.parameters.clone(), own));
    }
    assert!(plan.candidates.iter().all(|cell| cell.selection_test().is_none()));
}

/// Cells that are trained after the selection have the same ids as with the paper's rule. Tuning cells have other ids.
#[test]
fn cell_id_without_selection_matches_the_papers_rule() {
    let papers = PLAN.replace("'clean'", "'paper'").replace("runs = 3\nseed = 4", "runs = 5\nseed = 4");
    let papers = papers.replace("tuning_runs = 2\n", "").replace("selection_episodes = 70\n", "");
    let papers = Plan::parse("test", papers).unwrap();
    let ids: Vec<&str> = papers.cells.iter().map(|cell| cell.id.as_str()).collect();
    let plan = plan();
    assert!(plan.candidates.iter().all(|cell| ids.contains(&cell.id.as_str())));
    assert!(plan.cells.iter().all(|cell| !ids.contains(&cell.id.as_str())));
    let other = Plan::parse("test", PLAN.replace("selection_episodes = 70", "selection_episodes = 71")).unwrap();
    assert!(plan.cells.iter().all(|cell| other.find(&cell.id).is_none()));
    assert_eq!(plan.candidates[0].id, other.candidates[0].id);
}

#[rstest]
#[case::the_mean_over_seeds(|name: &str, seed: u64| Some((if name == "A" { [90.0, 10.0] } else { [40.0, 70.0] }[seed as usize - 4], 1.0)), "B", 2)]
#[case::then_the_return(|name: &str, seed: u64| Some((if seed == 4 { 90.0 } else { 10.0 }, if name == "B" { 2.0 } else { 1.0 })), "B", 2)]
#[case::then_the_plan(|_: &str, _: u64| Some((50.0, 1.0)), "A", 2)]
#[case::of_what_has_not_failed(|name: &str, seed: u64| (name == "B" && seed == 5).then_some((0.0, -9.0)), "B", 1)]
fn selection_episodes_select(#[case] known: SelectionResultFn, #[case] expected: &str, #[case] seeds: usize) {
    let (plan, (_directory, folder)) = (plan(), place());
    done(&plan, &folder, known, true);
    let chosen = plan.with_selected_cells(&folder).unwrap();
    assert_eq!(chosen.cells[..16], plan.cells[..]);
    let anew = &chosen.cells[16..];
    assert_eq!(anew.len(), 2 * 2 * 3, "environments, versions and runs");
    assert!(anew.iter().all(|cell| is_a(cell) == (expected == "A") && plan.candidates.contains(cell)));
    let states: Vec<CellState> = plan.cells.iter().map(|cell| folder.state(cell).unwrap()).collect();
    assert!(tuned(&plan, &states).iter().all(|tuned| tuned.chosen.unwrap().seeds == seeds));
}

#[test]
fn selection_waits_for_all_tuning_cells() {
    let plan = plan();
    for failed in [true, false] {
        let (_directory, folder) = place();
        done(&plan, &folder, |_, _| None, failed);
        assert_eq!(plan.with_selected_cells(&folder).unwrap().cells, plan.cells);
    }
    let (_directory, folder) = place();
    done(&plan, &folder, |_, _| Some((1.0, 1.0)), false);
    std::fs::remove_file(folder.cell(&plan.cells[0].id).path().join("result.json")).unwrap();
    let known = plan.with_selected_cells(&folder).unwrap();
    assert_eq!(known.cells.len(), 16 + 3 * 3, "one of four waits");
    assert!(
        known.cells[16..]
            .iter()
            .all(|cell| cell.config.common.environment != "CartPole" || cell.config.common.version != Version::D)
    );
    // The final number of cells does not depend on the selected configurations.
    for folder in [None, Some(&folder)] {
        assert_eq!(
            plan.with_expected_cells(folder.map(|folder| folder as &dyn CellStates)).unwrap().cells.len(),
            16 + 4 * 3
        );
    }
}

#[test]
fn reported_cells_depend_on_the_rule() {
    let (plan, (_directory, folder)) = (plan(), place());
    let known: SelectionResultFn = |name, seed| Some((if name == "A" { 60.0 } else { 50.0 } + seed as f64, 1.0));
    done(&plan, &folder, known, false);
    let waiting = plan.with_selected_cells(&folder).unwrap();
    let results = Results::read(&waiting, &folder).unwrap();
    let selections = results.select();
    assert_eq!((selections[0].cells, selections[0].done), (8 + 6, 8));
    assert_eq!(selections[0].runs.len(), 3);
    assert!(selections[0].summary(perturb_records::Metric::Default).is_none(), "nothing is trained anew");

    done(&waiting, &folder, known, false);
    let results = Results::read(&waiting, &folder).unwrap();
    let selections = results.select();
    assert_eq!((selections[0].cells, selections[0].done), (14, 14));
    let rates =
        |selections: &[crate::selection::MethodResults<'_>]| selections[0].metric(perturb_records::Metric::Default);
    // These are the rates of A in ordinary tests with seeds 6 to 8.
    assert_eq!(rates(&selections), [(1, 34.0), (2, 33.0), (3, 32.0)].into());

    let papers = plan.with_rule(Selection::Paper).unwrap().with_selected_cells(&folder).unwrap();
    let results = Results::read(&papers, &folder).unwrap();
    // These are the rates of B with seeds 4 and 5, because B is better in ordinary tests.
    assert_eq!(rates(&results.select()), [(1, 46.0), (2, 45.0)].into());
}

#[test]
fn a_rule_that_a_plan_was_not_made_for_is_refused() {
    let papers = "environments = ['CartPole']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
    let papers = Plan::parse("test", papers.into()).unwrap();
    assert_eq!((papers.selection, papers.candidates.len()), (Selection::Paper, 0));
    let message = papers.with_rule(Selection::Clean).unwrap_err().to_string();
    assert!(message.contains("selection is clean, but must be \"paper\": the plan has no tuning cells"), "{message}");
    for (from, to, part) in [
        ("'clean'", "'fair'", "unknown variant `fair`, expected `paper` or `clean`"),
        ("'clean'", "'paper'", "tuning_runs is 2, but must be left out, or given with selection = \"clean\""),
        ("tuning_runs = 2", "tuning_runs = 0", "tuning_runs is 0, but must be at least 1"),
        ("selection_episodes = 70", "selection_episodes = 0", "selection_episodes is 0"),
        (
            "seed = 4",
            "seed = 4\nsets.selection.length = 1",
            "[sets.selection] is `selection`, but must be another name",
        ),
    ] {
        let message = Plan::parse("test", PLAN.replace(from, to)).unwrap_err().to_string();
        assert!(message.contains(part), "{to}: {message}");
    }
}
