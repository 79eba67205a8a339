//! Finds round numbers for the ticks of an axis, and formats them.

use std::ops::Range;

/// Returns at most `most` ticks in `range`, each with its text. Ticks are multiples of 1, 2 or 5 times a power of ten.
/// An empty range has a single tick at its lower end.
pub(super) fn round_ticks(range: &Range<f64>, most: usize) -> Vec<(f64, String)> {
    let span = range.end - range.start;
    if !span.is_finite() || span <= 0.0 {
        return vec![(range.start, format_number(range.start))];
    }
    let smallest = (span / most.max(1) as f64).log10().floor() as i32;
    // Tolerance, in steps between ticks. Without it, rounding errors could exclude a tick at an end of the range.
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
        // For a negative power, divides by a whole number. This gives the float closest to the decimal text.
        // Multiplying by a negative power of ten would give rounding errors.
        if power < 0 { multiple / 10_f64.powi(-power) } else { multiple * 10_f64.powi(power) }
    };
    let values: Vec<f64> = (0..=(last - first) as i32).map(value).collect();
    let largest = values.iter().fold(0.0, |largest: f64, value| largest.max(value.abs()));
    values.into_iter().map(|value| (value, format_tick(value, power, largest))).collect()
}

/// Widens `range` on both sides to the next tick. Returns an empty range unchanged.
pub(super) fn rounded(range: &Range<f64>) -> Range<f64> {
    match round_ticks(range, 6)[..] {
        [(first, _), (second, _), ..] => {
            let step = second - first;
            let slack = 1e-9;
            // Removes rounding errors of binary fractions.
            let tidy = |number: f64| format!("{number:.9e}").parse().unwrap_or(number);
            tidy((range.start / step + slack).floor() * step)..tidy((range.end / step - slack).ceil() * step)
        }
        _ => range.clone(),
    }
}

/// Formats a tick. All ticks of the axis are multiples of 10^`power`, and `power` decides the number of decimals.
/// `largest` is the largest absolute value of the ticks. It decides whether all ticks are written in thousands (k) or
/// millions (M).
fn format_tick(value: f64, power: i32, largest: f64) -> String {
    // Adding 0 makes a negative zero positive.
    if power < 0 {
        return format!("{:.*}", power.unsigned_abs() as usize, value + 0.0);
    }
    let decimals = |of: i32| (of - power).max(0) as usize;
    match largest {
        _ if value == 0.0 => format_number(value),
        1e6.. => format!("{:.*}M", decimals(6), value / 1e6),
        10_000.0.. => format!("{:.*}k", decimals(3), value / 1e3),
        _ => format_number(value),
    }
}

/// Formats a number for an axis: short, and without rounding errors of binary fractions.
fn format_number(number: f64) -> String {
    let digits = match number.abs() {
        1e6.. => return format!("{}M", (number / 1e5).round() / 10.0),
        10_000.0.. => return format!("{}k", (number / 100.0).round() / 10.0),
        100.0.. => 0,
        10.0.. => 1,
        _ => 3,
    };
    let factor = 10_f64.powi(digits);
    // Adding 0 makes a negative zero positive.
    ((number * factor).round() / factor + 0.0).to_string()
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case(0.0, "0")]
    #[case(-0.0001, "0")]
    #[case(0.1 + 0.2, "0.3")]
    #[case(-12.34, "-12.3")]
    #[case(123.4, "123")]
    #[case(9999.6, "10000")]
    #[case(15_000.0, "15k")]
    #[case(-12_345.0, "-12.3k")]
    #[case(2_520_000.0, "2.5M")]
    fn numbers_at_an_axis_are_short(#[case] number: f64, #[case] shown: &str) {
        assert_eq!(format_number(number), shown);
    }

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
    #[case(0.0..15_000.0, 4, &["0", "5k", "10k", "15k"])]
    #[case(0.0..1.5e6, 4, &["0", "0.5M", "1.0M", "1.5M"])]
    #[case(1e6..1.2e6, 6, &["1.00M", "1.05M", "1.10M", "1.15M", "1.20M"])]
    #[case(101_000.0..101_250.0, 6, &["101.00k", "101.05k", "101.10k", "101.15k", "101.20k", "101.25k"])]
    #[case(0.0..2e6, 3, &["0", "1M", "2M"])]
    #[case(3.0..3.0, 5, &["3"])]
    fn ticks_are_round_and_few(#[case] range: Range<f64>, #[case] most: usize, #[case] expected: &[&str]) {
        let ticks = round_ticks(&range, most);
        assert_eq!(ticks.iter().map(|(_, written)| written.as_str()).collect::<Vec<_>>(), expected);
        let read = |written: &str| match written
            .strip_suffix('k')
            .map(|k| (k, 1e3))
            .or(written.strip_suffix('M').map(|m| (m, 1e6)))
        {
            Some((number, unit)) => number.parse::<f64>().unwrap() * unit,
            None => written.parse().unwrap(),
        };
        let exact = |(value, written): &(f64, String)| (read(written) - value).abs() <= 1e-9 * value.abs();
        assert!(ticks.iter().all(exact), "each number stands at its own place: {ticks:?}");
        let slack = 1e-6 * (range.end - range.start);
        assert!(ticks.iter().all(|(value, _)| *value >= range.start - slack && *value <= range.end + slack));
    }
}
