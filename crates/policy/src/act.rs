//! Acting: a policy's forward pass in plain f32 loops.
//!
//! libtorch needs about 30 µs for one observation, most of it overhead. These loops need a few µs. An [`Actor`] returns
//! the same bytes for an observation regardless of the rest of the batch, because each output is summed in a fixed
//! order.

use rand_chacha::ChaCha8Rng;

use crate::act_ff::{BLOCK, FeedForward};
use crate::act_rc::Recurrent;
use crate::error::{Error, Result, check_length};
use crate::kernel::RowsFrom;
use crate::sample::{sample_categorical, sample_gaussian, sample_uniform};
use crate::spec::{ActionKind, PolicySpec};
use crate::weights::Weights;

/// Computes a policy's actions, log-probabilities and values for batches of at most `max_batch` observations. After its
/// creation it allocates no memory, except to grow the caller's output buffers.
///
/// The actor of a recurrent policy has a memory for every environment. [`Actor::act`] updates this memory, and
/// [`Actor::values`] reads it. Call [`Actor::forget`] to clear it at the end of an episode (with RL², at the end of a
/// trial).
#[derive(Clone, Debug)]
pub struct Actor {
    spec: PolicySpec,
    max_batch: usize,
    network: Network,
    log_std: Vec<f32>,
    /// Whether continuous actions are sampled uniformly from a box instead of from a Gaussian.
    uniform: bool,
    /// Whether the networks were exchanged with those of a differentiator. The actor then refuses to act until weights
    /// are loaded.
    is_stale: bool,
}

/// The networks of a feed-forward or of a recurrent policy.
#[derive(Clone, Debug)]
enum Network {
    FeedForward(FeedForward),
    Recurrent(Box<Recurrent>),
}

/// Actions, log-probabilities and values for N environments.
#[derive(Clone, Debug, PartialEq)]
pub struct ActorOutput {
    /// Whether the actions are discrete or continuous.
    pub kind: ActionKind,
    /// `[N, A]` sampled actions, not clipped to any bounds. A discrete action has A = 1 and is stored as its index,
    /// which f32 represents exactly below 2²⁴.
    pub actions: Vec<f32>,
    /// `[N]` log-probabilities (densities, if continuous) of the actions.
    pub log_probs: Vec<f32>,
    /// `[N]` estimated state values V of the observations.
    pub values: Vec<f32>,
}

/// A source of random numbers for sampling actions in N environments.
pub trait Streams {
    /// Returns the random number generator for `environment`, an index in 0 … N-1.
    fn stream(&mut self, environment: usize) -> &mut ChaCha8Rng;
}

/// Uses one generator for all environments.
impl Streams for ChaCha8Rng {
    fn stream(&mut self, _: usize) -> &mut ChaCha8Rng {
        self
    }
}

/// Uses a separate generator for each environment.
impl Streams for Vec<ChaCha8Rng> {
    fn stream(&mut self, environment: usize) -> &mut ChaCha8Rng {
        &mut self[environment]
    }
}

impl Actor {
    /// Creates an actor for batches of at most `max_batch` observations. All weights are 0 until [`Actor::load`].
    pub fn new(spec: &PolicySpec, max_batch: usize) -> Self {
        let log_std = match spec.action {
            ActionKind::Discrete { .. } => Vec::new(),
            ActionKind::Continuous { size } => vec![0.0; size],
        };
        let network = match spec.lstm {
            Some(width) => Network::Recurrent(Box::new(Recurrent::new(spec, width, max_batch))),
            None => Network::FeedForward(FeedForward::new(spec, max_batch)),
        };
        Actor { spec: spec.clone(), max_batch, network, log_std, uniform: false, is_stale: false }
    }

    /// Makes the actor sample continuous actions uniformly from a box. The centre of the box is the policy's mean, and
    /// half of its width is the standard deviation. Discrete actions are still sampled from the logits; equal logits
    /// make them uniform.
    pub fn act_uniformly(&mut self) {
        self.uniform = true;
    }

    /// Loads weights, whose names and shapes must match [`PolicySpec::layout`]. Keeps the memories of the environments.
    ///
    /// # Errors
    /// [`Error::Arrays`] if a name or a shape differs.
    pub fn load(&mut self, weights: &Weights) -> Result<()> {
        self.spec.check(weights)?;
        self.load_flat(&weights.iter().flat_map(|array| array.data.iter().copied()).collect::<Vec<f32>>())
    }

    /// Loads all weights as one array `[P]`, in the order of [`PolicySpec::layout`].
    ///
    /// # Errors
    /// [`Error::Length`] if the number of weights is wrong.
    pub fn load_flat(&mut self, weights: &[f32]) -> Result<()> {
        check_length("weights [P]", weights.len(), self.spec.n_weights())?;
        let mut rest = weights;
        match &mut self.network {
            Network::FeedForward(network) => network.load(&mut rest),
            Network::Recurrent(network) => network.load(&mut rest),
        }
        self.log_std.copy_from_slice(rest);
        self.is_stale = false;
        Ok(())
    }

    /// Makes the actor of a feed-forward policy cache the activations of its networks, for
    /// [`Differentiator::load_from`](crate::Differentiator::load_from). The cache needs one row for each observation of
    /// `n_steps` steps, and for each observation of one more batch whose values are computed afterwards. If these are
    /// more than 64 rows, this call has no effect.
    pub fn keep_activations(&mut self, n_steps: usize) {
        match &mut self.network {
            Network::FeedForward(network) if self.max_batch.saturating_mul(n_steps.saturating_add(1)) <= BLOCK => {
                network.enable_cache(&self.spec);
            }
            _ => {}
        }
    }

    /// Returns the networks and log σ `[A]` of a feed-forward policy, so that the caller can swap them for its own
    /// networks. The actor then refuses to act until weights are loaded. Returns `None` if the policy is recurrent or
    /// its shape is not `spec`.
    pub(crate) fn give_networks(&mut self, spec: &PolicySpec) -> Option<(&mut FeedForward, &[f32])> {
        match &mut self.network {
            Network::FeedForward(network) if self.spec == *spec => {
                self.is_stale = true;
                Some((network, &self.log_std))
            }
            _ => None,
        }
    }

    /// Samples an action for each row of the normalised `observations` `[N, O]`, and overwrites `out`. Rows are
    /// processed in order. A discrete action takes one number from `streams`, a Gaussian action two for each element,
    /// and a uniform action one for each element.
    ///
    /// Row n belongs to environment n. A recurrent policy updates that environment's memory.
    ///
    /// # Errors
    /// [`Error::NoWeights`] if weights must be loaded first, [`Error::Length`] if `observations` does not fit, and
    /// [`Error::PolicyOutput`] if an output is not finite.
    pub fn act(&mut self, observations: &[f32], streams: &mut impl Streams, out: &mut ActorOutput) -> Result<()> {
        let n_envs = self.count(observations)?;
        let width = self.spec.action.width();
        let outputs = self.spec.action.outputs();
        let (heads, values) = match &mut self.network {
            Network::FeedForward(network) => network.act(observations, n_envs),
            Network::Recurrent(network) => network.advance(observations, n_envs),
        };
        out.kind = self.spec.action;
        out.actions.resize(n_envs * width, 0.0);
        out.log_probs.resize(n_envs, 0.0);
        replace_by_first_column(&mut out.values, values, n_envs);
        for n in 0..n_envs {
            let head = &heads.row(n)[..outputs];
            let action = &mut out.actions[n * width..][..width];
            let rng = streams.stream(n);
            let log_prob = match self.spec.action {
                ActionKind::Discrete { .. } => {
                    let (choice, log_prob) = sample_categorical(head, rng);
                    action[0] = choice as f32;
                    log_prob
                }
                ActionKind::Continuous { .. } if self.uniform => sample_uniform(head, &self.log_std, rng, action),
                ActionKind::Continuous { .. } => sample_gaussian(head, &self.log_std, rng, action),
            };
            let finite = action.iter().all(|x| x.is_finite()) && log_prob.is_finite() && out.values[n].is_finite();
            if !finite {
                return Err(Error::PolicyOutput { environment: n });
            }
            out.log_probs[n] = log_prob;
        }
        Ok(())
    }

    /// Writes the values V of the normalised `observations` `[N, O]` to `out` `[N]`. Row n belongs to environment n. A
    /// recurrent policy reads that environment's memory without changing it.
    pub fn values(&mut self, observations: &[f32], out: &mut Vec<f32>) -> Result<()> {
        let n_envs = self.count(observations)?;
        let values = match &mut self.network {
            Network::FeedForward(network) => network.values(observations, n_envs),
            Network::Recurrent(network) => network.values(observations, 0..n_envs),
        };
        replace_by_first_column(out, values, n_envs);
        Ok(())
    }

    /// Writes the values V of the final `observations` `[K, O]` to `out` `[K]`. Row k belongs to environment
    /// `environments[k]`. Call this before [`Actor::forget`], because a recurrent policy needs its memory of the
    /// episode that ended.
    pub fn values_in(&mut self, observations: &[f32], environments: &[usize], out: &mut Vec<f32>) -> Result<()> {
        check_length("environments [K]", environments.len(), self.count(observations)?)?;
        let values = match &mut self.network {
            Network::FeedForward(network) => network.values(observations, environments.len()),
            Network::Recurrent(network) => network.values(observations, environments.iter().copied()),
        };
        replace_by_first_column(out, values, environments.len());
        Ok(())
    }

    /// Clears the memory of `environment` (0 … `max_batch`-1). Call it when the environment's episode has ended. Has no
    /// effect on a feed-forward policy.
    pub fn forget(&mut self, environment: usize) {
        if let Network::Recurrent(network) = &mut self.network {
            network.forget(environment);
        }
    }

    /// Returns the memories of all environments, `[max_batch, S]` with S = [`PolicySpec::memory_size`].
    pub fn memory(&self) -> &[f32] {
        match &self.network {
            Network::FeedForward(_) => &[],
            Network::Recurrent(network) => network.memory(),
        }
    }

    /// Restores memories that [`Actor::memory`] returned.
    ///
    /// # Errors
    /// [`Error::Length`] if the length is not `max_batch` · S. The memories are then unchanged.
    pub fn set_memory(&mut self, memory: &[f32]) -> Result<()> {
        check_length("memory [N, S]", memory.len(), self.memory().len())?;
        if let Network::Recurrent(network) = &mut self.network {
            network.memory_mut().copy_from_slice(memory);
        }
        Ok(())
    }

    /// Returns the number of observations. Fails if weights must be loaded first, or if the length does not fit.
    fn count(&self, observations: &[f32]) -> Result<usize> {
        if self.is_stale {
            return Err(Error::NoWeights);
        }
        let n_envs = observations.len() / self.spec.observation_size;
        let expected = self.max_batch.min(n_envs) * self.spec.observation_size;
        check_length("observations [N, O]", observations.len(), expected)?;
        Ok(n_envs)
    }
}

/// Replaces `out` by the first element of each of the first `n` rows: the values V, because a value network has one
/// output.
fn replace_by_first_column(out: &mut Vec<f32>, rows: RowsFrom<'_>, n: usize) {
    out.clear();
    out.extend((0..n).map(|n| rows.row(n)[0]));
}

impl ActorOutput {
    /// Creates an empty output with capacity for `n_envs` environments.
    pub fn new(kind: ActionKind, n_envs: usize) -> Self {
        ActorOutput {
            kind,
            actions: Vec::with_capacity(n_envs * kind.width()),
            log_probs: Vec::with_capacity(n_envs),
            values: Vec::with_capacity(n_envs),
        }
    }

    /// Encodes the actions as the protocol does, and replaces `bytes` by the result: little-endian i32 `[N]` if
    /// discrete, little-endian f32 `[N, A]` if continuous.
    pub fn write_bytes(&self, bytes: &mut Vec<u8>) {
        bytes.clear();
        match self.kind {
            ActionKind::Discrete { .. } => {
                bytes.extend(self.actions.iter().flat_map(|&action| (action as i32).to_le_bytes()));
            }
            ActionKind::Continuous { .. } => bytes.extend(self.actions.iter().flat_map(|action| action.to_le_bytes())),
        }
    }
}
