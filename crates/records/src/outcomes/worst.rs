//! Tail risk: results in the worst tenth of episodes and of test contexts.

use std::collections::BTreeMap;

use super::Outcomes;

/// The share of episodes or contexts that count as the worst: a tenth.
pub const SHARE: f64 = 0.1;
/// Minimum number of regions for which the worst tenth is computed.
const MIN_PARTS: usize = 10;

/// Returns the conditional value at risk: the mean of the ⌈`share` · n⌉ lowest of n returns (Rockafellar and Uryasev,
/// 2000). NaN if there are no returns.
pub fn conditional_value_at_risk(returns: &[f64], share: f64) -> f64 {
    let mut worst = returns.to_vec();
    worst.sort_unstable_by(f64::total_cmp);
    worst.truncate((share * worst.len() as f64).ceil() as usize);
    worst.iter().sum::<f64>() / worst.len() as f64
}

/// The numbers of successes and of episodes of a region. The region's episodes are divided into two halves, 0 and 1.
#[derive(Clone, Copy, Default)]
struct ContextGroup {
    successes: [f64; 2],
    episodes: [f64; 2],
}

impl ContextGroup {
    fn rate(&self, half: usize) -> f64 {
        self.successes[half] / self.episodes[half]
    }
}

/// Returns the success rate, in %, in the worst tenth of contexts. These are the regions of the parameter space with
/// the lowest success rates that together hold a tenth of the episodes.
///
/// The estimate is cross-fitted: if the same episodes ranked the regions and measured their success, a region with bad
/// luck would look like a bad region. Therefore the episodes of each region alternate between two halves. One half
/// ranks the regions, and the other measures success in the worst of them. The result is the average over both
/// assignments. Regions with equal rates are weighted equally. Because a half may rank regions wrongly, the true rate
/// may be lower than the estimate, but it is never systematically higher.
///
/// `None` if fewer than ten regions have at least two episodes, for example because all parameters are fixed.
pub fn worst_contexts(outcomes: &Outcomes) -> Option<f64> {
    // For each region: the counts of both halves, and the number of episodes so far. The episodes of a region alternate
    // between half 0 and half 1.
    let mut parts: BTreeMap<usize, (ContextGroup, usize)> = BTreeMap::new();
    for (part, success) in outcomes.parts().into_iter().zip(&outcomes.successes) {
        let (part, seen) = parts.entry(part).or_default();
        part.episodes[*seen % 2] += 1.0;
        part.successes[*seen % 2] += f64::from(u8::from(*success));
        *seen += 1;
    }
    let mut parts: Vec<ContextGroup> =
        parts.into_values().filter(|(_, seen)| *seen > 1).map(|(part, _)| part).collect();
    if parts.len() < MIN_PARTS {
        return None;
    }
    // Ranks the regions by their success rate in one half of the episodes, and measures success in the other half.
    // `chooses` is the number of the half that ranks, 0 or 1.
    let mut one_way = |chooses: usize| {
        parts.sort_by(|a, b| a.rate(chooses).total_cmp(&b.rate(chooses)));
        worst_success_rate(&parts, chooses)
    };
    // Averages both assignments of the halves, and converts the result to %.
    Some(50.0 * (one_way(0) + one_way(1)))
}

/// Returns the success rate, 0 … 1, in the worst tenth of the regions `parts`. The episodes of half `chooses`, 0 or 1,
/// determine which regions are worst. The returned rate is measured in the other half. `parts` must be sorted by the
/// success rate in half `chooses`.
fn worst_success_rate(parts: &[ContextGroup], chooses: usize) -> f64 {
    let judges = 1 - chooses;
    let mut wanted = SHARE * parts.iter().map(|part| part.episodes[chooses]).sum::<f64>();
    let (mut successes, mut episodes) = (0.0, 0.0);
    for equal in parts.chunk_by(|a, b| a.rate(chooses) == b.rate(chooses)) {
        let there: f64 = equal.iter().map(|part| part.episodes[chooses]).sum();
        let taken = (wanted / there).clamp(0.0, 1.0);
        successes += taken * equal.iter().map(|part| part.successes[judges]).sum::<f64>();
        episodes += taken * equal.iter().map(|part| part.episodes[judges]).sum::<f64>();
        wanted -= there;
    }
    successes / episodes
}

#[cfg(test)]
mod tests {
    use perturb_policy::random::{Purpose, stream, uniform};

    use super::*;

    /// Returns `episodes` episodes in each of `contexts` contexts. `success` decides from the context and the episode's
    /// number whether an episode is a success.
    fn outcomes(contexts: usize, episodes: usize, mut success: impl FnMut(usize, usize) -> bool) -> Outcomes {
        let all = || (0..episodes).flat_map(|episode| (0..contexts).map(move |context| (context, episode)));
        Outcomes {
            contexts: Some(all().map(|(context, _)| context).collect()),
            successes: all().map(|(context, episode)| success(context, episode)).collect(),
            returns: all().map(|(context, _)| context as f64).collect(),
            ..Outcomes::default()
        }
    }

    #[test]
    fn the_worst_tenth_of_returns_is_rounded_up() {
        let returns: Vec<f64> = (0..25).map(f64::from).rev().collect();
        assert_eq!(conditional_value_at_risk(&returns, 0.1), 1.0, "0, 1 and 2");
        assert_eq!(conditional_value_at_risk(&[5.0], 0.1), 5.0);
        assert!(conditional_value_at_risk(&[], 0.1).is_nan());
    }

    #[test]
    fn the_worst_contexts_are_found_and_parts_of_them_count_in_part() {
        // Two of 20 contexts always fail. They are the worst tenth.
        assert_eq!(worst_contexts(&outcomes(20, 10, |context, _| context != 3 && context != 17)), Some(0.0));
        // One of 20 contexts always fails. The worst tenth is two contexts, so the other one of them always succeeds.
        assert_eq!(worst_contexts(&outcomes(20, 10, |context, _| context != 3)), Some(50.0));
        // Context c succeeds in its first c + 1 episodes. In episodes 0, 2, … contexts 0 and 1 are equally bad. In the
        // other episodes they have 0 and 1 successes of 5. In episodes 1, 3, … context 0 is the worst. In the other
        // episodes it has 1 success of 5.
        let rate = worst_contexts(&outcomes(10, 10, |context, episode| episode <= context)).unwrap();
        assert!((rate - (10.0 + 20.0) / 2.0).abs() < 1e-9, "{rate}");
    }

    /// All contexts are alike. If the same episodes ranked the contexts and measured success, the worst tenth would
    /// look far worse: with 20 episodes each, the rates are 0.5 ± 0.11, and the two lowest of 20 rates lie about 0.19
    /// below 0.5. The mean of 40 repetitions with 40 episodes each has a standard error of 0.0125.
    #[test]
    fn bad_luck_is_not_taken_for_bad_contexts() {
        let mut rng = stream(1, Purpose::TestEnvironments);
        let rates: Vec<f64> =
            (0..40).map(|_| worst_contexts(&outcomes(20, 20, |_, _| uniform(&mut rng) < 0.5)).unwrap()).collect();
        let mean = rates.iter().sum::<f64>() / 40.0;
        assert!((mean - 50.0).abs() < 5.0, "{mean}");
    }

    #[test]
    fn few_contexts_have_no_tenth() {
        assert_eq!(worst_contexts(&outcomes(9, 100, |_, _| true)), None);
        assert_eq!(worst_contexts(&outcomes(100, 1, |_, _| true)), None, "nothing is left to judge by");
        assert_eq!(worst_contexts(&Outcomes::default()), None);
    }
}
