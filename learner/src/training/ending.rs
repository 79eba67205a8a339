//! Decides when a training ends: at its budget, or at a success rate.

use perturb_checkpoint::Counters;
use perturb_settings::Common;

use crate::logging::EpisodeFigures;

/// Number of recent episodes over which means are taken, as in stable-baselines3.
pub(super) const RECENT: usize = 100;

/// Returns whether a training has used up its budget, or has reached the success rate `stop_at_success` in its last 100
/// episodes. `recent` are these episodes; with fewer than 100, only the budget counts.
pub fn is_over<'a>(
    common: &Common,
    counters: &Counters,
    recent: impl ExactSizeIterator<Item = &'a EpisodeFigures>,
) -> bool {
    let is_known = common.stop_at_success > 0.0 && recent.len() == RECENT;
    let successes: f64 = recent.map(|episode| episode.success).sum();
    counters.episodes >= common.episodes || (is_known && 100.0 * successes >= common.stop_at_success * RECENT as f64)
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;
    use perturb_settings::TrainConfig;

    #[rstest]
    #[case(0.0, 300, 100, 100, false, "nothing to stop at")]
    #[case(95.0, 300, 95, 100, true, "reached exactly")]
    #[case(95.0, 300, 94, 100, false, "one too few")]
    #[case(95.0, 300, 99, 99, false, "too few episodes to tell")]
    #[case(95.0, 500, 0, 100, true, "the budget is used up")]
    fn a_training_is_over_by_its_budget_or_its_successes(
        #[case] stop_at_success: f64,
        #[case] episodes: u64,
        #[case] successes: usize,
        #[case] known: usize,
        #[case] over: bool,
        #[case] why: &str,
    ) {
        let sets = ["environment=CartPole".into(), "episodes=500".into(), format!("stop_at_success={stop_at_success}")];
        let config = TrainConfig::load(None, &sets, Default::default()).unwrap();
        let of = |success: f64| EpisodeFigures { episode_return: 0.0, length: 0.0, success };
        let recent: Vec<_> = (0..known).map(|i| of(if i < successes { 1.0 } else { 0.0 })).collect();
        let counters = Counters { episodes, ..Default::default() };
        assert_eq!(is_over(&config.common, &counters, recent.iter()), over, "{why}");
    }
}
