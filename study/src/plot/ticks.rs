//! Round numbers along an axis.

use std::ops::Range;

use super::tick;

/// At most `most` multiples of 1, 2 or 5 times a power of ten in `range`, both ends included, with what is written there;
/// the low end alone of a range that is none.
pub(super) fn round_ticks(range: &Range<f64>, most: usize) -> Vec<(f64, String)> {
    let span = range.end - range.start;
    if !span.is_finite() || span <= 0.0 {
        return vec![(range.start, tick(range.start))];
    }
    let smallest = (span / most.max(1) as f64).log10().floor() as i32;
    // The ends count in spite of rounding.
    let slack = 1e-9;
    let steps = (smallest..smallest + 3).flat_map(|power| [1.0, 2.0, 5.0].map(|factor| (factor, power)));
    let multiples = |(factor, power): (f64, i32)| {
        let step = factor * 10_f64.powi(power);
        let (first, last) = ((range.start / step - slack).ceil(), (range.end / step + slack).floor());
        (last - first < most as f64).then_some((first, last, factor, power))
    };
    let Some((first, last, factor, power)) = steps.into_iter().find_map(multiples) else { return Vec::new() };
    let value = |index: i32| {
        let multiple = (first + f64::from(index)) * factor;
        // Dividing by a whole number, the nearest to what is written.
        if power < 0 { multiple / 10_f64.powi(-power) } else { multiple * 10_f64.powi(power) }
    };
    (0..=(last - first) as i32).map(|index| (value(index), written(value(index), power))).collect()
}

/// With as many digits as multiples of that power of ten need.
fn written(value: f64, power: i32) -> String {
    // Adding 0 makes a negative zero positive.
    if power < 0 { format!("{:.*}", power.unsigned_abs() as usize, value + 0.0) } else { tick(value) }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case(0.0..100.0, 6, &["0", "20", "40", "60", "80", "100"])]
    #[case(0.05..1.0, 6, &["0.2", "0.4", "0.6", "0.8", "1.0"])]
    #[case(0.1..0.3, 6, &["0.10", "0.15", "0.20", "0.25", "0.30"])]
    #[case(0.0001..0.01, 6, &["0.002", "0.004", "0.006", "0.008", "0.010"])]
    #[case(0.5..1.5, 6, &["0.6", "0.8", "1.0", "1.2", "1.4"])]
    #[case(0.5..1.5, 4, &["0.5", "1.0", "1.5"])]
    #[case(500.0..1500.0, 6, &["600", "800", "1000", "1200", "1400"])]
    #[case(-1613.2..-121.7, 5, &["-1500", "-1000", "-500"])]
    #[case(-0.31..0.29, 4, &["-0.2", "0.0", "0.2"])]
    #[case(-20000.0..20000.0, 5, &["-20k", "-10k", "0", "10k", "20k"])]
    #[case(3.0..3.0, 5, &["3"])]
    fn ticks_are_round_and_few(#[case] range: Range<f64>, #[case] most: usize, #[case] expected: &[&str]) {
        let ticks = round_ticks(&range, most);
        assert_eq!(ticks.iter().map(|(_, written)| written.as_str()).collect::<Vec<_>>(), expected);
        let exact = |(value, written): &(f64, String)| written.ends_with('k') || written.parse() == Ok(*value);
        assert!(ticks.iter().all(exact), "each number stands at its own place: {ticks:?}");
        let slack = 1e-6 * (range.end - range.start);
        assert!(ticks.iter().all(|(value, _)| *value >= range.start - slack && *value <= range.end + slack));
    }
}
