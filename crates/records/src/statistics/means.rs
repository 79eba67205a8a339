//! Means, and confidence intervals of proportions.

/// The 97.5th percentile of the standard normal distribution: half the width of a 95 % interval, in standard
/// deviations.
pub(crate) const Z_95: f64 = 1.959_963_984_540_054;

/// Returns the 95 % confidence interval of a proportion after Wilson (1927), for `successes` among `trials`, as (low,
/// high) in 0 … 1. Unlike the interval of the normal approximation, it is also accurate near 0 and 1. Returns (0, 1) if
/// there are no trials.
pub fn wilson(successes: u64, trials: u64) -> (f64, f64) {
    if trials == 0 {
        return (0.0, 1.0);
    }
    wilson_of_share(successes as f64 / trials as f64, trials as f64)
}

/// Returns [`wilson`]'s interval for a `share`, 0 … 1, of `n` trials. `n` may be fractional: correlated trials have an
/// effective number below their count.
pub fn wilson_of_share(share: f64, n: f64) -> (f64, f64) {
    let z2 = Z_95 * Z_95;
    let centre = (share + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let half = Z_95 / (1.0 + z2 / n) * (share * (1.0 - share) / n + z2 / (4.0 * n * n)).sqrt();
    // For a share of 0 or 1, the end of the interval is exactly 0 or 1. The formula would miss it by rounding.
    let low = if share <= 0.0 { 0.0 } else { (centre - half).max(0.0) };
    let high = if share >= 1.0 { 1.0 } else { (centre + half).min(1.0) };
    (low, high)
}

/// Returns the geometric mean (∏ xᵢ)^(1/n) of numbers that are not negative: 0 if one of them is 0, NaN if there are
/// none.
pub fn geometric_mean(numbers: &[f64]) -> f64 {
    if numbers.contains(&0.0) {
        return 0.0;
    }
    (numbers.iter().map(|x| x.ln()).sum::<f64>() / numbers.len() as f64).exp()
}

/// Returns the arithmetic mean; NaN if there are no numbers.
pub fn mean(numbers: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = numbers.len() as f64;
    numbers.sum::<f64>() / n
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(got: f64, expected: f64) {
        assert!((got - expected).abs() < 5e-5, "{got} is not {expected}");
    }

    #[test]
    fn wilson_gives_published_intervals() {
        // Expected values are from Newcombe (1998), Statistics in Medicine 17, table I, method 3, to four digits.
        for (successes, trials, low, high) in
            [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)]
        {
            let (got_low, got_high) = wilson(successes, trials);
            close(got_low, low);
            close(got_high, high);
        }
    }

    #[test]
    fn wilson_is_closed_at_the_ends_and_mirrored() {
        assert_eq!(wilson(0, 0), (0.0, 1.0));
        assert_eq!(wilson(0, 1000).0, 0.0);
        assert_eq!(wilson(1000, 1000).1, 1.0);
        let ((low, high), (mirrored_low, mirrored_high)) = (wilson(3, 10), wilson(7, 10));
        close(low, 1.0 - mirrored_high);
        close(high, 1.0 - mirrored_low);
    }

    #[test]
    fn the_geometric_mean_is_the_root_of_the_product() {
        close(geometric_mean(&[1.0, 10.0, 100.0]), 10.0);
        close(geometric_mean(&[27.0]), 27.0);
        assert_eq!(geometric_mean(&[0.0, 50.0, 100.0]), 0.0);
        assert!(geometric_mean(&[]).is_nan());
    }
}
