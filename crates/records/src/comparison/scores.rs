//! The scores of a policy in the episodes of a test.

use super::ComparedScore;
use crate::records::Records;
use crate::statistics::mean;

/// The address of an episode within a test: the seed, the environment index and the episode index.
type EpisodeAddress = (u64, u32, u64);

/// A policy's episodes of a test, in their order.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct EpisodeScores {
    addresses: Vec<EpisodeAddress>,
    /// A score for each address.
    pub(super) values: Vec<f64>,
}

impl EpisodeScores {
    pub(super) fn new(records: &Records, set: &str, score: ComparedScore) -> Self {
        let rows = || records.episodes_on(set);
        let value = |row: &crate::EpisodeRecord| match score {
            ComparedScore::Success => 100.0 * f64::from(u8::from(row.success)),
            ComparedScore::Return => row.episode_return,
            ComparedScore::Length => f64::from(row.length),
        };
        Self {
            addresses: rows().map(|row| (row.seed, row.environment_index, row.episode_index)).collect(),
            values: rows().map(value).collect(),
        }
    }
}

/// Whether all played the same episodes.
pub(super) fn share_episodes(policies: &[EpisodeScores]) -> bool {
    policies.windows(2).all(|two| two[0].addresses == two[1].addresses)
}

/// `[episodes]` the mean over policies, which share their episodes.
pub(super) fn mean_by_episode(policies: &[EpisodeScores]) -> Vec<f64> {
    let episodes = policies.first().map_or(0, |policy| policy.values.len());
    (0..episodes).map(|episode| mean(policies.iter().map(|policy| policy.values[episode]))).collect()
}

/// Returns the variance of the mean over strata, each of which has the same weight, with n in the denominators.
pub(super) fn variance_of_mean(strata: &[Vec<f64>]) -> f64 {
    let of_stratum = |scores: &Vec<f64>| {
        let (n, center) = (scores.len() as f64, mean(scores.iter().copied()));
        scores.iter().map(|score| (score - center).powi(2)).sum::<f64>() / n / n
    };
    strata.iter().map(of_stratum).sum::<f64>() / (strata.len() as f64).powi(2)
}
