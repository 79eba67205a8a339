//! Uniform distributions over unions of intervals.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::limits::MAX_INTERVALS;
use crate::proto;
pub use crate::proto::Interval;

/// Maximal number of intervals that an error message shows.
const SHOWN_INTERVALS: usize = 8;

impl Interval {
    /// Creates the closed interval [low, high].
    pub const fn new(low: f64, high: f64) -> Self {
        Self { low, high }
    }

    fn length(self) -> f64 {
        self.high - self.low
    }
}

impl fmt::Display for Interval {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.low == self.high { write!(f, "{}", self.low) } else { write!(f, "[{}, {}]", self.low, self.high) }
    }
}

/// A uniform distribution over a union of intervals: an interval's probability is its share of the total length. A
/// single interval of length 0 is a fixed value.
///
/// Its text is `0.1` or `0.3..0.4,0.8..0.9`. In TOML and JSON a fixed value may also be a number.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "WrittenDistribution", into = "WrittenDistribution")]
pub struct Distribution(Vec<Interval>);

/// The error for intervals or a text that are not a distribution.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{got} is not a set of values; expected {expected}")]
pub struct DistributionError {
    /// The wrong intervals or text.
    pub got: String,
    /// The expected form.
    pub expected: &'static str,
}

impl Distribution {
    /// Creates the distribution of a fixed `value`.
    ///
    /// # Panics
    /// If `value` is not finite.
    pub fn fixed(value: f64) -> Self {
        assert!(value.is_finite(), "a fixed value of {value}");
        Self(vec![Interval::new(value, value)])
    }

    /// Creates the uniform distribution over the union of `intervals`.
    ///
    /// # Errors
    /// [`DistributionError`] unless there are 1 to 64 intervals with finite ends and `low` ≤ `high`, in ascending order
    /// without overlap. Several intervals must each have a positive length.
    pub fn union(intervals: &[Interval]) -> Result<Self, DistributionError> {
        let refuse = |expected| {
            let shown = &intervals[..intervals.len().min(SHOWN_INTERVALS)];
            let mut got = shown.iter().map(Interval::to_string).collect::<Vec<_>>().join(" ∪ ");
            if intervals.is_empty() {
                got = "empty".into();
            } else if intervals.len() > SHOWN_INTERVALS {
                got = format!("{got} ∪ … ({} intervals)", intervals.len());
            }
            Err(DistributionError { got, expected })
        };
        if !(1..=MAX_INTERVALS).contains(&intervals.len()) {
            return refuse("1 to 64 intervals");
        }
        if intervals.iter().any(|i| !i.low.is_finite() || !i.high.is_finite()) {
            return refuse("finite ends");
        }
        if intervals.iter().any(|i| i.low > i.high) {
            return refuse("low at most high in every interval");
        }
        if intervals.len() > 1 && intervals.iter().any(|i| i.length() <= 0.0) {
            return refuse("intervals of positive length; a fixed value stands alone");
        }
        if intervals.windows(2).any(|w| w[0].high > w[1].low) {
            return refuse("ascending intervals that do not overlap");
        }
        Ok(Self(intervals.to_vec()))
    }

    /// The intervals, ascending.
    pub fn intervals(&self) -> &[Interval] {
        &self.0
    }

    /// Returns the value if the distribution has only one, otherwise `None`.
    pub fn fixed_value(&self) -> Option<f64> {
        match *self.0 {
            [Interval { low, high }] if low == high => Some(low),
            _ => None,
        }
    }

    /// Maps `u` in [0, 1) to the value at that fraction of the total length. If `u` is uniform, the value has this
    /// distribution.
    pub fn at(&self, u: f64) -> f64 {
        let mut rest = u * self.0.iter().map(|i| i.length()).sum::<f64>();
        for interval in &self.0 {
            if rest < interval.length() {
                return interval.low + rest;
            }
            rest -= interval.length();
        }
        // The loop returns nothing for a fixed value, whose length is 0. It also returns nothing if `u` is so close to
        // 1 that rounding exceeds the total length.
        self.0[self.0.len() - 1].high
    }

    /// Maps `u` in [0, 1) to one of the whole numbers in the intervals. If `u` is uniform, all of them are equally
    /// likely. Returns `None` if the intervals contain no whole number.
    pub fn whole_number_at(&self, u: f64) -> Option<f64> {
        // Adjacent intervals may share an end. A shared whole number counts only once.
        let numbers = |i: usize| {
            let Interval { low, high } = self.0[i];
            let is_shared = i > 0 && self.0[i - 1].high == low && low.fract() == 0.0;
            let first = low.ceil() + f64::from(u8::from(is_shared));
            (first, (high.floor() - first + 1.0).max(0.0))
        };
        let mut rest = (u * (0..self.0.len()).map(|i| numbers(i).1).sum::<f64>()).floor();
        for (first, count) in (0..self.0.len()).map(numbers) {
            if rest < count {
                return Some(first + rest);
            }
            rest -= count;
        }
        None
    }

    /// Whether `value` is in one of the intervals, with a relative tolerance of 1e-9.
    pub fn contains(&self, value: f64) -> bool {
        let margin = 1e-9 * value.abs();
        self.0.iter().any(|interval| interval.low - margin <= value && value <= interval.high + margin)
    }

    /// Whether every value of this distribution is also a value of `other`.
    pub fn is_within(&self, other: &Self) -> bool {
        let mut wider: Vec<Interval> = Vec::with_capacity(other.0.len());
        for &interval in &other.0 {
            match wider.last_mut() {
                Some(last) if last.high >= interval.low => last.high = interval.high,
                _ => wider.push(interval),
            }
        }
        self.0.iter().all(|own| wider.iter().any(|other| other.low <= own.low && own.high <= other.high))
    }

    /// Whether this distribution and `other` have values in common. Two intervals that share only an end do not
    /// overlap, since the probability of drawing the end is 0. For instance, the intervals of versions R and E touch,
    /// but do not overlap. A fixed value at the end of an interval overlaps the interval.
    pub fn overlaps(&self, other: &Self) -> bool {
        let meet = |one: &Interval, other: &Interval| {
            let low = one.low.max(other.low);
            let high = one.high.min(other.high);
            let is_fixed = one.low == one.high || other.low == other.high;
            low < high || (is_fixed && low == high)
        };
        self.0.iter().any(|one| other.0.iter().any(|other| meet(one, other)))
    }

    /// Returns the text from which [`FromStr`] reads exactly this distribution.
    pub fn written(&self) -> String {
        let interval = |&Interval { low, high }: &Interval| {
            if low == high { low.to_string() } else { format!("{low}..{high}") }
        };
        self.0.iter().map(interval).collect::<Vec<_>>().join(",")
    }

    /// The minimum and the maximum of the values.
    pub fn range(&self) -> (f64, f64) {
        (self.0[0].low, self.0[self.0.len() - 1].high)
    }
}

impl fmt::Display for Distribution {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, interval) in self.0.iter().enumerate() {
            write!(f, "{}{interval}", if i > 0 { " ∪ " } else { "" })?;
        }
        Ok(())
    }
}

impl FromStr for Distribution {
    type Err = DistributionError;

    /// Parses a value, an interval `low..high`, or several intervals separated by commas.
    fn from_str(text: &str) -> Result<Self, DistributionError> {
        let expected = "a value, an interval such as 0.3..0.4, or several with commas between them";
        let number = |text: &str| text.trim().parse::<f64>().ok();
        let interval = |part: &str| match part.split_once("..") {
            Some((low, high)) => Some(Interval::new(number(low)?, number(high)?)),
            None => number(part).map(|value| Interval::new(value, value)),
        };
        let intervals: Option<Vec<Interval>> = text.split(',').map(interval).collect();
        let refuse = |expected| DistributionError { got: format!("`{text}`"), expected };
        let made = Self::union(&intervals.ok_or_else(|| refuse(expected))?);
        if made.is_err() && text.split("..").any(|end| decimal_comma(end.trim()).is_some()) {
            return Err(refuse("a decimal point in each number, such as 0.5 or 0.5..1.1"));
        }
        made
    }
}

/// Replaces the decimal comma of the number in `text` by a point: returns `7.5` for `7,5`. Returns `None` if `text` is
/// not a number with a decimal comma.
pub fn decimal_comma(text: &str) -> Option<String> {
    let (whole, fraction) = text.split_once(',')?;
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let mantissa = fraction.split(['e', 'E']).next().unwrap_or_default();
    let number = format!("{whole}.{fraction}");
    let is_number = digits(whole.trim_start_matches(['+', '-'])) && digits(mantissa) && number.parse::<f64>().is_ok();
    is_number.then_some(number)
}

impl From<&Distribution> for proto::Distribution {
    fn from(distribution: &Distribution) -> Self {
        Self { intervals: distribution.0.clone() }
    }
}

impl TryFrom<&proto::Distribution> for Distribution {
    type Error = DistributionError;

    fn try_from(distribution: &proto::Distribution) -> Result<Self, DistributionError> {
        Self::union(&distribution.intervals)
    }
}

/// A distribution as it is stored in a file.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum WrittenDistribution {
    Number(f64),
    Text(String),
}

impl From<Distribution> for WrittenDistribution {
    fn from(distribution: Distribution) -> Self {
        match distribution.0[..] {
            [Interval { low, high }] if low == high => Self::Number(low),
            _ => Self::Text(distribution.written()),
        }
    }
}

impl TryFrom<WrittenDistribution> for Distribution {
    type Error = DistributionError;

    fn try_from(written: WrittenDistribution) -> Result<Self, DistributionError> {
        match written {
            WrittenDistribution::Number(value) => Self::union(&[Interval::new(value, value)]),
            WrittenDistribution::Text(text) => text.parse(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distribution_survives_a_round_trip() {
        for text in ["0.1", "0.3..0.4", "0.3..0.4,0.8..0.9", "-1..1"] {
            let distribution: Distribution = text.parse().unwrap();
            let json = serde_json::to_string(&distribution).unwrap();
            assert_eq!(json.trim_matches('"'), text);
            assert_eq!(serde_json::from_str::<Distribution>(&json).unwrap(), distribution);
            assert_eq!(Distribution::try_from(&proto::Distribution::from(&distribution)), Ok(distribution));
        }
        assert_eq!(" 1 .. 2 ".parse::<Distribution>().unwrap().range(), (1.0, 2.0));
    }

    #[test]
    fn whole_numbers_of_all_intervals_are_as_likely() {
        for (text, expected) in [
            ("2", &[2.0][..]),
            ("0..3", &[0.0, 1.0, 2.0, 3.0]),
            ("0.5..2.5", &[1.0, 2.0]),
            ("0..1,1..2", &[0.0, 1.0, 2.0]),
            ("-1..0.5,3..4", &[-1.0, 0.0, 3.0, 4.0]),
            ("2.5", &[]),
        ] {
            let distribution: Distribution = text.parse().unwrap();
            let n = 120;
            let mut counts = vec![0; expected.len()];
            for i in 0..n {
                let Some(drawn) = distribution.whole_number_at((f64::from(i) + 0.5) / f64::from(n)) else { continue };
                counts[expected.iter().position(|value| *value == drawn).unwrap()] += 1;
            }
            assert!(counts.iter().all(|&count| count == n / counts.len() as i32), "{text}: {counts:?}");
        }
    }

    #[test]
    fn containment_and_overlap_follow_the_values() {
        let of = |text: &str| text.parse::<Distribution>().unwrap();
        for (one, other, within, overlaps) in [
            ("1", "1", true, true),
            ("1", "2", false, false),
            ("1", "0..2", true, true),
            ("0..2", "1", false, true),
            ("1", "1..2", true, true),
            ("1", "1.1..2", false, false),
            ("1..2", "2..3", false, false),
            ("1..2", "1..2", true, true),
            ("1..3", "1..2,2..3", true, true),
            ("1..3", "1..2,2.5..3", false, true),
            ("0..1,2..3", "0..3", true, true),
            ("0..1,2..3", "1..2", false, false),
        ] {
            let a = of(one);
            let b = of(other);
            assert_eq!((a.is_within(&b), a.overlaps(&b)), (within, overlaps), "{one} and {other}");
            assert_eq!(a.overlaps(&b), b.overlaps(&a), "{one} and {other}");
        }
    }

    #[test]
    fn decimal_commas_are_refused() {
        for text in ["7,5", "7,5..8,5", "7..8,5", "0,5..1"] {
            let error = text.parse::<Distribution>().unwrap_err().to_string();
            assert!(error.contains("a decimal point in each number"), "{text}: {error}");
        }
        assert_eq!(decimal_comma("-7,25").as_deref(), Some("-7.25"));
        for text in ["7, 5", "7.0,5", "7,5,3", "7,", ",5", "7", "a,5"] {
            assert_eq!(decimal_comma(text), None, "{text}");
        }
    }

    #[test]
    fn wrong_text_is_refused_with_the_expected_form() {
        for text in ["", "x", "1..", "..2", "1..2..3", "1,", "2..1", "1..3,2..4", "1,2", "nan", "inf"] {
            let error = text.parse::<Distribution>().unwrap_err().to_string();
            assert!(error.contains("expected"), "{text}: {error}");
        }
        assert!("x..1".parse::<Distribution>().unwrap_err().to_string().starts_with("`x..1` is not a set of values"));
    }
}
