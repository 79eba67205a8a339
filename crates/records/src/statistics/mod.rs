//! Statistics over runs: means, standard deviations, paired comparisons, and the aggregates with bootstrap intervals
//! that Agarwal et al. (2021, arXiv:2108.13264) recommend.
//!
//! Runs are grouped in strata: a stratum holds the scores of all runs in one environment. The aggregates and their
//! bootstrap agree with the Python library rliable on the same data, which `rliable_tests.rs` checks.

mod aggregates;
mod bootstrap;
mod means;
mod paired;
mod t_interval;

pub use aggregates::{interquartile_mean, optimality_gap, probability_of_improvement, profile};
pub use bootstrap::{Bootstrapped, MIN_RUNS_FOR_INTERVAL, bootstrap, percentile_interval, resample};
pub(crate) use means::Z_95;
pub use means::{geometric_mean, mean, wilson, wilson_of_share};
pub use paired::{holm, sign_flip_p};
pub use t_interval::{mean_with_t_interval, t_test_p};

/// Mean and standard deviation over runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// Arithmetic mean.
    pub mean: f64,
    /// Population standard deviation (divided by n, not n - 1), as in the paper's tables. The paper does not state the
    /// divisor, but it gives 0.06 ± 0.12 % for five runs of 1000 episodes. The rates of these runs must be 0.3, 0, 0, 0
    /// and 0 %, and division by n - 1 would give 0.13 %. `None` for a single run, or if unknown.
    pub std: Option<f64>,
    /// The number of runs.
    pub runs: usize,
}

impl Summary {
    /// Returns the mean and standard deviation of `numbers`; `None` if there are none.
    pub fn from_values(numbers: &[f64]) -> Option<Self> {
        if numbers.is_empty() {
            return None;
        }
        let n = numbers.len() as f64;
        let mean = numbers.iter().sum::<f64>() / n;
        let variance = numbers.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
        Some(Self { mean, std: (numbers.len() > 1).then_some(variance.sqrt()), runs: numbers.len() })
    }
}

impl std::fmt::Display for Summary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.1}", self.mean)?;
        self.std.map_or(Ok(()), |std| write!(f, " ± {std:.1}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_deviation_is_the_papers() {
        // The paper's value for RL²-A2C on CartPole: 0.06 ± 0.12 % Interpolation over five runs of 1000 episodes.
        let summary = Summary::from_values(&[0.3, 0.0, 0.0, 0.0, 0.0]).unwrap();
        assert_eq!(
            (format!("{:.2} ± {:.2}", summary.mean, summary.std.unwrap()), summary.runs),
            ("0.06 ± 0.12".into(), 5)
        );
        assert_eq!(Summary::from_values(&[]), None);
        assert_eq!(Summary::from_values(&[7.0]).unwrap().to_string(), "7.0", "one run does not deviate from itself");
        assert_eq!(Summary::from_values(&[7.0, 7.0]).unwrap().to_string(), "7.0 ± 0.0");
    }
}

#[cfg(test)]
mod rliable_tests;
