//! The normalisers between an environment and a policy.

use crate::error::{Result, check_length};
use crate::normaliser::{ObservationNormaliser, RewardNormaliser};

/// The normalisers of a policy; `None` where nothing is normalised.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Normalisers {
    /// The normaliser of observations.
    pub observations: Option<ObservationNormaliser>,
    /// The normaliser of rewards.
    pub rewards: Option<RewardNormaliser>,
}

/// Whether statistics are updated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Statistics {
    /// Numbers are added to the statistics, and normalised with the updated ones, as stable-baselines3's VecNormalize does in
    /// training.
    Running,
    /// Statistics stay as they are.
    Frozen,
}

impl Normalisers {
    /// Normalises `observations` `[N, O]`, after adding those of the `active` `[N]` environments, or all, to running
    /// statistics.
    pub(crate) fn take_observations(
        &mut self,
        observations: &mut [f32],
        statistics: Statistics,
        active: Option<&[bool]>,
    ) -> Result<()> {
        let Some(normaliser) = &mut self.observations else { return Ok(()) };
        if statistics == Statistics::Running {
            normaliser.update_active(observations, active)?;
        }
        normaliser.normalise(observations)
    }

    /// Normalises a step's `rewards` `[N]`, after adding those of the `active` `[N]` environments, or all, to running
    /// statistics. `done` `[N]`: where the discounted return ends.
    pub(crate) fn take_rewards(
        &mut self,
        rewards: &mut [f32],
        done: &[bool],
        statistics: Statistics,
        active: Option<&[bool]>,
    ) -> Result<()> {
        let Some(normaliser) = &mut self.rewards else { return Ok(()) };
        if statistics == Statistics::Running {
            normaliser.update_active(rewards, done, active)?;
        }
        normaliser.normalise(rewards);
        Ok(())
    }

    /// Normalises final observations `[K, O]`; the statistics stay.
    pub(crate) fn normalise(&self, observations: &mut [f32]) -> Result<()> {
        self.observations.as_ref().map_or(Ok(()), |normaliser| normaliser.normalise(observations))
    }

    /// Checks that these fit N environments with observations of O numbers, the last `left_alone` of which are not normalised.
    ///
    /// # Errors
    /// [`Error::Statistics`](crate::Error::Statistics) with the reason; [`Error::Length`](crate::Error::Length).
    pub fn check(&self, n_envs: usize, observation_size: usize, left_alone: usize) -> Result<()> {
        let named = |name| move |reason| crate::error::Error::Statistics { name, reason };
        if let Some(normaliser) = &self.observations {
            normaliser.check(observation_size, left_alone).map_err(named("observations"))?;
        }
        if let Some(normaliser) = &self.rewards {
            normaliser.check().map_err(named("rewards"))?;
            check_length("the discounted returns [N]", normaliser.returns().len(), n_envs)?;
        }
        Ok(())
    }
}
