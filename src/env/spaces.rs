//! Observations, actions and rewards: an environment as its users see it.

/// A named entry of a vector, with its unit and range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Channel {
    /// Unique within its list.
    pub name: &'static str,
    /// SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
    /// Minimum; may be `-inf`.
    pub low: f64,
    /// Maximum; may be `+inf`.
    pub high: f64,
    /// The scale of disturbances of the entry, in the entry's unit. By default it is half of the range, or 1 without a
    /// finite range. An entry with scale 0 is constant and is not disturbed.
    pub scale: f64,
}

impl Channel {
    /// A channel of the given name, unit and range `[low, high]`.
    pub const fn new(name: &'static str, unit: &'static str, low: f64, high: f64) -> Self {
        let scale = if low.is_finite() && high.is_finite() { (high - low) / 2.0 } else { 1.0 };
        Self { name, unit, low, high, scale }
    }

    /// Sets the scale.
    pub const fn scale(mut self, scale: f64) -> Self {
        self.scale = scale;
        self
    }

    /// A channel without bounds.
    pub const fn unbounded(name: &'static str, unit: &'static str) -> Self {
        Self::new(name, unit, f64::NEG_INFINITY, f64::INFINITY)
    }
}

/// The actions that an environment takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ActionSpace {
    /// A choice out of `n`, each with a name that describes its effect.
    Discrete(&'static [&'static str]),
    /// A vector of A numbers. The environment clips them to the channels' ranges.
    Continuous(&'static [Channel]),
}

/// The action of one environment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Action<'a> {
    /// A choice, below the space's `n`.
    Discrete(u32),
    /// `[A]`, finite.
    Continuous(&'a [f32]),
}

/// A term of the reward.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RewardTerm {
    /// Unique within its environment.
    pub name: &'static str,
    /// The term's formula.
    pub description: &'static str,
}

/// A quantity that is read back from the physics.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quantity {
    /// Unique within its environment.
    pub name: &'static str,
    /// SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
}
