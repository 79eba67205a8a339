//! Intermediate evaluations during a training.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use perturb_experiment::ExperimentFolder;
use perturb_learner::checkpoint::Checkpoint;

use super::{Experiment, kill_all, succeeded};
use crate::common::{perturb, wait_for};

/// A plan with two cells that reach the numbers of episodes in `evaluate_at` exactly, and a cell of EPOpt, which learns
/// only from a part of its episodes.
const PLAN: &str = "
environments = ['CartPole']
versions = ['D']
test_versions = ['D', 'E']
test_episodes = 6
evaluate_at = [10, 30, 60]
settings = { episodes = 60, num_envs = 4, checkpoint_interval = 15 }

[[algorithm]]
name = 'a2c'
architectures = ['ff']
settings = { num_envs = 1, learning_rate_schedule = 'constant' }
grid = { learning_rate = [7e-3, 7e-4] }

[[algorithm]]
name = 'epopt-ppo'
architectures = ['ff']
settings = { episodes_per_iteration = 20 }
";

impl Experiment {
    /// Returns the bytes of all results, and of the records and checkpoint documents of the intermediate evaluations. A
    /// document contains the checksum of the policy's weights.
    fn kept(&self, name: &str) -> BTreeMap<PathBuf, Vec<u8>> {
        let folder = ExperimentFolder::new(&self.out(name));
        let mut files = BTreeMap::new();
        for cell in &self.plan.cells {
            let place = folder.cell(&cell.id).path().to_owned();
            add(&place, "result.json", &mut files);
            for mark in ["10", "30"] {
                add(&place, &format!("marks/{mark}/episodes.parquet"), &mut files);
                add(&place, &format!("training/marks/{mark}/checkpoint.json"), &mut files);
            }
        }
        files
            .into_iter()
            .map(|(path, bytes)| (path.strip_prefix(self.out(name)).expect("inside").into(), bytes))
            .collect()
    }
}

fn add(place: &Path, name: &str, files: &mut BTreeMap<PathBuf, Vec<u8>>) {
    if let Ok(bytes) = std::fs::read(place.join(name)) {
        files.insert(place.join(name), bytes);
    }
}

#[test]
fn intermediate_evaluations_survive_kills() {
    let experiment = Experiment::new(PLAN);
    succeeded(&experiment.run("whole", &["--jobs", "1"]));
    let whole = experiment.kept("whole");
    assert_eq!(whole.len(), 3 * 5, "{:?}", whole.keys());
    let without = Experiment::new(&PLAN.replace("evaluate_at = [10, 30, 60]\n", ""));
    succeeded(&without.run("out", &[]));
    for index in 0..3 {
        let marked = experiment.cell_result("whole", index);
        let plain = without.cell_result("out", index);
        assert_eq!((&marked.training.counters, &marked.results), (&plain.training.counters, &plain.results));
        let training = |experiment: &Experiment, name: &str| {
            let folder = ExperimentFolder::new(&experiment.out(name));
            let path = folder.cell(&experiment.plan.cells[index].id).training();
            (std::fs::read(path.join("monitor.csv")).is_ok(), Checkpoint::load(&path).expect("a checkpoint"))
        };
        assert!(training(&experiment, "whole") == training(&without, "out"), "the same policy and statistics");
        assert_eq!(marked.marks.keys().copied().collect::<Vec<_>>(), [10, 30], "the end is tested anyway");
        for (mark, test) in &marked.marks {
            assert!((*mark..60).contains(&test.counters.episodes), "{:?}", test.counters);
            assert_eq!(test.results.values().map(|test| test.episodes).collect::<Vec<_>>(), [6, 6]);
        }
        let policies: Vec<String> = [10, 30]
            .iter()
            .map(|mark| {
                let place = ExperimentFolder::new(&experiment.out("whole"))
                    .cell(&marked.id)
                    .training()
                    .join(format!("marks/{mark}"));
                Checkpoint::load(&place).expect("a policy").id().expect("a name")
            })
            .collect();
        assert_ne!(policies[0], policies[1]);
    }

    let kept_files = || experiment.kept("killed").len();
    for least in [1, 4, 6] {
        let child = experiment.command("killed", &["--jobs", "1", "--group", "1"]).spawn().expect("started");
        wait_for("a policy on the way", || kept_files() >= least);
        kill_all(child);
    }
    assert!(kept_files() < 15, "killed before the end");
    succeeded(&experiment.run("killed", &["--jobs", "1", "--group", "1"]));
    assert!(experiment.kept("killed") == whole, "the same bytes, alone and together");

    let output = perturb(&["audit", "--all"]).arg(experiment.out("killed")).output().expect("ended");
    assert!(output.stdout.starts_with(b"108 of 108 episodes of 9 policies"), "{output:?}");
}

/// With a constant learning rate, a training equals the beginning of a training with a larger budget.
#[test]
fn an_intermediate_policy_is_that_of_a_shorter_training() {
    let shorter = PLAN.replace("30, 60]", "30]").replace("= 60", "= 30");
    let [long, short] = [PLAN, &shorter].map(|plan| {
        let experiment = Experiment::new(plan);
        succeeded(&experiment.run("out", &["--cell", "0,2"]));
        experiment
    });
    for index in [0, 2] {
        let policy = |experiment: &Experiment, place: &str| {
            let cell = ExperimentFolder::new(&experiment.out("out")).cell(&experiment.plan.cells[index].id);
            let Checkpoint { state, weights, .. } = Checkpoint::load(&cell.training().join(place)).expect("a policy");
            (state.counters, state.observation_normaliser, state.reward_normaliser, weights)
        };
        assert!(policy(&long, "marks/30") == policy(&short, "checkpoint"), "cell {index}");
        let marked = long.cell_result("out", index);
        let ended = short.cell_result("out", index);
        assert_eq!((&marked.marks[&30].results, marked.marks.len()), (&ended.results, 2));
        assert_eq!(marked.marks[&10], ended.marks[&10]);
    }
    assert_eq!(long.cell_result("out", 0).marks[&30].counters.episodes, 30, "reached exactly");
}

/// If the stored policy of an intermediate evaluation is deleted, the next run trains the cell again and stores it.
#[test]
fn a_training_without_its_intermediate_policies_restarts() {
    let experiment = Experiment::new(PLAN);
    succeeded(&experiment.run("out", &["--cell", "0"]));
    let whole = experiment.kept("out");
    let place = ExperimentFolder::new(&experiment.out("out")).cell(&experiment.plan.cells[0].id);
    std::fs::remove_dir_all(place.training().join("marks/10")).expect("deleted");
    std::fs::remove_file(place.path().join("result.json")).expect("deleted");
    succeeded(&experiment.run("out", &["--cell", "0"]));
    assert!(experiment.kept("out") == whole);
}
