//! Stratified bootstrap with percentile intervals.

use perturb_policy::random::{Purpose, stream, uniform};

/// Minimum number of runs in each environment for which an interval is computed.
pub const MIN_RUNS_FOR_INTERVAL: usize = 3;

/// A statistic with its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bootstrapped {
    /// The value of the statistic.
    pub point: f64,
    /// The 95 % interval, [low, high]. `None` with fewer than [`MIN_RUNS_FOR_INTERVAL`] runs.
    pub interval_95: Option<[f64; 2]>,
    /// Number of runs in each environment; the smallest number if the numbers differ.
    pub runs: usize,
}

impl std::fmt::Display for Bootstrapped {
    /// Formats the value and the interval with the requested number of decimals, by default 1.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let digits = f.precision().unwrap_or(1);
        // Adding 0 turns -0.0 into 0.0.
        write!(f, "{:.digits$}", self.point + 0.0)?;
        self.interval_95.map_or(Ok(()), |[low, high]| write!(f, " [{:.digits$}, {:.digits$}]", low + 0.0, high + 0.0))
    }
}

impl Bootstrapped {
    /// Computes a single `statistic` of `strata`, see [`bootstrap`].
    pub fn new(
        strata: &[Vec<f64>],
        resamples: usize,
        seed: u64,
        statistic: impl Fn(&[Vec<f64>]) -> f64,
    ) -> Option<Self> {
        bootstrap(strata, resamples, seed, |strata| vec![statistic(strata)])?.pop()
    }
}

/// Computes the numbers that `statistic` returns for `strata`, each with its percentile interval. The interval is
/// computed from `resamples` resamples. The statistic must always return the same number of values. Returns `None` if
/// there are no strata, or if a stratum has no runs.
pub fn bootstrap(
    strata: &[Vec<f64>],
    resamples: usize,
    seed: u64,
    statistic: impl Fn(&[Vec<f64>]) -> Vec<f64>,
) -> Option<Vec<Bootstrapped>> {
    let runs = strata.iter().map(Vec::len).min().filter(|runs| *runs > 0)?;
    let points = statistic(strata);
    if strata.iter().all(|runs| runs.len() == 1) {
        return Some(points.into_iter().map(|point| Bootstrapped { point, interval_95: None, runs }).collect());
    }
    let sizes: Vec<usize> = strata.iter().map(Vec::len).collect();
    let mut drawn = strata.to_vec();
    let mut estimates = vec![Vec::with_capacity(resamples); points.len()];
    resample(&sizes, resamples, seed, |draws| {
        for ((drawn, scores), draws) in drawn.iter_mut().zip(strata).zip(draws) {
            drawn.iter_mut().zip(draws).for_each(|(drawn, &run)| *drawn = scores[run]);
        }
        estimates.iter_mut().zip(statistic(&drawn)).for_each(|(estimates, number)| estimates.push(number));
    });
    let with_interval = |(point, estimates)| {
        let interval_95 = (runs >= MIN_RUNS_FOR_INTERVAL).then(|| percentile_interval(estimates));
        Bootstrapped { point, interval_95, runs }
    };
    Some(points.into_iter().zip(estimates).map(with_interval).collect())
}

/// Draws `resamples` resamples, and calls `each` with every resample. A resample has the indices of the drawn runs by
/// stratum. The runs of a stratum are drawn with replacement, as many as it has. `sizes` has the number of runs of each
/// stratum, at least 1. The same seed draws the same runs.
pub fn resample(sizes: &[usize], resamples: usize, seed: u64, mut each: impl FnMut(&[Vec<usize>])) {
    let mut rng = stream(seed, Purpose::Bootstrap);
    let mut draws: Vec<Vec<usize>> = sizes.iter().map(|&size| vec![0; size]).collect();
    for _ in 0..resamples {
        for (draws, &size) in draws.iter_mut().zip(sizes) {
            draws.fill_with(|| (uniform(&mut rng) * size as f64) as usize);
        }
        each(&draws);
    }
}

/// Returns the 2.5th and the 97.5th percentile of `estimates`; NaN if there are none.
pub fn percentile_interval(mut estimates: Vec<f64>) -> [f64; 2] {
    estimates.sort_unstable_by(f64::total_cmp);
    [2.5, 97.5].map(|percent| percentile(&estimates, percent))
}

/// Returns the `percent`th percentile of sorted numbers, interpolated linearly between neighbours, as numpy does by
/// default. NaN if there are no numbers.
fn percentile(sorted: &[f64], percent: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let place = percent / 100.0 * last as f64;
    let below = (place as usize).min(last);
    let above = (below + 1).min(last);
    sorted[below] + (sorted[above] - sorted[below]) * (place - below as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean(strata: &[Vec<f64>]) -> f64 {
        strata.concat().iter().sum::<f64>() / strata.concat().len() as f64
    }

    #[test]
    fn percentiles_lie_between_neighbours() {
        let numbers = [10.0, 20.0, 40.0];
        assert_eq!([0.0, 25.0, 50.0, 75.0, 100.0].map(|p| percentile(&numbers, p)), [10.0, 15.0, 20.0, 30.0, 40.0]);
        assert_eq!(percentile(&[3.0], 97.5), 3.0);
        assert!(percentile(&[], 50.0).is_nan());
    }

    #[test]
    fn an_environment_without_runs_leaves_nothing_to_say() {
        assert_eq!(Bootstrapped::new(&[], 10, 1, mean), None);
        assert_eq!(Bootstrapped::new(&[vec![1.0], vec![]], 10, 1, mean), None);
        let two = Bootstrapped::new(&[vec![5.0; 3], vec![7.0, 9.0]], 10, 1, mean).unwrap();
        assert_eq!((two.interval_95, two.runs), (None, 2), "fewer than three runs have no interval");
        assert_eq!(two.to_string(), "6.2");
        let three = Bootstrapped::new(&[vec![5.0; 3], vec![7.0, 9.0, 8.0]], 10, 1, mean).unwrap();
        assert_eq!((three.interval_95.is_some(), three.runs), (true, 3));
    }

    #[test]
    fn runs_are_drawn_within_their_stratum_and_by_the_seed_alone() {
        let all = |seed| {
            let mut all = Vec::new();
            resample(&[2, 5], 200, seed, |draws| all.push(draws.to_vec()));
            all
        };
        let draws = all(3);
        assert!(draws == all(3) && draws != all(4));
        assert!(draws.iter().all(|draws| (draws[0].len(), draws[1].len()) == (2, 5)));
        let seen = |stratum: usize, run: usize| draws.iter().any(|draws| draws[stratum].contains(&run));
        assert!((0..2).all(|run| seen(0, run)) && (0..5).all(|run| seen(1, run)) && !seen(0, 2) && !seen(1, 5));
    }

    #[test]
    fn zero_has_no_sign() {
        let number = Bootstrapped { point: -0.01, interval_95: Some([-0.0, 0.26]), runs: 2 };
        assert_eq!(
            (format!("{number:.2}"), number.to_string()),
            ("-0.01 [0.00, 0.26]".into(), "-0.0 [0.0, 0.3]".into())
        );
    }
}
