//! The normalisers of observations and rewards, between an environment and a policy.

use crate::error::{Result, check_length};
use crate::normaliser::{ObservationNormaliser, RewardNormaliser};

/// The normalisers of a policy. A field is `None` if its quantity is not normalised.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Normalisers {
    /// The normaliser of observations.
    pub observations: Option<ObservationNormaliser>,
    /// The normaliser of rewards.
    pub rewards: Option<RewardNormaliser>,
}

/// Whether a normaliser's statistics are updated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Statistics {
    /// Each batch is first added to the statistics, then normalised with the updated statistics, as in the training
    /// mode of stable-baselines3's VecNormalize.
    Running,
    /// The statistics are not changed.
    Frozen,
}

impl Normalisers {
    /// Normalises `observations` `[N, O]`. With [`Statistics::Running`], first adds the observations of the
    /// environments where `active` `[N]` is true, or of all if it is `None`, to the statistics.
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

    /// Normalises a step's `rewards` `[N]`. With [`Statistics::Running`], first adds the rewards of the environments
    /// where `active` `[N]` is true, or of all if it is `None`, to the statistics. `done` `[N]` is true where the
    /// discounted return ends.
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

    /// Normalises final observations `[K, O]` without changing the statistics.
    pub(crate) fn normalise(&self, observations: &mut [f32]) -> Result<()> {
        self.observations.as_ref().map_or(Ok(()), |normaliser| normaliser.normalise(observations))
    }

    /// Checks that the normalisers fit N = `n_envs` environments whose observations have `observation_size` numbers, of
    /// which the last `left_alone` are not normalised.
    ///
    /// # Errors
    /// [`Error::Statistics`](crate::Error::Statistics) if the statistics are impossible or have the wrong size,
    /// [`Error::Length`](crate::Error::Length) if the discounted returns are not N numbers.
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
