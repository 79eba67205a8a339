//! Tests of initial weights and of acting.

use perturb_policy::random::{Purpose, normal, stream};
use perturb_policy::{ActionKind, Actor, ActorOutput, Error, PolicySpec, Weights, initial_weights};

const DISCRETE: ActionKind = ActionKind::Discrete { n: 3 };
const CONTINUOUS: ActionKind = ActionKind::Continuous { size: 6 };

fn spec(action: ActionKind, hidden: &[usize]) -> PolicySpec {
    PolicySpec { observation_size: 17, action, hidden: hidden.to_vec(), lstm: None }
}

/// Returns weights that differ from the initial weights by about 0.1. Biases and log_std also differ.
fn moved(spec: &PolicySpec) -> Weights {
    let mut rng = stream(9, Purpose::Weights);
    let mut weights = initial_weights(spec, &mut stream(1, Purpose::Weights));
    weights.iter_mut().flat_map(|array| &mut array.data).for_each(|x| *x += 0.1 * normal(&mut rng) as f32);
    weights
}

fn observations(n_envs: usize) -> Vec<f32> {
    let mut rng = stream(4, Purpose::Weights);
    (0..n_envs * 17).map(|_| (3.0 * normal(&mut rng)) as f32).collect()
}

fn actor(spec: &PolicySpec, weights: &Weights, max_batch: usize) -> Actor {
    let mut actor = Actor::new(spec, max_batch);
    actor.load(weights).expect("weights that fit");
    actor
}

fn act(actor: &mut Actor, spec: &PolicySpec, observations: &[f32], seed: u64) -> ActorOutput {
    let mut acts = ActorOutput::new(spec.action, 0);
    actor.act(observations, &mut stream(seed, Purpose::Actions), &mut acts).expect("actions");
    acts
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_others() {
    for action in [DISCRETE, CONTINUOUS] {
        let weights = |seed| initial_weights(&spec(action, &[64, 64]), &mut stream(seed, Purpose::Weights));
        assert_eq!(weights(7), weights(7));
        assert_ne!(weights(7), weights(8));
    }
}

#[test]
fn initial_weights_are_orthogonal() {
    let weights = initial_weights(&spec(CONTINUOUS, &[64, 64]), &mut stream(3, Purpose::Weights));
    let names: Vec<_> = weights.iter().map(|array| (array.name.as_str(), array.shape.as_slice())).collect();
    assert_eq!(
        names[..3],
        [("policy.0.weight", &[64, 17][..]), ("policy.0.bias", &[64]), ("policy.1.weight", &[64, 64])]
    );
    assert_eq!(names.last(), Some(&("log_std", &[6][..])));
    for array in &weights {
        // The shorter axis has `count` orthogonal vectors of length `gain`, so all squares sum to count·gain².
        let squares: f64 = array.data.iter().map(|&x| f64::from(x).powi(2)).sum();
        let count = array.shape.iter().min().copied().unwrap_or(0) as f64;
        let expected = match array.name.as_str() {
            "policy.2.weight" => count * 1e-4,
            "value.2.weight" => count,
            name if name.ends_with("weight") => count * 2.0,
            _ => 0.0,
        };
        assert!((squares - expected).abs() <= 1e-6 * expected, "{}: {squares}; f32 rounding", array.name);
    }
}

#[test]
fn weights_of_another_shape_are_refused() {
    let weights = moved(&spec(DISCRETE, &[64, 64]));
    for other in [spec(DISCRETE, &[64, 32]), spec(CONTINUOUS, &[64, 64]), spec(DISCRETE, &[64])] {
        assert!(matches!(other.check(&weights), Err(Error::Arrays { .. })));
        assert!(matches!(Actor::new(&other, 1).load(&weights), Err(Error::Arrays { .. })));
    }
    let empty = PolicySpec { observation_size: 0, ..spec(DISCRETE, &[64]) };
    assert_eq!(empty.validate(), Err(Error::Empty { name: "observation_size" }));
}

#[test]
fn actions_do_not_depend_on_the_rest_of_the_batch() {
    for action in [DISCRETE, CONTINUOUS] {
        let spec = spec(action, &[64, 64]);
        let mut actor = actor(&spec, &moved(&spec), 7);
        let observations = observations(7);
        let together = act(&mut actor, &spec, &observations, 2);
        let mut rng = stream(2, Purpose::Actions);
        let mut alone = ActorOutput::new(action, 1);
        for (n, observation) in observations.chunks(17).enumerate() {
            actor.act(observation, &mut rng, &mut alone).expect("actions");
            let width = action.width();
            assert_eq!(alone.actions, together.actions[n * width..][..width]);
            assert_eq!(alone.log_probs, [together.log_probs[n]]);
            assert_eq!(alone.values, [together.values[n]]);
        }
        let mut values = Vec::new();
        actor.values(&observations, &mut values).expect("values");
        assert_eq!(values, together.values);
    }
}

#[test]
fn actions_follow_the_closed_form_of_the_last_layer_alone() {
    // Without hidden layers, the logits for an observation of 0 are the biases.
    let spec = spec(DISCRETE, &[]);
    let mut weights = moved(&spec);
    weights[1].data = vec![2.0f32.ln(), 0.0, 1.0f32.ln()]; // probabilities ½, ¼, ¼
    let acts = act(&mut actor(&spec, &weights, 20_000), &spec, &vec![0.0; 17 * 20_000], 3);
    let share = |choice: f32| acts.actions.iter().filter(|&&a| a == choice).count() as f64 / 20_000.0;
    // The tolerance is four standard deviations of the share of an action with probability p in 20 000 draws:
    // 4·√(p(1-p)/20 000).
    assert!(
        (share(0.0) - 0.5).abs() < 0.0142 && (share(1.0) - 0.25).abs() < 0.0123 && (share(2.0) - 0.25).abs() < 0.0123
    );
    for (action, log_prob) in acts.actions.iter().zip(&acts.log_probs) {
        let p: f32 = if *action == 0.0 { 0.5 } else { 0.25 };
        assert!((log_prob - p.ln()).abs() < 1e-6, "f32 rounding");
    }
}

#[test]
fn actions_are_encoded_as_the_protocol_says() {
    let mut bytes = vec![1, 2, 3];
    let acts = |kind, actions| ActorOutput { kind, actions, log_probs: vec![], values: vec![] };
    acts(DISCRETE, vec![2.0, 0.0]).write_bytes(&mut bytes);
    assert_eq!(bytes, [2, 0, 0, 0, 0, 0, 0, 0]);
    acts(ActionKind::Continuous { size: 2 }, vec![1.0, -2.0]).write_bytes(&mut bytes);
    assert_eq!(bytes, [0, 0, 0x80, 0x3f, 0, 0, 0, 0xc0]);
}

#[test]
fn nan_is_an_error_not_an_action() {
    for action in [DISCRETE, CONTINUOUS] {
        let spec = spec(action, &[64, 64]);
        let mut actor = actor(&spec, &moved(&spec), 2);
        let mut observations = observations(2);
        observations[20] = f32::NAN;
        let mut acts = ActorOutput::new(action, 2);
        let result = actor.act(&observations, &mut stream(1, Purpose::Actions), &mut acts);
        assert!(matches!(result, Err(Error::PolicyOutput { environment: 1 })), "{result:?}");
    }
}

#[test]
fn observations_of_wrong_length_are_refused() {
    let spec = spec(DISCRETE, &[8]);
    let mut actor = actor(&spec, &moved(&spec), 2);
    let mut values = Vec::new();
    for length in [3 * 17, 17 + 1] {
        assert!(matches!(actor.values(&vec![0.0; length], &mut values), Err(Error::Length { .. })));
    }
    actor.values(&[], &mut values).expect("nothing to do");
    assert!(values.is_empty());
}
