//! Success rates in bins of a parameter's values.

use super::Outcomes;
use crate::statistics::wilson;

/// Number of bins over the range of a parameter, if its values have no gaps.
const BINS: f64 = 10.0;

/// An interval of parameter values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bin {
    /// The lower end, which belongs to the bin.
    pub low: f64,
    /// The upper end. It belongs to the next bin, or to this bin if no bin follows directly.
    pub high: f64,
}

/// A number of episodes and the number of successes among them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SuccessCount {
    /// The number of successful episodes.
    pub successes: u64,
    /// The number of all episodes.
    pub episodes: u64,
}

impl SuccessCount {
    /// Returns the success rate, in %; NaN if there are no episodes.
    pub fn rate(self) -> f64 {
        100.0 * self.successes as f64 / self.episodes as f64
    }

    /// Returns the 95 % interval of [`SuccessCount::rate`] after Wilson (1927), [low, high] in %.
    pub fn interval(self) -> [f64; 2] {
        let (low, high) = wilson(self.successes, self.episodes);
        [100.0 * low, 100.0 * high]
    }

    /// Returns [`SuccessCount::interval`], or `None` if there are no episodes.
    pub fn known(self) -> Option<[f64; 2]> {
        (self.episodes > 0).then(|| self.interval())
    }
}

impl std::iter::Sum for SuccessCount {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), |a, b| Self {
            successes: a.successes + b.successes,
            episodes: a.episodes + b.episodes,
        })
    }
}

/// Divides the range of the parameter with index `place` in `tests` into about ten equal bins. A gap wider than
/// a tenth of the range belongs to no bin; version E (extreme) has such a gap between its two intervals. Returns no
/// bins if the parameter does not vary.
pub fn bins<'a>(tests: impl Iterator<Item = &'a Outcomes>, place: usize) -> Vec<Bin> {
    let values = tests.filter_map(|outcomes| outcomes.parameters.get(place)).flatten();
    let mut values: Vec<f64> = values.copied().filter(|value| value.is_finite()).collect();
    values.sort_unstable_by(f64::total_cmp);
    let range = values.last().zip(values.first()).map_or(0.0, |(high, low)| high - low);
    if range == 0.0 {
        return Vec::new();
    }
    let width = range / BINS;
    let of_interval = |values: &[f64]| {
        let (low, high) = (values[0], values[values.len() - 1]);
        let count = ((high - low) / width).round().max(1.0) as usize;
        let edge = move |index: usize| {
            if index == count { high } else { low + (high - low) * index as f64 / count as f64 }
        };
        (0..count).map(move |index| Bin { low: edge(index), high: edge(index + 1) })
    };
    values.chunk_by(|a, b| b - a < width).flat_map(of_interval).collect()
}

/// Counts the episodes and successes of `outcomes` in each of the `bins` of the parameter with index `place`.
pub fn success_within(outcomes: &Outcomes, place: usize, bins: &[Bin]) -> Vec<SuccessCount> {
    let mut counted = vec![SuccessCount::default(); bins.len()];
    let values = outcomes.parameters.get(place).into_iter().flatten();
    for (value, success) in values.zip(&outcomes.successes) {
        if let Some(bin) = counted.get_mut(bin_of(*value, bins)) {
            bin.episodes += 1;
            bin.successes += u64::from(*success);
        }
    }
    counted
}

/// Counts the episodes and successes of `outcomes` for each pair of bins of the two parameters with the indices `x` and
/// `y`. Returns the counts `[Y, X]` as one array. The array is empty if one of the parameters does not vary.
pub fn success_within_both(
    outcomes: &Outcomes,
    [x, y]: [usize; 2],
    [over_x, over_y]: [&[Bin]; 2],
) -> Vec<SuccessCount> {
    let mut counted = vec![SuccessCount::default(); over_x.len() * over_y.len()];
    let values = |place: usize| outcomes.parameters.get(place).into_iter().flatten();
    for ((x, y), success) in values(x).zip(values(y)).zip(&outcomes.successes) {
        if let Some(cell) = counted.get_mut(bin_of(*y, over_y) * over_x.len() + bin_of(*x, over_x)) {
            cell.episodes += 1;
            cell.successes += u64::from(*success);
        }
    }
    counted
}

/// Returns the index of the bin that contains `value`.
fn bin_of(value: f64, bins: &[Bin]) -> usize {
    bins.partition_point(|bin| bin.low <= value).saturating_sub(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns four episodes. The first parameter is always 1, and the second one varies. Only the episode at 0.95
    /// fails.
    fn outcomes() -> Outcomes {
        Outcomes {
            parameters: vec![vec![1.0; 4], vec![0.15, 0.95, 1.0, 0.0]],
            returns: vec![0.0; 4],
            successes: vec![true, false, true, true],
            contexts: None,
        }
    }

    #[test]
    fn an_episode_counts_in_the_bin_of_its_parameter() {
        let spread = Outcomes { parameters: vec![(0..=100).map(f64::from).collect()], ..Outcomes::default() };
        let even = bins([&spread].into_iter(), 0);
        assert_eq!((even.len(), even[0], even[9]), (10, Bin { low: 0.0, high: 10.0 }, Bin { low: 90.0, high: 100.0 }));
        // The values lie in two intervals, 0 … 0.3 and 0.8 … 1. They are divided into bins of width 0.1, with no bin in
        // the gap.
        let tenth = |from: u32, to: u32| (from..=to).map(|value| f64::from(value) / 100.0).collect::<Vec<_>>();
        let gap = Outcomes { parameters: vec![Vec::new(), [tenth(0, 30), tenth(80, 100)].concat()], ..outcomes() };
        let bins = bins([&gap].into_iter(), 1);
        let edges: Vec<(f64, f64)> = bins.iter().map(|bin| (bin.low, bin.high)).collect();
        assert_eq!((edges.len(), edges[0].0, edges[2].1, edges[3].0, edges[4].1), (5, 0.0, 0.3, 0.8, 1.0));
        let counted = success_within(&outcomes(), 1, &bins);
        let of = |bin: usize| (counted[bin].successes, counted[bin].episodes);
        assert_eq!([0, 1, 2, 3, 4].map(of), [(1, 1), (1, 1), (0, 0), (0, 0), (1, 2)], "0.95 fails");
        assert!(super::bins([&outcomes()].into_iter(), 0).is_empty(), "it does not vary");
        assert_eq!(counted.into_iter().sum::<SuccessCount>(), SuccessCount { successes: 3, episodes: 4 });
    }
}
