//! Running normalisation of observations and rewards.

use serde::{Deserialize, Serialize};

use crate::error::Result;

/// Running mean and variance of vectors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunningMoments {}

/// Normalises observations by their running mean and variance, clipped to ±10.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObservationNormaliser {}

impl ObservationNormaliser {
    /// Nothing seen yet.
    pub fn new(_observation_size: usize) -> Self {
        todo!()
    }
    /// Adds `observations` [N, O] to the statistics.
    pub fn update(&mut self, _observations: &[f32]) -> Result<()> {
        todo!()
    }
    /// Normalises `observations` [N, O] in place; the statistics stay.
    pub fn normalise(&self, _observations: &mut [f32]) -> Result<()> {
        todo!()
    }
}

/// Divides rewards by the running standard deviation of the discounted return, clipped to ±10.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RewardNormaliser {}

impl RewardNormaliser {
    /// Nothing seen yet.
    pub fn new(_n_envs: usize, _gamma: f64) -> Self {
        todo!()
    }
    /// Adds `rewards` [N] to the statistics; where `done` [N] (terminated or truncated), the environment's discounted
    /// return starts again at 0 afterwards.
    pub fn update(&mut self, _rewards: &[f32], _done: &[bool]) -> Result<()> {
        todo!()
    }
    /// Normalises `rewards` [N] in place; the statistics stay.
    pub fn normalise(&self, _rewards: &mut [f32]) {
        todo!()
    }
}
