//! Statistical comparison of conditions, such as two ways of training. It accounts for two sources of chance: the seeds
//! of the trainings and the episodes of the tests.

mod check;
mod scores;
mod table;
mod verdict;

use perturb_settings::ValueError;
use serde::{Deserialize, Serialize};

use crate::records::Records;
use crate::statistics::{
    Z_95, holm, mean, mean_with_t_interval, probability_of_improvement, t_test_p, wilson_of_share,
};
use scores::{TestScores, share_episodes};
pub use table::{TableCondition, compare_rows};

/// A condition to compare: a group of policies that differ only in their seed.
#[derive(Clone, Debug)]
pub struct ComparedCondition<'a> {
    /// The condition's name. It is freely chosen, but no two conditions may have the same name.
    pub name: String,
    /// The policies, each with a key and the recorded tests. Policies of two conditions with the same key form a pair.
    /// The key is, for example, the seed of the training.
    pub policies: Vec<(String, &'a Records)>,
}

/// A quantity of an episode. Conditions are compared by its mean over episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ComparedScore {
    /// 100 for a success and 0 for a failure, so that means are success rates in %.
    Success,
    /// The undiscounted return of the episode.
    Return,
    /// The number of steps of the episode.
    Length,
}

/// The mean score of a condition on one test set.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ConditionMean {
    /// The name of the condition.
    pub condition: String,
    /// The name of the test set.
    pub tested_on: String,
    /// The mean score of each policy, in the order of the condition's policies.
    pub by_seed: Vec<f64>,
    /// The mean of the policies' mean scores.
    pub mean: f64,
    /// The 95 % t interval of the mean over policies, [low, high]. It supports conclusions about other seeds. `None`
    /// with fewer than three policies.
    pub seeds_95: Option<[f64; 2]>,
    /// Number of episodes that each policy played; the smallest number if the numbers differ.
    pub episodes: usize,
    /// The 95 % interval of the mean over episodes, [low, high]. It supports conclusions about the same policies in
    /// other episodes. For returns and lengths it is a t interval. For success rates it is Wilson's interval with an
    /// effective number of episodes, because policies that play the same episodes are not independent. `None` if
    /// only the means of policies are known. For returns and lengths also `None` with fewer than three episodes.
    pub episodes_95: Option<[f64; 2]>,
}

/// The difference x − y between the mean scores of two conditions on one test set.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ConditionDifference {
    /// The name of condition x.
    pub x: String,
    /// The name of condition y.
    pub y: String,
    /// The name of the test set.
    pub tested_on: String,
    /// The number of policies of x and of y.
    pub seeds: [usize; 2],
    /// Whether each policy of x is paired with the policy of y that has the same key.
    pub paired: bool,
    /// The mean score of x minus the mean score of y.
    pub difference: f64,
    /// The difference of each pair, or empty if policies are not paired.
    pub by_seed: Vec<f64>,
    /// The 95 % interval of the difference over policies, [low, high]: a t interval over pairs, or Welch's interval if
    /// policies are not paired. `None` if either condition has fewer than three policies.
    pub seeds_95: Option<[f64; 2]>,
    /// The 95 % interval of the difference over episodes, [low, high]. `None` if only the means of policies are
    /// known. If `same_episodes` is true, also `None` with fewer than three episodes.
    pub episodes_95: Option<[f64; 2]>,
    /// Whether all policies of both conditions played the same episodes. If so, `episodes_95` is computed from the
    /// difference in each episode.
    pub same_episodes: bool,
    /// The probability, 0 … 1, that a policy of x has a higher mean score than a policy of y, if both are drawn at
    /// random from their conditions.
    pub improvement: f64,
    /// The p-value of the difference: by the t test over pairs, or by Welch's test if policies are not paired. `None`
    /// if `seeds_95` is `None`.
    pub p: Option<f64>,
    /// The value of `p` after Holm's correction for all differences of the comparison.
    pub p_holm: Option<f64>,
    /// The result in words.
    pub verdict: String,
}

/// The result of comparing conditions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ConditionComparison {
    /// The compared quantity.
    pub score: ComparedScore,
    /// The mean of each condition on each test set, ordered by test set, then condition.
    pub means: Vec<ConditionMean>,
    /// The differences between pairs of conditions, ordered by test set, then pair.
    pub differences: Vec<ConditionDifference>,
    /// The result of the whole comparison in words.
    pub verdict: String,
    /// Whether the tests are rows of a results table, which have counts and means instead of episodes. Then only
    /// success rates have an interval over episodes.
    pub from_counts: bool,
}

/// Compares the scores of conditions on each of the test sets `sets`. With a `baseline`, compares every other condition
/// with the condition of this name. Otherwise compares every pair of conditions.
///
/// # Errors
/// [`ValueError`] if a condition has no policies, two conditions have the same name, or the baseline is unknown. Also
/// if `sets` is empty, a policy was not tested on a set of `sets`, or environments, success rules or a set's parameters
/// differ between policies.
pub fn compare(
    conditions: &[ComparedCondition<'_>],
    sets: &[String],
    score: ComparedScore,
    baseline: Option<&str>,
) -> Result<ConditionComparison, ValueError> {
    let names: Vec<_> = conditions.iter().map(|it| (it.name.as_str(), it.policies.len())).collect();
    check::names(&names, baseline)?;
    check::records(conditions, sets)?;
    Ok(compared(sets, score, baseline, |set| conditions.iter().map(|it| condition_tested_on(it, set, score)).collect()))
}

/// Compares conditions on each test set of `sets`. `tested` returns the scores of all conditions on a test set.
fn compared<'a>(
    sets: &[String],
    score: ComparedScore,
    baseline: Option<&str>,
    tested: impl Fn(&str) -> Vec<TestedCondition<'a>>,
) -> ConditionComparison {
    let (mut means, mut differences) = (Vec::new(), Vec::new());
    for set in sets {
        let tested = tested(set);
        means.extend(tested.iter().map(|condition| condition.mean(set, score)));
        let pairs: Vec<[usize; 2]> = match baseline.and_then(|name| tested.iter().position(|it| it.name == name)) {
            Some(y) => (0..tested.len()).filter(|x| *x != y).map(|x| [x, y]).collect(),
            None => (0..tested.len()).flat_map(|x| (0..x).map(move |y| [x, y])).collect(),
        };
        differences.extend(pairs.into_iter().map(|[x, y]| difference(&tested[x], &tested[y], set)));
    }
    // Applies Holm's correction for multiple comparisons to all p-values.
    let known: Vec<f64> = differences.iter().filter_map(|it| it.p).collect();
    let mut corrected = holm(&known).into_iter();
    for it in &mut differences {
        it.p_holm = it.p.and_then(|_| corrected.next());
    }
    let compared = known.len();
    for it in &mut differences {
        it.verdict = verdict::of_difference(it, score, compared);
    }
    let verdict = verdict::of_all(&differences, score, compared);
    ConditionComparison { score, means, differences, verdict, from_counts: false }
}

/// The scores of a condition's policies on one test set.
struct TestedCondition<'a> {
    name: &'a str,
    /// The keys that pair policies.
    keys: Vec<String>,
    policies: Vec<TestScores>,
}

fn condition_tested_on<'a>(
    condition: &'a ComparedCondition<'_>,
    set: &str,
    score: ComparedScore,
) -> TestedCondition<'a> {
    TestedCondition {
        name: &condition.name,
        keys: condition.policies.iter().map(|(key, _)| key.clone()).collect(),
        policies: condition.policies.iter().map(|(_, records)| TestScores::of_records(records, set, score)).collect(),
    }
}

impl TestedCondition<'_> {
    fn by_seed(&self) -> Vec<f64> {
        self.policies.iter().map(|policy| policy.mean).collect()
    }

    /// Returns the scores of episodes in independent groups. If all policies played the same episodes, there is one
    /// group: the mean score over policies for each episode. Otherwise each policy's scores are a group. Returns `None`
    /// if only the means of policies are known.
    fn strata(&self) -> Option<Vec<Vec<f64>>> {
        if self.policies.iter().any(|policy| policy.values.is_empty()) {
            return None;
        }
        if share_episodes(&self.policies) {
            return Some(vec![scores::mean_by_episode(&self.policies)]);
        }
        Some(self.policies.iter().map(|policy| policy.values.clone()).collect())
    }

    fn mean(&self, set: &str, score: ComparedScore) -> ConditionMean {
        let by_seed = self.by_seed();
        let strata = self.strata();
        let mean = mean(by_seed.iter().copied());
        let seeds_95 = mean_with_t_interval(std::slice::from_ref(&by_seed)).and_then(|it| it.interval_95);
        ConditionMean {
            condition: self.name.to_owned(),
            tested_on: set.to_owned(),
            mean,
            seeds_95: seeds_95.map(|interval| match score {
                ComparedScore::Success => interval.map(|end| end.clamp(0.0, 100.0)),
                ComparedScore::Return | ComparedScore::Length => interval,
            }),
            by_seed,
            episodes: self.policies.iter().map(|policy| policy.episodes).min().unwrap_or(0),
            episodes_95: strata.and_then(|strata| match score {
                ComparedScore::Success => Some(success_interval(mean, &strata)),
                ComparedScore::Return | ComparedScore::Length => {
                    mean_with_t_interval(&strata).and_then(|it| it.interval_95)
                }
            }),
        }
    }
}

/// Returns Wilson's interval of the success rate `percent`, in %. Uses an effective number of episodes: the number of
/// independent episodes whose success rate would have the same variance as the mean over `strata`.
fn success_interval(percent: f64, strata: &[Vec<f64>]) -> [f64; 2] {
    let share = percent / 100.0;
    let count: usize = strata.iter().map(Vec::len).sum();
    let variance = scores::variance_of_mean(strata) / 1e4;
    let n = if variance > 0.0 { share * (1.0 - share) / variance } else { count as f64 };
    let (low, high) = wilson_of_share(share, n);
    [100.0 * low, 100.0 * high]
}

fn difference(x: &TestedCondition<'_>, y: &TestedCondition<'_>, set: &str) -> ConditionDifference {
    let [of_x, of_y] = [x.by_seed(), y.by_seed()];
    let pairs = pairs(&x.keys, &y.keys);
    let by_seed: Vec<f64> = pairs.iter().flatten().map(|&[x, y]| of_x[x] - of_y[y]).collect();
    // Without pairs, the strata are the scores of x and the negated scores of y. The mean over these two strata is half
    // of the difference between x and y, so the ends of its interval are multiplied by 2.
    let (strata, scale) = match pairs {
        Some(_) => (vec![by_seed.clone()], 1.0),
        None => (vec![of_x.clone(), of_y.iter().map(|score| -score).collect()], 2.0),
    };
    let interval = mean_with_t_interval(&strata).and_then(|it| it.interval_95);
    // The interval over episodes: a t interval of the differences in each episode if all policies played the same
    // episodes, else an interval by the normal approximation.
    let all: Vec<TestScores> = x.policies.iter().chain(&y.policies).cloned().collect();
    let same_episodes = share_episodes(&all);
    let difference = mean(of_x.iter().copied()) - mean(of_y.iter().copied());
    let episodes_95 = if same_episodes {
        let [of_x, of_y] = [&x.policies, &y.policies].map(|policies| scores::mean_by_episode(policies));
        let by_episode: Vec<f64> = of_x.iter().zip(of_y).map(|(x, y)| x - y).collect();
        mean_with_t_interval(&[by_episode]).and_then(|it| it.interval_95)
    } else {
        x.strata().zip(y.strata()).map(|(x, y)| {
            let half = Z_95 * (scores::variance_of_mean(&x) + scores::variance_of_mean(&y)).sqrt();
            [difference - half, difference + half]
        })
    };
    ConditionDifference {
        x: x.name.to_owned(),
        y: y.name.to_owned(),
        tested_on: set.to_owned(),
        seeds: [of_x.len(), of_y.len()],
        paired: !by_seed.is_empty(),
        difference,
        by_seed,
        seeds_95: interval.map(|ends| ends.map(|end| scale * end)),
        episodes_95,
        same_episodes,
        improvement: probability_of_improvement(&[of_x], &[of_y]),
        p: t_test_p(&strata),
        p_holm: None,
        verdict: String::new(),
    }
}

/// Returns the pairs of equal keys, as an index into `x` and an index into `y`, in the order of `x`. Returns `None`
/// unless `x` and `y` have the same keys, each only once.
fn pairs(x: &[String], y: &[String]) -> Option<Vec<[usize; 2]>> {
    let distinct: std::collections::BTreeSet<&String> = x.iter().collect();
    if x.len() != y.len() || distinct.len() != x.len() {
        return None;
    }
    x.iter().enumerate().map(|(place, key)| Some([place, y.iter().position(|other| other == key)?])).collect()
}

#[cfg(test)]
mod tests;
