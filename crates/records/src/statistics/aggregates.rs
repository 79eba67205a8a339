//! Aggregate metrics over all environments, as recommended by Agarwal et al. (2021, arXiv:2108.13264). `strata` are the
//! scores by environment, then run. All scores have the same weight unless stated otherwise.

/// Returns the interquartile mean: the mean of n scores without the ⌊n/4⌋ lowest and the ⌊n/4⌋ highest. NaN if there
/// are no scores.
pub fn interquartile_mean(strata: &[Vec<f64>]) -> f64 {
    let mut scores = strata.concat();
    scores.sort_unstable_by(f64::total_cmp);
    let cut = scores.len() / 4;
    let middle = &scores[cut..scores.len() - cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

/// Returns the mean of `target` minus score, where scores above the target count as the target. NaN if there are no
/// scores.
pub fn optimality_gap(strata: &[Vec<f64>], target: f64) -> f64 {
    let count = strata.iter().map(Vec::len).sum::<usize>() as f64;
    target - strata.iter().flatten().map(|score| score.min(target)).sum::<f64>() / count
}

/// Returns the performance profile: for each of `thresholds` the share of scores, 0 … 1, above it.
pub fn profile(strata: &[Vec<f64>], thresholds: &[f64]) -> Vec<f64> {
    let mut scores = strata.concat();
    scores.sort_unstable_by(f64::total_cmp);
    let above = |&threshold: &f64| scores.len() - scores.partition_point(|score| *score <= threshold);
    thresholds.iter().map(|threshold| above(threshold) as f64 / scores.len() as f64).collect()
}

/// Returns the probability, 0 … 1, that a run of X has a higher score than a run of Y in the same environment, averaged
/// over environments. Equal scores count as one half (Mann and Whitney, 1947). `x` and `y` must have the same
/// environments.
pub fn probability_of_improvement(x: &[Vec<f64>], y: &[Vec<f64>]) -> f64 {
    let of_environment = |(x, y): (&Vec<f64>, &Vec<f64>)| {
        let wins =
            x.iter().flat_map(|x| y.iter().map(move |y| f64::from(u8::from(x > y)) + f64::from(u8::from(x >= y))));
        wins.sum::<f64>() / (2 * x.len() * y.len()) as f64
    };
    x.iter().zip(y).map(of_environment).sum::<f64>() / x.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_of_the_scores_counts_at_neither_end() {
        let iqm = |scores: &[f64]| interquartile_mean(&[scores.to_vec()]);
        assert_eq!(iqm(&[100.0, 1.0, 3.0, -50.0]), 2.0);
        assert_eq!(iqm(&[9.0, 0.0, 0.0]), 3.0, "of three none is taken away");
        assert_eq!(iqm(&[0.0, 10.0, 20.0, 30.0, 90.0]), 20.0);
        assert!(iqm(&[]).is_nan());
    }

    #[test]
    fn scores_beyond_the_target_give_no_credit() {
        assert_eq!(profile(&[vec![0.0, 50.0], vec![100.0, 50.0]], &[-1.0, 0.0, 50.0, 100.0]), [1.0, 0.75, 0.25, 0.0]);
        assert_eq!(optimality_gap(&[vec![120.0, 40.0]], 100.0), 30.0);
    }

    #[test]
    fn equal_scores_are_half_an_improvement() {
        assert_eq!(probability_of_improvement(&[vec![1.0, 2.0]], &[vec![2.0]]), 0.25);
        assert_eq!(probability_of_improvement(&[vec![1.0], vec![5.0]], &[vec![1.0], vec![0.0, 9.0]]), 0.5);
    }
}
