//! Tests that a training gives the same bytes alone, in any group, after resuming in another group, and with actions
//! chosen in the server or the client.

use std::path::Path;

use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::{Checkpoint, ResumeState};
use perturb_learner::client::{ActorLocation, PrivateServer, Servers};
use perturb_learner::evaluation::{TestOptions, Tester};
use perturb_learner::logging::Progress;
use perturb_learner::training::{RunDirectory, Start, TrainRequest, train, train_together};
use perturb_protocol::Version;
use perturb_settings::TrainConfig;
use rstest::rstest;

use crate::common::{connect, server};

/// Settings of trainings with all algorithms. They differ in batch size, version, parameters and length of rollouts.
const TRAININGS: [&str; 11] = [
    "algorithm = 'a2c'\nnum_envs = 1\nn_steps = 5\nseed = 3",
    "algorithm = 'ppo'\nversion = 'R'\nnum_envs = 3\nn_steps = 16\nn_minibatches = 2\nn_epochs = 2\nseed = 3",
    "algorithm = 'epopt-ppo'\nversion = 'E'\nnum_envs = 2\nepisodes_per_iteration = 3\nepsilon = 0.5\nfull_iterations = 1
     n_epochs = 2\nseed = 4",
    "algorithm = 'ppo'\narchitecture = 'rc'\nnum_envs = 2\nn_steps = 64\nn_minibatches = 2\nn_epochs = 1\nseed = 5",
    "algorithm = 'rl2-a2c'\narchitecture = 'rc'\nversion = 'R+E'\nnum_envs = 2\nn_steps = 20\nseed = 6",
    "preset = 'paper'\nalgorithm = 'ppo'\nversion = 'R'\nn_steps = 64\nn_epochs = 2\nseed = 3",
    "preset = 'paper'\nalgorithm = 'epopt-a2c'\nversion = 'E'\nepisodes_per_iteration = 3\nepsilon = 0.5
     full_iterations = 1\nseed = 4",
    "preset = 'paper'\nalgorithm = 'epopt-ppo'\narchitecture = 'rc'\nepisodes_per_iteration = 3\nepsilon = 0.5
     full_iterations = 1\nn_epochs = 2\nseed = 4",
    // Trainings with observation noise choose their actions in the client.
    "algorithm = 'ppo'\nversion = 'R'\nnum_envs = 3\nn_steps = 64\nn_epochs = 2\nobservation_noise = 0.5
     weight_decay = 0.1\nseed = 8",
    "algorithm = 'epopt-a2c'\nversion = 'E'\nnum_envs = 2\nepisodes_per_iteration = 3\nepsilon = 0.5
     full_iterations = 1\nobservation_noise = 0.5\nweight_decay = 0.1\nseed = 4",
    // If other runs wait for the server too, this rollout comes in several replies.
    "algorithm = 'ppo'\nversion = 'R'\nnum_envs = 65\nn_steps = 64\nn_minibatches = 2\nn_epochs = 1\nseed = 7",
];

/// Environment and budget of trainings in CartPole.
const CART_POLE: &str = "environment = 'CartPole'\nepisodes = 12";
const PENDULUM: &str = "environment = 'Pendulum'\nepisodes = 5";
const SEEN_PENDULUM: &str = "environment = 'Pendulum'\nepisodes = 5\nobserve = 'parameters'";

fn config(task: &str, training: &str) -> TrainConfig {
    let text = format!("{task}\n{training}");
    TrainConfig::from_table("the test", text.parse().expect("TOML")).expect("a configuration")
}

/// Returns the state of a run as text: counters, weights, statistics, and everything else that later steps depend on.
fn kept(directory: &Path) -> String {
    let (checkpoint, resume) = ResumeState::load(directory).expect("a checkpoint");
    let state = checkpoint.state;
    assert!(resume.history.logs.monitor > 0);
    format!(
        "{:?} {:?} {:?} {:?} {:?} {:?} {:?}",
        state.counters,
        checkpoint.weights,
        state.observation_normaliser,
        state.reward_normaliser,
        resume.collector,
        resume.algorithm,
        resume.history.recent
    )
}

/// Trains the runs with these `numbers` together, each from its last checkpoint in its own folder. Stops when all have
/// ended, or when one has had `most_iterations` iterations.
fn together(servers: &Servers, base: &Path, task: &str, numbers: &[usize], most_iterations: u64) {
    let directories: Vec<(RunDirectory, Start)> = numbers
        .iter()
        .map(|number| {
            let path = base.join(number.to_string());
            if path.exists() {
                let (directory, checkpoint, state) = RunDirectory::resume(&path).expect("a run");
                (directory, Start::Checkpoint(Box::new((checkpoint, state))))
            } else {
                let start = Start::Fresh(Box::new(config(task, TRAININGS[*number])));
                (RunDirectory::choose(&path, false).expect("a directory"), start)
            }
        })
        .collect();
    let entries = directories
        .iter()
        .map(|(directory, start)| TrainRequest { directory, start: start.clone(), marks: &[] })
        .collect();
    let stop = StopFlag::default();
    let mut ended = vec![false; numbers.len()];
    train_together(
        servers,
        entries,
        1,
        &stop,
        &mut |_, progress| {
            if progress.iterations >= most_iterations {
                stop.raise(15);
            }
        },
        &mut |index, outcome| {
            outcome.expect("an outcome");
            ended[index] = true;
        },
    )
    .expect("a session");
    assert!(ended.iter().all(|&ended| ended));
}

fn alone(servers: &Servers, task: &str) -> Vec<String> {
    let base = tempfile::tempdir().expect("a directory");
    let one = |training: &&str| {
        let path = base.path().join("run");
        let directory = RunDirectory::choose(&path, true).expect("a directory");
        train(servers, &config(task, training), &directory, 1, &StopFlag::default(), |_| {}).expect("a training");
        kept(&path)
    };
    TRAININGS.iter().map(one).collect()
}

#[rstest]
fn training_bytes_do_not_depend_on_the_group(#[values(CART_POLE, PENDULUM, SEEN_PENDULUM)] task: &str) {
    let private = [server(), server()];
    let one = connect(&private[..1]);
    let expected = alone(&connect(&private[..1]).with_act(ActorLocation::Client), task);
    assert!(alone(&one, task) == expected, "acting at the server");
    assert!(alone(&connect(&private), task) == expected, "on two servers");

    let base = tempfile::tempdir().expect("a directory");
    let all = |base: &Path, count| (0..count).map(|number| kept(&base.join(number.to_string()))).collect::<Vec<_>>();
    together(&one, base.path(), task, &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10], u64::MAX);
    assert!(all(base.path(), TRAININGS.len()) == expected, "together");

    let base = tempfile::tempdir().expect("a directory");
    together(&one, base.path(), task, &[3, 1, 7, 0], 1);
    together(&connect(&private), base.path(), task, &[2, 6, 4, 5, 8, 9], 1);
    let expected = &expected[..10]; // the last run has ended after its first iteration
    assert!(all(base.path(), 10) != expected, "all are stopped before their ends");
    together(&connect(&private), base.path(), task, &[0, 4, 3, 6], u64::MAX);
    together(&one, base.path(), task, &[1, 5, 8], u64::MAX);
    together(&one, base.path(), task, &[2, 7, 9], u64::MAX);
    assert!(all(base.path(), 10) == expected, "resumed in other groups");
}

/// With `update_per_episode`, the schedule counts every kept episode as if it had as many steps as the step limit,
/// because the paper's published code pads episodes to this length.
#[rstest]
fn learning_rate_falls_by_episodes_with_update_per_episode(#[values(true, false)] update_per_episode: bool) {
    let private = [server()];
    let text = format!(
        "preset = 'paper'\nenvironment = 'CartPole'\nalgorithm = 'epopt-a2c'\nepisodes = 6\n\
         episodes_per_iteration = 3\nlearning_rate = 1.0e-3\nupdate_per_episode = {update_per_episode}"
    );
    let config = TrainConfig::from_table("the test", text.parse().expect("TOML")).expect("a configuration");
    let base = tempfile::tempdir().expect("a directory");
    let directory = RunDirectory::choose(&base.path().join("run"), false).expect("a directory");
    let mut progress = Vec::new();
    let report = |it: &Progress| progress.push((it.update.learning_rate, it.timesteps, it.update.n_updates));
    train(&connect(&private), &config, &directory, 1, &StopFlag::default(), report).expect("a training");
    let steps = progress[0].1 as f64 / (6.0 * 200.0);
    let (left, updates) = if update_per_episode { (0.5, [3, 6]) } else { (1.0 - steps, [1, 2]) };
    assert_eq!(progress.iter().map(|it| it.2).collect::<Vec<_>>(), updates);
    assert_eq!(progress[0].0, 1e-3);
    assert!((progress[1].0 - 1e-3 * left).abs() < 1e-15, "f64 rounding: {progress:?}");
}

#[test]
fn new_run_has_no_marks_of_the_earlier_one() {
    let base = tempfile::tempdir().expect("a directory");
    let kept = base.path().join("marks/10");
    std::fs::create_dir_all(&kept).expect("a folder");
    std::fs::write(kept.join("checkpoint.json"), "{}").expect("a file");
    let error = RunDirectory::choose(base.path(), false).expect_err("it holds a run").to_string();
    assert!(error.contains("already holds a run (marks)"), "{error}");
    let directory = RunDirectory::choose(base.path(), true).expect("a directory");
    let has_kept = |marks: &[u64]| directory.has_kept(marks.iter().copied()).expect("it can be told");
    assert!(has_kept(&[10]) && !has_kept(&[10, 20]));
    let stop = StopFlag::default();
    train(&connect(&[server()]), &config(CART_POLE, TRAININGS[0]), &directory, 1, &stop, |_| {}).expect("a training");
    assert!(!has_kept(&[10]));
}

#[rstest]
fn failed_training_does_not_stop_the_others(
    #[values(CART_POLE, PENDULUM)] task: &str,
    #[values(("algorithm = 'a2c'\nn_steps = 5", 0), ("algorithm = 'ppo'\nn_steps = 64", 5))] kind: (&str, usize),
) {
    let private: [PrivateServer; 1] = [server()];
    let servers = connect(&private);
    let base = tempfile::tempdir().expect("a directory");
    let (base_settings, number) = kind;
    let bad = format!("{base_settings}\nnum_envs = 2\nlearning_rate = 1e30\nmax_grad_norm = 1e30\nseed = 1");
    let good = config(task, TRAININGS[number]);
    let directories: Vec<RunDirectory> =
        ["bad", "good"].map(|name| RunDirectory::choose(&base.path().join(name), false).expect("a directory")).into();
    let starts = [config(task, &bad), good].map(|config| Start::Fresh(Box::new(config)));
    let entries = directories
        .iter()
        .zip(starts)
        .map(|(directory, start)| TrainRequest { directory, start, marks: &[] })
        .collect();
    let mut ends = vec![String::new(); 2];
    let mut ended = |index: usize, outcome: Result<_, _>| {
        ends[index] =
            outcome.map_or_else(|error: perturb_learner::training::TrainError| error.to_string(), |_| "ok".into());
    };
    train_together(&servers, entries, 1, &StopFlag::default(), &mut |_, _| {}, &mut ended).expect("a session");
    assert!(ends[0].contains("not finite") || ends[0].contains("became"), "{}", ends[0]);
    assert_eq!(ends[1], "ok");
    let expected = alone(&servers, task).remove(number);
    assert!(kept(&base.path().join("good")) == expected, "as if it had been alone");
}

#[rstest]
fn tests_do_not_depend_on_the_actor_location(
    #[values(0, 3, 4)] number: usize,
    #[values("", "\nobserve = 'parameters'")] observe: &str,
) {
    let private = [server(), server()];
    let one = connect(&private[..1]);
    let base = tempfile::tempdir().expect("a directory");
    together(&one, base.path(), &format!("{CART_POLE}{observe}"), &[number], u64::MAX);
    let checkpoint = Checkpoint::load(&base.path().join(number.to_string())).expect("a checkpoint");
    let episodes = |servers: &Servers| {
        let options = TestOptions { episodes: 130, seed: 8, selects: false, success: None };
        let tester = Tester::new(servers, &checkpoint, options).expect("a tester");
        let sets = [Version::D.into(), Version::E.into()];
        tester.test(&sets, &StopFlag::default(), &mut |_, _| {}).expect("records").episodes
    };
    let expected = episodes(&connect(&private[..1]).with_act(ActorLocation::Client));
    assert_eq!(expected.len(), 260);
    assert!(episodes(&one) == expected);
    assert!(episodes(&connect(&private)) == expected, "on two servers");
}
