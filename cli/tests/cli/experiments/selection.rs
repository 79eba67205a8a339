//! The clean selection rule: reported tests share no seeds and no episodes with the selection.

use std::collections::{BTreeMap, BTreeSet};

use perturb_experiment::{Cell, CellState, ExperimentFolder, SELECTION_TEST, Selection};
use perturb_records::{FILE, Records};

use super::{Experiment, kill_all, succeeded};
use crate::common::{perturb, stderr, wait_for};

/// A plan with four tuning cells and four selected cells.
const PLAN: &str = "
environments = ['CartPole']
versions = ['D', 'E']
selection = 'clean'
selection_episodes = 9
runs = 2
test_versions = ['D', 'R']
test_episodes = 12
settings = { episodes = 40, num_envs = 4 }

[[algorithm]]
name = 'a2c'
architectures = ['ff']
grid = { learning_rate = [7e-3, 7e-4] }
";

impl Experiment {
    /// Returns all cells of the plan, including the cells that the folder's results select.
    fn cells(&self, name: &str) -> Vec<Cell> {
        self.plan.with_selected_cells(&ExperimentFolder::new(&self.out(name))).expect("readable").cells
    }

    /// Returns the bytes of the result and the records of each finished cell.
    fn all_results(&self, name: &str) -> BTreeMap<String, [Vec<u8>; 2]> {
        let folder = ExperimentFolder::new(&self.out(name));
        let read = |id: &str, file: &str| std::fs::read(folder.cell(id).path().join(file)).ok();
        let of = |cell: Cell| Some((cell.id.clone(), [read(&cell.id, "result.json")?, read(&cell.id, FILE)?]));
        self.cells(name).into_iter().filter_map(of).collect()
    }
}

#[test]
fn selected_cells_run_after_any_number_of_kills() {
    let experiment = Experiment::new(PLAN);
    let output = experiment.run("whole", &["--jobs", "2"]);
    succeeded(&output);
    assert!(
        stderr(&output).contains("tuning is finished; 4 cells with the selected configurations"),
        "{}",
        stderr(&output)
    );
    assert!(stderr(&output).contains("all 8 cells are done"), "{}", stderr(&output));
    let whole = experiment.all_results("whole");
    assert_eq!(whole.len(), 8);

    let done = || experiment.all_results("killed").len();
    for least in [1, 4, 5] {
        let child = experiment.command("killed", &["--jobs", "1", "--group", "1"]).spawn().expect("started");
        wait_for("a few results", || done() >= least);
        kill_all(child);
    }
    assert!(done() < 8, "killed before the end");
    succeeded(&experiment.run("killed", &[]));
    assert_eq!(experiment.all_results("killed"), whole);
    let mut plan = perturb(&["plan"]);
    let missing = plan.arg(experiment.out("killed/plan.toml")).arg("--unfinished-in").arg(experiment.out("killed"));
    let output = missing.output().expect("ended");
    assert_eq!((output.status.code(), output.stdout), (Some(0), Vec::new()));
}

#[test]
fn reported_tests_share_nothing_with_selection_tests() {
    let experiment = Experiment::new(PLAN);
    succeeded(&experiment.run("out", &[]));
    let folder = ExperimentFolder::new(&experiment.out("out"));
    let mut selecting = BTreeSet::new();
    let mut reported = BTreeSet::new();
    for cell in experiment.cells("out") {
        let Ok(CellState::Done(result)) = folder.state(&cell) else { panic!("{} is not done", cell.id) };
        let episodes: Vec<u64> = result.results.values().map(|test| test.episodes).collect();
        let records = Records::read(&folder.cell(&cell.id).path().join(FILE)).expect("records");
        let anew = cell.tuned_as.is_some();
        assert_eq!(episodes, if anew { vec![12, 12] } else { vec![12, 12, 9] }, "{}", cell.id);
        for test in &records.about.tests {
            let selects = test.set.name == SELECTION_TEST;
            assert!(!selects || (!anew && test.set.version == cell.config.common.version));
            if selects { &mut selecting } else { &mut reported }.insert(test.seed);
        }
        assert_eq!(result.training.seed, if anew { 1 + u64::from(cell.run) } else { 1 });
    }
    assert!(
        selecting.is_disjoint(&reported) && selecting.len() == 2 && reported.len() == 6,
        "two selection seeds, and six seeds of reported tests"
    );

    let output = perturb(&["audit", "--all"]).arg(experiment.out("out")).output().expect("ended");
    assert!(output.status.success() && output.stdout.starts_with(b"228 of 228 episodes of 8 policies"), "{output:?}");

    let cell = &experiment.plan.cells[0];
    let Ok(CellState::Done(result)) = folder.state(cell) else { panic!("it is done") };
    let evaluate = result.command.split(" && ").last().expect("a command");
    let expected = "perturb evaluate --checkpoint RUN --versions D --selection-episodes --episodes 9";
    assert_eq!(evaluate, expected);
    let training = folder.cell(&cell.id).training();
    let json = experiment.out("again.json");
    let mut command =
        perturb(&expected.replace("RUN", training.to_str().expect("a path")).split(' ').skip(1).collect::<Vec<_>>());
    succeeded(&command.arg("--json").arg(&json).output().expect("ended"));
    let again: serde_json::Value = serde_json::from_slice(&std::fs::read(json).expect("written")).expect("JSON");
    assert_eq!(again["results"]["D"], serde_json::to_value(&result.results[SELECTION_TEST]).expect("JSON"));
}

#[test]
fn selected_cells_run_alone_and_both_rules_report() {
    let experiment = Experiment::new(PLAN);
    let tuning: Vec<&str> = experiment.plan.cells.iter().map(|cell| cell.id.as_str()).collect();
    let output = experiment.run("out", &["--cell", &tuning.join(",")]);
    succeeded(&output);
    assert!(stderr(&output).contains("all 4 cells are done"), "no others follow: {}", stderr(&output));
    let selected = experiment.cells("out")[4..].iter().map(|cell| cell.id.clone()).collect::<Vec<_>>();
    succeeded(&experiment.run("out", &["--cell", &selected[1]]));
    let report = |rule: &[&str]| {
        let output = perturb(&["report"]).arg(experiment.out("out")).args(rule).output().expect("ended");
        succeeded(&output);
        String::from_utf8(output.stdout).expect("text")
    };
    let clean = report(&[]);
    assert!(clean.contains("5 of 8 cells are done") && clean.contains("Selection: `clean`"), "{clean}");
    assert!(clean.contains("on seed 1; the reported configurations were trained anew on seeds 2 to 3"), "{clean}");
    let papers = report(&["--selection", "paper"]);
    assert!(papers.contains("4 of 4 cells are done") && papers.contains("Selection: `paper`"), "{papers}");
    let at = |name: &str| experiment.out("out/report").join(name).is_file();
    assert!(at("selected.csv") && at("paper/metrics.csv"));
    assert_eq!(experiment.plan.selection, Selection::Clean);
}
