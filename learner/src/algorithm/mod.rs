//! Reinforcement-learning algorithms, which improve a policy's weights from rollouts.

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
use crate::policy::TrainablePolicy;
use crate::rollout::{self, Estimates, RolloutBuffer};

/// An algorithm that improves a policy from rollouts.
pub trait Algorithm: Send {
    /// Returns the amount of experience to collect between two updates.
    fn collect_until(&self) -> CollectUntil;

    /// Improves `policy` from a finished rollout. `progress_remaining` falls from 1 at the start of training. It may end
    /// above 0, see `Schedule::Linear`. Returns an error if a loss or gradient is not finite; the policy then has the
    /// weights from before that gradient step.
    fn update(
        &mut self,
        policy: &mut TrainablePolicy,
        rollout: &RolloutBuffer,
        progress_remaining: f64,
    ) -> Result<UpdateStats>;

    /// Returns everything that later updates depend on, except the policy's weights.
    fn state(&self) -> AlgorithmState;

    /// Restores a saved state. Later updates then give the same bytes as without the interruption.
    fn load_state(&mut self, state: &AlgorithmState) -> Result<()>;
}

/// An algorithm that EPOpt can wrap: it can learn from several rollouts in one update.
pub trait BaseAlgorithm: Algorithm {
    /// Improves `policy` from one or more rollouts in one update. A2C takes a gradient step on each rollout, and PPO
    /// makes `n_epochs` passes over all of them. The advantages use the values that the rollouts recorded. The returned
    /// statistics are means over all gradient steps.
    ///
    /// # Errors
    /// The errors of [`Algorithm::update`].
    fn update_many(
        &mut self,
        policy: &mut TrainablePolicy,
        rollouts: &[&RolloutBuffer],
        progress_remaining: f64,
    ) -> Result<UpdateStats>;
}

/// The state of an algorithm, from which training resumes exactly.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlgorithmState {
    /// Number of gradient steps so far.
    pub n_updates: u64,
    /// Number of iterations so far; 0 except with EPOpt.
    #[serde(default)]
    pub iterations: u64,
    /// The optimiser's running averages.
    pub optimiser: Vec<NamedArray>,
    /// The random stream that draws minibatches; `None` except with PPO.
    pub rng: Option<ChaCha8Rng>,
}

/// Statistics of an update, with stable-baselines3's names. Losses and other averaged figures are means over the
/// gradient steps of the update.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStats {
    /// The optimiser's step size in this update.
    pub learning_rate: f64,
    /// The policy's term of the loss.
    pub policy_gradient_loss: f64,
    /// The value loss, before it is multiplied by `vf_coef`.
    pub value_loss: f64,
    /// The negative mean entropy, in nats, before it is multiplied by `ent_coef`.
    pub entropy_loss: f64,
    /// The total loss, which is minimised.
    pub loss: f64,
    /// Estimate, from sampled actions, of the KL divergence of the new policy from the policy that acted, in nats;
    /// `None` except with PPO.
    pub approx_kl: Option<f64>,
    /// KL divergence of the new policy from the policy that acted, in nats, from their distributions, before it is
    /// multiplied by `kl_coef`. `None` except with PPO and a `kl_coef` above 0.
    pub kl_divergence: Option<f64>,
    /// Share of samples (0 to 1) whose probability ratio was outside `1 ± clip_range`; `None` except with PPO.
    pub clip_fraction: Option<f64>,
    /// The configured `clip_range`; `None` except with PPO.
    pub clip_range: Option<f64>,
    /// Share of the variance of the returns that the predicted values explain: at most 1, and negative for poor
    /// predictions. `None` if the returns are constant.
    pub explained_variance: Option<f64>,
    /// Global norm of the gradient before clipping.
    pub grad_norm: f64,
    /// Number of gradient steps so far, including this update's.
    pub n_updates: u64,
    /// Standard deviation of the action distribution, averaged over action dimensions; `None` for discrete actions.
    pub std: Option<f64>,
    /// Statistics of the selected episodes; `None` except with EPOpt.
    pub selection: Option<EpisodeSelection>,
}

/// Checks that the shape of a rollout fits the algorithm and the policy. A rollout of complete episodes may have any
/// length.
fn check_rollout(rollout: &RolloutBuffer, policy: &TrainablePolicy, n_steps: usize) -> Result<()> {
    if rollout.lengths().is_none() {
        check_length("the rollout's axis T", rollout.n_steps(), n_steps)?;
    }
    check_length("the rollout's axis O", rollout.observation_size(), policy.spec().observation_size)?;
    check_length("the rollout's axis A", rollout.action_width(), policy.spec().action.width())?;
    let memory = rollout.n_envs() * policy.spec().memory_size();
    Ok(check_length("the rollout's memory [N, S]", rollout.memory().len(), memory)?)
}

/// Returns the algorithm of `settings` with a new state for `policy`. `seed` determines its random numbers.
///
/// # Errors
/// An error if a setting is out of its range.
pub fn build(settings: &Settings, policy: &TrainablePolicy, seed: u64) -> Result<Box<dyn Algorithm>> {
    let base: Box<dyn BaseAlgorithm> = match &settings.base {
        Base::A2c(settings) => Box::new(A2c::new(settings.clone(), policy)?),
        Base::Ppo(settings) => Box::new(Ppo::new(settings.clone(), policy, seed)?),
        Base::Random | Base::Heuristic => unreachable!("this policy is made, not trained"),
    };
    Ok(match &settings.wrapper {
        Wrapper::Plain | Wrapper::Rl2(_) => base,
        Wrapper::Epopt(settings) => Box::new(Epopt::new(settings.clone(), base)?),
    })
}

/// Returns the share of the variance of the returns that the rollouts' values explain. `estimates` has the returns of
/// each rollout. Returns `None` if the returns are constant.
fn explained_variance(rollouts: &[&RolloutBuffer], estimates: &[Estimates]) -> Option<f64> {
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
