//! Cells for comparison in reports: the random policy, heuristic policies, policies that observe parameters, and
//! training on R+E.

use perturb_settings::Observe;

use super::{Experiment, succeeded};
use crate::common::{perturb, stderr};

/// A plan with six cells of the random policy and two of a learner.
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
fn random_policies_are_tested_reported_and_replayed() {
    let experiment = Experiment::new(PLAN);
    succeeded(&experiment.run("out", &["--jobs", "1"]));
    let random: Vec<_> = (0..8).map(|index| experiment.cell_result("out", index)).collect();
    let random: Vec<_> = random.iter().filter(|result| result.training.method.algorithm == "random").collect();
    assert_eq!(random.len(), 6);
    for result in &random {
        assert_eq!(result.training.counters.timesteps, 0);
        assert!(result.results.values().all(|test| test.episodes == 12));
        assert_eq!(result.marks[&10].results, result.results, "intermediate evaluations equal the final one");
        let first = random.iter().find(|first| first.training.environment == result.training.environment);
        assert_eq!(result.results, first.unwrap().results, "results do not depend on the training version");
    }
    // With random actions, CartPole's pole falls after some twenty steps.
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

/// A plan with one cell of each heuristic policy.
const HEURISTIC: &str = "
environments = ['CartPole', 'MountainCar', 'Acrobot', 'Pendulum']
versions = ['D']
test_versions = ['D', 'R', 'E']
test_episodes = 100

[[algorithm]]
name = 'heuristic'
architectures = ['ff']
";

#[test]
fn heuristic_policies_are_tested_reported_and_replayed() {
    let experiment = Experiment::new(HEURISTIC);
    succeeded(&experiment.run("out", &["--jobs", "1"]));
    // The bounds are three standard deviations of 100 episodes below the success rates of many episodes.
    for (index, bounds) in
        [[100.0, 100.0, 91.0], [26.0, 74.0, 83.0], [47.0, 37.0, 36.0], [97.0, 97.0, 91.0]].into_iter().enumerate()
    {
        let results = experiment.cell_result("out", index).results;
        for (version, bound) in ["D", "R", "E"].into_iter().zip(bounds) {
            assert!(results[version].success_percent >= bound, "cell {index}, {version}: {:?}", results[version]);
        }
    }
    let output = perturb(&["audit", "--all"]).arg(experiment.out("out")).output().expect("ended");
    assert!(output.stdout.starts_with(b"1200 of 1200 episodes of 4 policies"), "{output:?}");
    let output = perturb(&["report"]).arg(experiment.out("out")).output().expect("ended");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("heuristic policy (reference)"), "{text}{}", stderr(&output));
}

/// A plan with four cells: PPO that does not observe parameters, and PPO, RL²-PPO and the random policy that observe
/// them.
const SEEING: &str = "
environments = ['Pendulum']
versions = ['R']
test_versions = ['D', 'E']
test_episodes = 12
evaluate_at = [10]
settings = { episodes = 20, num_envs = 4, observe = 'parameters' }

[[algorithm]]
name = 'ppo'
architectures = ['ff']
grid = { observe = ['state', 'parameters'] }
settings = { n_steps = 64 }

[[algorithm]]
name = 'rl2-ppo'
architectures = ['rc']
settings = { n_steps = 32, n_epochs = 1 }

[[algorithm]]
name = 'random'
architectures = ['ff']
";

#[test]
fn policies_that_observe_parameters_have_a_row_of_their_own() {
    // The plan sets `observe` in its settings and in the grid of PPO. The grid takes precedence.
    let experiment = Experiment::new(SEEING);
    succeeded(&experiment.run("out", &["--jobs", "1"]));
    let results: Vec<_> = (0..4).map(|index| experiment.cell_result("out", index)).collect();
    let seen = results.iter().map(|result| result.training.method.observe).collect::<Vec<_>>();
    assert_eq!(seen, [Observe::State, Observe::Parameters, Observe::Parameters, Observe::Parameters]);
    assert!(results[0].results != results[1].results);

    succeeded(&experiment.run("alone", &["--jobs", "1", "--group", "1"]));
    assert!(experiment.results("out") == experiment.results("alone"), "alone, acting at the server, and together");
    let output = perturb(&["audit", "--all"]).arg(experiment.out("out")).output().expect("ended");
    assert!(output.stdout.starts_with(b"192 of 192 episodes of 8 policies"), "{output:?}");
    succeeded(&experiment.heatmap("out", &[]));
    let output = perturb(&["report"]).arg(experiment.out("out")).output().expect("ended");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    for row in ["ppo ff  ", "ppo ff (sees parameters)", "random policy (reference) (sees parameters)"] {
        assert!(text.contains(row), "{row}: {text}{}", stderr(&output));
    }
    let output = perturb(&["plan", "--measure", "1", "--jobs", "1"]).arg(experiment.out("file.toml")).output();
    succeeded(&output.expect("ended"));
}

#[test]
fn a_checkpoint_knows_what_its_policy_sees() {
    let out = tempfile::tempdir().expect("a directory");
    let run = out.path().join("run");
    let run = run.to_str().expect("a path");
    let episodes = |more: &[&str]| {
        let output = perturb(more).output().expect("ended");
        succeeded(&output);
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    let train = ["train", "--env", "CartPole", "--version", "R", "--episodes", "40", "--out", run];
    episodes(&[&train[..], &["--observe", "parameters", "--set", "n_steps=32"]].concat());
    let told = episodes(&["evaluate", "--checkpoint", run, "--episodes", "12"]);
    assert!(told.contains("CartPole ppo ff (sees parameters), trained on R"), "{told}");
    let json = out.path().join("evaluated.json");
    episodes(&["evaluate", "--checkpoint", run, "--episodes", "12", "--json", json.to_str().expect("a path")]);
    let told = std::fs::read_to_string(json).expect("a document");
    assert!(told.contains("\"observe\": \"parameters\""), "{told}");
    let video = out.path().join("video.gif");
    episodes(&[
        "video",
        "--checkpoint",
        run,
        "--out",
        video.to_str().expect("a path"),
        "--width",
        "240",
        "--height",
        "240",
    ]);
    let heatmap = out.path().join("heatmap");
    let heatmap = heatmap.to_str().expect("a path");
    episodes(&["heatmap", "--checkpoint", run, "--grid", "2", "--episodes", "1", "--out", heatmap]);
    let output = perturb(&[&train[..7], &["--observe", "all", "--out", run]].concat()).output().expect("ended");
    assert!(stderr(&output).contains("possible values: state, parameters"), "{}", stderr(&output));
}

/// A plan that trains on R+E and on D.
const BOTH: &str = "
environments = ['CartPole']
versions = ['D', 'R+E']
test_versions = ['D', 'R', 'E', 'R+E']
test_episodes = 12
evaluate_at = [10]
settings = { episodes = 40 }

[[algorithm]]
name = 'a2c'
architectures = ['ff']
grid = { learning_rate = [7e-3, 7e-4] }
";

#[test]
fn policies_trained_on_r_and_e_are_in_the_report() {
    let experiment = Experiment::new(BOTH);
    succeeded(&experiment.run("out", &["--jobs", "1"]));
    let results: Vec<_> = (0..4).map(|index| experiment.cell_result("out", index)).collect();
    let of_both = results.iter().filter(|result| result.id.starts_with("CartPole-a2c-ff-R-or-E-")).count();
    assert_eq!(of_both, 2);
    assert!(results.iter().all(|result| result.results.keys().eq(["D", "E", "R", "R+E"])));

    let output = perturb(&["audit", "--all"]).arg(experiment.out("out")).output().expect("ended");
    assert!(output.stdout.starts_with(b"384 of 384 episodes of 8 policies"), "{output:?}");
    let output = perturb(&["report"]).arg(experiment.out("out")).output().expect("ended");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let row =
        text.lines().find(|line| line.trim_start().starts_with("a2c ff  R+E ")).unwrap_or_else(|| panic!("{text}"));
    assert!(!row.contains("missing") && text.contains("on R+E"), "{text}");
    let page = experiment.page("out");
    assert!(page.contains("trained on R+E"), "curves and success over parameters");
    let files = std::fs::read_dir(experiment.out("out").join("report")).expect("a folder");
    let names: Vec<String> = files.map(|file| file.expect("a file").file_name().into_string().expect("text")).collect();
    assert!(
        names.iter().any(|name| name.contains("R-or-E")) && names.iter().all(|name| !name.contains('+')),
        "{names:?}"
    );
}
