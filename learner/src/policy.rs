//! A policy that learns.

use perturb_policy::math::exp;
use perturb_policy::random::{Purpose, stream};
use perturb_policy::{
    Acting, ActionKind, Descent, Differentiator, Losses, NamedArray, Objective, Player, PolicySpec, RecurrentBatch,
    RecurrentDifferentiator, Samples, SequenceSamples, Weights, initial_weights, recurrent_differentiator,
};

use crate::error::Result;
use crate::rollout::{Estimates, Rollout};

/// A policy of either architecture, its weights, and what differentiates losses by them: plain arithmetic for a
/// feed-forward policy, for a recurrent one [what is registered](perturb_policy::register_recurrent).
pub struct Policy {
    spec: PolicySpec,
    /// `[P]`.
    weights: Vec<f32>,
    /// `[P]` of the last step.
    gradient: Vec<f32>,
    calculus: Calculus,
}

/// Buffers in which gradients of feed-forward policies of one shape are computed.
pub struct GradientWorkspace {
    networks: Box<Differentiator>,
    /// `[P]`.
    gradient: Vec<f32>,
}

enum Calculus {
    /// Whether it has the weights as they are now.
    FeedForward(Box<Differentiator>, bool),
    Recurrent(Box<dyn RecurrentDifferentiator>),
}

/// What a policy learns from: a rollout, as M sequences that it must see whole. A recurrent policy needs the steps of an
/// environment in order: M = N. A feed-forward one takes every sample by itself: M = T·N, or what of them are samples.
pub struct Batch<'a>(Data<'a>);

enum Data<'a> {
    FeedForward { samples: Samples<'a>, indices: Vec<u32>, acting: Option<ActingOutputs> },
    Recurrent(Box<dyn RecurrentBatch>),
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
            Data::Recurrent(batch) => (0..batch.count() as u32).collect(),
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
    /// A shape that is empty somewhere, other weights, or a recurrent policy that nothing differentiates.
    pub fn from_weights(spec: PolicySpec, weights: &Weights) -> Result<Self> {
        spec.validate()?;
        spec.check(weights)?;
        let weights: Vec<f32> = weights.iter().flat_map(|array| array.data.iter().copied()).collect();
        let calculus = match spec.lstm {
            None => Calculus::FeedForward(Box::new(Differentiator::new(&spec, 1)?), false),
            Some(_) => Calculus::Recurrent(recurrent_differentiator(&spec)?),
        };
        Ok(Policy { spec, gradient: vec![0.0; weights.len()], weights, calculus })
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

    /// A workspace like the one in which this policy computes gradients; `None` if it is recurrent.
    ///
    /// # Errors
    /// Those of [`Differentiator::new`].
    pub fn workspace(&self) -> Result<Option<GradientWorkspace>> {
        match self.calculus {
            Calculus::FeedForward(..) => Ok(Some(GradientWorkspace {
                networks: Box::new(Differentiator::new(&self.spec, 1)?),
                gradient: vec![0.0; self.weights.len()],
            })),
            Calculus::Recurrent(_) => Ok(None),
        }
    }

    /// Swaps in another gradient workspace. Policies of one shape that share one find it in the processor's caches.
    pub fn swap_workspace(&mut self, other: &mut GradientWorkspace) {
        if let Calculus::FeedForward(networks, is_current) = &mut self.calculus {
            std::mem::swap(networks, &mut other.networks);
            std::mem::swap(&mut self.gradient, &mut other.gradient);
            *is_current = false;
        }
    }

    /// Takes the networks of a player that acted with the present weights, with their cached activations, to skip a forward
    /// pass. The player must load weights before it acts again.
    pub fn reuse_activations(&mut self, player: &mut Player) {
        if let Calculus::FeedForward(networks, is_current) = &mut self.calculus {
            *is_current = player.give_networks(networks);
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
    /// What the library refuses that differentiates recurrent policies.
    pub fn batch<'a>(&self, rollout: &'a Rollout, estimates: &'a Estimates) -> Result<Batch<'a>> {
        let samples = Samples {
            observations: rollout.observations(),
            actions: rollout.actions(),
            old_log_probs: rollout.log_probs(),
            old_values: rollout.values(),
            advantages: &estimates.advantages,
            returns: &estimates.returns,
            acting: None,
        };
        Ok(Batch(match &self.calculus {
            Calculus::FeedForward(..) => {
                let all = || (0..rollout.values().len() as u32).collect();
                Data::FeedForward { samples, indices: rollout.samples().unwrap_or_else(all), acting: None }
            }
            Calculus::Recurrent(networks) => Data::Recurrent(networks.batch(&SequenceSamples {
                samples,
                n_steps: rollout.n_steps(),
                starts: rollout.starts(),
                memory: rollout.memory(),
                lengths: rollout.lengths(),
            })?),
        }))
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
            (Calculus::Recurrent(_), Data::Recurrent(batch)) => batch.remember_acting(&self.weights)?,
            _ => unreachable!("a batch is made by a policy of its architecture"),
        }
        Ok(())
    }

    /// One gradient step down `objective` on `sequences` of `batch`. Returns the losses before it, and the gradient's global
    /// norm before clipping.
    ///
    /// # Errors
    /// A loss or a gradient that is not finite; the weights are unchanged then.
    pub fn gradient_step(
        &mut self,
        batch: &Batch<'_>,
        sequences: &[u32],
        objective: &Objective,
        descent: &mut Descent,
        learning_rate: f64,
    ) -> Result<(Losses, f64)> {
        let losses = self.calculus.gradient(&self.weights, batch, sequences, objective, &mut self.gradient)?;
        let norm = descent.step(losses.total, &self.gradient, &mut self.weights, learning_rate)?;
        if let Calculus::FeedForward(_, is_current) = &mut self.calculus {
            *is_current = false;
        }
        Ok((losses, norm))
    }

    /// The losses of `objective` over `sequences` of `batch`, and in `gradient` `[P]` the derivatives of their total.
    ///
    /// # Errors
    /// A gradient of another length, or what the library refuses that differentiates recurrent policies.
    pub fn gradient(
        &mut self,
        batch: &Batch<'_>,
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses> {
        self.calculus.gradient(&self.weights, batch, sequences, objective, gradient)
    }
}

impl Calculus {
    fn gradient(
        &mut self,
        weights: &[f32],
        batch: &Batch<'_>,
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses> {
        match (self, &batch.0) {
            (Self::FeedForward(networks, is_current), Data::FeedForward { samples, acting, .. }) => {
                take_over(networks, is_current, weights)?;
                let acting =
                    acting.as_ref().map(|acting| Acting { outputs: &acting.outputs, log_std: &acting.log_std });
                let samples = Samples { acting, ..*samples };
                Ok(networks.gradient(weights, &samples, sequences, objective, gradient)?)
            }
            (Self::Recurrent(_), Data::Recurrent(batch)) => {
                Ok(batch.gradient(weights, sequences, objective, gradient)?)
            }
            _ => unreachable!("a batch is made by a policy of its architecture"),
        }
    }
}

/// Has `networks` use `weights`, if they do not.
fn take_over(networks: &mut Differentiator, is_current: &mut bool, weights: &[f32]) -> Result<()> {
    if !std::mem::replace(is_current, true) {
        networks.load(weights)?;
    }
    Ok(())
}
