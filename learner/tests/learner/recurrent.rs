//! Tests of recurrent policies: acting and learning compute the same function of past observations, its gradient is
//! right, and policies learn to remember.

use perturb_learner::algorithm::{A2c, Algorithm, AlgorithmState, Ppo};
use perturb_learner::error::Error;
use perturb_learner::policy::TrainablePolicy;
use perturb_learner::rollout::{RolloutBuffer, RolloutStep};
use perturb_policy::random::{Purpose, normal, stream, uniform};
use perturb_policy::{ActionKind, Actor, ActorOutput, PolicySpec, Weights};
use perturb_settings::{A2cConfig, PpoConfig};
use perturb_torch::{Evaluated, Sequences, TorchPolicy};
use rand_chacha::ChaCha8Rng;
use rstest::rstest;
use tch::{Kind, Tensor};

const DISCRETE: ActionKind = ActionKind::Discrete { n: 3 };
const CONTINUOUS: ActionKind = ActionKind::Continuous { size: 2 };
const O: usize = 5;

fn spec(action: ActionKind, hidden: &[usize], width: usize) -> PolicySpec {
    perturb_torch::register();
    PolicySpec { observation_size: O, action, hidden: hidden.to_vec(), lstm: Some(width) }
}

/// Returns weights in which every number, including biases and log_std, differs from its initial value by about 0.1.
fn moved(spec: &PolicySpec) -> Weights {
    let mut rng = stream(9, Purpose::Weights);
    let mut weights = TrainablePolicy::new(spec.clone(), 1).expect("a policy").weights();
    weights.iter_mut().flat_map(|array| &mut array.data).for_each(|x| *x += 0.1 * normal(&mut rng) as f32);
    weights
}

/// Some steps of a policy that acts on random observations. At the first step it already has a memory, and episodes
/// start at later steps.
struct Window {
    n_envs: usize,
    observations: Vec<f32>,
    starts: Vec<bool>,
    /// The policy's memory before the first step.
    memory: Vec<f32>,
    acts: Vec<ActorOutput>,
}

impl Window {
    fn new(spec: &PolicySpec, weights: &Weights, n_steps: usize, n_envs: usize) -> Self {
        let mut rng = stream(4, Purpose::Weights);
        let mut actor = Actor::new(spec, n_envs);
        actor.load(weights).expect("weights that fit");
        let mut window = Window { n_envs, observations: vec![], starts: vec![], memory: vec![], acts: vec![] };
        let mut acts = ActorOutput::new(spec.action, n_envs);
        for t in 0..n_steps + 3 {
            if t == 3 {
                window = Window {
                    memory: actor.memory().to_vec(),
                    acts: vec![],
                    starts: vec![],
                    observations: vec![],
                    n_envs,
                };
            }
            // About every sixth step of an environment starts an episode: 30 % of the odd steps, and none of the even
            // steps. The window's first step is odd.
            for n in 0..n_envs {
                let start = t % 2 == 1 && uniform(&mut rng) < 0.3;
                if start {
                    actor.forget(n);
                }
                window.starts.push(start);
            }
            let observations: Vec<f32> = (0..n_envs * O).map(|_| normal(&mut rng) as f32).collect();
            actor.act(&observations, &mut rng, &mut acts).expect("actions");
            window.observations.extend(observations);
            window.acts.push(acts.clone());
        }
        assert!(window.starts[..n_envs].contains(&true) && window.starts.iter().filter(|&&start| start).count() > 3);
        assert!(window.memory.iter().any(|&x| x != 0.0));
        window
    }

    fn evaluate(&self, policy: &TorchPolicy) -> Evaluated {
        let n_steps = self.acts.len();
        let sequences = Sequences::new(policy.spec(), n_steps, &self.observations, &self.starts, &self.memory);
        let actions: Vec<f32> = self.acts.iter().flat_map(|acts| acts.actions.clone()).collect();
        policy.evaluate(&sequences.expect("shapes that fit"), &Tensor::of_slice(&actions))
    }
}

/// Tolerance for outputs. Acting and learning add in different orders, and acting's tanh has an error of up to 3e-7.
/// Over layers of at most 256 units, this grows to about 1e-6 for values and logits of order 1.
const TOLERANCE: f32 = 1e-5;

fn torch(spec: &PolicySpec, weights: &Weights) -> TorchPolicy {
    let weights: Vec<f32> = weights.iter().flat_map(|array| array.data.clone()).collect();
    TorchPolicy::new(spec, &weights).expect("a policy")
}

#[test]
fn evaluating_a_window_equals_acting_step_by_step() {
    // Some sizes of layers and batches are not multiples of the block size.
    for (hidden, width) in [(vec![256, 256], 256), (vec![9, 17], 13), (vec![], 16), (vec![7], 1)] {
        for action in [DISCRETE, CONTINUOUS] {
            let spec = spec(action, &hidden, width);
            let weights = moved(&spec);
            let window = Window::new(&spec, &weights, 12, 7);
            for policy in [torch(&spec, &weights), torch(&spec, &weights).with_plain_autograd()] {
                let evaluated = window.evaluate(&policy);
                let log_probs = Vec::<f32>::from(evaluated.log_probs);
                let values = Vec::<f32>::from(evaluated.values);
                for (b, (log_prob, value)) in log_probs.into_iter().zip(values).enumerate() {
                    let acts = &window.acts[b / window.n_envs];
                    let n = b % window.n_envs;
                    let got = acts.log_probs[n];
                    let got_value = acts.values[n];
                    assert!((got - log_prob).abs() < TOLERANCE, "{hidden:?} {width} {b}: log π {got} {log_prob}");
                    assert!((got_value - value).abs() < TOLERANCE, "{hidden:?} {width} {b}: V {got_value} {value}");
                }
            }
        }
    }
}

#[test]
fn the_two_stage_gradient_equals_autograds() {
    for (hidden, width) in [(vec![256, 256], 256), (vec![9, 17], 13), (vec![], 16)] {
        for action in [DISCRETE, CONTINUOUS] {
            let spec = spec(action, &hidden, width);
            let weights = moved(&spec);
            let window = Window::new(&spec, &weights, 12, 7);
            let gradient = |policy: TorchPolicy| {
                let evaluated = window.evaluate(&policy);
                let weighting = Tensor::of_slice(&window.observations[..12 * 7]); // arbitrary numbers
                let loss = (&evaluated.log_probs * &weighting + evaluated.values.square() + &evaluated.entropy * 0.3)
                    .mean(Kind::Float);
                let mut gradient = vec![0.0; policy.spec().n_weights()];
                policy.gradient(&evaluated, &loss, &mut gradient).expect("a gradient");
                gradient
            };
            let policy = || torch(&spec, &weights);
            let two_stage = gradient(policy());
            let plain = gradient(policy().with_plain_autograd());
            let mut start = 0;
            for array in &weights {
                let range = start..start + array.data.len();
                start = range.end;
                let norm =
                    |numbers: &mut dyn Iterator<Item = f32>| numbers.map(|x| f64::from(x).powi(2)).sum::<f64>().sqrt();
                let size = norm(&mut plain[range.clone()].iter().copied());
                let difference = norm(&mut range.map(|i| two_stage[i] - plain[i]));
                // The tolerance covers sums of 84 products in another order, each rounded to 2⁻²⁴.
                assert!(size > 0.0 && difference < 1e-5 * size, "{hidden:?} {}: {difference} of {size}", array.name);
            }
            assert_eq!(start, plain.len());
        }
    }
}

#[test]
fn memory_is_emptied_per_environment() {
    let spec = spec(DISCRETE, &[16], 16);
    let mut actor = Actor::new(&spec, 3);
    actor.load(&moved(&spec)).expect("weights that fit");
    let fresh = actor.clone();
    let mut rng = stream(1, Purpose::Actions);
    let mut acts = ActorOutput::new(DISCRETE, 3);
    let observations: Vec<f32> = (0..3 * O).map(|_| normal(&mut rng) as f32).collect();
    actor.act(&observations, &mut rng, &mut acts).expect("actions");
    let remembered = actor.memory().to_vec();

    let mut values = vec![];
    let mut some = vec![];
    actor.values(&observations, &mut values).expect("values");
    actor.values_in(&observations[O..], &[1, 2], &mut some).expect("values");
    assert_eq!(some, values[1..], "row k belongs to the environment that is named");
    actor.values_in(&observations[O..2 * O], &[2], &mut some).expect("values");
    assert_ne!(some[0], values[1], "with another past the value is another");
    assert_eq!(actor.memory(), remembered);
    assert!(matches!(actor.values_in(&observations, &[1, 2], &mut some), Err(perturb_policy::Error::Length { .. })));

    actor.forget(1);
    let mut second = ActorOutput::new(DISCRETE, 3);
    actor.clone().act(&observations, &mut rng, &mut second).expect("actions");
    fresh.clone().act(&observations, &mut rng, &mut acts).expect("actions");
    assert_eq!(second.values[1], acts.values[1], "it begins anew");
    assert_ne!(second.values[0], acts.values[0]);
    assert_eq!(second.values[0], values[0], "the others go on, as the values said");
    assert_eq!(second.values[2], values[2]);
}

#[test]
fn a_policy_begins_with_orthogonal_weights_and_zero_biases() {
    let weights = TrainablePolicy::new(spec(CONTINUOUS, &[32, 24], 16), 3).expect("a policy").weights();
    let shapes: Vec<_> = weights.iter().map(|array| (array.name.as_str(), array.shape.as_slice())).collect();
    assert_eq!(
        shapes[4..],
        [
            ("lstm.input.weight", &[64, 24][..]),
            ("lstm.recurrent.weight", &[64, 16]),
            ("lstm.bias", &[64]),
            ("policy.weight", &[2, 16]),
            ("policy.bias", &[2]),
            ("value.weight", &[1, 16]),
            ("value.bias", &[1]),
            ("log_std", &[2]),
        ]
    );
    for array in &weights {
        // An orthogonal matrix has as many orthogonal vectors as its shorter side. Each has the length gain, so the
        // squares of all entries add up to count·gain².
        let squares: f64 = array.data.iter().map(|&x| f64::from(x).powi(2)).sum();
        let count = array.shape.iter().min().copied().unwrap_or(0) as f64;
        let expected = match array.name.as_str() {
            "policy.weight" => count * 1e-4,
            "value.weight" | "lstm.input.weight" | "lstm.recurrent.weight" => count,
            name if name.starts_with("hidden") && name.ends_with("weight") => count * 2.0,
            _ => 0.0,
        };
        assert!((squares - expected).abs() <= 1e-6 * expected, "{}: {squares}; f32 rounding", array.name);
    }
}

#[test]
fn nan_is_an_error_not_an_action() {
    for action in [DISCRETE, CONTINUOUS] {
        let spec = spec(action, &[16], 8);
        let mut actor = Actor::new(&spec, 2);
        actor.load(&moved(&spec)).expect("weights that fit");
        let mut observations = [0.5; 2 * O];
        observations[O + 2] = f32::NAN;
        let result = actor.act(&observations, &mut stream(1, Purpose::Actions), &mut ActorOutput::new(action, 2));
        assert!(matches!(result, Err(perturb_policy::Error::PolicyOutput { environment: 1 })), "{result:?}");
    }
}

const N_ENVS: usize = 16;
/// Number of steps in an episode of [`Recall`].
const LENGTH: usize = 4;

/// A task that needs a memory. The first observation of an episode is (±1, 0), the next ones are (0, 0), and the last
/// is (0, 1). In the last step, the reward is 1 if the action names the sign of the first observation, otherwise 0.
/// Without memory, the best mean reward is ½.
///
/// Neighbouring environments start their episodes one step apart, so that rollouts begin in the middle of some
/// episodes.
struct Recall {
    rng: ChaCha8Rng,
    cues: [usize; N_ENVS],
    t: usize,
}

impl Recall {
    fn step_of(&self, n: usize) -> usize {
        (self.t + n) % LENGTH
    }

    fn observations(&mut self) -> Vec<f32> {
        let mut observations = Vec::new();
        for n in 0..N_ENVS {
            let step = self.step_of(n);
            if step == 0 {
                self.cues[n] = usize::from(uniform(&mut self.rng) < 0.5);
            }
            let cue = if step == 0 { 2.0 * self.cues[n] as f32 - 1.0 } else { 0.0 };
            observations.extend([cue, f32::from(u8::from(step == LENGTH - 1))]);
        }
        observations
    }
}

/// A policy and a task, with the state of a training loop.
struct Training {
    policy: TrainablePolicy,
    actor: Actor,
    task: Recall,
    observations: Vec<f32>,
    starts: [bool; N_ENVS],
    rng: ChaCha8Rng,
    rollout: RolloutBuffer,
}

const TWO: ActionKind = ActionKind::Discrete { n: 2 };

impl Training {
    fn new(lstm: Option<usize>, n_steps: usize) -> Self {
        let spec = PolicySpec { observation_size: 2, action: TWO, hidden: vec![16], lstm };
        let mut task = Recall { rng: stream(11, Purpose::Weights), cues: [0; N_ENVS], t: 0 };
        Training {
            policy: TrainablePolicy::new(spec.clone(), 5).expect("a policy"),
            actor: Actor::new(&spec, N_ENVS),
            observations: task.observations(),
            task,
            starts: [true; N_ENVS],
            rng: stream(5, Purpose::Actions),
            rollout: RolloutBuffer::new(n_steps, N_ENVS, 2, 1),
        }
    }

    /// Collects a rollout. Returns the share of episodes in which the action named the right sign.
    fn collect(&mut self) -> f64 {
        self.actor.load(&self.policy.weights()).expect("weights that fit");
        self.rollout.begin(self.actor.memory());
        let mut acts = ActorOutput::new(TWO, N_ENVS);
        let mut told = 0.0;
        let mut episodes = 0.0;
        while !self.rollout.is_full() {
            self.actor.act(&self.observations, &mut self.rng, &mut acts).expect("actions");
            let done: [bool; N_ENVS] = std::array::from_fn(|n| self.task.step_of(n) == LENGTH - 1);
            let right = |n: usize| done[n] && acts.actions[n] as usize == self.task.cues[n];
            let rewards: [f32; N_ENVS] = std::array::from_fn(|n| f32::from(u8::from(right(n))));
            told += rewards.iter().map(|&r| f64::from(r)).sum::<f64>();
            episodes += done.iter().filter(|&&done| done).count() as f64;
            let step = RolloutStep {
                observations: &self.observations,
                starts: &self.starts,
                actions: &acts.actions,
                log_probs: &acts.log_probs,
                values: &acts.values,
                rewards: &rewards,
                terminated: &done,
                truncated: &[false; N_ENVS],
                truncation_values: &[0.0; N_ENVS],
            };
            self.rollout.push(step).expect("a step that fits");
            (0..N_ENVS).filter(|&n| done[n]).for_each(|n| self.actor.forget(n));
            self.starts = done;
            self.task.t += 1;
            self.observations = self.task.observations();
        }
        let mut last_values = Vec::new();
        self.actor.values(&self.observations, &mut last_values).expect("values");
        self.rollout.finish(&last_values).expect("a full rollout");
        told / episodes
    }

    /// Collects a rollout and updates the policy, `updates` times. Returns the mean share of right signs in four more
    /// rollouts.
    fn train(&mut self, algorithm: &mut dyn Algorithm, updates: usize) -> f64 {
        for _ in 0..updates {
            self.collect();
            algorithm.update(&mut self.policy, &self.rollout, 1.0).expect("an update");
        }
        (0..4).map(|_| self.collect()).sum::<f64>() / 4.0
    }
}

fn a2c(training: &Training) -> A2c {
    let n_steps = training.rollout.n_steps();
    let config = A2cConfig { n_steps, learning_rate: 7e-3, ..A2cConfig::default() };
    A2c::new(config, &training.policy).expect("valid settings")
}

fn ppo(training: &Training, n_minibatches: usize) -> Ppo {
    let n_steps = training.rollout.n_steps();
    let config = PpoConfig { n_steps, n_minibatches, learning_rate: 3e-3, n_epochs: 5, ..PpoConfig::default() };
    Ppo::new(config, &training.policy, 5).expect("valid settings")
}

/// Checks the share of right signs after the training. Without memory it is ½ by chance. The tolerance is 0.18: four
/// standard deviations of a mean over the 128 episodes of A2C's last four rollouts.
fn assert_recalls(lstm: Option<usize>, share: f64) {
    let expected = if lstm.is_some() { 0.95..=1.0 } else { 0.0..=0.68 };
    assert!(expected.contains(&share), "{share}");
}

#[rstest]
#[case::in_one_minibatch(Some(16), 1)]
#[case::in_four(Some(16), 4)]
#[case::without_memory(None, 4)]
fn only_a_recurrent_policy_of_ppo_recalls(#[case] lstm: Option<usize>, #[case] n_minibatches: usize) {
    let mut training = Training::new(lstm, 30);
    let mut algorithm = ppo(&training, n_minibatches);
    assert_recalls(lstm, training.train(&mut algorithm, 60));
}

#[rstest]
#[case::with_memory(Some(16))]
#[case::without(None)]
fn only_a_recurrent_policy_of_a2c_recalls(#[case] lstm: Option<usize>) {
    let mut training = Training::new(lstm, 8);
    let mut algorithm = a2c(&training);
    assert_recalls(lstm, training.train(&mut algorithm, 1600));
}

#[rstest]
fn ppo_begins_with_ratio_1_and_clips_nothing(#[values(1, 4)] n_minibatches: usize) {
    let mut training = Training::new(Some(16), 30);
    let mut algorithm = ppo(&training, n_minibatches);
    training.train(&mut algorithm, 20); // after this, the rollout is of a policy that uses its memory
    assert!(training.rollout.memory().iter().any(|&x| x != 0.0));
    let config = PpoConfig {
        n_steps: 30,
        n_epochs: 1,
        n_minibatches,
        learning_rate: 1e-12,
        kl_coef: 0.5,
        ..PpoConfig::default()
    };
    let mut first = Ppo::new(config.clone(), &training.policy, 1).expect("valid settings");
    let stats = first.update(&mut training.policy, &training.rollout, 1.0).expect("an update");
    assert_eq!(stats.clip_fraction, Some(0.0));
    // The log probabilities have errors of 1e-6, which change the divergence by half their square. The tolerance is for
    // the rounding of its f32 terms to 2⁻²⁴.
    assert!(stats.approx_kl.expect("PPO's").abs() < 2e-7, "{stats:?}");
    // A policy's divergence from itself is 0. The outputs of a minibatch may differ from those of the whole batch by
    // rounding.
    assert!(stats.kl_divergence.expect("a penalty").abs() < 2e-7, "{stats:?}");
    // With ratio 1, the surrogate is the negative mean of the normalised advantages. This is 0 up to the error of the
    // ratios.
    assert!(stats.policy_gradient_loss.abs() < 1e-5, "{stats:?}");
    let config = PpoConfig { n_epochs: 10, learning_rate: 1e-2, ..config };
    let mut later = Ppo::new(config, &training.policy, 1).expect("valid settings");
    let stats = later.update(&mut training.policy, &training.rollout, 1.0).expect("an update");
    assert!(stats.approx_kl > Some(1e-4), "a moved policy: {stats:?}");
    let divergence = stats.kl_divergence.expect("a penalty");
    assert!(divergence > 1e-4, "{stats:?}");
    let sum = stats.policy_gradient_loss + 0.5 * stats.value_loss + 0.5 * divergence;
    assert!((stats.loss - sum).abs() < 1e-6, "f32 rounding of numbers of order 1: {stats:?}");
}

#[test]
fn same_seed_and_resume_give_same_bytes() {
    let start = || {
        let training = Training::new(Some(16), 6);
        let algorithms: [Box<dyn Algorithm>; 2] = [Box::new(a2c(&training)), Box::new(ppo(&training, 2))];
        (training, algorithms)
    };
    for which in 0..2 {
        let run = |resume: bool| {
            let (mut training, mut algorithms) = start();
            training.train(algorithms[which].as_mut(), 3);
            if resume {
                let json = serde_json::to_string(&algorithms[which].state()).expect("JSON");
                let state: AlgorithmState = serde_json::from_str(&json).expect("a state");
                let spec = training.policy.spec().clone();
                let weights = training.policy.weights();
                training.policy = TrainablePolicy::from_weights(spec, &weights).expect("a policy");
                (_, algorithms) = start();
                algorithms[which].load_state(&state).expect("a state that fits");
            }
            training.train(algorithms[which].as_mut(), 3);
            training.policy.weights()
        };
        assert_eq!(run(false), run(false));
        assert_eq!(run(false), run(true));
    }
}

#[test]
fn wrong_recurrent_arrays_are_refused() {
    let mut training = Training::new(Some(16), 6);
    training.collect();
    let mut odd = ppo(&training, 3); // divides T·N = 96, but not N = 16
    let result = odd.update(&mut training.policy, &training.rollout, 1.0);
    assert!(matches!(&result, Err(Error::Setting(error)) if error.name == "n_minibatches"), "{result:?}");

    let mut forgetful = Training::new(None, 6);
    forgetful.collect();
    let result = a2c(&training).update(&mut training.policy, &forgetful.rollout, 1.0);
    assert!(matches!(
        result,
        Err(Error::Policy(perturb_policy::Error::Length {
            name: "the rollout's memory [N, S]",
            got: 0,
            expected: 512
        }))
    ));
    assert!(matches!(
        Sequences::new(training.policy.spec(), 2, &[0.0; 8], &[false; 5], &[]),
        Err(perturb_torch::Error::Policy(perturb_policy::Error::Length { .. }))
    ));
    let spec = PolicySpec { lstm: Some(0), ..training.policy.spec().clone() };
    assert!(matches!(
        TrainablePolicy::new(spec, 1),
        Err(Error::Policy(perturb_policy::Error::Empty { name: "the width of the LSTM" }))
    ));
}
