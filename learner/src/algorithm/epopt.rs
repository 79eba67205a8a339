//! EPOpt: learns from the worst of many episodes.

use perturb_policy::CollectUntil;
use perturb_settings::{EpoptConfig, Ranking};

use super::{Algorithm, AlgorithmState, BaseAlgorithm, UpdateStats};
use crate::error::Result;
use crate::policy::TrainablePolicy;
use crate::rollout::{EpisodeSlice, RolloutBuffer};

/// EPOpt-ε, Rajeswaran et al. (2017), arXiv:1610.01283, which wraps another algorithm.
///
/// Each iteration generates L complete episodes, each with newly drawn parameters. The wrapped algorithm learns only
/// from the worst: the episodes whose undiscounted return is at most the ε-percentile of all L returns. The percentile
/// interpolates linearly between neighbouring returns, as numpy's does. If several returns equal the percentile, more
/// than the share ε is kept. As in Packer et al. (2018), ε is 1 in the first iterations. Episodes can also be ranked by
/// the sum of their normalised rewards, see [`Ranking`].
pub struct Epopt {
    config: EpoptConfig,
    base: Box<dyn BaseAlgorithm>,
    iterations: u64,
}

/// Statistics of the episodes that EPOpt selected in an iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpisodeSelection {
    /// The share ε of this iteration: 1 in the first iterations, later the configured share.
    pub epsilon: f64,
    /// Number of selected episodes, from which the wrapped algorithm learned.
    pub kept: u64,
    /// Number of steps in the selected episodes.
    pub kept_steps: u64,
    /// Mean return of all L episodes.
    pub mean_return: f64,
    /// Conditional value at risk: the mean return of the ⌈εL⌉ worst episodes, where ε is the configured share. This
    /// also holds in the first iterations, which learn from all episodes.
    pub cvar: f64,
}

impl Epopt {
    /// Wraps `base`, which must not have made an update yet. Returns an error for an invalid setting.
    pub fn new(config: EpoptConfig, base: Box<dyn BaseAlgorithm>) -> Result<Self> {
        config.validate()?;
        Ok(Epopt { config, base, iterations: 0 })
    }
}

impl Algorithm for Epopt {
    fn collect_until(&self) -> CollectUntil {
        CollectUntil::Episodes(self.config.episodes_per_iteration)
    }

    /// Learns from the worst episodes of `rollout`, which must contain L complete episodes, see
    /// [`RolloutBuffer::episodes`].
    fn update(
        &mut self,
        policy: &mut TrainablePolicy,
        rollout: &RolloutBuffer,
        progress_remaining: f64,
    ) -> Result<UpdateStats> {
        let full = self.iterations < self.config.full_iterations;
        let epsilon = if full { 1.0 } else { self.config.epsilon };
        let episodes = rollout.episodes();
        let kept = match self.config.rank_by {
            Ranking::Raw => worst(episodes, &returns(episodes), epsilon),
            Ranking::Normalized => worst(episodes, &rollout.normalized_returns(), epsilon),
        };
        let selection = EpisodeSelection {
            epsilon,
            kept: kept.len() as u64,
            kept_steps: kept.iter().map(|episode| episode.length as u64).sum(),
            mean_return: mean_return(episodes),
            cvar: conditional_value_at_risk(episodes, self.config.epsilon),
        };
        let parts: Vec<&[EpisodeSlice]> =
            if self.config.update_per_episode { kept.chunks(1).collect() } else { vec![&kept] };
        let parts =
            parts.into_iter().map(|episodes| rollout.select(episodes)).collect::<Result<Vec<RolloutBuffer>>>()?;
        let mut stats = self.base.update_many(policy, &parts.iter().collect::<Vec<_>>(), progress_remaining)?;
        stats.selection = Some(selection);
        self.iterations += 1;
        Ok(stats)
    }

    fn state(&self) -> AlgorithmState {
        AlgorithmState { iterations: self.iterations, ..self.base.state() }
    }

    fn load_state(&mut self, state: &AlgorithmState) -> Result<()> {
        self.base.load_state(state)?;
        self.iterations = state.iterations;
        Ok(())
    }
}

/// Returns the episodes whose rank is at most the `epsilon`-percentile of `ranks`, in their original order. `ranks` has
/// a raw or normalised return for each episode; a lower one is worse.
fn worst(episodes: &[EpisodeSlice], ranks: &[f64], epsilon: f64) -> Vec<EpisodeSlice> {
    let mut sorted = ranks.to_vec();
    sorted.sort_by(f64::total_cmp);
    let threshold = percentile(&sorted, epsilon);
    episodes.iter().zip(ranks).filter(|(_, rank)| **rank <= threshold).map(|(episode, _)| *episode).collect()
}

fn returns(episodes: &[EpisodeSlice]) -> Vec<f64> {
    episodes.iter().map(|episode| episode.episode_return).collect()
}

/// Returns the `share`-percentile (0 to 1) of `sorted`, linearly interpolated between neighbours. It is never below the
/// minimum. Returns NaN for an empty list.
fn percentile(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let position = share * last as f64;
    let low = position.floor() as usize;
    let fraction = position.fract();
    if fraction == 0.0 { sorted[low] } else { sorted[low] + fraction * (sorted[low + 1] - sorted[low]) }
}

/// Returns the mean return of the ⌈share · L⌉ worst of L episodes. Unlike [`worst`], ties add no further episodes.
fn conditional_value_at_risk(episodes: &[EpisodeSlice], share: f64) -> f64 {
    let mut returns = returns(episodes);
    returns.sort_by(f64::total_cmp);
    returns.truncate((share * returns.len() as f64).ceil() as usize);
    returns.iter().sum::<f64>() / returns.len() as f64
}

fn mean_return(episodes: &[EpisodeSlice]) -> f64 {
    episodes.iter().map(|episode| episode.episode_return).sum::<f64>() / episodes.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn episodes(returns: &[f64]) -> Vec<EpisodeSlice> {
        let span = |(environment, &episode_return)| EpisodeSlice { environment, start: 0, length: 1, episode_return };
        returns.iter().enumerate().map(span).collect()
    }

    fn kept(returns: &[f64], epsilon: f64) -> Vec<usize> {
        worst(&episodes(returns), returns, epsilon).iter().map(|episode| episode.environment).collect()
    }

    #[test]
    fn percentiles_equal_those_of_numpy() {
        let sorted = [-3.0, 0.0, 1.0, 10.0];
        for (share, expected) in [(0.0, -3.0), (0.1, -2.1), (0.5, 0.5), (0.9, 7.3), (1.0, 10.0)] {
            assert!((percentile(&sorted, share) - expected).abs() < 1e-12, "rounding of a few f64 operations: {share}");
        }
    }

    #[test]
    fn worst_share_is_kept_in_order_with_all_ties() {
        let returns: Vec<f64> = (0..100).map(|i| f64::from((i * 37) % 100)).collect();
        let kept_returns: Vec<f64> =
            worst(&episodes(&returns), &returns, 0.1).iter().map(|e| e.episode_return).collect();
        assert_eq!(kept_returns.len(), 10);
        assert!(kept_returns.iter().all(|&r| r < 10.0));
        assert_eq!(kept(&[5.0, 1.0, 7.0, 0.0], 0.5), [1, 3]);
        assert_eq!(kept(&[5.0, 1.0, 7.0, 0.0], 1.0), [0, 1, 2, 3]);
        assert_eq!(kept(&[2.0; 4], 0.1), [0, 1, 2, 3], "none is worse than another");
        assert_eq!(kept(&[3.0], 0.1), [0]);
    }

    #[test]
    fn cvar_with_ties_has_no_further_episodes() {
        let returns: Vec<f64> = (0..100).map(|i| if i < 95 { 200.0 } else { 0.0 }).collect();
        assert_eq!(conditional_value_at_risk(&episodes(&returns), 0.1), 100.0);
        assert_eq!(conditional_value_at_risk(&episodes(&[3.0, 1.0, 2.0]), 0.5), 1.5);
        assert_eq!(conditional_value_at_risk(&episodes(&[3.0, 1.0, 2.0]), 1.0), 2.0);
    }
}
