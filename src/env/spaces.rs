//! The interface of an environment for its users: the entries of observations, actions, states and rewards.

/// A named entry of an observation, action or state vector, with its unit and range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChannelSpec {
    /// The name, unique within the vector.
    pub name: &'static str,
    /// The SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
    /// Minimum; may be `-inf`.
    pub low: f64,
    /// Maximum; may be `+inf`.
    pub high: f64,
    /// The standard deviation that `sensor_noise` = 1 adds to an observed entry, in the entry's unit. By default
    /// `scale` is half of the range, or 1 if the range is not finite. An entry with scale 0 is constant: it gets
    /// neither noise nor dropout.
    pub scale: f64,
}

impl ChannelSpec {
    /// Creates a channel with this name, unit and range `[low, high]`.
    pub const fn new(name: &'static str, unit: &'static str, low: f64, high: f64) -> Self {
        let scale = if low.is_finite() && high.is_finite() { (high - low) / 2.0 } else { 1.0 };
        Self { name, unit, low, high, scale }
    }

    /// Sets the field `scale`.
    pub const fn scale(mut self, scale: f64) -> Self {
        self.scale = scale;
        self
    }

    /// Creates a channel without bounds.
    pub const fn unbounded(name: &'static str, unit: &'static str) -> Self {
        Self::new(name, unit, f64::NEG_INFINITY, f64::INFINITY)
    }
}

/// The actions that an environment accepts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ActionSpec {
    /// A choice out of n. The list has a name for each choice, which describes its effect.
    Discrete(&'static [&'static str]),
    /// A vector with an entry for each channel. The environment clips the entries to the channels' ranges.
    Continuous(&'static [ChannelSpec]),
}

/// The action of one environment in one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Action<'a> {
    /// The index of a choice, below the number of choices.
    Discrete(u32),
    /// A vector of finite numbers, one for each channel of the action space.
    Continuous(&'a [f32]),
}

/// A term of the reward. The reward of a step is the sum of its terms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RewardTermSpec {
    /// The name, unique within the environment.
    pub name: &'static str,
    /// The term's formula, as text.
    pub description: &'static str,
}

/// A physical quantity that is read back from the simulation, such as a mass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QuantitySpec {
    /// The name, unique within the environment.
    pub name: &'static str,
    /// The SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
}
