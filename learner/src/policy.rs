//! A policy that learns.

use perturb_policy::math::exp;
use perturb_policy::random::{Purpose, stream};
use perturb_policy::{
    Acting, ActionKind, Descent, Differentiator, Losses, NamedArray, Objective, PolicySpec, Samples, Weights,
    initial_weights,
};

use crate::error::Result;
use crate::rollout::{Estimates, Rollout};
use crate::torch::{self, TensorBatch, TorchPolicy};

/// A policy of either architecture, its weights, and what differentiates losses by them: plain arithmetic for a
/// feed-forward policy, libtorch for a recurrent one.
pub struct Policy {
    spec: PolicySpec,
    /// `[P]`.
    weights: Vec<f32>,
    calculus: Calculus,
}

/// Where gradients of feed-forward policies of one shape are computed.
pub type Room = Box<Differentiator>;

enum Calculus {
    /// Whether the room has the weights as they are now.
    FeedForward(Room, bool),
    Recurrent(TorchPolicy),
}

/// What a policy learns from: a rollout, as M sequences that it must see whole. A recurrent policy needs the steps of an
/// environment in order: M = N. A feed-forward one takes every sample by itself: M = T·N, or what of them are samples.
pub struct Batch<'a>(Data<'a>);

enum Data<'a> {
    FeedForward { samples: Samples<'a>, indices: Vec<u32>, acting: Option<ActingOutputs> },
    Recurrent(Box<TensorBatch>),
}

/// The distributions of the policy that acted.
struct ActingOutputs {
    outputs: Vec<f32>,
    log_std: Vec<f32>,
}

impl Batch<'_> {
    /// The sequences, by their indices.
    pub fn sequences(&self) -> Vec<u32> {
        match &self.0 {
            Data::FeedForward { indices, .. } => indices.clone(),
            Data::Recurrent(batch) => (0..batch.sequences.count() as u32).collect(),
        }
    }
}

impl Policy {
    /// A policy with initial weights from the stream of `seed`: orthogonal with gain √2 in hidden layers, 0.01 in the
    /// policy's last layer, 1 in the value's last layer and in the LSTM; biases and log_std 0. Same seed, same bytes.
    ///
    /// # Errors
    /// A shape that is empty somewhere.
    pub fn new(spec: PolicySpec, seed: u64) -> Result<Self> {
        spec.validate()?;
        let weights = initial_weights(&spec, &mut stream(seed, Purpose::Weights));
        Policy::from_weights(spec, &weights)
    }

    /// A policy with the given weights, whose names and shapes must be those of [`PolicySpec::layout`].
    ///
    /// # Errors
    /// A shape that is empty somewhere, or other weights.
    pub fn from_weights(spec: PolicySpec, weights: &Weights) -> Result<Self> {
        spec.validate()?;
        spec.check(weights)?;
        let weights: Vec<f32> = weights.iter().flat_map(|array| array.data.iter().copied()).collect();
        let calculus = match spec.lstm {
            None => Calculus::FeedForward(Box::new(Differentiator::new(&spec, 1)?), false),
            Some(_) => Calculus::Recurrent(TorchPolicy::new(&spec, &weights)?),
        };
        Ok(Policy { spec, weights, calculus })
    }

    /// Computes gradients of feed-forward policies with `threads` threads, at least 1. Their number changes no byte.
    ///
    /// # Errors
    /// Threads that cannot be started.
    pub fn with_threads(self, threads: usize) -> Result<Self> {
        let Calculus::FeedForward(..) = self.calculus else { return Ok(self) };
        let calculus = Calculus::FeedForward(Box::new(Differentiator::new(&self.spec, threads)?), false);
        Ok(Policy { calculus, ..self })
    }

    /// A room like the one in which this policy computes gradients; `None` if it is recurrent.
    ///
    /// # Errors
    /// Those of [`Differentiator::new`].
    pub fn room(&self) -> Result<Option<Room>> {
        match self.calculus {
            Calculus::FeedForward(..) => Ok(Some(Box::new(Differentiator::new(&self.spec, 1)?))),
            Calculus::Recurrent(_) => Ok(None),
        }
    }

    /// Exchanges the room for another one. Policies of one shape that learn by turns in the same room find it in the
    /// processor's caches.
    pub fn change_room(&mut self, other: &mut Room) {
        if let Calculus::FeedForward(room, is_current) = &mut self.calculus {
            std::mem::swap(room, other);
            *is_current = false;
        }
    }

    /// The shape.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// `[P]` the weights, in the order of [`PolicySpec::layout`].
    pub fn flat_weights(&self) -> &[f32] {
        &self.weights
    }

    /// A copy of the weights.
    pub fn weights(&self) -> Weights {
        let mut rest = &self.weights[..];
        let array = |(name, shape): (String, Vec<usize>)| {
            let (data, others) = rest.split_at(shape.iter().product());
            rest = others;
            NamedArray { name, shape, data: data.to_vec() }
        };
        self.spec.layout().into_iter().map(array).collect()
    }

    /// Replaces the numbers of `weights`, which are those of a policy of this shape.
    pub fn copy_weights(&self, weights: &mut Weights) {
        let mut rest = &self.weights[..];
        for array in weights {
            let (data, others) = rest.split_at(array.data.len());
            array.data.copy_from_slice(data);
            rest = others;
        }
    }

    /// The log standard deviations of continuous actions, which come last.
    fn log_std(&self) -> &[f32] {
        match self.spec.action {
            ActionKind::Discrete { .. } => &[],
            ActionKind::Continuous { size } => &self.weights[self.weights.len() - size..],
        }
    }

    /// Mean standard deviation of the actions; None for discrete ones.
    pub fn mean_std(&self) -> Option<f64> {
        let log_std = self.log_std();
        let sum = log_std.iter().map(|&x| f64::from(exp(x))).sum::<f64>();
        (!log_std.is_empty()).then(|| sum / log_std.len() as f64)
    }

    /// All of a rollout, with what was estimated from it.
    ///
    /// # Errors
    /// What libtorch refuses.
    pub fn batch<'a>(&self, rollout: &'a Rollout, estimates: &'a Estimates) -> Result<Batch<'a>> {
        if self.spec.lstm.is_some() {
            return Ok(Batch(Data::Recurrent(Box::new(TensorBatch::new(rollout, &self.spec, estimates)?))));
        }
        let samples = Samples {
            observations: rollout.observations(),
            actions: rollout.actions(),
            old_log_probs: rollout.log_probs(),
            old_values: rollout.values(),
            advantages: &estimates.advantages,
            returns: &estimates.returns,
            acting: None,
        };
        let indices = rollout.samples().unwrap_or_else(|| (0..rollout.values().len() as u32).collect());
        Ok(Batch(Data::FeedForward { samples, indices, acting: None }))
    }

    /// Takes the policy as it is for the one that acted in `batch`, from which the KL divergence is measured.
    ///
    /// # Errors
    /// A batch of other observations.
    pub fn remember_acting(&mut self, batch: &mut Batch<'_>) -> Result<()> {
        match (&mut self.calculus, &mut batch.0) {
            (Calculus::FeedForward(networks, is_current), Data::FeedForward { samples, acting, .. }) => {
                take_over(networks, is_current, &self.weights)?;
                let mut outputs = Vec::new();
                networks.outputs(samples.observations, &mut outputs)?;
                *acting = Some(ActingOutputs { outputs, log_std: self.log_std().to_vec() });
            }
            (Calculus::Recurrent(networks), Data::Recurrent(batch)) => batch.remember_acting(networks),
            _ => unreachable!("a batch is made by a policy of its architecture"),
        }
        Ok(())
    }

    /// One gradient step down `objective` on `sequences` of `batch`. Gives the losses before it, and the gradient's global
    /// norm before clipping.
    ///
    /// # Errors
    /// A loss or a gradient that is not finite; the policy is as before then.
    pub fn descend(
        &mut self,
        batch: &Batch<'_>,
        sequences: &[u32],
        objective: &Objective,
        descent: &mut Descent,
        learning_rate: f64,
    ) -> Result<(Losses, f64)> {
        let losses = self.gradient(batch, sequences, objective, descent.gradient_mut())?;
        let norm = descent.step(losses.total, &mut self.weights, learning_rate)?;
        match &mut self.calculus {
            Calculus::FeedForward(_, is_current) => *is_current = false,
            Calculus::Recurrent(networks) => networks.load(&self.weights)?,
        }
        Ok((losses, norm))
    }

    /// The losses of `objective` over `sequences` of `batch`, and in `gradient` `[P]` the derivatives of their total.
    ///
    /// # Errors
    /// A gradient of another length, or what libtorch refuses.
    pub fn gradient(
        &mut self,
        batch: &Batch<'_>,
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses> {
        match (&mut self.calculus, &batch.0) {
            (Calculus::FeedForward(networks, is_current), Data::FeedForward { samples, acting, .. }) => {
                take_over(networks, is_current, &self.weights)?;
                let acting =
                    acting.as_ref().map(|acting| Acting { outputs: &acting.outputs, log_std: &acting.log_std });
                Ok(networks.gradient(&Samples { acting, ..*samples }, sequences, objective, gradient)?)
            }
            (Calculus::Recurrent(networks), Data::Recurrent(batch)) => {
                let whole = sequences.iter().copied().eq(0..batch.sequences.count() as u32);
                let part = if whole { None } else { Some(batch.select(sequences)?) };
                let batch = part.as_ref().unwrap_or(batch);
                let evaluated = networks.evaluate(&batch.sequences, &batch.actions);
                let (total, losses) = torch::evaluate(objective, &evaluated, &batch.targets()?)?;
                networks.gradient(&evaluated, &total, gradient)?;
                Ok(losses)
            }
            _ => unreachable!("a batch is made by a policy of its architecture"),
        }
    }
}

/// Has `room` use `weights`, if it does not.
fn take_over(room: &mut Room, is_current: &mut bool, weights: &[f32]) -> Result<()> {
    if !std::mem::replace(is_current, true) {
        room.load(weights)?;
    }
    Ok(())
}
