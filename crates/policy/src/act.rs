//! Acting: a policy's forward pass in plain f32 loops.
//!
//! libtorch needs 30 µs for one observation, most of it not arithmetic; these loops need a few. An [`Actor`] gives the
//! same bytes for an observation whatever else is in the batch: each output is a sum in one fixed order.

use rand_chacha::ChaCha8Rng;

use crate::act_ff::{BLOCK, FeedForward};
use crate::act_rc::Recurrent;
use crate::error::{Error, Result, check_length};
use crate::kernel::RowsFrom;
use crate::sample::{sample_categorical, sample_gaussian, sample_uniform};
use crate::spec::{ActionKind, PolicySpec};
use crate::weights::Weights;

/// Computes actions, log-probabilities and values. Acting allocates nothing after its creation for batches of at most
/// `max_batch`, except where the caller's outputs grow.
///
/// A recurrent policy's actor keeps a memory for every environment. [`Actor::act`] advances it. [`Actor::forget`]
/// clears it at the end of an episode (RL²: of a trial). Computing values alone does not change it.
#[derive(Clone, Debug)]
pub struct Actor {
    spec: PolicySpec,
    max_batch: usize,
    network: Network,
    log_std: Vec<f32>,
    /// Continuous actions are uniform in a box, not Gaussian.
    uniform: bool,
    /// Whether the networks were swapped for others, which do not have the weights.
    is_stale: bool,
}

/// The networks of an architecture.
#[derive(Clone, Debug)]
enum Network {
    FeedForward(FeedForward),
    Recurrent(Box<Recurrent>),
}

/// The output of an actor in N environments.
#[derive(Clone, Debug, PartialEq)]
pub struct ActorOutput {
    /// The kind of the actions.
    pub kind: ActionKind,
    /// `[N, A]` actions as sampled, not clipped. A discrete action is its index as f32, exact below 2²⁴, with A = 1.
    pub actions: Vec<f32>,
    /// `[N]` log-probabilities (densities, if continuous) of the actions.
    pub log_probs: Vec<f32>,
    /// `[N]` values of the observations.
    pub values: Vec<f32>,
}

/// The random streams from which the environments' actions are sampled.
pub trait Streams {
    /// The stream of `environment`, one of 0 … N-1.
    fn stream(&mut self, environment: usize) -> &mut ChaCha8Rng;
}

/// A single stream for all environments, in their order.
impl Streams for ChaCha8Rng {
    fn stream(&mut self, _: usize) -> &mut ChaCha8Rng {
        self
    }
}

/// A stream for each environment.
impl Streams for Vec<ChaCha8Rng> {
    fn stream(&mut self, environment: usize) -> &mut ChaCha8Rng {
        &mut self[environment]
    }
}

impl Actor {
    /// An actor for at most `max_batch` observations at a time, with all weights 0 until [`Actor::load`].
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

    /// From now on a continuous action is uniform in a box: its middle is the policy's mean, half its width the standard
    /// deviation. Discrete actions are sampled as before: equal logits make them uniform.
    pub fn act_uniformly(&mut self) {
        self.uniform = true;
    }

    /// Loads weights, whose names and shapes must be those of [`PolicySpec::layout`]. The environments' memories stay.
    ///
    /// # Errors
    /// [`Error::Arrays`] for other names or shapes.
    pub fn load(&mut self, weights: &Weights) -> Result<()> {
        self.spec.check(weights)?;
        self.load_flat(&weights.iter().flat_map(|array| array.data.iter().copied()).collect::<Vec<f32>>())
    }

    /// Loads all weights `[P]` in a row.
    ///
    /// # Errors
    /// [`Error::Length`].
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

    /// From now on caches the activations of a feed-forward policy's networks while it acts for `n_steps` with the same weights,
    /// for [`Differentiator::load_from`](crate::Differentiator::load_from). Has no effect if these steps and the values of one
    /// more batch have more than 64 observations.
    pub fn keep_activations(&mut self, n_steps: usize) {
        match &mut self.network {
            Network::FeedForward(network) if self.max_batch.saturating_mul(n_steps.saturating_add(1)) <= BLOCK => {
                network.keep(&self.spec);
            }
            _ => {}
        }
    }

    /// The networks of a feed-forward policy of shape `spec`, to be swapped for others, and log σ `[A]` of its actions. The
    /// actor refuses to act until weights are loaded.
    pub(crate) fn give_networks(&mut self, spec: &PolicySpec) -> Option<(&mut FeedForward, &[f32])> {
        match &mut self.network {
            Network::FeedForward(network) if self.spec == *spec => {
                self.is_stale = true;
                Some((network, &self.log_std))
            }
            _ => None,
        }
    }

    /// Samples an action for each normalised observation of `observations` `[N, O]`, in order of n; draws from `streams`
    /// once per discrete action and twice per element of a continuous one. Replaces what is in `out`.
    ///
    /// Row n belongs to environment n: a recurrent policy adds the observation to that environment's memory.
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

    /// Replaces `out` `[N]` by the values V of the normalised `observations` `[N, O]`. Row n belongs to environment n, whose
    /// memory is used, but not changed.
    pub fn values(&mut self, observations: &[f32], out: &mut Vec<f32>) -> Result<()> {
        let n_envs = self.count(observations)?;
        let values = match &mut self.network {
            Network::FeedForward(network) => network.values(observations, n_envs),
            Network::Recurrent(network) => network.values(observations, 0..n_envs),
        };
        replace_by_first_column(out, values, n_envs);
        Ok(())
    }

    /// Replaces `out` `[K]` by the values of final `observations` `[K, O]`. Row k belongs to environment `environments[k]`,
    /// whose memory must still be that of the episode that ended: call this before [`Actor::forget`].
    pub fn values_in(&mut self, observations: &[f32], environments: &[usize], out: &mut Vec<f32>) -> Result<()> {
        check_length("environments [K]", environments.len(), self.count(observations)?)?;
        let values = match &mut self.network {
            Network::FeedForward(network) => network.values(observations, environments.len()),
            Network::Recurrent(network) => network.values(observations, environments.iter().copied()),
        };
        replace_by_first_column(out, values, environments.len());
        Ok(())
    }

    /// Empties the memory of `environment`, one of 0 … `max_batch`-1, after the end of its episode.
    pub fn forget(&mut self, environment: usize) {
        if let Network::Recurrent(network) = &mut self.network {
            network.forget(environment);
        }
    }

    /// [`max_batch`, S] the memory of every environment, S = [`PolicySpec::memory_size`].
    pub fn memory(&self) -> &[f32] {
        match &self.network {
            Network::FeedForward(_) => &[],
            Network::Recurrent(network) => network.memory(),
        }
    }

    /// Restores a memory that [`Actor::memory`] returned.
    ///
    /// # Errors
    /// [`Error::Length`] if it is not [`max_batch`, S]; nothing is changed then.
    pub fn set_memory(&mut self, memory: &[f32]) -> Result<()> {
        check_length("memory [N, S]", memory.len(), self.memory().len())?;
        if let Network::Recurrent(network) = &mut self.network {
            network.memory_mut().copy_from_slice(memory);
        }
        Ok(())
    }

    /// The number of observations. An error if the actor may not act.
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

/// Replaces `out` by the first numbers of the first `n` rows of a value head.
fn replace_by_first_column(out: &mut Vec<f32>, rows: RowsFrom<'_>, n: usize) {
    out.clear();
    out.extend((0..n).map(|n| rows.row(n)[0]));
}

impl ActorOutput {
    /// No actions yet, with capacity for `n_envs`.
    pub fn new(kind: ActionKind, n_envs: usize) -> Self {
        ActorOutput {
            kind,
            actions: Vec::with_capacity(n_envs * kind.width()),
            log_probs: Vec::with_capacity(n_envs),
            values: Vec::with_capacity(n_envs),
        }
    }

    /// Replaces `bytes` by the actions as the protocol encodes them: little-endian i32 `[N]`, or f32 `[N, A]`.
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
