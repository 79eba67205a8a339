//! Lines to compare with.

use super::{Experiment, succeeded};
use crate::common::{perturb, stderr};

/// Six cells of the random policy, two of a learner.
const PLAN: &str = "
environments = ['CartPole', 'Pendulum']
versions = ['D', 'R', 'E']
test_episodes = 12
evaluate_at = [10]
settings = { episodes = 40 }

[[algorithm]]
name = 'a2c'
architectures = ['ff']
versions = ['D']

[[algorithm]]
name = 'random'
architectures = ['ff']
";

#[test]
fn a_random_policy_is_tested_reported_and_played_again_like_any_other_but_not_trained() {
    let experiment = Experiment::new(PLAN);
    succeeded(&experiment.run("out", &["--jobs", "1"]));
    let random: Vec<_> = (0..8).map(|index| experiment.cell_result("out", index)).collect();
    let random: Vec<_> = random.iter().filter(|result| result.training.method.algorithm == "random").collect();
    assert_eq!(random.len(), 6);
    for result in &random {
        assert_eq!(result.training.counters.timesteps, 0);
        assert!(result.results.values().all(|test| test.episodes == 12));
        assert_eq!(result.marks[&10].results, result.results, "it is the same at all times");
        let first = random.iter().find(|first| first.training.environment == result.training.environment);
        assert_eq!(result.results, first.unwrap().results, "it is the same whatever it would be trained on");
    }
    // An untrained CartPole falls after some twenty steps.
    assert!((10.0..40.0).contains(&random[0].results["D"].mean_length), "{:?}", random[0].results);

    succeeded(&experiment.run("alone", &["--jobs", "1", "--group", "1"]));
    assert!(experiment.results("out") == experiment.results("alone"), "the same bytes, alone and together");
    let output = perturb(&["audit", "--all"]).arg(experiment.out("out")).output().expect("ended");
    assert!(output.stdout.starts_with(b"576 of 576 episodes of 16 policies"), "{output:?}");
    let output = perturb(&["report"]).arg(experiment.out("out")).output().expect("ended");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("random policy (reference)"), "{text}{}", stderr(&output));
    let output = perturb(&["plan", "--measure", "1", "--jobs", "1"]).arg(experiment.out("file.toml")).output();
    succeeded(&output.expect("ended"));
}
