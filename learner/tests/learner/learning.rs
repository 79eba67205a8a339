//! Tests that algorithms learn small tasks within seconds, and tests of single updates.

use perturb_learner::algorithm::{A2c, Algorithm, AlgorithmState, Ppo};
use perturb_learner::error::Error;
use perturb_learner::policy::TrainablePolicy;
use perturb_learner::rollout::{RolloutBuffer, RolloutStep};
use perturb_policy::random::{Purpose, normal, stream, uniform};
use perturb_policy::{ActionKind, Actor, ActorOutput, PolicySpec};
use perturb_settings::{A2cConfig, PpoConfig, Schedule, SettingError};
use perturb_torch::{Sequences, TorchPolicy};
use rand_chacha::ChaCha8Rng;
use rstest::rstest;
use tch::{Kind, Tensor};

const N_ENVS: usize = 16;
const DISCRETE: ActionKind = ActionKind::Discrete { n: 4 };
const CONTINUOUS: ActionKind = ActionKind::Continuous { size: 2 };

/// The identity task of stable-baselines3: the best action equals the observation. Every step is an episode.
///
/// With discrete actions, the observation is one-hot with four entries, and the reward is 1 for the action with the
/// same index, otherwise 0. With continuous actions, the observation has two numbers in [-1, 1], and the reward is
/// minus the squared distance of the action.
struct Identity {
    action: ActionKind,
    rng: ChaCha8Rng,
    observations: Vec<f32>,
}

impl Identity {
    fn new(action: ActionKind) -> Self {
        let mut task = Identity { action, rng: stream(11, Purpose::Weights), observations: vec![] };
        task.draw();
        task
    }

    fn size(&self) -> usize {
        self.action.outputs()
    }

    fn draw(&mut self) {
        self.observations.clear();
        for _ in 0..N_ENVS {
            match self.action {
                ActionKind::Discrete { n } => {
                    let best = (uniform(&mut self.rng) * n as f64) as usize;
                    self.observations.extend((0..n).map(|i| f32::from(u8::from(i == best))));
                }
                ActionKind::Continuous { size } => {
                    let rng = &mut self.rng;
                    self.observations.extend((0..size).map(|_| (2.0 * uniform(rng) - 1.0) as f32));
                }
            }
        }
    }

    fn rewards(&self, actions: &[f32]) -> Vec<f32> {
        let reward = |(observation, action): (&[f32], &[f32])| match self.action {
            ActionKind::Discrete { .. } => observation[action[0] as usize],
            ActionKind::Continuous { .. } => -observation.iter().zip(action).map(|(o, a)| (o - a).powi(2)).sum::<f32>(),
        };
        self.observations.chunks(self.size()).zip(actions.chunks(self.action.width())).map(reward).collect()
    }
}

/// A policy and a task, with the state of a training loop.
struct Training {
    policy: TrainablePolicy,
    actor: Actor,
    task: Identity,
    rng: ChaCha8Rng,
    rollout: RolloutBuffer,
}

impl Training {
    fn new(action: ActionKind, n_steps: usize) -> Self {
        let spec = PolicySpec { observation_size: action.outputs(), action, hidden: vec![32, 32], lstm: None };
        Training {
            policy: TrainablePolicy::new(spec.clone(), 5).expect("a policy"),
            actor: Actor::new(&spec, N_ENVS),
            task: Identity::new(action),
            rng: stream(5, Purpose::Actions),
            rollout: RolloutBuffer::new(n_steps, N_ENVS, spec.observation_size, action.width()),
        }
    }

    /// Collects a rollout. Returns its mean reward.
    fn collect(&mut self) -> f64 {
        self.actor.load(&self.policy.weights()).expect("weights that fit");
        self.rollout.clear();
        let mut acts = ActorOutput::new(self.task.action, N_ENVS);
        let mut sum = 0.0;
        while !self.rollout.is_full() {
            self.actor.act(&self.task.observations, &mut self.rng, &mut acts).expect("actions");
            let rewards = self.task.rewards(&acts.actions);
            sum += rewards.iter().map(|&r| f64::from(r)).sum::<f64>();
            let step = RolloutStep {
                observations: &self.task.observations,
                actions: &acts.actions,
                log_probs: &acts.log_probs,
                values: &acts.values,
                rewards: &rewards,
                starts: &[true; N_ENVS],
                terminated: &[true; N_ENVS],
                truncated: &[false; N_ENVS],
                truncation_values: &[0.0; N_ENVS],
            };
            self.rollout.push(step).expect("a step that fits");
            self.task.draw();
        }
        self.rollout.finish(&[0.0; N_ENVS]).expect("a full rollout");
        sum / (self.rollout.n_steps() * N_ENVS) as f64
    }

    /// Collects a rollout and updates the policy, `updates` times. Returns the mean reward of one more rollout.
    fn train(&mut self, algorithm: &mut dyn Algorithm, updates: usize) -> f64 {
        for update in 0..updates {
            self.collect();
            let progress_remaining = 1.0 - update as f64 / updates as f64;
            algorithm.update(&mut self.policy, &self.rollout, progress_remaining).expect("an update");
        }
        self.collect()
    }
}

fn a2c(training: &Training) -> A2c {
    let n_steps = training.rollout.n_steps();
    let config = A2cConfig { n_steps, learning_rate: 7e-3, ent_coef: 0.0, ..A2cConfig::default() };
    A2c::new(config, &training.policy).expect("valid settings")
}

fn ppo(training: &Training, n_minibatches: usize) -> Ppo {
    let n_steps = training.rollout.n_steps();
    let config = PpoConfig { n_steps, n_minibatches, learning_rate: 3e-3, n_epochs: 5, ..PpoConfig::default() };
    Ppo::new(config, &training.policy, 5).expect("valid settings")
}

// Expected rewards: a uniform discrete policy gets 0.25, and the best one gets 1. The best continuous policy with
// standard deviation σ gets -2σ², and the initial policy gets -2.7.

#[rstest]
#[case(DISCRETE, 1500, 0.95)]
#[case(CONTINUOUS, 2000, -0.4)]
fn a2c_learns_the_identity(#[case] action: ActionKind, #[case] updates: usize, #[case] enough: f64) {
    let mut training = Training::new(action, 5);
    let mut algorithm = a2c(&training);
    let reward = training.train(&mut algorithm, updates);
    assert!(reward > enough, "{reward}");
}

#[rstest]
#[case(DISCRETE, 40, 0.95)]
#[case(CONTINUOUS, 100, -0.2)]
fn ppo_learns_the_identity(
    #[case] action: ActionKind,
    #[case] updates: usize,
    #[case] enough: f64,
    #[values(1, 4)] n_minibatches: usize,
) {
    let mut training = Training::new(action, 32);
    let mut algorithm = ppo(&training, n_minibatches);
    let reward = training.train(&mut algorithm, updates);
    assert!(reward > enough, "{reward}");
}

#[rstest]
fn ppo_begins_with_ratio_1_and_clips_nothing(
    #[values(DISCRETE, CONTINUOUS)] action: ActionKind,
    #[values(1, 4)] n_minibatches: usize,
) {
    let mut training = Training::new(action, 32);
    training.collect();
    // The learning rate is so small that no weight changes, so all minibatches see the initial policy.
    let config = PpoConfig {
        n_steps: 32,
        n_epochs: 1,
        n_minibatches,
        learning_rate: 1e-12,
        kl_coef: 0.5,
        ..PpoConfig::default()
    };
    let mut first = Ppo::new(config.clone(), &training.policy, 1).expect("valid settings");
    let stats = first.update(&mut training.policy, &training.rollout, 1.0).expect("an update");
    assert_eq!(stats.clip_fraction, Some(0.0));
    // The actor's log probabilities have errors of at most 1e-6, which change the divergence only by half their square.
    // The tolerance is for the rounding of its f32 terms to 2⁻²⁴.
    assert!(stats.approx_kl.expect("PPO's").abs() < 2e-7, "{stats:?}");
    // A policy's divergence from itself is 0. The outputs of a minibatch may differ from those of the whole batch by
    // rounding.
    assert!(stats.kl_divergence.expect("a penalty").abs() < 2e-7, "{stats:?}");
    // With ratio 1, the surrogate is the negative mean of the normalised advantages. This is 0 up to the error of the
    // ratios.
    assert!(stats.policy_gradient_loss.abs() < 1e-5, "{stats:?}");
    // The current values equal the rollout's, so value clipping changes nothing.
    let mut unclipped =
        Ppo::new(PpoConfig { clip_range_vf: 0.0, ..config.clone() }, &training.policy, 1).expect("valid settings");
    let value_loss = unclipped.update(&mut training.policy, &training.rollout, 1.0).expect("an update").value_loss;
    assert!((value_loss - stats.value_loss).abs() < 1e-6 * value_loss, "f32 rounding: {value_loss} {stats:?}");
    let config = PpoConfig { n_epochs: 10, learning_rate: 1e-2, ..config };
    let mut later = Ppo::new(config, &training.policy, 1).expect("valid settings");
    let stats = later.update(&mut training.policy, &training.rollout, 1.0).expect("an update");
    assert!(stats.clip_fraction > Some(0.0) && stats.approx_kl > Some(1e-4), "a moved policy: {stats:?}");
}

#[test]
fn the_loss_is_the_weighted_sum_of_its_parts() {
    for action in [DISCRETE, CONTINUOUS] {
        let mut training = Training::new(action, 8);
        training.collect();
        let ent_coef = 0.3;
        let vf_coef = 0.7;
        let kl_coef = 0.9;
        let a2c = A2cConfig { n_steps: 8, ent_coef, vf_coef, ..A2cConfig::default() };
        let ppo = PpoConfig {
            n_steps: 8,
            ent_coef,
            vf_coef,
            n_epochs: 3,
            learning_rate: 1e-2, // large enough for the divergence to matter
            ..PpoConfig::default()
        };
        let penalised = |n_minibatches| PpoConfig { kl_coef, n_minibatches, ..ppo.clone() };
        let ppos = [penalised(1), penalised(4), ppo.clone()];
        let mut algorithms: Vec<Box<dyn Algorithm>> =
            vec![Box::new(A2c::new(a2c, &training.policy).expect("valid settings"))];
        for config in ppos {
            algorithms.push(Box::new(Ppo::new(config, &training.policy, 1).expect("valid settings")));
        }
        let penalties = algorithms.into_iter().map(|mut algorithm| {
            let spec = training.policy.spec().clone();
            let weights = training.policy.weights();
            let mut policy = TrainablePolicy::from_weights(spec, &weights).expect("a policy");
            let stats = algorithm.update(&mut policy, &training.rollout, 1.0).expect("an update");
            let penalty = kl_coef * stats.kl_divergence.unwrap_or(0.0);
            let sum = stats.policy_gradient_loss + ent_coef * stats.entropy_loss + vf_coef * stats.value_loss + penalty;
            assert!((stats.loss - sum).abs() < 1e-6, "f32 rounding of numbers of order 1: {stats:?}");
            assert!(stats.entropy_loss < 0.0 && stats.value_loss > 0.0, "{stats:?}");
            stats.kl_divergence.map(|divergence| divergence > 1e-4)
        });
        assert_eq!(penalties.collect::<Vec<_>>(), [None, Some(true), Some(true), None]);
    }
}

#[rstest]
fn a_penalty_on_the_divergence_keeps_the_policy_near(
    #[values(DISCRETE, CONTINUOUS)] action: ActionKind,
    #[values(1, 4)] n_minibatches: usize,
) {
    let mut training = Training::new(action, 8);
    training.collect();
    let copy =
        || TrainablePolicy::from_weights(training.policy.spec().clone(), &training.policy.weights()).expect("a copy");
    let rollout = &training.rollout;
    let moved_by = |kl_coef| {
        let before = copy();
        let mut after = copy();
        let config = PpoConfig { n_steps: 8, n_minibatches, learning_rate: 1e-2, kl_coef, ..PpoConfig::default() };
        let mut ppo = Ppo::new(config, &after, 1).expect("valid settings");
        ppo.update(&mut after, rollout, 1.0).expect("an update");
        let distributions = |policy: &TrainablePolicy| {
            let sequences = Sequences::new(policy.spec(), 8, rollout.observations(), rollout.starts(), &[]);
            let policy = TorchPolicy::new(policy.spec(), policy.flat_weights()).expect("a policy");
            policy.evaluate(&sequences.expect("shapes that fit"), &Tensor::of_slice(rollout.actions())).distributions
        };
        distributions(&before).divergence_to(&distributions(&after)).mean(Kind::Float).double_value(&[])
    };
    let free = moved_by(0.0);
    let held = moved_by(30.0);
    assert!(0.0 < held && held < 0.5 * free, "{action:?}, {n_minibatches} minibatches: {held} {free}");
}

#[test]
fn same_seed_and_resume_give_same_bytes() {
    let start = |action| {
        let training = Training::new(action, 8);
        let algorithms: [Box<dyn Algorithm>; 2] = [Box::new(a2c(&training)), Box::new(ppo(&training, 2))];
        (training, algorithms)
    };
    for action in [DISCRETE, CONTINUOUS] {
        for which in 0..2 {
            let run = |resume: bool| {
                let (mut training, mut algorithms) = start(action);
                training.train(algorithms[which].as_mut(), 3);
                if resume {
                    let json = serde_json::to_string(&algorithms[which].state()).expect("JSON");
                    let state: AlgorithmState = serde_json::from_str(&json).expect("a state");
                    let spec = training.policy.spec().clone();
                    let weights = training.policy.weights();
                    training.policy = TrainablePolicy::from_weights(spec, &weights).expect("a policy");
                    (_, algorithms) = start(action);
                    algorithms[which].load_state(&state).expect("a state that fits");
                }
                training.train(algorithms[which].as_mut(), 3);
                training.policy.weights()
            };
            assert_eq!(run(false), run(false));
            assert_eq!(run(false), run(true));
        }
    }
}

#[test]
fn a_state_of_another_algorithm_is_refused() {
    let training = Training::new(DISCRETE, 8);
    let mut a2c = a2c(&training);
    let mut ppo = ppo(&training, 1);
    assert!(matches!(a2c.load_state(&ppo.state()), Err(Error::Policy(perturb_policy::Error::Arrays { .. }))));
    assert!(ppo.load_state(&a2c.state()).is_err());
}

#[test]
fn loss_that_is_not_finite_changes_nothing() {
    let mut training = Training::new(DISCRETE, 8);
    training.collect();
    let mut rollout = RolloutBuffer::new(8, N_ENVS, 4, 1);
    for _ in 0..8 {
        let step = RolloutStep {
            observations: &[0.5; 4 * N_ENVS],
            actions: &[1.0; N_ENVS],
            log_probs: &[-1.0; N_ENVS],
            values: &[0.0; N_ENVS],
            rewards: &[f32::MAX; N_ENVS],
            starts: &[false; N_ENVS],
            terminated: &[false; N_ENVS],
            truncated: &[false; N_ENVS],
            truncation_values: &[0.0; N_ENVS],
        };
        rollout.push(step).expect("a step that fits");
    }
    rollout.finish(&[0.0; N_ENVS]).expect("a full rollout");
    let before = training.policy.weights();
    let algorithms: [Box<dyn Algorithm>; 2] = [Box::new(a2c(&training)), Box::new(ppo(&training, 2))];
    for mut algorithm in algorithms {
        let result = algorithm.update(&mut training.policy, &rollout, 1.0);
        assert!(matches!(result, Err(Error::Policy(perturb_policy::Error::NotFinite { update: 0, .. }))), "{result:?}");
        assert_eq!(training.policy.weights(), before);
    }
}

#[test]
fn the_learning_rate_falls_linearly_or_stays() {
    let mut training = Training::new(DISCRETE, 8);
    training.collect();
    for (learning_rate_schedule, expected) in [(Schedule::Linear, 0.25e-3), (Schedule::Constant, 1e-3)] {
        let config = A2cConfig { n_steps: 8, learning_rate: 1e-3, learning_rate_schedule, ..A2cConfig::default() };
        let mut algorithm = A2c::new(config, &training.policy).expect("valid settings");
        let stats = algorithm.update(&mut training.policy, &training.rollout, 0.25).expect("an update");
        assert_eq!(stats.learning_rate, expected);
        assert!(algorithm.update(&mut training.policy, &training.rollout, 1.5).is_err());
    }
    // A2C's last learning rate is 0, so the last update changes no weight.
    let mut algorithm = a2c(&training);
    let before = training.policy.weights();
    algorithm.update(&mut training.policy, &training.rollout, 0.0).expect("an update");
    assert_eq!(training.policy.weights(), before);
}

#[test]
fn rollouts_that_do_not_fit_are_refused() {
    let mut training = Training::new(DISCRETE, 8);
    let mut algorithm = a2c(&training);
    let result = algorithm.update(&mut training.policy, &training.rollout, 1.0);
    assert!(matches!(result, Err(Error::RolloutLength { got: 0, expected: 8, .. })), "{result:?}");
    training.collect();
    let mut short = A2c::new(A2cConfig::default(), &training.policy).expect("valid settings");
    assert!(matches!(
        short.update(&mut training.policy, &training.rollout, 1.0),
        Err(Error::Policy(perturb_policy::Error::Length { .. }))
    ));
    let mut odd = ppo(&training, 3);
    let result = odd.update(&mut training.policy, &training.rollout, 1.0);
    assert!(matches!(&result, Err(Error::Setting(error)) if error.name == "n_minibatches"), "{result:?}");
    assert!(matches!(training.rollout.finish(&[0.0; 3]), Err(Error::Policy(perturb_policy::Error::Length { .. }))));
}

#[track_caller]
fn assert_refused(result: Result<(), SettingError>, setting: &str) {
    assert!(matches!(&result, Err(error) if error.name == setting), "{setting}: {result:?}");
}

#[rstest]
#[case("learning_rate", |config: &mut A2cConfig, bad| config.learning_rate = bad)]
#[case("gamma", |config: &mut A2cConfig, bad| config.gamma = bad)]
#[case("ent_coef", |config: &mut A2cConfig, bad| config.ent_coef = bad)]
#[case("vf_coef", |config: &mut A2cConfig, bad| config.vf_coef = bad)]
#[case("max_grad_norm", |config: &mut A2cConfig, bad| config.max_grad_norm = bad)]
#[case("weight_decay", |config: &mut A2cConfig, bad| config.weight_decay = bad)]
#[case("rms_alpha", |config: &mut A2cConfig, bad| config.rms_alpha = bad)]
#[case("rms_eps", |config: &mut A2cConfig, bad| config.rms_eps = bad)]
fn a2cs_settings_outside_their_ranges_are_refused_by_name(
    #[case] name: &str,
    #[case] set: fn(&mut A2cConfig, f64),
    #[values(f64::NAN, f64::INFINITY, -1.0)] bad: f64,
) {
    let mut config = A2cConfig::default();
    config.validate().expect("defaults are valid");
    set(&mut config, bad);
    assert_refused(config.validate(), name);
}

#[rstest]
#[case("learning_rate", |config: &mut PpoConfig, bad| config.learning_rate = bad)]
#[case("gamma", |config: &mut PpoConfig, bad| config.gamma = bad)]
#[case("gae_lambda", |config: &mut PpoConfig, bad| config.gae_lambda = bad)]
#[case("clip_range", |config: &mut PpoConfig, bad| config.clip_range = bad)]
#[case("clip_range_vf", |config: &mut PpoConfig, bad| config.clip_range_vf = bad)]
#[case("ent_coef", |config: &mut PpoConfig, bad| config.ent_coef = bad)]
#[case("kl_coef", |config: &mut PpoConfig, bad| config.kl_coef = bad)]
#[case("vf_coef", |config: &mut PpoConfig, bad| config.vf_coef = bad)]
#[case("max_grad_norm", |config: &mut PpoConfig, bad| config.max_grad_norm = bad)]
#[case("weight_decay", |config: &mut PpoConfig, bad| config.weight_decay = bad)]
#[case("adam_eps", |config: &mut PpoConfig, bad| config.adam_eps = bad)]
fn ppos_settings_outside_their_ranges_are_refused_by_name(
    #[case] name: &str,
    #[case] set: fn(&mut PpoConfig, f64),
    #[values(f64::NAN, f64::INFINITY, -1.0)] bad: f64,
) {
    let mut config = PpoConfig::default();
    config.validate().expect("defaults are valid");
    set(&mut config, bad);
    assert_refused(config.validate(), name);
}

#[test]
fn counts_of_0_are_refused_by_name() {
    assert_refused(A2cConfig { n_steps: 0, ..A2cConfig::default() }.validate(), "n_steps");
    assert_refused(PpoConfig { n_steps: 0, ..PpoConfig::default() }.validate(), "n_steps");
    assert_refused(PpoConfig { n_epochs: 0, ..PpoConfig::default() }.validate(), "n_epochs");
    assert_refused(PpoConfig { n_minibatches: 0, ..PpoConfig::default() }.validate(), "n_minibatches");
}

#[test]
fn settings_in_a_file_have_defaults() {
    let config: PpoConfig = toml::from_str("learning_rate = 1e-3").expect("other settings have defaults");
    assert_eq!(config, PpoConfig { learning_rate: 1e-3, ..PpoConfig::default() });
}

#[test]
fn streams_of_one_seed_are_independent() {
    let draw = |purpose| -> Vec<f64> {
        let mut rng = stream(3, purpose);
        (0..4).map(|_| normal(&mut rng)).collect()
    };
    assert_eq!(draw(Purpose::Actions), draw(Purpose::Actions));
    assert_ne!(draw(Purpose::Actions), draw(Purpose::Minibatches));
}
