//! Figures over runs: means, deviations, interquartile means with bootstrap intervals.

use rand_chacha::ChaCha8Rng;

use perturb_policy::random::{Purpose, stream, uniform};

/// Mean and deviation over runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// Arithmetic mean.
    pub mean: f64,
    /// Standard deviation with n in the denominator, not n - 1: that is what the paper's tables hold. Its 0.06 ± 0.12 %
    /// over five runs of 1000 episodes can only be the rates 0.3, 0, 0, 0, 0, whose deviation with n - 1 were 0.13.
    /// `None` of a single run, which has none, and where it is not known.
    pub std: Option<f64>,
    /// How many there are.
    pub runs: usize,
}

impl Summary {
    /// Of `numbers`; `None` if there are none.
    pub fn of(numbers: &[f64]) -> Option<Self> {
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

/// An interquartile mean with its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Iqm {
    /// The mean of the middle half of all scores.
    pub iqm: f64,
    /// 2.5th and 97.5th percentile of the bootstrap; `None` if no environment has a second run.
    pub interval_95: Option<[f64; 2]>,
    /// Runs of each environment; of the one that has fewest, if they differ.
    pub runs: usize,
}

impl std::fmt::Display for Iqm {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.1}", self.iqm)?;
        self.interval_95.map_or(Ok(()), |[low, high]| write!(f, " [{low:.1}, {high:.1}]"))
    }
}

impl Iqm {
    /// Of `strata`, which are the scores of an environment's runs each; all scores count alike (Agarwal et al., 2021,
    /// arXiv:2108.13264, and rliable). The bootstrap draws runs anew within each environment, `resamples` times. `None`
    /// if there is no environment, or one without runs.
    pub fn of(strata: &[Vec<f64>], resamples: usize, seed: u64) -> Option<Self> {
        let runs = strata.iter().map(Vec::len).min().filter(|runs| *runs > 0)?;
        let mut scores: Vec<f64> = strata.concat();
        let iqm = interquartile_mean(&mut scores);
        if strata.iter().all(|runs| runs.len() == 1) {
            return Some(Self { iqm, interval_95: None, runs });
        }
        let mut rng = stream(seed, Purpose::Bootstrap);
        let mut means = Vec::with_capacity(resamples);
        for _ in 0..resamples {
            scores.clear();
            strata.iter().for_each(|runs| draw(runs, &mut rng, &mut scores));
            means.push(interquartile_mean(&mut scores));
        }
        means.sort_unstable_by(f64::total_cmp);
        Some(Self { iqm, interval_95: Some([percentile(&means, 2.5), percentile(&means, 97.5)]), runs })
    }
}

/// Adds as many of `runs` to `drawn` as there are, drawn with replacement.
fn draw(runs: &[f64], rng: &mut ChaCha8Rng, drawn: &mut Vec<f64>) {
    drawn.extend((0..runs.len()).map(|_| runs[(uniform(rng) * runs.len() as f64) as usize]));
}

/// The mean of what is left when the ⌊n/4⌋ lowest and the ⌊n/4⌋ highest of n numbers are taken away. Sorts them; NaN if
/// there are none.
pub fn interquartile_mean(numbers: &mut [f64]) -> f64 {
    numbers.sort_unstable_by(f64::total_cmp);
    let cut = numbers.len() / 4;
    let middle = &numbers[cut..numbers.len() - cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

/// The `percent`th percentile of sorted numbers, linear between neighbours, as numpy's default; NaN if there are none.
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

    #[test]
    fn the_deviation_is_the_papers() {
        // RL²-A2C on CartPole: 0.06 ± 0.12 % Interpolation over five runs of 1000 episodes.
        let summary = Summary::of(&[0.3, 0.0, 0.0, 0.0, 0.0]).unwrap();
        assert_eq!(
            (format!("{:.2} ± {:.2}", summary.mean, summary.std.unwrap()), summary.runs),
            ("0.06 ± 0.12".into(), 5)
        );
        assert_eq!(Summary::of(&[]), None);
        assert_eq!(Summary::of(&[7.0]).unwrap().to_string(), "7.0", "one run does not deviate from itself");
        assert_eq!(Summary::of(&[7.0, 7.0]).unwrap().to_string(), "7.0 ± 0.0");
    }

    #[test]
    fn percentiles_lie_between_neighbours() {
        let numbers = [10.0, 20.0, 40.0];
        assert_eq!([0.0, 25.0, 50.0, 75.0, 100.0].map(|p| percentile(&numbers, p)), [10.0, 15.0, 20.0, 30.0, 40.0]);
        assert_eq!(percentile(&[3.0], 97.5), 3.0);
        assert!(percentile(&[], 50.0).is_nan());
    }

    #[test]
    fn a_quarter_of_the_numbers_counts_at_neither_end() {
        assert_eq!(interquartile_mean(&mut [100.0, 1.0, 3.0, -50.0]), 2.0);
        assert_eq!(interquartile_mean(&mut [9.0, 0.0, 0.0]), 3.0, "of three none is taken away");
        assert_eq!(interquartile_mean(&mut [0.0, 10.0, 20.0, 30.0, 90.0]), 20.0);
        assert!(interquartile_mean(&mut []).is_nan());
    }

    #[test]
    fn an_environment_without_runs_leaves_nothing_to_say() {
        assert_eq!(Iqm::of(&[], 10, 1), None);
        assert_eq!(Iqm::of(&[vec![1.0], vec![]], 10, 1), None);
        let alone = Iqm::of(&[vec![5.0], vec![7.0]], 10, 1).unwrap();
        assert_eq!((alone.iqm, alone.interval_95), (6.0, None), "a run alone can only be drawn again");
        assert_eq!(alone.to_string(), "6.0");
        assert!(Iqm::of(&[vec![5.0], vec![7.0, 9.0]], 10, 1).unwrap().interval_95.is_some());
    }

    fn numbers(value: &serde_json::Value) -> Vec<f64> {
        value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
    }

    /// Against rliable itself (`tests/fixtures/make_iqm.py`).
    #[test]
    fn interquartile_means_and_intervals_are_rliables() {
        let fixture: serde_json::Value = serde_json::from_str(include_str!("../tests/fixtures/iqm.json")).unwrap();
        let cases = fixture["cases"].as_object().unwrap();
        assert_eq!(cases.len(), 4);
        for (name, case) in cases {
            let strata: Vec<Vec<f64>> = case["scores"].as_array().unwrap().iter().map(numbers).collect();
            let close = |got: f64, expected: f64, tolerance: f64| {
                assert!((got - expected).abs() <= tolerance, "{name}: {got} is not {expected}");
            };
            let ours = Iqm::of(&strata, 50_000, 1).unwrap();
            close(ours.iqm, case["iqm"].as_f64().unwrap(), 1e-9); // sums of a few dozen numbers up to 100
            for resample in case["resamples"].as_array().unwrap() {
                let chosen = resample["runs"].as_array().unwrap().iter().map(numbers);
                let mut scores: Vec<f64> = strata
                    .iter()
                    .zip(chosen)
                    .flat_map(|(runs, chosen)| chosen.into_iter().map(|run| runs[run as usize]))
                    .collect();
                close(interquartile_mean(&mut scores), resample["iqm"].as_f64().unwrap(), 1e-9);
            }
            // Own resamples: an end of an interval over 50,000 of them is uncertain by about a tenth of a point.
            for (got, expected) in ours.interval_95.unwrap().into_iter().zip(numbers(&case["interval_95"])) {
                close(got, expected, 0.5);
            }
        }
    }
}
