//! The scores of a policy in the episodes of one test.

use super::ComparedScore;
use crate::records::Records;
use crate::statistics::mean;

/// The seed, the environment index and the episode index, which together identify an episode of a test.
type EpisodeAddress = (u64, u32, u64);

/// The scores of a policy's episodes in one test, in recorded order.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct EpisodeScores {
    addresses: Vec<EpisodeAddress>,
    /// The score of each episode, in the order of `addresses`.
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

/// Returns whether all policies played the same episodes.
pub(super) fn share_episodes(policies: &[EpisodeScores]) -> bool {
    policies.windows(2).all(|two| two[0].addresses == two[1].addresses)
}

/// Returns for each episode the mean score over `policies`, which must have played the same episodes.
pub(super) fn mean_by_episode(policies: &[EpisodeScores]) -> Vec<f64> {
    let episodes = policies.first().map_or(0, |policy| policy.values.len());
    (0..episodes).map(|episode| mean(policies.iter().map(|policy| policy.values[episode]))).collect()
}

/// Returns the variance of the mean over groups of scores. Every group has the same weight. Variances are divided by n,
/// not by n - 1.
pub(super) fn variance_of_mean(strata: &[Vec<f64>]) -> f64 {
    let of_stratum = |scores: &Vec<f64>| {
        let (n, center) = (scores.len() as f64, mean(scores.iter().copied()));
        scores.iter().map(|score| (score - center).powi(2)).sum::<f64>() / n / n
    };
    strata.iter().map(of_stratum).sum::<f64>() / (strata.len() as f64).powi(2)
}
