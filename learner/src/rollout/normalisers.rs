//! What a collector normalises with.

use perturb_policy::{ObservationNormaliser, Result, RewardNormaliser};

/// Statistics of a training; `None` where nothing is normalised.
#[derive(Clone, Debug, PartialEq)]
pub struct Normalisers {
    /// Of observations.
    pub observations: Option<ObservationNormaliser>,
    /// Of rewards.
    pub rewards: Option<RewardNormaliser>,
}

impl Normalisers {
    /// Adds those of `observations` `[N, O]` whose environments are `active` `[N]`, or all, to the statistics, and
    /// normalises all.
    pub(super) fn take_observations(&mut self, observations: &mut [f32], active: Option<&[bool]>) -> Result<()> {
        let Some(normaliser) = &mut self.observations else { return Ok(()) };
        match active.filter(|active| active.contains(&false)) {
            None => normaliser.update(observations)?,
            Some(active) => {
                let size = observations.len() / active.len();
                let rows = observations.chunks_exact(size).zip(active).filter(|(_, active)| **active);
                let seen: Vec<f32> = rows.flat_map(|(row, _)| row.iter().copied()).collect();
                normaliser.update(&seen)?;
            }
        }
        normaliser.normalise(observations)
    }

    /// Adds those of a step's `rewards` `[N]` whose environments are `active` `[N]`, or all, to the statistics, and
    /// normalises all. `done` `[N]`: where the discounted return ends.
    pub(super) fn take_rewards(&mut self, rewards: &mut [f32], done: &[bool], active: Option<&[bool]>) -> Result<()> {
        let Some(normaliser) = &mut self.rewards else { return Ok(()) };
        normaliser.update_active(rewards, done, active)?;
        normaliser.normalise(rewards);
        Ok(())
    }

    /// Normalises `observations`; the statistics stay.
    pub(super) fn normalise(&self, observations: &mut [f32]) -> Result<()> {
        self.observations.as_ref().map_or(Ok(()), |normaliser| normaliser.normalise(observations))
    }
}
