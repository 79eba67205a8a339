//! The gradient of a feed-forward policy.

use rayon::{ThreadPool, ThreadPoolBuilder};

use pulp::Simd;

use crate::act::Actor;
use crate::act_ff::{Activations, BLOCK, Networks};
use crate::error::{Error, Result, check_length};
use crate::gradient::{ActingOutputs, GradientBackend, GradientBatch};
use crate::kernel::{Kernel, call, run};
use crate::losses::Losses;
use crate::objective::{Acting, Gaussian, Objective, Outputs, Sample};
use crate::perceptron::{Backward, Forward};
use crate::samples::{Samples, SequenceSamples};
use crate::spec::PolicySpec;

/// Maximal number of parts into which a minibatch is divided. No more threads than this can work on one minibatch.
const MAX_PARTS: usize = 16;

/// Computes the gradients of a feed-forward policy's loss.
///
/// The division of a minibatch into parts depends only on its size, and the gradients of the parts are added in order.
/// The result therefore has the same bytes with any number of threads.
#[derive(Debug)]
pub struct Differentiator {
    spec: PolicySpec,
    /// P, the number of weights.
    n_weights: usize,
    networks: Networks,
    gaussian: Gaussian,
    parts: Vec<MinibatchPart>,
    /// Whether `networks` hold the weights for which the next gradient is computed.
    is_current: bool,
    /// Number of rows of the first part whose activations were already computed by an actor.
    computed: usize,
    /// The additional threads; `None` if the calling thread does all the work.
    threads: Option<ThreadPool>,
}

/// The buffers and results for one part of a minibatch.
#[derive(Debug)]
struct MinibatchPart {
    block: SampleBlock,
    /// `[P]` gradient of the part's losses. Empty in the first part, which writes to the caller's buffer instead.
    gradient: Vec<f32>,
    losses: Losses,
}

/// The buffers for the forward and backward pass of at most [`BLOCK`] samples.
#[derive(Debug)]
struct SampleBlock {
    activations: Activations,
    through_policy: Backward,
    through_value: Backward,
}

impl SampleBlock {
    fn new(spec: &PolicySpec, networks: &Networks) -> Self {
        SampleBlock {
            activations: Activations::new(spec, networks, BLOCK),
            through_policy: Backward::new(&networks.policy, BLOCK),
            through_value: Backward::new(&networks.value, BLOCK),
        }
    }
}

impl Differentiator {
    /// Creates a differentiator for policies of shape `spec` that uses `threads` threads, at least 1 and at most 16. A
    /// larger number is reduced to 16.
    ///
    /// # Errors
    /// [`Error::Threads`] if the threads cannot be started.
    pub fn new(spec: &PolicySpec, threads: usize) -> Result<Self> {
        let others = threads.min(MAX_PARTS) - 1;
        let pool = || ThreadPoolBuilder::new().num_threads(others).build();
        let threads = (others > 0).then(pool).transpose();
        Ok(Differentiator {
            spec: spec.clone(),
            n_weights: spec.n_weights(),
            networks: Networks::new(spec),
            gaussian: Gaussian::new(spec.action.log_stds()),
            parts: Vec::new(),
            is_current: false,
            computed: 0,
            threads: threads.map_err(|error| Error::Threads { wanted: others, reason: error.to_string() })?,
        })
    }

    /// Loads weights `[P]`.
    ///
    /// # Errors
    /// [`Error::Length`] if the number of weights is wrong.
    pub fn load(&mut self, weights: &[f32]) -> Result<()> {
        check_length("weights [P]", weights.len(), self.n_weights)?;
        let mut rest = weights;
        self.networks.load(&mut rest);
        self.gaussian.load(rest);
        self.computed = 0;
        self.is_current = true;
        Ok(())
    }

    fn load_if_changed(&mut self, weights: &[f32]) -> Result<()> {
        if self.is_current { Ok(()) } else { self.load(weights) }
    }

    /// Takes over the networks of an actor that has the weights for the next gradient. This is faster than loading the
    /// weights. Also takes over the activations that [the actor has cached](Actor::keep_activations). In exchange the
    /// actor gets this differentiator's networks, and refuses to act until weights are loaded ([`Error::NoWeights`]).
    ///
    /// Returns whether the actor's policy is feed-forward and has the same shape. If not, nothing is exchanged.
    #[must_use]
    pub fn load_from(&mut self, actor: &mut Actor) -> bool {
        self.make_parts(1);
        let Some((acted, log_std)) = actor.give_networks(&self.spec) else { return false };
        self.computed = acted.swap_networks(&mut self.networks, &mut self.parts[0].block.activations);
        self.gaussian.load(log_std);
        true
    }

    /// Creates missing parts until there are at least `n`.
    fn make_parts(&mut self, n: usize) {
        while self.parts.len() < n {
            let length = if self.parts.is_empty() { 0 } else { self.n_weights };
            let block = SampleBlock::new(&self.spec, &self.networks);
            self.parts.push(MinibatchPart { block, gradient: vec![0.0; length], losses: Losses::default() });
        }
    }

    /// Returns whether the cached activations in the first part belong to exactly the samples at `indices`.
    fn has_computed(&self, samples: &Samples<'_>, indices: &[u32]) -> bool {
        let size = self.spec.observation_size;
        let are_all = indices.len() == self.computed && indices.iter().enumerate().all(|(b, &i)| i as usize == b);
        are_all
            && samples.observations.chunks_exact(size).take(self.computed).enumerate().all(|(b, observation)| {
                let computed = &self.parts[0].block.activations.observations.row(b)[..size];
                computed.iter().zip(observation).all(|(a, b)| a.to_bits() == b.to_bits())
            })
    }

    /// Writes the gradient of the total loss over the samples at `indices`, with respect to `weights` `[P]`, to
    /// `gradient` `[P]`. The same `weights` must have been loaded before. Returns the losses.
    ///
    /// # Errors
    /// [`Error::Length`] if an array has the wrong length, [`Error::NoSamples`] if `indices` is empty.
    ///
    /// # Panics
    /// If an index is out of range, or a discrete action is not in 0 … n-1.
    pub fn gradient_at(
        &mut self,
        weights: &[f32],
        samples: &Samples<'_>,
        indices: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses> {
        samples.check(&self.spec)?;
        check_length("weights [P]", weights.len(), self.n_weights)?;
        check_length("gradient [P]", gradient.len(), self.n_weights)?;
        if indices.is_empty() {
            return Err(Error::NoSamples);
        }
        // The division into parts depends only on the size of the minibatch.
        let n_parts = indices.len().div_ceil(BLOCK).min(MAX_PARTS);
        self.make_parts(n_parts);
        let is_computed = self.has_computed(samples, indices);
        if !is_computed {
            self.computed = 0; // the rows are overwritten below
        }
        let (mean, scale) = if objective.normalize_advantages { samples.mean_and_scale(indices) } else { (0.0, 1.0) };
        let Self { spec, networks, gaussian, parts, threads, .. } = self;
        let spec = &*spec;
        let networks = &*networks;
        let gaussian = &*gaussian;
        let n = indices.len();
        let size = n.div_ceil(n_parts);
        // Computes the gradient of the part with index `part_index`. The first part writes to the caller's gradient,
        // all others to their own buffers.
        let work = |part_index: usize, part: &mut MinibatchPart, gradient: Option<&mut [f32]>| {
            let MinibatchPart { block, gradient: own, losses } = part;
            let sums = gradient.unwrap_or(own);
            let first = part_index * size;
            let indices = &indices[first..n.min(first + size)];
            let context =
                MinibatchContext { spec, networks, gaussian, weights, samples, is_computed, objective, mean, scale, n };
            run(Differentiation { context, indices, block, sums, losses });
        };
        let parts = &mut parts[..n.div_ceil(size)];
        match threads {
            // Each thread gets at least two parts: waking a thread takes about as long as computing one part.
            Some(pool) if parts.len() > 2 => {
                let share = parts.len().div_ceil(pool.current_num_threads() + 1).max(2);
                pool.in_place_scope(|scope| {
                    let (own, others) = parts.split_at_mut(share);
                    for (i, parts) in others.chunks_mut(share).enumerate() {
                        let work = &work;
                        scope.spawn(move |_| {
                            parts.iter_mut().enumerate().for_each(|(k, part)| work((i + 1) * share + k, part, None));
                        });
                    }
                    let mut gradient = Some(&mut *gradient);
                    own.iter_mut().enumerate().for_each(|(k, part)| work(k, part, gradient.take()));
                });
            }
            _ => {
                let mut gradient = Some(&mut *gradient);
                parts.iter_mut().enumerate().for_each(|(k, part)| work(k, part, gradient.take()));
            }
        }
        // Adds the parts in order, so that the sum does not depend on which thread finished first.
        let mut losses = Losses::default();
        for (part_index, part) in parts.iter().enumerate() {
            losses += part.losses;
            if part_index > 0 {
                run(Add { sums: gradient, more: &part.gradient });
            }
        }
        Ok(objective.means(losses, n))
    }

    /// Computes the policy network at `observations` `[B, O]`, and replaces `outputs` by the logits `[B, n]` or means
    /// `[B, A]`.
    ///
    /// # Errors
    /// [`Error::Length`] if `observations` is not a multiple of O long.
    pub fn outputs(&mut self, observations: &[f32], outputs: &mut Vec<f32>) -> Result<()> {
        let size = self.spec.observation_size;
        check_length("observations [B, O]", observations.len(), observations.len() / size * size)?;
        self.make_parts(1);
        self.computed = 0;
        let activations = &mut self.parts[0].block.activations;
        let networks = &self.networks;
        let Activations { observations: rows, policy_layers, .. } = activations;
        outputs.clear();
        for block in observations.chunks(BLOCK * size) {
            let n = block.len() / size;
            rows.copy(0, block, size);
            run(Forward { network: &networks.policy, inputs: rows, rows: 0..n, outputs: policy_layers });
            let head = &policy_layers[policy_layers.len() - 1];
            outputs.extend((0..n).flat_map(|b| &head.row(b)[..self.spec.action.outputs()]));
        }
        Ok(())
    }
}

impl GradientBackend for Differentiator {
    fn batch<'a>(&self, sequences: &SequenceSamples<'a>) -> Result<GradientBatch<'a>> {
        Ok(GradientBatch::FeedForward { samples: sequences.samples, indices: sequences.indices(), acting: None })
    }

    fn remember_acting(&mut self, weights: &[f32], batch: &mut GradientBatch<'_>) -> Result<()> {
        let GradientBatch::FeedForward { samples, acting, .. } = batch else {
            unreachable!("a recurrent policy's batch")
        };
        self.load_if_changed(weights)?;
        let mut outputs = Vec::new();
        self.outputs(samples.observations, &mut outputs)?;
        *acting = Some(ActingOutputs { outputs, log_std: self.gaussian.log_std.clone() });
        Ok(())
    }

    fn gradient(
        &mut self,
        weights: &[f32],
        batch: &GradientBatch<'_>,
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses> {
        let GradientBatch::FeedForward { samples, acting, .. } = batch else {
            unreachable!("a recurrent policy's batch")
        };
        self.load_if_changed(weights)?;
        let acting = acting.as_ref().map(|it| Acting { outputs: &it.outputs, log_std: &it.log_std });
        self.gradient_at(weights, &Samples { acting, ..*samples }, sequences, objective, gradient)
    }

    fn weights_changed(&mut self) {
        self.is_current = false;
    }

    fn reuse_activations(&mut self, actor: &mut Actor) {
        self.is_current = self.load_from(actor);
    }
}

/// The arguments of the vectorised addition of `more` to `sums`, element by element.
struct Add<'a> {
    sums: &'a mut [f32],
    more: &'a [f32],
}

impl Kernel for Add<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        self.sums.iter_mut().zip(self.more).for_each(|(sum, x)| *sum += x);
    }
}

/// The inputs that are the same for all parts of a minibatch.
struct MinibatchContext<'a> {
    spec: &'a PolicySpec,
    networks: &'a Networks,
    gaussian: &'a Gaussian,
    weights: &'a [f32],
    samples: &'a Samples<'a>,
    /// Whether the activations of the samples are already in the first part's buffers.
    is_computed: bool,
    objective: &'a Objective,
    /// Mean of the advantages; 0 if they are not normalised.
    mean: f32,
    /// Factor by which an advantage's distance from the mean is multiplied; 1 if advantages are not normalised.
    scale: f32,
    /// Number of samples in the minibatch.
    n: usize,
}

/// The arguments of the vectorised gradient of one part.
struct Differentiation<'a> {
    context: MinibatchContext<'a>,
    indices: &'a [u32],
    block: &'a mut SampleBlock,
    /// `[P]` the gradient, which is overwritten.
    sums: &'a mut [f32],
    losses: &'a mut Losses,
}

impl Kernel for Differentiation<'_> {
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        *self.losses = Losses::default();
        for (i, block) in self.indices.chunks(BLOCK).enumerate() {
            if i == 0 { self.block::<S, false>(simd, block) } else { self.block::<S, true>(simd, block) }
        }
    }
}

impl Differentiation<'_> {
    /// Computes the forward pass, the losses and the backward pass of the samples at `indices`, at most [`BLOCK`]. With
    /// `ADD` the derivatives are added to `sums`, otherwise they replace `sums`.
    #[inline(always)]
    fn block<S: Simd, const ADD: bool>(&mut self, simd: S, indices: &[u32]) {
        let SampleBlock { activations, through_policy, through_value } = &mut *self.block;
        let Activations { observations, policy_layers, value_layers } = activations;
        let MinibatchContext { spec, networks, gaussian, weights, samples, is_computed, objective, mean, scale, n: of } =
            &self.context;
        let size = spec.observation_size;
        let n = indices.len();
        // Forward pass, unless an actor has cached its results.
        if !is_computed {
            for (b, &i) in indices.iter().enumerate() {
                observations.row_mut(b)[..size].copy_from_slice(&samples.observations[i as usize * size..][..size]);
            }
            let inputs = &*observations;
            let rows = 0..n;
            call(simd, Forward { network: &networks.policy, inputs, rows: rows.clone(), outputs: policy_layers });
            call(simd, Forward { network: &networks.value, inputs, rows, outputs: value_layers });
        }
        // The losses, and their derivatives with respect to the networks' outputs.
        let heads = &policy_layers[policy_layers.len() - 1];
        let values = &value_layers[value_layers.len() - 1];
        let n_outputs = spec.action.outputs();
        let width = spec.action.width();
        let (policy_sums, rest) = self.sums.split_at_mut(through_policy.n_weights());
        let (value_sums, by_log_std) = rest.split_at_mut(through_value.n_weights());
        if !ADD {
            by_log_std.fill(0.0);
        }
        for (b, &i) in indices.iter().enumerate() {
            let i = i as usize;
            let sample = Sample {
                action: &samples.actions[i * width..][..width],
                old_log_prob: samples.old_log_probs[i],
                old_value: samples.old_values[i],
                advantage: (samples.advantages[i] - mean) * scale,
                return_: samples.returns[i],
                acting: samples.acting.map(|acting| (&acting.outputs[i * n_outputs..][..n_outputs], acting.log_std)),
            };
            let outputs = Outputs {
                head: &heads.row(b)[..n_outputs],
                gaussian,
                value: values.row(b)[0],
                by_head: &mut through_policy.by_outputs().row_mut(b)[..n_outputs],
                by_log_std,
                by_value: &mut through_value.by_outputs().row_mut(b)[0],
            };
            *self.losses += objective.differentiate(spec.action, &sample, outputs, *of);
        }
        // Backward pass.
        let (policy_weights, rest) = weights.split_at(policy_sums.len());
        let value_weights = &rest[..value_sums.len()];
        through_policy.sum::<S, ADD>(simd, policy_weights, policy_sums, observations, policy_layers, n);
        through_value.sum::<S, ADD>(simd, value_weights, value_sums, observations, value_layers, n);
    }
}

#[cfg(test)]
mod tests;
