//! Tests that cached activations are used only when they are right.

use super::*;
use crate::act::ActorOutput;
use crate::objective::Surrogate;
use crate::random::{Purpose, stream};
use crate::spec::ActionKind;

const O: usize = 2;
const ACTION: ActionKind = ActionKind::Discrete { n: 2 };
const OBJECTIVE: Objective = Objective {
    surrogate: Surrogate::PolicyGradient,
    normalize_advantages: false,
    ent_coef: 0.0,
    vf_coef: 0.5,
    value_clip_range: None,
    kl_coef: 0.0,
};

/// Returns a differentiator that took over the activations that an actor cached for `observations`. Also returns the
/// weights `[P]`.
fn taken(observations: &[f32]) -> (Differentiator, Vec<f32>) {
    let spec = PolicySpec::feed_forward(O, ACTION);
    let weights: Vec<f32> = (0..spec.n_weights()).map(|i| 0.01 * (i % 7) as f32 - 0.03).collect();
    let mut actor = Actor::new(&spec, 1);
    actor.keep_activations(observations.len() / O);
    actor.load_flat(&weights).expect("weights that fit");
    let mut rng = stream(1, Purpose::Actions);
    let mut acts = ActorOutput::new(ACTION, 1);
    for observation in observations.chunks(O) {
        actor.act(observation, &mut rng, &mut acts).expect("acts");
    }
    let mut differentiator = Differentiator::new(&spec, 1).expect("threads");
    assert!(differentiator.load_from(&mut actor));
    (differentiator, weights)
}

fn gradient(differentiator: &mut Differentiator, weights: &[f32], observations: &[f32], indices: &[u32]) {
    let zeros = vec![0.0; observations.len() / O];
    let samples = Samples {
        observations,
        actions: &zeros,
        old_log_probs: &zeros,
        old_values: &zeros,
        advantages: &zeros,
        returns: &zeros,
        acting: None,
    };
    let mut gradient = vec![0.0; weights.len()];
    differentiator.gradient_at(weights, &samples, indices, &OBJECTIVE, &mut gradient).expect("a gradient");
}

const OBSERVATIONS: [f32; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 0.0];

#[test]
fn what_was_kept_serves_the_same_samples_as_often_as_they_come() {
    let (mut differentiator, weights) = taken(&OBSERVATIONS);
    // The changed number proves that the cached rows are used instead of being computed again.
    let head = differentiator.parts[0].block.activations.value_layers.len() - 1;
    for _ in 0..2 {
        differentiator.parts[0].block.activations.value_layers[head].row_mut(2)[0] = 77.0;
        gradient(&mut differentiator, &weights, &OBSERVATIONS, &[0, 1, 2]);
        assert_eq!(differentiator.computed, 3);
        assert_eq!(differentiator.parts[0].block.activations.value_layers[head].row(2)[0], 77.0);
    }
}

#[test]
fn other_samples_other_weights_and_outputs_are_computed() {
    let others = [1.0, 2.0, 3.0, 4.0, 5.0, -0.0]; // equal, but not the same bytes
    let more = [&OBSERVATIONS[..], &[6.0, 7.0]].concat();
    type Change<'a> = &'a dyn Fn(&mut Differentiator, &[f32]);
    let changes: [(&str, Change<'_>); 7] = [
        ("other observations", &|d, w| gradient(d, w, &others, &[0, 1, 2])),
        ("another order", &|d, w| gradient(d, w, &OBSERVATIONS, &[0, 2, 1])),
        ("a part", &|d, w| gradient(d, w, &OBSERVATIONS, &[0, 1])),
        ("one twice", &|d, w| gradient(d, w, &OBSERVATIONS, &[0, 1, 2, 2])),
        ("more", &|d, w| gradient(d, w, &more, &[0, 1, 2, 3])),
        ("other weights", &|d, w| d.load(w).expect("weights that fit")),
        ("outputs", &|d, _| d.outputs(&OBSERVATIONS, &mut Vec::new()).expect("outputs")),
    ];
    for (name, change) in changes {
        let (mut differentiator, weights) = taken(&OBSERVATIONS);
        assert_eq!(differentiator.computed, 3);
        change(&mut differentiator, &weights);
        assert_eq!(differentiator.computed, 0, "{name}");
    }
}
