//! Tests the effects of the presets' settings on updates and on whole trainings. docs/algorithms.md lists the settings
//! in which the presets differ. Tests of `perturb-settings` check the default values.

use perturb_files::interrupt::StopFlag;
use perturb_learner::algorithm::{A2c, Algorithm, Ppo};
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::logging::Progress;
use perturb_learner::rollout::{RolloutBuffer, RolloutStep};
use perturb_learner::training::{RunDirectory, train};
use perturb_policy::random::{Purpose, normal, stream};
use perturb_policy::{ActionKind, PolicySpec};
use perturb_settings::{A2cConfig, PpoConfig, TrainConfig};

use crate::common::{connect, moved, server};
use rstest::rstest;
use tempfile::TempDir;

/// Trains on CartPole. Returns the run's folder and every reported [`Progress`].
fn trained(settings: &str) -> (TempDir, Vec<Progress>) {
    let private = [server()];
    let text = format!("environment = 'CartPole'\n{settings}");
    let config = TrainConfig::from_table("the test", text.parse().expect("TOML")).expect("a configuration");
    let out = tempfile::tempdir().expect("a directory");
    let directory = RunDirectory::choose(out.path(), false).expect("an empty directory");
    let mut progress = Vec::new();
    let report = |it: &Progress| progress.push(*it);
    train(&connect(&private), &config, &directory, 1, &StopFlag::default(), report).expect("a training");
    (out, progress)
}

const N_STEPS: usize = 6;
const N_ENVS: usize = 3;
/// The discount factor. Multiplying by 0.5 causes no rounding errors.
const GAMMA: f64 = 0.5;

/// The way in which a task reports that its step limit ended an episode.
#[derive(Clone, Copy)]
enum Limit {
    /// The episode is truncated.
    Truncation,
    /// The episode terminates, and a bonus is added to the reward.
    Termination { bonus: f32 },
}

/// Returns a rollout of random numbers in which the step limit ends two episodes: one in the middle of the rollout, one
/// in its last step. The value of every final observation is 1.5.
fn rollout(spec: &PolicySpec, limit: Limit) -> RolloutBuffer {
    let mut rng = stream(7, Purpose::Actions);
    let mut numbers = |count: usize| (0..count).map(|_| normal(&mut rng) as f32).collect::<Vec<f32>>();
    let mut rollout = RolloutBuffer::new(N_STEPS, N_ENVS, spec.observation_size, spec.action.width());
    rollout.begin(&vec![0.0; N_ENVS * spec.memory_size()]);
    let is_limit = |t: usize, n: usize| (t, n) == (2, 1) || (t, n) == (N_STEPS - 1, 2);
    for t in 0..N_STEPS {
        let ended: [bool; N_ENVS] = std::array::from_fn(|n| is_limit(t, n));
        let starts: [bool; N_ENVS] = std::array::from_fn(|n| t == 0 || is_limit(t - 1, n));
        let (truncated, terminated, bonus) = match limit {
            Limit::Truncation => (ended, [false; N_ENVS], 0.0),
            Limit::Termination { bonus } => ([false; N_ENVS], ended, bonus),
        };
        // Rewards are multiples of ¼, so that adding the bonus causes no rounding.
        let reward = |n: usize| (t * N_ENVS + n) as f32 / 4.0 - 2.0 + if ended[n] { bonus } else { 0.0 };
        let step = RolloutStep {
            observations: &numbers(N_ENVS * spec.observation_size),
            starts: &starts,
            actions: &[0.0, 1.0, 1.0],
            log_probs: &[-0.7; N_ENVS],
            values: &numbers(N_ENVS),
            rewards: &std::array::from_fn::<f32, N_ENVS, _>(reward),
            terminated: &terminated,
            truncated: &truncated,
            truncation_values: &[1.5; N_ENVS],
        };
        rollout.push(step).expect("a step that fits");
    }
    rollout.finish(&numbers(N_ENVS)).expect("a full rollout");
    rollout
}

fn a2c(bootstrap_truncation: bool, spec: &PolicySpec) -> Box<dyn Algorithm> {
    let config = A2cConfig { n_steps: N_STEPS, gamma: GAMMA, bootstrap_truncation, ..A2cConfig::default() };
    Box::new(A2c::new(config, &moved(spec)).expect("valid settings"))
}

fn ppo(bootstrap_truncation: bool, spec: &PolicySpec) -> Box<dyn Algorithm> {
    let config = PpoConfig { n_steps: N_STEPS, gamma: GAMMA, bootstrap_truncation, ..PpoConfig::default() };
    Box::new(Ppo::new(config, &moved(spec), 5).expect("valid settings"))
}

#[rstest]
fn updates_bootstrap_truncation_if_set(
    #[values(a2c, ppo)] algorithm: fn(bool, &PolicySpec) -> Box<dyn Algorithm>,
    #[values(None, Some(8))] lstm: Option<usize>,
) {
    let spec = PolicySpec { observation_size: 3, action: ActionKind::Discrete { n: 2 }, hidden: vec![8], lstm };
    let weights = |bootstrap_truncation, limit| {
        let mut policy = moved(&spec);
        let mut algorithm = algorithm(bootstrap_truncation, &spec);
        algorithm.update(&mut policy, &rollout(&spec, limit), 1.0).expect("an update");
        policy.weights()
    };
    let end = |bonus| Limit::Termination { bonus };
    assert_eq!(weights(false, Limit::Truncation), weights(false, end(0.0)));
    assert_eq!(weights(true, Limit::Truncation), weights(true, end(0.75)), "γ times the value follows");
    assert_ne!(weights(true, Limit::Truncation), weights(false, Limit::Truncation));
}

/// The schedule counts only steps that EPOpt learns from. If each episode has an update, it counts episodes instead,
/// because the paper's published code then pads each episode to the step limit.
#[rstest]
fn epopts_linear_learning_rate_falls_by_the_kept_episodes(#[values(true, false)] update_per_episode: bool) {
    let settings = "preset = 'paper'\nalgorithm = 'epopt-a2c'\nepisodes = 9\nepisodes_per_iteration = 4\nepsilon = 0.4\n\
                    full_iterations = 0\nlearning_rate = 1e-3";
    let (_, progress) = trained(&format!("{settings}\nupdate_per_episode = {update_per_episode}"));
    let mut episodes = 0;
    let mut steps = 0;
    for it in &progress {
        let done = if update_per_episode { episodes as f64 / 9.0 } else { steps as f64 / (9.0 * 200.0) };
        let expected = 1e-3 * (1.0 - done);
        assert!((it.update.learning_rate - expected).abs() < 1e-15, "f64 rounding: {it:?} {expected}");
        let selection = it.update.selection.expect("EPOpt's");
        episodes += selection.kept;
        steps += selection.kept_steps;
        assert_eq!((it.episodes, it.generated_episodes), (episodes, 4 * it.iterations));
    }
    assert!(progress.len() > 2 && episodes < 4 * progress.len() as u64, "some are not kept: {progress:?}");
}

/// The preset "paper" has one environment and logs every tenth rollout. The preset "perturb" has eight environments and
/// logs every rollout.
#[rstest]
#[case("perturb", 8, 1)]
#[case("paper", 1, 10)]
fn ppos_log_has_a_line_for_so_many_rollouts_and_for_the_last(
    #[case] preset: &str,
    #[case] num_envs: u64,
    #[case] log_interval: u64,
) {
    let settings = "algorithm = 'ppo'\nn_steps = 16\nn_epochs = 1\nepisodes = 30";
    let (out, progress) = trained(&format!("preset = '{preset}'\n{settings}"));
    let last = progress.len() as u64;
    assert!(last > log_interval);
    for (it, iteration) in progress.iter().zip(1..) {
        assert_eq!((it.iterations, it.timesteps), (iteration, 16 * num_envs * iteration));
    }
    let log = std::fs::read_to_string(out.path().join("progress.csv")).expect("a log");
    let mut lines = log.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let column = lines.next().and_then(|names| names.iter().position(|name| *name == "time/iterations"));
    let logged: Vec<u64> = lines.map(|line| line[column.expect("a column")].parse().expect("a whole number")).collect();
    let due = |iteration: &u64| iteration.is_multiple_of(log_interval) || *iteration == last;
    assert_eq!(logged, (1..=last).filter(due).collect::<Vec<_>>());
}

/// Tests use the final weights, regardless of `checkpoint_interval`. In contrast, the paper's published code tests the
/// weights that it saved last, which can be a hundred updates old.
#[test]
fn tested_policy_has_the_last_weights() {
    let checkpoint = |checkpoint_interval: u64| {
        let settings = "preset = 'paper'\nalgorithm = 'a2c'\nepisodes = 5";
        let (out, progress) = trained(&format!("{settings}\ncheckpoint_interval = {checkpoint_interval}"));
        let checkpoint = Checkpoint::load(out.path()).expect("a checkpoint");
        assert_eq!(Some(checkpoint.state.counters.iterations), progress.last().map(|it| it.iterations));
        checkpoint
    };
    let rarely = checkpoint(500);
    let often = checkpoint(1);
    assert_eq!(rarely.weights, often.weights);
    assert_eq!(rarely.state.reward_normaliser, often.state.reward_normaliser);
    assert!(rarely.state.reward_normaliser.is_some_and(|rewards| rewards.runs_on()));
}

#[rstest]
fn regularisation_reaches_the_weights(
    #[values("a2c", "ppo", "epopt-a2c", "epopt-ppo")] algorithm: &str,
    #[values("observation_noise", "weight_decay")] setting: &str,
) {
    let weights = |value: f64| {
        let sizes = if algorithm.starts_with("epopt") { "episodes_per_iteration = 4" } else { "n_steps = 16" };
        let text = format!("algorithm = '{algorithm}'\nnum_envs = 2\nepisodes = 8\n{sizes}\n{setting} = {value:?}");
        let (out, _) = trained(&text);
        Checkpoint::load(out.path()).expect("a checkpoint").weights
    };
    assert_eq!(weights(0.0), weights(0.0));
    assert_ne!(weights(0.5), weights(0.0));
}
