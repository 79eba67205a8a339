//! Confidence intervals and significance tests for means, by Student's t distribution.
//!
//! With few runs, a percentile bootstrap gives intervals that are too narrow. On normal data from one environment, its
//! 95 % interval of a mean covers the true value in 73 % of the cases with three runs, and in 84 % with five. The t
//! interval covers it in 95 %.

use statrs::distribution::{ContinuousCDF, StudentsT};

use super::{Bootstrapped, MIN_RUNS_FOR_INTERVAL, mean};

/// Returns the mean over `strata`, all with the same weight, and its 95 % t interval.
///
/// `strata` has the scores `[environments][runs]`. The variance of the mean is the sum of the variances of the
/// environments' means, with degrees of freedom after Welch and Satterthwaite (Satterthwaite, 1946). The interval is
/// `None` if an environment has fewer than [`MIN_RUNS_FOR_INTERVAL`] runs. Returns `None` if there are no environments,
/// or if one has no runs.
pub fn mean_with_t_interval(strata: &[Vec<f64>]) -> Option<Bootstrapped> {
    let runs = strata.iter().map(Vec::len).min().filter(|runs| *runs > 0)?;
    let point = mean(strata.iter().map(|runs| mean(runs.iter().copied())));
    let half_width = (runs >= MIN_RUNS_FOR_INTERVAL).then(|| half_width(strata));
    Some(Bootstrapped { point, interval_95: half_width.map(|half| [point - half, point + half]), runs })
}

/// Returns the two-sided p-value of Student's t test of the hypothesis that the mean over `strata` is 0. Standard error
/// and degrees of freedom are those of [`mean_with_t_interval`]. `None` if there is no interval.
///
/// For a paired test, pass one stratum with the differences of the pairs. For Welch's test, pass the scores of one
/// condition and the negated scores of the other. If all scores of each stratum are equal, returns 1 if the mean is 0,
/// else 0.
pub fn t_test_p(strata: &[Vec<f64>]) -> Option<f64> {
    let mean = mean_with_t_interval(strata).filter(|mean| mean.interval_95.is_some())?.point;
    let (error, freedom) = standard_error(strata);
    if error == 0.0 {
        return Some(f64::from(u8::from(mean == 0.0)));
    }
    let beyond = |t: StudentsT| 2.0 * t.sf((mean / error).abs());
    Some(StudentsT::new(0.0, 1.0, freedom).map_or(f64::NAN, beyond))
}

fn half_width(strata: &[Vec<f64>]) -> f64 {
    let (error, freedom) = standard_error(strata);
    if error == 0.0 {
        return 0.0; // all runs of each stratum are equal
    }
    StudentsT::new(0.0, 1.0, freedom).map_or(f64::NAN, |t| t.inverse_cdf(0.975)) * error
}

/// Returns the standard error of the mean over `strata` and its degrees of freedom.
fn standard_error(strata: &[Vec<f64>]) -> (f64, f64) {
    let count = strata.len() as f64;
    let (mut variance, mut by_freedom) = (0.0, 0.0);
    for runs in strata {
        let (n, center) = (runs.len() as f64, mean(runs.iter().copied()));
        let squares: f64 = runs.iter().map(|run| (run - center).powi(2)).sum();
        let of_mean = squares / (n - 1.0) / n / (count * count);
        variance += of_mean;
        by_freedom += of_mean * of_mean / (n - 1.0);
    }
    (variance.sqrt(), variance * variance / by_freedom)
}

#[cfg(test)]
mod tests {
    use perturb_policy::random::{Purpose, stream, uniform};

    use super::*;

    fn ends(strata: &[Vec<f64>]) -> [f64; 2] {
        mean_with_t_interval(strata).unwrap().interval_95.unwrap()
    }

    /// The expected intervals are those of R's `t.test(c(1, 2, 4))` and `t.test(c(1, 2, 4, 7, 9))`.
    #[test]
    fn one_environment_has_the_textbook_interval() {
        for (runs, expected) in
            [(vec![1.0, 2.0, 4.0], [-1.461_250, 6.127_917]), (vec![1.0, 2.0, 4.0, 7.0, 9.0], [0.426_088, 8.773_912])]
        {
            let got = ends(&[runs]);
            assert!(got.iter().zip(expected).all(|(got, expected)| (got - expected).abs() < 1e-5), "{got:?}");
        }
    }

    #[test]
    fn fewer_than_three_runs_have_no_interval() {
        let interval = |strata: &[Vec<f64>]| mean_with_t_interval(strata).unwrap().interval_95;
        assert_eq!(interval(&[vec![1.0, 2.0]]), None);
        assert_eq!(interval(&[vec![1.0, 2.0, 3.0], vec![1.0, 2.0]]), None);
        assert_eq!(mean_with_t_interval(&[]), None);
        assert_eq!(mean_with_t_interval(&[vec![1.0], vec![]]), None);
        assert_eq!(ends(&[vec![100.0; 3]]), [100.0, 100.0]);
    }

    /// The expected values are the areas under the tails of the t distribution. With 2 degrees of freedom, the area is
    /// 1 - t / √(2 + t²). With Welch's 4.03 degrees, the area was computed by Simpson's rule.
    #[test]
    fn p_values_are_those_of_the_textbook_tests() {
        let close = |got: Option<f64>, expected: f64| assert!((got.unwrap() - expected).abs() < 1e-5, "{got:?}");
        close(t_test_p(&[vec![1.0, 2.0, 4.0]]), 0.118_083);
        close(t_test_p(&[vec![1.0, 2.0, 4.0, 7.0], vec![0.0, 1.0, -1.0]]), 0.071_872);
        assert_eq!(t_test_p(&[vec![1.0, 2.0]]), None);
        assert_eq!([t_test_p(&[vec![0.0; 3]]), t_test_p(&[vec![5.0; 3]])], [Some(1.0), Some(0.0)]);
    }

    /// Draws 4 000 samples of three runs. Each run is the sum of 48 uniform numbers, which is nearly normal. The
    /// interval must cover the mean in 95 ± 1.4 % of the samples (four standard errors).
    #[test]
    fn three_runs_cover_the_mean_in_95_percent() {
        let mut rng = stream(1, Purpose::Bootstrap);
        let mut normal = || (0..48).map(|_| uniform(&mut rng)).sum::<f64>() - 24.0;
        let covered = (0..4000).filter(|_| {
            let [low, high] = ends(&[(0..3).map(|_| normal()).collect()]);
            (low..=high).contains(&0.0)
        });
        let covered = covered.count() as f64 / 4000.0;
        assert!((covered - 0.95).abs() < 0.014, "{covered}");
    }
}
