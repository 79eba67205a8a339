//! The gradient of a feed-forward policy.

use rayon::{ThreadPool, ThreadPoolBuilder};

use pulp::Simd;

use crate::act_ff::network;
use crate::error::{Error, Result, check_length};
use crate::kernel::{Kernel, Rows, run};
use crate::objective::{Acting, Gaussian, Losses, Objective, Outputs, Sample};
use crate::perceptron::{Derivatives, Forward, Give, Perceptron, Transposed};
use crate::spec::{ActionKind, PolicySpec};

/// Samples whose activations are kept at once: those of both networks stay in the processor's second cache.
const BLOCK: usize = 64;
/// The most parts of a minibatch, and so the most threads that work on one.
const MOST_PARTS: usize = 16;

/// B samples of a rollout.
#[derive(Clone, Copy, Debug)]
pub struct Samples<'a> {
    /// `[B, O]` normalised observations.
    pub observations: &'a [f32],
    /// `[B, A]` actions; a discrete one is its index, A = 1.
    pub actions: &'a [f32],
    /// `[B]` log-probabilities under the policy that acted.
    pub old_log_probs: &'a [f32],
    /// `[B]` its values.
    pub old_values: &'a [f32],
    /// `[B]` advantages.
    pub advantages: &'a [f32],
    /// `[B]` value targets.
    pub returns: &'a [f32],
    /// Its distributions, for their divergence.
    pub acting: Option<Acting<'a>>,
}

/// Differentiates losses of a feed-forward policy.
///
/// A minibatch is cut into parts by its size alone, and their gradients are added in order: the same bytes with any
/// number of threads.
#[derive(Debug)]
pub struct Differentiator {
    spec: PolicySpec,
    /// P.
    n_weights: usize,
    networks: Networks,
    parts: Vec<Part>,
    /// None: the calling thread does everything.
    threads: Option<ThreadPool>,
}

/// The weights.
#[derive(Debug)]
struct Networks {
    policy: Perceptron,
    value: Perceptron,
    policy_transposed: Transposed,
    value_transposed: Transposed,
    gaussian: Gaussian,
}

/// Room for a part of a minibatch: activations of a block, and sums over the part.
#[derive(Debug)]
struct Part {
    observations: Rows,
    policy_layers: Vec<Rows>,
    value_layers: Vec<Rows>,
    by_policy: Derivatives,
    by_value: Derivatives,
    by_log_std: Vec<f32>,
    losses: Losses,
}

impl Part {
    fn new(spec: &PolicySpec, networks: &Networks) -> Self {
        Part {
            observations: Rows::new(BLOCK, spec.observation_size),
            policy_layers: networks.policy.room(BLOCK),
            value_layers: networks.value.room(BLOCK),
            by_policy: Derivatives::new(&networks.policy, BLOCK),
            by_value: Derivatives::new(&networks.value, BLOCK),
            by_log_std: vec![0.0; networks.gaussian.log_std.len()],
            losses: Losses::default(),
        }
    }
}

impl Differentiator {
    /// Room for the gradient of policies of shape `spec`, computed by `threads` threads, at least 1; more than 16 are not used.
    ///
    /// # Errors
    /// [`Error::Threads`] if the system starts no more.
    pub fn new(spec: &PolicySpec, threads: usize) -> Result<Self> {
        let (policy, value) = (network(spec, spec.action.outputs()), network(spec, 1));
        let n_log_std = match spec.action {
            ActionKind::Discrete { .. } => 0,
            ActionKind::Continuous { size } => size,
        };
        let others = threads.min(MOST_PARTS) - 1;
        let pool = || ThreadPoolBuilder::new().num_threads(others).build();
        let threads = (others > 0).then(pool).transpose();
        Ok(Differentiator {
            spec: spec.clone(),
            n_weights: spec.n_weights(),
            networks: Networks {
                policy_transposed: Transposed::new(&policy),
                value_transposed: Transposed::new(&value),
                policy,
                value,
                gaussian: Gaussian::new(n_log_std),
            },
            parts: Vec::new(),
            threads: threads.map_err(|error| Error::Threads { wanted: others, reason: error.to_string() })?,
        })
    }

    /// Takes over weights `[P]`.
    ///
    /// # Errors
    /// Another length.
    pub fn load(&mut self, weights: &[f32]) -> Result<()> {
        check_length("weights [P]", weights.len(), self.n_weights)?;
        let networks = &mut self.networks;
        let mut rest = weights;
        networks.policy.load(&mut rest);
        networks.policy_transposed.load(&networks.policy, weights);
        let values = rest;
        networks.value.load(&mut rest);
        networks.value_transposed.load(&networks.value, values);
        networks.gaussian.load(rest);
        Ok(())
    }

    /// The losses of the samples at `indices`, and in `gradient` `[P]` the derivatives of their total by the weights.
    ///
    /// # Errors
    /// Lengths that do not fit, or no indices.
    ///
    /// # Panics
    /// If an index is not one of a sample, or a discrete action is not in 0 … n-1.
    pub fn gradient(
        &mut self,
        samples: &Samples<'_>,
        indices: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses> {
        self.check(samples)?;
        check_length("gradient [P]", gradient.len(), self.n_weights)?;
        if indices.is_empty() {
            return Err(Error::NoSamples);
        }
        let n_parts = indices.len().div_ceil(BLOCK).min(MOST_PARTS);
        while self.parts.len() < n_parts {
            self.parts.push(Part::new(&self.spec, &self.networks));
        }
        let (mean, scale) =
            if objective.normalize_advantages { mean_and_scale(samples.advantages, indices) } else { (0.0, 1.0) };
        let (spec, networks, n) = (&self.spec, &self.networks, indices.len());
        let size = n.div_ceil(n_parts);
        let work = |first: usize, parts: &mut [Part]| {
            for (part, indices) in parts.iter_mut().zip(indices.chunks(size).skip(first)) {
                run(Differentiation { spec, networks, samples, indices, objective, mean, scale, n, part });
            }
        };
        let parts = &mut self.parts[..n.div_ceil(size)];
        match &self.threads {
            // To wake a thread takes about as long as a part.
            Some(pool) if parts.len() > 2 => {
                let share = parts.len().div_ceil(pool.current_num_threads() + 1).max(2);
                pool.in_place_scope(|scope| {
                    let (own, others) = parts.split_at_mut(share);
                    for (i, parts) in others.chunks_mut(share).enumerate() {
                        let work = &work;
                        scope.spawn(move |_| work((i + 1) * share, parts));
                    }
                    work(0, own);
                });
            }
            _ => work(0, parts),
        }
        Ok(self.sum(n.div_ceil(size), n, objective, gradient))
    }

    /// Adds the parts up, in order.
    fn sum(&self, n_parts: usize, n: usize, objective: &Objective, gradient: &mut [f32]) -> Losses {
        let mut losses = Losses::default();
        for (i, part) in self.parts[..n_parts].iter().enumerate() {
            let (mut rest, add) = (&mut gradient[..], i > 0);
            for derivatives in [&part.by_policy, &part.by_value] {
                run(Give { derivatives, gradient: &mut rest, add });
            }
            rest.iter_mut().zip(&part.by_log_std).for_each(|(sum, x)| *sum = if add { *sum + x } else { *x });
            losses += part.losses;
        }
        losses.means(n, objective)
    }

    /// Replaces `outputs` by the logits `[B, n]` or means `[B, A]` at `observations` `[B, O]`.
    ///
    /// # Errors
    /// A length that does not fit.
    pub fn outputs(&mut self, observations: &[f32], outputs: &mut Vec<f32>) -> Result<()> {
        let size = self.spec.observation_size;
        check_length("observations [B, O]", observations.len(), observations.len() / size * size)?;
        if self.parts.is_empty() {
            self.parts.push(Part::new(&self.spec, &self.networks));
        }
        let (part, networks) = (&mut self.parts[0], &self.networks);
        outputs.clear();
        for block in observations.chunks(BLOCK * size) {
            let n = block.len() / size;
            part.observations.copy(block, size);
            let Part { observations, policy_layers, .. } = part;
            run(Forward { network: &networks.policy, inputs: observations, n, outputs: policy_layers });
            let head = &part.policy_layers[part.policy_layers.len() - 1];
            outputs.extend((0..n).flat_map(|b| &head.row(b)[..self.spec.action.outputs()]));
        }
        Ok(())
    }

    fn check(&self, samples: &Samples<'_>) -> Result<()> {
        let Samples { observations, actions, old_log_probs, old_values, advantages, returns, acting } = samples;
        let n = returns.len();
        check_length("observations [B, O]", observations.len(), n * self.spec.observation_size)?;
        check_length("actions [B, A]", actions.len(), n * self.spec.action.width())?;
        for (name, got) in
            [("old_log_probs [B]", old_log_probs), ("old_values [B]", old_values), ("advantages [B]", advantages)]
        {
            check_length(name, got.len(), n)?;
        }
        let Some(acting) = acting else { return Ok(()) };
        check_length("acting outputs [B, n]", acting.outputs.len(), n * self.spec.action.outputs())?;
        check_length("acting log_std [A]", acting.log_std.len(), self.networks.gaussian.log_std.len())
    }
}

/// Mean of the advantages at `indices`, and 1/(standard deviation + 10⁻⁸).
fn mean_and_scale(advantages: &[f32], indices: &[u32]) -> (f32, f32) {
    let picked = || indices.iter().map(|&i| f64::from(advantages[i as usize]));
    let n = indices.len() as f64;
    let mean = picked().sum::<f64>() / n;
    let variance = picked().map(|x| (x - mean) * (x - mean)).sum::<f64>() / n;
    (mean as f32, (1.0 / (variance.sqrt() + 1e-8)) as f32)
}

/// The work on one part.
struct Differentiation<'a> {
    spec: &'a PolicySpec,
    networks: &'a Networks,
    samples: &'a Samples<'a>,
    indices: &'a [u32],
    objective: &'a Objective,
    /// Of the advantages, and what the distance from it is multiplied with.
    mean: f32,
    scale: f32,
    /// Samples in the minibatch.
    n: usize,
    part: &'a mut Part,
}

impl Kernel for Differentiation<'_> {
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        self.part.by_policy.clear();
        self.part.by_value.clear();
        self.part.by_log_std.fill(0.0);
        self.part.losses = Losses::default();
        for block in self.indices.chunks(BLOCK) {
            self.block(simd, block);
        }
    }
}

impl Differentiation<'_> {
    #[inline(always)]
    fn block<S: Simd>(&mut self, simd: S, indices: &[u32]) {
        let Part { observations, policy_layers, value_layers, by_policy, by_value, by_log_std, losses } =
            &mut *self.part;
        let (size, n) = (self.spec.observation_size, indices.len());
        for (b, &i) in indices.iter().enumerate() {
            observations.row_mut(b)[..size].copy_from_slice(&self.samples.observations[i as usize * size..][..size]);
        }
        self.networks.policy.forward(simd, observations, n, policy_layers);
        self.networks.value.forward(simd, observations, n, value_layers);
        let (heads, values) = (&policy_layers[policy_layers.len() - 1], &value_layers[value_layers.len() - 1]);
        let (n_outputs, width) = (self.spec.action.outputs(), self.spec.action.width());
        for (b, &i) in indices.iter().enumerate() {
            let i = i as usize;
            let sample = Sample {
                action: &self.samples.actions[i * width..][..width],
                old_log_prob: self.samples.old_log_probs[i],
                old_value: self.samples.old_values[i],
                advantage: (self.samples.advantages[i] - self.mean) * self.scale,
                return_: self.samples.returns[i],
                acting: self
                    .samples
                    .acting
                    .map(|acting| (&acting.outputs[i * n_outputs..][..n_outputs], acting.log_std)),
            };
            let outputs = Outputs {
                head: &heads.row(b)[..n_outputs],
                gaussian: &self.networks.gaussian,
                value: values.row(b)[0],
                by_head: &mut by_policy.by_outputs().row_mut(b)[..n_outputs],
                by_log_std,
                by_value: &mut by_value.by_outputs().row_mut(b)[0],
            };
            *losses += self.objective.differentiate(self.spec.action, &sample, outputs, self.n);
        }
        by_policy.add(simd, &self.networks.policy_transposed, observations, policy_layers, n);
        by_value.add(simd, &self.networks.value_transposed, observations, value_layers, n);
    }
}
