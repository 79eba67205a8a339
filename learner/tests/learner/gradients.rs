//! Compares feed-forward policies with libtorch: acting, gradients and updates.

use perturb_learner::policy::TrainablePolicy;
use perturb_policy::random::{Purpose, normal, stream, uniform};
use perturb_policy::{
    Acting, ActionKind, Actor, ActorOutput, Differentiator, Losses, Objective, Optimiser, PolicySpec, Samples,
    Surrogate, UpdateRule,
};
use perturb_torch::{LossTargets, Sequences, TorchPolicy, evaluate};
use rstest::rstest;
use tch::Tensor;

use super::common::moved;

const DISCRETE: ActionKind = ActionKind::Discrete { n: 3 };
const CONTINUOUS: ActionKind = ActionKind::Continuous { size: 6 };
/// Length of an observation.
const O: usize = 17;

fn spec(action: ActionKind, hidden: &[usize]) -> PolicySpec {
    PolicySpec { observation_size: O, action, hidden: hidden.to_vec(), lstm: None }
}

/// Returns `n` random numbers with this standard deviation.
fn numbers(n: usize, deviation: f64, seed: u64) -> Vec<f32> {
    let mut rng = stream(seed, Purpose::Weights);
    (0..n).map(|_| (deviation * normal(&mut rng)) as f32).collect()
}

fn torch(spec: &PolicySpec, weights: &[f32]) -> TorchPolicy {
    TorchPolicy::new(spec, weights).expect("a policy")
}

#[test]
fn weights_survive_a_round_trip() {
    let spec = spec(CONTINUOUS, &[64, 64]);
    let weights = moved(&spec).weights();
    assert_eq!(TrainablePolicy::from_weights(spec, &weights).expect("a policy").weights(), weights);
}

/// Tolerance for outputs. Acting and libtorch add in different orders, and acting's tanh has an error of up to 3e-7.
/// Over two layers of 64 units, this grows to about 1e-6 for values and logits of order 1 to 10.
const TOLERANCE: f32 = 1e-5;

#[test]
fn the_actor_agrees_with_libtorch() {
    // Some sizes of layers and batches are not multiples of the block size.
    for hidden in [vec![64, 64], vec![13], vec![], vec![9, 70, 5]] {
        for action in [DISCRETE, CONTINUOUS] {
            let spec = spec(action, &hidden);
            let weights = moved(&spec);
            let torch = torch(&spec, weights.flat_weights());
            let mut actor = Actor::new(&spec, 64);
            actor.load_flat(weights.flat_weights()).expect("weights that fit");
            for n_envs in [1, 3, 7, 64] {
                let observations = numbers(n_envs * O, 3.0, 4);
                let mut acts = ActorOutput::new(action, 0);
                actor.act(&observations, &mut stream(2, Purpose::Actions), &mut acts).expect("actions");
                let sequences =
                    Sequences::new(&spec, 1, &observations, &vec![false; n_envs], &[]).expect("shapes that fit");
                let evaluated = torch.evaluate(&sequences, &Tensor::of_slice(&acts.actions));
                let log_probs = Vec::<f32>::from(evaluated.log_probs);
                let values = Vec::<f32>::from(evaluated.values);
                for n in 0..n_envs {
                    let got = acts.log_probs[n];
                    let expected = log_probs[n];
                    assert!((got - expected).abs() < TOLERANCE, "{hidden:?} {n}: log π {got} {expected}");
                    let got = acts.values[n];
                    let expected = values[n];
                    assert!((got - expected).abs() < TOLERANCE, "{hidden:?} {n}: V {got} {expected}");
                }
            }
        }
    }
}

/// Samples from an older policy, whose weights differ a little from the weights to be updated.
struct Data {
    observations: Vec<f32>,
    actions: Vec<f32>,
    old_log_probs: Vec<f32>,
    old_values: Vec<f32>,
    advantages: Vec<f32>,
    returns: Vec<f32>,
    acting_outputs: Vec<f32>,
    acting_log_std: Vec<f32>,
}

impl Data {
    /// Returns `n` samples of a policy whose weights differ from `weights` by some hundredths.
    fn new(spec: &PolicySpec, weights: &[f32], n: usize) -> Self {
        let old: Vec<f32> = weights.iter().zip(numbers(weights.len(), 0.02, 3)).map(|(w, x)| w + x).collect();
        let observations = numbers(n * spec.observation_size, 1.0, 5);
        let mut actor = Actor::new(spec, n);
        actor.load_flat(&old).expect("weights that fit");
        let mut acts = ActorOutput::new(spec.action, n);
        actor.act(&observations, &mut stream(6, Purpose::Actions), &mut acts).expect("actions");
        let mut network = Differentiator::new(spec, 1).expect("threads");
        network.load(&old).expect("weights that fit");
        let mut acting_outputs = Vec::new();
        network.outputs(&observations, &mut acting_outputs).expect("outputs");
        let acting_log_std = match spec.action {
            ActionKind::Discrete { .. } => vec![],
            ActionKind::Continuous { size } => old[old.len() - size..].to_vec(),
        };
        let returns = acts.values.iter().zip(numbers(n, 0.5, 7)).map(|(value, x)| value + x).collect();
        Data {
            observations,
            actions: acts.actions,
            old_log_probs: acts.log_probs,
            old_values: acts.values,
            advantages: numbers(n, 2.0, 8),
            returns,
            acting_outputs,
            acting_log_std,
        }
    }

    fn samples(&self) -> Samples<'_> {
        Samples {
            observations: &self.observations,
            actions: &self.actions,
            old_log_probs: &self.old_log_probs,
            old_values: &self.old_values,
            advantages: &self.advantages,
            returns: &self.returns,
            acting: Some(Acting { outputs: &self.acting_outputs, log_std: &self.acting_log_std }),
        }
    }

    /// Computes losses and gradient of the samples at `indices` with libtorch.
    fn torch(&self, policy: &TorchPolicy, indices: &[u32], objective: &Objective) -> (Losses, Vec<f32>) {
        let spec = policy.spec();
        let pick = |data: &[f32], width: usize| -> Vec<f32> {
            indices.iter().flat_map(|&i| data[i as usize * width..][..width].to_vec()).collect()
        };
        let one = |data: &[f32]| Tensor::of_slice(&pick(data, 1));
        let sequences = Sequences::new(spec, 1, &pick(&self.observations, O), &vec![true; indices.len()], &[]);
        let evaluated = policy.evaluate(
            &sequences.expect("shapes that fit"),
            &Tensor::of_slice(&pick(&self.actions, spec.action.width())),
        );
        let n_outputs = spec.action.outputs();
        let targets = LossTargets {
            old_log_probs: one(&self.old_log_probs),
            old_values: one(&self.old_values),
            advantages: one(&self.advantages),
            returns: one(&self.returns),
            acting: Some(evaluated.distributions.with(&pick(&self.acting_outputs, n_outputs), &self.acting_log_std)),
        };
        let (total, losses) = evaluate(objective, &evaluated, &targets).expect("a loss");
        let mut gradient = vec![0.0; spec.n_weights()];
        policy.gradient(&evaluated, &total, &mut gradient).expect("a gradient");
        (losses, gradient)
    }
}

fn a2c() -> Objective {
    Objective {
        surrogate: Surrogate::PolicyGradient,
        normalize_advantages: false,
        ent_coef: 0.01,
        vf_coef: 0.5,
        value_clip_range: None,
        kl_coef: 0.0,
    }
}

fn ppo() -> Objective {
    Objective {
        surrogate: Surrogate::Clipped { range: 0.02 }, // so narrow that many samples are clipped
        normalize_advantages: true,
        value_clip_range: Some(0.05),
        kl_coef: 0.3,
        ..a2c()
    }
}

/// Asserts that each array differs by at most 1e-5 of its norm, or by the rounding of sums of order 1 that cancel out.
#[track_caller]
fn assert_arrays_close(spec: &PolicySpec, got: &[f32], expected: &[f32]) {
    let norm = |numbers: &mut dyn Iterator<Item = f64>| numbers.map(|x| x * x).sum::<f64>().sqrt();
    let mut start = 0;
    for (name, shape) in spec.layout() {
        let range = start..start + shape.iter().product::<usize>();
        start = range.end;
        let pairs = || got[range.clone()].iter().zip(&expected[range.clone()]);
        let distance = norm(&mut pairs().map(|(a, b)| f64::from(a - b)));
        let size = norm(&mut pairs().map(|(_, b)| f64::from(*b)));
        assert!(distance <= 1e-5 * size + 1e-7, "{name}: off by {distance:e} of {size:e}");
    }
    assert_eq!((got.len(), expected.len()), (start, start));
}

#[rstest]
fn gradients_agree_with_libtorch(
    #[values(DISCRETE, CONTINUOUS)] action: ActionKind,
    #[values(&[64, 64], &[13], &[], &[9, 70, 5])] hidden: &[usize],
    #[values(a2c(), ppo())] objective: Objective,
    #[values(2, 5, 80, 300)] n: usize,
) {
    let spec = spec(action, hidden);
    let policy = moved(&spec);
    let data = Data::new(&spec, policy.flat_weights(), n);
    // The indices are a part of the samples, in reverse order.
    let indices: Vec<u32> = (0..n as u32).rev().filter(|i| n < 10 || i % 7 != 0).collect();
    let mut network = Differentiator::new(&spec, 2).expect("threads");
    network.load(policy.flat_weights()).expect("weights that fit");
    let mut gradient = vec![f32::NAN; spec.n_weights()];
    let losses = network
        .gradient_at(policy.flat_weights(), &data.samples(), &indices, &objective, &mut gradient)
        .expect("a gradient");
    let (expected, reference) = data.torch(&torch(&spec, policy.flat_weights()), &indices, &objective);
    assert_arrays_close(&spec, &gradient, &reference);
    let pairs = [
        (losses.policy, expected.policy),
        (losses.value, expected.value),
        (losses.entropy, expected.entropy),
        (losses.total, expected.total),
        (losses.approx_kl, expected.approx_kl),
        (losses.clip_fraction, expected.clip_fraction),
        (losses.kl_divergence, expected.kl_divergence),
    ];
    for (i, (got, expected)) in pairs.into_iter().enumerate() {
        // libtorch's losses are f32 numbers of order 1 to 10.
        assert!((got - expected).abs() < 1e-5 * (1.0 + expected.abs()), "loss {i}: {got} {expected}");
    }
    assert!(objective == a2c() || n < 300 || losses.clip_fraction > 0.01, "some are clipped: {losses:?}");
}

#[rstest]
#[case(a2c(), UpdateRule::rms_prop(0.99, 1e-5, spec(DISCRETE, &[64, 64]).n_weights()), DISCRETE, 7e-3)]
#[case(ppo(), UpdateRule::adam(1e-5, spec(DISCRETE, &[64, 64]).n_weights()), DISCRETE, 3e-4)]
#[case(a2c(), UpdateRule::rms_prop(0.99, 1e-5, spec(CONTINUOUS, &[64, 64]).n_weights()), CONTINUOUS, 7e-3)]
#[case(ppo(), UpdateRule::adam(1e-5, spec(CONTINUOUS, &[64, 64]).n_weights()), CONTINUOUS, 3e-4)]
fn ten_updates_agree_with_libtorch(
    #[case] objective: Objective,
    #[case] optimiser: UpdateRule,
    #[case] action: ActionKind,
    #[case] learning_rate: f64,
) {
    let spec = spec(action, &[64, 64]);
    let begin = moved(&spec).flat_weights().to_vec();
    let data = Data::new(&spec, &begin, 128);
    let mut rng = stream(12, Purpose::Minibatches);
    let minibatches: Vec<Vec<u32>> =
        (0..10).map(|_| (0..64).map(|_| (128.0 * uniform(&mut rng)) as u32).collect()).collect();
    let optimiser = || Optimiser::new(optimiser.clone(), 0.5);
    let (mut own, mut own_descent, mut network) =
        (begin.clone(), optimiser(), Differentiator::new(&spec, 2).expect("threads"));
    let mut reference = begin.clone();
    let mut reference_descent = optimiser();
    let mut gradient = begin.clone();
    for indices in &minibatches {
        network.load(&own).expect("weights that fit");
        let losses =
            network.gradient_at(&own, &data.samples(), indices, &objective, &mut gradient).expect("a gradient");
        own_descent.step(losses.total, &gradient, &mut own, learning_rate).expect("a step");
        let (losses, gradient) = data.torch(&torch(&spec, &reference), indices, &objective);
        reference_descent.step(losses.total, &gradient, &mut reference, learning_rate).expect("a step");
    }
    assert_arrays_close(&spec, &own, &reference);
    let moved = own.iter().zip(&begin).filter(|(new, old)| new != old).count();
    assert!(moved > begin.len() * 9 / 10, "{moved}");
}
