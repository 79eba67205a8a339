//! Algorithms: they turn a rollout into better weights.

mod a2c;
mod epopt;
mod ppo;
mod watch;

pub use a2c::{A2c, n_step_returns};
pub use epopt::{EpisodeSelection, Epopt};
pub use ppo::{Ppo, gae};

use perturb_policy::{CollectUntil, NamedArray, check_length};
use perturb_settings::{Base, Settings, Wrapper};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::policy::Policy;
use crate::rollout::{self, Estimates, Rollout};

/// Learns from rollouts.
pub trait Algorithm: Send {
    /// The amount of experience to collect between two updates.
    fn collect_until(&self) -> CollectUntil;

    /// Improves `policy` by a finished rollout. `progress_remaining` falls from 1 at the start of training to 0 at its
    /// end. A loss or gradient that is not finite is an error, after which the policy is as it was before that gradient
    /// step.
    fn update(&mut self, policy: &mut Policy, rollout: &Rollout, progress_remaining: f64) -> Result<UpdateStats>;

    /// Everything that later updates depend on, except the policy's weights.
    fn state(&self) -> AlgorithmState;

    /// Restores a saved state. Later updates give the same bytes as without the break.
    fn load_state(&mut self, state: &AlgorithmState) -> Result<()>;
}

/// An algorithm that EPOpt can wrap: it can learn from several rollouts at once.
pub trait BaseAlgorithm: Algorithm {
    /// Improves `policy` by one or more `rollouts`, with as many passes over each as if it were the only one: A2C takes a
    /// step on each, PPO makes `n_epochs` passes over all. All advantages are estimated before the first step. Figures are
    /// means over all steps.
    ///
    /// # Errors
    /// The errors of [`Algorithm::update`].
    fn update_many(
        &mut self,
        policy: &mut Policy,
        rollouts: &[&Rollout],
        progress_remaining: f64,
    ) -> Result<UpdateStats>;
}

/// The state of an algorithm, for exact resumption.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlgorithmState {
    /// Gradient steps so far.
    pub n_updates: u64,
    /// Iterations so far; EPOpt only.
    #[serde(default)]
    pub iterations: u64,
    /// The optimiser's running averages.
    pub optimiser: Vec<NamedArray>,
    /// The random stream of minibatch orders; PPO only.
    pub rng: Option<ChaCha8Rng>,
}

/// Figures of an update, with stable-baselines3's names. Averages are over the update's gradient steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStats {
    /// The optimiser's step size.
    pub learning_rate: f64,
    /// The policy's part of the loss.
    pub policy_gradient_loss: f64,
    /// The value network's part of the loss, before `vf_coef`.
    pub value_loss: f64,
    /// Minus the mean entropy, before `ent_coef`, in nats.
    pub entropy_loss: f64,
    /// The sum that was minimised.
    pub loss: f64,
    /// Estimate of the KL divergence of the new from the acting policy, in nats; PPO only.
    pub approx_kl: Option<f64>,
    /// KL divergence of the new from the acting policy, in nats, before `kl_coef`; PPO with `kl_coef` above 0 only.
    pub kl_divergence: Option<f64>,
    /// Share of samples whose ratio was outside `1 ± clip_range`; PPO only.
    pub clip_fraction: Option<f64>,
    /// `clip_range`; PPO only.
    pub clip_range: Option<f64>,
    /// Share of the variance of the returns that the rollout's values explain; None if the returns are constant.
    pub explained_variance: Option<f64>,
    /// Global norm of the gradient, before clipping.
    pub grad_norm: f64,
    /// Gradient steps so far, this update's included.
    pub n_updates: u64,
    /// Mean standard deviation of the actions; continuous actions only.
    pub std: Option<f64>,
    /// The episodes that were learned from; EPOpt only.
    pub selection: Option<EpisodeSelection>,
}

/// Checks that a rollout's axes fit the algorithm and the policy. The length of a rollout of complete episodes is free.
fn check_rollout(rollout: &Rollout, policy: &Policy, n_steps: usize) -> Result<()> {
    if rollout.lengths().is_none() {
        check_length("the rollout's axis T", rollout.n_steps(), n_steps)?;
    }
    check_length("the rollout's axis O", rollout.observation_size(), policy.spec().observation_size)?;
    check_length("the rollout's axis A", rollout.action_width(), policy.spec().action.width())?;
    let memory = rollout.n_envs() * policy.spec().memory_size();
    Ok(check_length("the rollout's memory [N, S]", rollout.memory().len(), memory)?)
}

/// The algorithm of `settings` with fresh state for `policy`; `seed` fixes its randomness.
///
/// # Errors
/// A setting out of its range.
pub fn build(settings: &Settings, policy: &Policy, seed: u64) -> Result<Box<dyn Algorithm>> {
    let base: Box<dyn BaseAlgorithm> = match &settings.base {
        Base::A2c(settings) => Box::new(A2c::new(settings.clone(), policy)?),
        Base::Ppo(settings) => Box::new(Ppo::new(settings.clone(), policy, seed)?),
        Base::Random => unreachable!("a random policy is made, not trained"),
    };
    Ok(match &settings.wrapper {
        Wrapper::Plain | Wrapper::Rl2(_) => base,
        Wrapper::Epopt(settings) => Box::new(Epopt::new(settings.clone(), base)?),
    })
}

/// The share of the variance of the returns that the rollouts' values explain.
fn explained_variance(rollouts: &[&Rollout], estimates: &[Estimates]) -> Option<f64> {
    let mut values = Vec::new();
    let mut returns = Vec::new();
    for (rollout, estimates) in rollouts.iter().zip(estimates) {
        match rollout.samples() {
            None => {
                values.extend_from_slice(rollout.values());
                returns.extend_from_slice(&estimates.returns);
            }
            Some(samples) => {
                values.extend(samples.iter().map(|&i| rollout.values()[i as usize]));
                returns.extend(samples.iter().map(|&i| estimates.returns[i as usize]));
            }
        }
    }
    rollout::explained_variance(&values, &returns)
}
