//! Uniform distributions over unions of intervals, as data.

use super::{Error, shorten};
use std::fmt;

/// The most intervals of one distribution: every environment holds its own copy.
const MOST_INTERVALS: usize = 64;
/// The most intervals that a refusal repeats.
const SHOWN_INTERVALS: usize = 8;

/// The closed interval [low, high].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end, not below `low`.
    pub high: f64,
}

impl Interval {
    /// The interval [low, high].
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

/// Uniform over a union of intervals: a point is as likely in any of them, so an interval's probability is its share
/// of the total length. One interval of length 0 is a fixed value.
#[derive(Debug, Clone, PartialEq)]
pub struct Distribution(Vec<Interval>);

impl Distribution {
    /// Always `value`.
    ///
    /// # Panics
    /// If it is not finite.
    pub fn fixed(value: f64) -> Self {
        assert!(value.is_finite(), "a fixed value of {value}");
        Self(vec![Interval::new(value, value)])
    }

    /// Over the union of `intervals`, for the parameter of that name.
    ///
    /// # Errors
    /// [`Error::Distribution`] unless there are 1 to 64 intervals, all ends are finite, each `low` is at most its
    /// `high`, they ascend without overlap, and of several each has a positive length.
    pub fn union(parameter: &str, intervals: &[Interval]) -> Result<Self, Error> {
        let refuse = |expected| {
            let shown = &intervals[..intervals.len().min(SHOWN_INTERVALS)];
            let mut got = shown.iter().map(Interval::to_string).collect::<Vec<_>>().join(" ∪ ");
            if intervals.is_empty() {
                got = "empty".into();
            } else if intervals.len() > SHOWN_INTERVALS {
                got = format!("{got} ∪ … ({} intervals)", intervals.len());
            }
            Err(Error::Distribution { parameter: shorten(parameter), got, expected })
        };
        if !(1..=MOST_INTERVALS).contains(&intervals.len()) {
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

    /// The value at the fraction `u` in [0, 1) of the total length: uniform if `u` is.
    pub fn at(&self, u: f64) -> f64 {
        let mut rest = u * self.0.iter().map(|i| i.length()).sum::<f64>();
        for interval in &self.0 {
            if rest < interval.length() {
                return interval.low + rest;
            }
            rest -= interval.length();
        }
        // A fixed value, or u so close to 1 that rounding ate the rest.
        self.0[self.0.len() - 1].high
    }

    /// Least and greatest value.
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
