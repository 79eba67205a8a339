//! Trainings that stop at a success rate.

use perturb_experiment::ExperimentFolder;
use perturb_learner::checkpoint::Checkpoint;

use super::{Experiment, succeeded};
use crate::common::{perturb, stderr};

/// A plan whose trainings stop at 10 % success in the last hundred episodes.
const PLAN: &str = "
environments = ['CartPole']
versions = ['D']
test_versions = ['D']
test_episodes = 6
evaluate_at = [40, 1900]
settings = { episodes = 2000, num_envs = 4, learning_rate_schedule = 'constant' }

[[algorithm]]
name = 'a2c'
architectures = ['ff']
settings = { stop_at_success = 10 }
";

#[test]
fn an_early_stop_equals_a_training_of_that_budget() {
    let early = Experiment::new(PLAN);
    succeeded(&early.run("out", &[]));
    let stopped = early.cell_result("out", 0);
    let episodes = stopped.training.counters.episodes;
    assert!((100..1900).contains(&episodes), "after a hundred episodes at least: {episodes}");
    assert_eq!(stopped.training.settings["stop_at_success"].as_float(), Some(10.0));
    assert_eq!(stopped.marks[&1900].results, stopped.results, "later it is what it was when it stopped");
    assert_eq!(stopped.marks[&1900].counters, stopped.training.counters);
    assert!(stopped.marks[&40].counters.episodes < 100);

    let plain =
        PLAN.replace("stop_at_success = 10", "").replace("[40, 1900]", "[40]").replace("2000", &episodes.to_string());
    let plain = Experiment::new(&plain);
    succeeded(&plain.run("out", &[]));
    let with_that_budget = plain.cell_result("out", 0);
    assert_eq!((&stopped.results, &stopped.marks[&40]), (&with_that_budget.results, &with_that_budget.marks[&40]));
    let training = |experiment: &Experiment| {
        ExperimentFolder::new(&experiment.out("out")).cell(&experiment.plan.cells[0].id).training()
    };
    let weights = |experiment: &Experiment| Checkpoint::load(&training(experiment)).expect("a checkpoint").weights;
    assert!(weights(&early) == weights(&plain), "and its policy");

    // A training that stopped at its success rate is not continued, either by `perturb train --resume` or by a run
    // whose result was deleted.
    let output = perturb(&["train", "--resume"]).arg(training(&early)).output().expect("ended");
    let said = stderr(&output);
    assert!(said.contains(&format!("it has {episodes} of 2000 episodes and stopped at ")), "{said}");
    let result = ExperimentFolder::new(&early.out("out")).cell(&early.plan.cells[0].id).path().join("result.json");
    let before = std::fs::read(&result).expect("a result");
    std::fs::remove_file(&result).expect("removed");
    succeeded(&early.run("out", &[]));
    assert!(std::fs::read(&result).expect("a result") == before);
    assert!(weights(&early) == weights(&plain));
}
