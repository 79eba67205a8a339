//! The scores of a policy in the episodes of one test.

use super::ComparedScore;
use crate::records::Records;
use crate::results_table::TableRow;
use crate::statistics::mean;

/// The seed, the environment index and the episode index, which together identify an episode of a test.
type EpisodeAddress = (u64, u32, u64);

/// The scores of a policy in one test.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct TestScores {
    /// The address of each episode, in recorded order; empty if the addresses are not known.
    addresses: Vec<EpisodeAddress>,
    /// The score of each episode, in the order of `addresses` if these are known. Empty if only the mean score is
    /// known.
    pub(super) values: Vec<f64>,
    /// The mean score.
    pub(super) mean: f64,
    /// The number of episodes.
    pub(super) episodes: usize,
}

impl TestScores {
    pub(super) fn of_records(records: &Records, set: &str, score: ComparedScore) -> Self {
        let rows = || records.episodes_on(set);
        let value = |row: &crate::EpisodeRecord| match score {
            ComparedScore::Success => 100.0 * f64::from(u8::from(row.success)),
            ComparedScore::Return => row.episode_return,
            ComparedScore::Length => f64::from(row.length),
        };
        let values: Vec<f64> = rows().map(value).collect();
        Self {
            addresses: rows().map(|row| (row.seed, row.environment_index, row.episode_index)).collect(),
            mean: mean(values.iter().copied()),
            episodes: values.len(),
            values,
        }
    }

    /// Returns the scores of a row of a results table. The row's number of successes gives the score of each episode,
    /// but not the order of the episodes. Of returns and lengths, only the means are known. The result is `None` for a
    /// failed cell.
    pub(super) fn of_row(row: &TableRow, score: ComparedScore) -> Option<Self> {
        let result = row.result()?;
        let (episodes, successes) = (usize::try_from(row.episodes?).ok()?, usize::try_from(row.successes?).ok()?);
        let (mean, values) = match score {
            ComparedScore::Success => {
                let value = |episode| if episode < successes { 100.0 } else { 0.0 };
                (result.success_percent, (0..episodes).map(value).collect())
            }
            ComparedScore::Return => (result.mean_return, Vec::new()),
            ComparedScore::Length => (result.mean_length, Vec::new()),
        };
        Some(Self { addresses: Vec::new(), values, mean, episodes })
    }
}

/// Returns whether all policies are known to have played the same episodes. Returns false if there are several policies
/// and the addresses of their episodes are unknown.
pub(super) fn share_episodes(policies: &[TestScores]) -> bool {
    policies.windows(2).all(|two| !two[0].addresses.is_empty() && two[0].addresses == two[1].addresses)
}

/// Returns for each episode the mean score over `policies`, which must have played the same episodes.
pub(super) fn mean_by_episode(policies: &[TestScores]) -> Vec<f64> {
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
