//! Tests of properties that the gradients of every backend must have.

use std::f64::consts::TAU;

use perturb_policy::random::{Purpose, normal, stream};
use perturb_policy::{
    Acting, ActionKind, Actor, ActorOutput, Differentiator, Error, Objective, PolicySpec, Samples, Surrogate,
    initial_weights,
};
use rstest::rstest;

const O: usize = 5;

fn numbers(n: usize, seed: u64) -> Vec<f32> {
    let mut rng = stream(seed, Purpose::Weights);
    (0..n).map(|_| normal(&mut rng) as f32).collect()
}

const OBJECTIVE: Objective = Objective {
    surrogate: Surrogate::Clipped { range: 0.2 },
    normalize_advantages: true,
    ent_coef: 0.01,
    vf_coef: 0.5,
    value_clip_range: Some(0.2),
    kl_coef: 0.0,
};

/// Computes the gradient over `n` samples with `threads` threads.
fn gradient(action: ActionKind, n: usize, threads: usize) -> Vec<f32> {
    let spec = PolicySpec::feed_forward(O, action);
    let weights = initial_weights(&spec, &mut stream(1, Purpose::Weights));
    let weights: Vec<f32> = weights.iter().flat_map(|array| array.data.clone()).collect();
    let actions = numbers(n * action.width(), 2);
    let actions: Vec<f32> = match action {
        ActionKind::Discrete { .. } => actions.iter().map(|x| f32::from(u8::from(*x > 0.0))).collect(),
        ActionKind::Continuous { .. } => actions,
    };
    let samples = Samples {
        observations: &numbers(n * O, 3),
        actions: &actions,
        old_log_probs: &numbers(n, 4),
        old_values: &numbers(n, 5),
        advantages: &numbers(n, 6),
        returns: &numbers(n, 7),
        acting: None,
    };
    let mut network = Differentiator::new(&spec, threads).expect("threads");
    network.load(&weights).expect("weights that fit");
    let mut gradient = vec![f32::NAN; spec.n_weights()];
    let indices: Vec<u32> = (0..n as u32).collect();
    network.gradient_at(&weights, &samples, &indices, &OBJECTIVE, &mut gradient).expect("a gradient");
    gradient
}

#[rstest]
fn the_number_of_threads_changes_no_byte(
    #[values(ActionKind::Discrete { n: 2 }, ActionKind::Continuous { size: 3 })] action: ActionKind,
    #[values(1, 64, 65, 200, 3000)] n: usize,
) {
    let one = gradient(action, n, 1);
    assert!(one.iter().any(|&g| g != 0.0));
    for threads in [2, 3, 16, 40] {
        let bits = |gradient: &[f32]| gradient.iter().map(|g| g.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&one), bits(&gradient(action, n, threads)), "{threads} threads");
    }
}

/// Acts in N environments for T steps. The cases have fewer observations than the cache can hold, exactly as many, and
/// more. Values of other observations are computed between the steps.
#[rstest]
fn cached_activations_give_the_same_gradient(
    #[values(ActionKind::Discrete { n: 2 }, ActionKind::Continuous { size: 3 })] action: ActionKind,
    #[values((1, 5), (3, 4), (1, 63), (8, 7), (1, 64), (8, 8), (70, 1))] (n_envs, n_steps): (usize, usize),
) {
    let spec = PolicySpec::feed_forward(O, action);
    let n = n_envs * n_steps;
    let mut actor = Actor::new(&spec, n_envs);
    actor.keep_activations(n_steps);
    let mut network = Differentiator::new(&spec, 1).expect("threads");
    for round in 0..3 {
        let weights: Vec<f32> = numbers(spec.n_weights(), 10 + round).iter().map(|x| 0.1 * x).collect();
        let observations = numbers(n * O, 20 + round);
        let others = numbers(n_envs * O, 30 + round);
        let samples = Samples {
            observations: &observations,
            actions: &vec![1.0; n * action.width()],
            old_log_probs: &numbers(n, 4),
            old_values: &numbers(n, 5),
            advantages: &numbers(n, 6),
            returns: &numbers(n, 7),
            acting: None,
        };
        let expect_same = |network: &mut Differentiator, weights: &[f32], indices: &[u32]| {
            let gradient = |network: &mut Differentiator| {
                let mut gradient = vec![f32::NAN; spec.n_weights()];
                network.gradient_at(weights, &samples, indices, &OBJECTIVE, &mut gradient).expect("a gradient");
                gradient.iter().map(|g| g.to_bits()).collect::<Vec<_>>()
            };
            let mut fresh = Differentiator::new(&spec, 1).expect("threads");
            fresh.load(weights).expect("weights that fit");
            assert_eq!(gradient(network), gradient(&mut fresh), "round {round}, {} samples", indices.len());
        };
        let mut acts = ActorOutput::new(action, n_envs);
        let mut values = Vec::new();
        actor.load_flat(&weights).expect("weights that fit");
        for observations in observations.chunks(n_envs * O) {
            actor.act(observations, &mut stream(1, Purpose::Actions), &mut acts).expect("acts");
            actor.values(&others, &mut values).expect("values");
            actor.values_in(&others[..O], &[0], &mut values).expect("a value");
        }
        assert!(network.load_from(&mut actor));
        let all: Vec<u32> = (0..n as u32).collect();
        expect_same(&mut network, &weights, &all);
        expect_same(&mut network, &weights, &all);
        expect_same(&mut network, &weights, &all[1..]);
        expect_same(&mut network, &weights, &all.iter().rev().copied().collect::<Vec<_>>());
        expect_same(&mut network, &weights, &all);
        assert!(!network.load_from(&mut Actor::new(&PolicySpec::feed_forward(O + 1, action), 1)), "of another shape");
        expect_same(&mut network, &weights, &all);
    }
}

#[rstest]
fn networks_of_an_actor_give_the_same_gradient(
    #[values(ActionKind::Discrete { n: 2 }, ActionKind::Continuous { size: 3 })] action: ActionKind,
) {
    let spec = PolicySpec::feed_forward(O, action);
    let weights: Vec<f32> = numbers(spec.n_weights(), 1).iter().map(|x| 0.1 * x).collect();
    let samples = Samples {
        observations: &numbers(O, 3),
        actions: &vec![1.0; action.width()],
        old_log_probs: &[-1.0],
        old_values: &[0.5],
        advantages: &[2.0],
        returns: &[1.0],
        acting: None,
    };
    let objective = Objective { normalize_advantages: false, ..OBJECTIVE };
    let gradient = |network: &mut Differentiator| {
        let mut gradient = vec![f32::NAN; spec.n_weights()];
        network.gradient_at(&weights, &samples, &[0], &objective, &mut gradient).expect("a gradient");
        gradient
    };
    let mut loaded = Differentiator::new(&spec, 1).expect("threads");
    loaded.load(&weights).expect("weights that fit");
    let mut actor = Actor::new(&spec, 1);
    actor.load_flat(&weights).expect("weights that fit");
    let mut taken = Differentiator::new(&spec, 1).expect("threads");
    assert!(taken.load_from(&mut actor));
    let expected = gradient(&mut loaded);
    assert!(expected.iter().filter(|&&g| g != 0.0).count() > expected.len() / 2);
    assert_eq!(gradient(&mut taken), expected);

    // The actor now has the differentiator's networks, and refuses to act.
    let mut acts = ActorOutput::new(action, 1);
    let refused = actor.act(&numbers(O, 3), &mut stream(1, Purpose::Actions), &mut acts);
    assert_eq!(refused, Err(Error::NoWeights));
    assert_eq!(actor.values(&numbers(O, 3), &mut Vec::new()), Err(Error::NoWeights));
    assert_eq!(actor.values_in(&numbers(O, 3), &[0], &mut Vec::new()), Err(Error::NoWeights));

    // With new weights it acts like a new actor, and its networks can be taken over again.
    let others: Vec<f32> = numbers(spec.n_weights(), 7).iter().map(|x| 0.2 * x).collect();
    let acts = |actor: &mut Actor| {
        let mut acts = ActorOutput::new(action, 1);
        actor.load_flat(&others).expect("weights that fit");
        actor.act(&numbers(O, 3), &mut stream(1, Purpose::Actions), &mut acts).expect("acts");
        acts
    };
    assert_eq!(acts(&mut actor), acts(&mut Actor::new(&spec, 1)));
    assert!(taken.load_from(&mut actor));
    loaded.load(&others).expect("weights that fit");
    let gradient = |network: &mut Differentiator| {
        let mut gradient = vec![f32::NAN; spec.n_weights()];
        network.gradient_at(&others, &samples, &[0], &objective, &mut gradient).expect("a gradient");
        gradient
    };
    assert_eq!(gradient(&mut taken), gradient(&mut loaded));
    assert_ne!(gradient(&mut taken), expected);
}

#[test]
fn only_networks_of_the_same_shape_are_taken_over() {
    let spec = PolicySpec::feed_forward(O, ActionKind::Discrete { n: 2 });
    let mut differentiator = Differentiator::new(&spec, 1).expect("threads");
    for other in [
        PolicySpec::feed_forward(O + 1, ActionKind::Discrete { n: 2 }),
        PolicySpec::feed_forward(O, ActionKind::Continuous { size: 2 }),
        PolicySpec::recurrent(O, ActionKind::Discrete { n: 2 }),
    ] {
        let mut actor = Actor::new(&other, 1);
        assert!(!differentiator.load_from(&mut actor), "{other:?}");
        actor
            .act(
                &numbers(other.observation_size, 3),
                &mut stream(1, Purpose::Actions),
                &mut ActorOutput::new(other.action, 1),
            )
            .expect("it has its networks");
    }
}

/// Computes a perceptron in f64, with weights from the front of `weights`.
fn perceptron(spec: &PolicySpec, weights: &mut &[f64], x: &[f32], outputs: usize) -> Vec<f64> {
    let mut layers = spec.hidden_layers();
    layers.push((spec.hidden_size(), outputs));
    let depth = layers.len();
    let mut x: Vec<f64> = x.iter().map(|&x| f64::from(x)).collect();
    for (i, (inputs, outputs)) in layers.into_iter().enumerate() {
        let (matrix, rest) = weights.split_at(inputs * outputs);
        let (biases, rest) = rest.split_at(outputs);
        *weights = rest;
        let sums =
            matrix.chunks(inputs).zip(biases).map(|(row, b)| b + row.iter().zip(&x).map(|(w, x)| w * x).sum::<f64>());
        x = sums.map(|sum| if i + 1 < depth { sum.tanh() } else { sum }).collect();
    }
    x
}

fn log_softmax(logits: &[f64]) -> Vec<f64> {
    let total = logits.iter().map(|l| l.exp()).sum::<f64>().ln();
    logits.iter().map(|l| l - total).collect()
}

/// Returns the log-probability, the entropy and the KL divergence from the acting policy, by textbook formulas.
fn distribution(
    action: ActionKind,
    head: &[f64],
    log_std: &[f64],
    taken: &[f32],
    acting: (&[f32], &[f32]),
) -> [f64; 3] {
    let old: Vec<f64> = acting.0.iter().map(|&x| f64::from(x)).collect();
    match action {
        ActionKind::Discrete { .. } => {
            let new = log_softmax(head);
            let old = log_softmax(&old);
            let entropy = -new.iter().map(|l| l.exp() * l).sum::<f64>();
            let divergence = old.iter().zip(&new).map(|(p, q)| p.exp() * (p - q)).sum();
            [new[taken[0] as usize], entropy, divergence]
        }
        ActionKind::Continuous { size } => {
            let mut sums = [0.0; 3];
            for i in 0..size {
                let std = log_std[i].exp();
                let old_std = f64::from(acting.1[i]).exp();
                let distance = (f64::from(taken[i]) - head[i]) / std;
                sums[0] -= 0.5 * distance * distance + log_std[i] + 0.5 * TAU.ln();
                sums[1] += 0.5 * (1.0 + TAU.ln()) + log_std[i];
                let spread = old_std.powi(2) + (old[i] - head[i]).powi(2);
                sums[2] += (std / old_std).ln() + spread / (2.0 * std * std) - 0.5;
            }
            sums
        }
    }
}

/// Computes the total loss of `objective` over all `samples`, in f64.
fn total(spec: &PolicySpec, weights: &[f64], samples: &Samples<'_>, objective: &Objective) -> f64 {
    let n = samples.returns.len();
    let advantages: Vec<f64> = samples.advantages.iter().map(|&x| f64::from(x)).collect();
    let mean = advantages.iter().sum::<f64>() / n as f64;
    let deviation = (advantages.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n as f64).sqrt();
    let acting = samples.acting.expect("acting distributions");
    let width = spec.action.width();
    let sample = |b: usize| {
        let mut rest = weights;
        let observation = &samples.observations[b * O..][..O];
        let head = perceptron(spec, &mut rest, observation, spec.action.outputs());
        let value = perceptron(spec, &mut rest, observation, 1)[0];
        let old = &acting.outputs[b * head.len()..][..head.len()];
        let taken = &samples.actions[b * width..][..width];
        let [log_prob, entropy, divergence] = distribution(spec.action, &head, rest, taken, (old, acting.log_std));
        let advantage =
            if objective.normalize_advantages { (advantages[b] - mean) / (deviation + 1e-8) } else { advantages[b] };
        let policy = match objective.surrogate {
            Surrogate::PolicyGradient => -advantage * log_prob,
            Surrogate::Clipped { range } => {
                let ratio = (log_prob - f64::from(samples.old_log_probs[b])).exp();
                (-advantage * ratio).max(-advantage * ratio.clamp(1.0 - range, 1.0 + range))
            }
        };
        let target = f64::from(samples.returns[b]);
        let old = f64::from(samples.old_values[b]);
        let clipped = objective.value_clip_range.map_or(value, |range| old + (value - old).clamp(-range, range));
        let value_loss = (value - target).powi(2).max((clipped - target).powi(2));
        policy - objective.ent_coef * entropy + objective.vf_coef * value_loss + objective.kl_coef * divergence
    };
    (0..n).map(sample).sum::<f64>() / n as f64
}

#[rstest]
fn gradients_are_finite_differences(
    // With 19 choices, the policy has more outputs than one lane of the kernel, which is 16 numbers.
    #[values(ActionKind::Discrete { n: 3 }, ActionKind::Discrete { n: 19 }, ActionKind::Continuous { size: 2 })]
    action: ActionKind,
    #[values(&[], &[7], &[5, 18])] hidden: &[usize],
    #[values(Objective { kl_coef: 0.7, ..OBJECTIVE }, Objective { surrogate: Surrogate::PolicyGradient,
        normalize_advantages: false, value_clip_range: None, ..OBJECTIVE })]
    objective: Objective,
    #[values(1, 70)] n: usize,
) {
    let spec = PolicySpec { observation_size: O, action, hidden: hidden.to_vec(), lstm: None };
    let weights: Vec<f32> = numbers(spec.n_weights(), 1).iter().map(|x| 0.5 * x).collect();
    let actions: Vec<f32> = match action {
        ActionKind::Discrete { n: choices } => (0..n).map(|b| (b % choices) as f32).collect(),
        ActionKind::Continuous { size } => numbers(n * size, 2),
    };
    let near = |numbers: Vec<f32>| numbers.iter().map(|x| 0.3 * x).collect::<Vec<f32>>();
    let (outputs, log_std) = (numbers(n * action.outputs(), 8), near(numbers(action.outputs(), 9)));
    let log_std = if matches!(action, ActionKind::Discrete { .. }) { &[][..] } else { &log_std };
    let samples = Samples {
        observations: &numbers(n * O, 3),
        actions: &actions,
        old_log_probs: &numbers(n, 4).iter().map(|x| x - 1.5).collect::<Vec<f32>>(),
        old_values: &numbers(n, 5),
        advantages: &numbers(n, 6),
        returns: &numbers(n, 7),
        acting: Some(Acting { outputs: &outputs, log_std }),
    };
    let mut network = Differentiator::new(&spec, 1).expect("threads");
    network.load(&weights).expect("weights that fit");
    let mut gradient = vec![f32::NAN; weights.len()];
    let indices: Vec<u32> = (0..n as u32).rev().collect();
    let losses = network.gradient_at(&weights, &samples, &indices, &objective, &mut gradient).expect("a gradient");
    let exact: Vec<f64> = weights.iter().map(|&w| f64::from(w)).collect();
    let expected = total(&spec, &exact, &samples, &objective);
    assert!((losses.total - expected).abs() < 1e-5 * expected.abs().max(1.0), "{} {expected}", losses.total);
    let mut distance = 0.0;
    let mut size = 0.0;
    for (k, &got) in gradient.iter().enumerate() {
        let at = |step: f64| {
            let mut weights = exact.clone();
            weights[k] += step;
            total(&spec, &weights, &samples, &objective)
        };
        let slope = (at(1e-6) - at(-1e-6)) / 2e-6;
        distance += (slope - f64::from(got)).powi(2);
        size += slope * slope;
    }
    // The tolerance covers the rounding of f32 sums. The difference would be larger if the derivative of the loss
    // jumped within 1e-6 of a weight.
    assert!(distance.sqrt() < 1e-5 * size.sqrt(), "off by {:e} of {:e}", distance.sqrt(), size.sqrt());
}

#[test]
fn lengths_that_do_not_fit_are_refused() {
    let spec = PolicySpec::feed_forward(O, ActionKind::Discrete { n: 2 });
    let mut network = Differentiator::new(&spec, 1).expect("threads");
    assert!(matches!(network.load(&[0.0; 3]), Err(Error::Length { name: "weights [P]", got: 3, .. })));
    let samples = Samples {
        observations: &[0.0; 2 * O],
        actions: &[0.0; 2],
        old_log_probs: &[0.0; 2],
        old_values: &[0.0; 2],
        advantages: &[0.0; 2],
        returns: &[0.0; 2],
        acting: None,
    };
    let weights = vec![0.0; spec.n_weights()];
    let mut gradient = weights.clone();
    let wrong = [
        Samples { observations: &[0.0; O], ..samples },
        Samples { actions: &[0.0; 3], ..samples },
        Samples { old_log_probs: &[0.0; 1], ..samples },
        Samples { old_values: &[0.0; 1], ..samples },
        Samples { advantages: &[0.0; 1], ..samples },
    ];
    for samples in wrong {
        let result = network.gradient_at(&weights, &samples, &[0], &OBJECTIVE, &mut gradient);
        assert!(matches!(result, Err(Error::Length { .. })), "{result:?}");
    }
    assert_eq!(network.gradient_at(&weights, &samples, &[], &OBJECTIVE, &mut gradient), Err(Error::NoSamples));
    let result = network.gradient_at(&weights, &samples, &[0], &OBJECTIVE, &mut [0.0; 3]);
    assert!(matches!(result, Err(Error::Length { name: "gradient [P]", got: 3, .. })), "{result:?}");
}
