//! Running normalisation of observations and rewards, like stable-baselines3's VecNormalize.
//!
//! In training, call `update` and then `normalise`. In testing, call only `normalise`, which does not change the
//! statistics. All state is f64, can be serialised with serde, and is part of a checkpoint.
//!
//! The reference implementation (OpenAI Baselines) starts its variances from a prior of 1 with the weight of 10⁻⁴
//! samples. Here there is no prior: the statistics are exactly those of the data. With fewer than two samples the
//! variance counts as 1.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, check_length};

/// Bound to which normalised numbers are clipped: ±10.
const CLIP: f64 = 10.0;
/// Number that is added to variances, so that constants are not divided by 0.
const EPSILON: f64 = 1e-8;

/// Running mean and variance of the vectors seen so far, by element, in f64.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunningMoments {
    count: u64,
    mean: Vec<f64>,
    /// Sums of squared distances from the mean.
    squares: Vec<f64>,
}

impl RunningMoments {
    /// Creates the moments of vectors of `size` numbers, before any vector was seen.
    pub fn new(size: usize) -> Self {
        RunningMoments { count: 0, mean: vec![0.0; size], squares: vec![0.0; size] }
    }

    /// Creates moments from saved numbers.
    pub fn from_parts(count: u64, mean: Vec<f64>, squares: Vec<f64>) -> Self {
        RunningMoments { count, mean, squares }
    }

    /// Adds `rows`, vectors of `size` numbers. Computes the moments of `rows` in two passes and merges them.
    fn take<'a>(&mut self, rows: impl Iterator<Item = &'a [f32]> + Clone) {
        let count = rows.clone().count();
        for i in 0..self.mean.len() {
            self.take_column(i, count, rows.clone().map(|row| f64::from(row[i])));
        }
        self.count += count as u64;
    }

    /// Adds element `i` of `count` vectors. The caller must add `count` to the number of vectors afterwards.
    fn take_column(&mut self, i: usize, count: usize, column: impl Iterator<Item = f64> + Clone) {
        if count > 0 {
            let mean = column.clone().sum::<f64>() / count as f64;
            let squares = column.map(|x| (x - mean) * (x - mean)).sum();
            self.merge_element(i, count as u64, mean, squares);
        }
    }

    /// Adds the vectors that `other` has seen. Up to rounding, the result does not depend on the order of the vectors
    /// (Chan, Golub and LeVeque, 1979). With δ = mean_b - mean_a, mean = mean_a + δ n_b/n and squares = squares_a +
    /// squares_b + δ² n_a n_b/n.
    pub fn merge(&mut self, other: &RunningMoments) -> Result<()> {
        check_length("moments", other.mean.len(), self.mean.len())?;
        if other.count == 0 {
            return Ok(());
        }
        for i in 0..self.mean.len() {
            self.merge_element(i, other.count, other.mean[i], other.squares[i]);
        }
        self.count += other.count;
        Ok(())
    }

    fn merge_element(&mut self, i: usize, count: u64, mean: f64, squares: f64) {
        let a = self.count as f64;
        let b = count as f64;
        let delta = mean - self.mean[i];
        self.mean[i] += delta * b / (a + b);
        self.squares[i] += squares + delta * delta * a * b / (a + b);
    }

    /// Checks saved moments of vectors of `size` numbers: lengths must match, numbers be finite, and sums of squares
    /// not negative. The error describes the fault.
    fn check(&self, size: usize) -> std::result::Result<(), String> {
        for (name, numbers) in [("mean", &self.mean), ("squares", &self.squares)] {
            if numbers.len() != size {
                return Err(format!("{name} has {} numbers, expected {size}", numbers.len()));
            }
            if let Some(x) = numbers.iter().find(|x| !x.is_finite()) {
                return Err(format!("{name} holds {x}"));
            }
        }
        if let Some(x) = self.squares.iter().find(|x| **x < 0.0) {
            return Err(format!("squares holds {x}, which no sum of squares can be"));
        }
        if self.count == 0 && self.mean.iter().chain(&self.squares).any(|&x| x != 0.0) {
            return Err("count is 0, but there are statistics".into());
        }
        Ok(())
    }

    /// Returns the number of vectors seen.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Returns the sums of squared distances from the mean, by element.
    pub fn squares(&self) -> &[f64] {
        &self.squares
    }

    /// Returns the means, by element; 0 before any vector was seen.
    pub fn mean(&self) -> &[f64] {
        &self.mean
    }

    /// Returns the population variance (divided by the count) of element `i`, or 1 if fewer than two vectors were seen.
    pub fn variance(&self, i: usize) -> f64 {
        if self.count < 2 { 1.0 } else { self.squares[i] / self.count as f64 }
    }
}

/// Normalises each element of an observation to (x - mean)/√(variance + 10⁻⁸), clipped to ±10. The last `left_alone`
/// elements are not changed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObservationNormaliser {
    moments: RunningMoments,
    /// Number of elements at the end of an observation that are neither normalised nor added to the statistics.
    #[serde(default, skip_serializing_if = "is_zero")]
    left_alone: usize,
}

fn is_zero(number: &usize) -> bool {
    *number == 0
}

impl ObservationNormaliser {
    /// Creates a normaliser for observations of O = `observation_size` numbers, before any observation was seen.
    pub fn new(observation_size: usize) -> Self {
        Self::from_moments(RunningMoments::new(observation_size))
    }

    /// Creates a normaliser with these statistics.
    pub fn from_moments(moments: RunningMoments) -> Self {
        ObservationNormaliser { moments, left_alone: 0 }
    }

    /// Makes observations longer by `left_alone` elements at the end, and leaves these elements unchanged. Use this for
    /// observed parameters, because they are already scaled. A parameter may also be constant throughout a training.
    /// Dividing it by its tiny standard deviation would magnify later differences without bound.
    #[must_use]
    pub fn leaving_alone(self, left_alone: usize) -> Self {
        ObservationNormaliser { left_alone, ..self }
    }

    /// Returns O, the length of an observation.
    fn observation_size(&self) -> usize {
        self.moments.mean.len() + self.left_alone
    }

    /// Returns the statistics of the normalised elements.
    pub fn moments(&self) -> &RunningMoments {
        &self.moments
    }

    /// Checks that this normaliser is for observations of `observation_size` numbers and leaves the last `left_alone`
    /// unchanged. Also checks that its statistics are valid. The error describes the fault.
    pub fn check(&self, observation_size: usize, left_alone: usize) -> std::result::Result<(), String> {
        if self.left_alone != left_alone {
            return Err(format!("left_alone is {}, expected {left_alone}", self.left_alone));
        }
        self.moments.check(observation_size.saturating_sub(left_alone))
    }

    /// Adds `observations` `[N, O]` to the statistics. Returns an error for infinite numbers and NaN, and then changes
    /// nothing.
    pub fn update(&mut self, observations: &[f32]) -> Result<()> {
        self.update_active(observations, None)
    }

    /// Adds `observations` `[N, O]` to the statistics, but only those of the environments where `active` `[N]` is true.
    /// `None` adds all.
    pub fn update_active(&mut self, observations: &[f32], active: Option<&[bool]>) -> Result<()> {
        let size = self.observation_size();
        check_length("observations [N, O]", observations.len(), observations.len() / size * size)?;
        check_finite("observations [N, O]", observations)?;
        let rows = observations.chunks_exact(size);
        match active.filter(|active| active.contains(&false)) {
            None => self.moments.take(rows),
            Some(active) => {
                check_length("active [N]", active.len(), observations.len() / size)?;
                self.moments.take(rows.zip(active).filter(|(_, active)| **active).map(|(row, _)| row));
            }
        }
        Ok(())
    }

    /// Normalises `observations` `[N, O]` in place, without changing the statistics.
    pub fn normalise(&self, observations: &mut [f32]) -> Result<()> {
        let size = self.observation_size();
        check_length("observations [N, O]", observations.len(), observations.len() / size * size)?;
        for i in 0..self.moments.mean.len() {
            let mean = self.moments.mean[i];
            let scale = scale(self.moments.variance(i));
            for x in observations.iter_mut().skip(i).step_by(size) {
                *x = ((f64::from(*x) - mean) * scale).clamp(-CLIP, CLIP) as f32;
            }
        }
        Ok(())
    }
}

/// Normalises rewards by a division, which keeps their sign, and clips the results to ±10. The divisor is the standard
/// deviation of all discounted returns R_t = γ R_{t-1} + r_t seen so far (Engstrom et al., 2020, arXiv:2005.12729). The
/// mean is not subtracted.
///
/// Normally R starts from 0 in every episode (with RL², in every trial), as in stable-baselines3. If
/// [`RewardNormaliser::runs_on`] is true, R continues across the ends of episodes and trials, as in the reference
/// implementation (OpenAI Baselines).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RewardNormaliser {
    gamma: f64,
    /// `[N]` discounted return R of each environment.
    returns: Vec<f64>,
    moments: RunningMoments,
    /// Whether the discounted return R continues across the ends of episodes and trials.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    runs_on: bool,
}

impl RewardNormaliser {
    /// Creates a normaliser for N = `n_envs` environments, before any reward was seen. `gamma` is the discount factor
    /// per step.
    pub fn new(n_envs: usize, gamma: f64) -> Self {
        Self::from_parts(gamma, vec![0.0; n_envs], RunningMoments::new(1))
    }

    /// Returns the statistics of the discounted returns.
    pub fn moments(&self) -> &RunningMoments {
        &self.moments
    }

    /// Creates a normaliser from saved numbers: the discount factor `gamma`, the discounted returns R `[N]` and their
    /// statistics.
    pub fn from_parts(gamma: f64, returns: Vec<f64>, moments: RunningMoments) -> Self {
        RewardNormaliser { gamma, returns, moments, runs_on: false }
    }

    /// Sets whether the discounted return R continues across the ends of episodes and trials, instead of starting again
    /// from 0.
    pub fn running_on(self, runs_on: bool) -> Self {
        RewardNormaliser { runs_on, ..self }
    }

    /// Returns whether the discounted return R continues across the ends of episodes and trials, instead of starting
    /// again from 0.
    pub fn runs_on(&self) -> bool {
        self.runs_on
    }

    /// Returns the discount factor per step.
    pub fn gamma(&self) -> f64 {
        self.gamma
    }

    /// Returns the discounted return R of each environment, `[N]`.
    pub fn returns(&self) -> &[f64] {
        &self.returns
    }

    /// Checks that this normaliser belongs to a training with `n_envs` environments, the discount factor `gamma` and
    /// this value of [`RewardNormaliser::runs_on`]. The error describes the difference.
    pub fn fits(&self, n_envs: usize, gamma: f64, runs_on: bool) -> std::result::Result<(), String> {
        if self.returns.len() != n_envs {
            return Err(format!("returns has {} numbers, expected {n_envs}", self.returns.len()));
        }
        if self.gamma.to_bits() != gamma.to_bits() {
            return Err(format!("gamma is {}, but {gamma} in the configuration", self.gamma));
        }
        if self.runs_on != runs_on {
            return Err(format!(
                "runs_on is {}, but reward_return_runs_on {runs_on} in the configuration",
                self.runs_on
            ));
        }
        Ok(())
    }

    /// Checks saved numbers: γ must be in 0 … 1, the returns finite, and the statistics valid. The error describes the
    /// fault.
    pub fn check(&self) -> std::result::Result<(), String> {
        if !(0.0..=1.0).contains(&self.gamma) {
            return Err(format!("gamma is {}, but must be between 0 and 1", self.gamma));
        }
        if let Some(x) = self.returns.iter().find(|x| !x.is_finite()) {
            return Err(format!("returns holds {x}"));
        }
        self.moments.check(1)
    }

    /// Adds a step's `rewards` `[N]` to the statistics. `done` `[N]` is true for each environment whose episode (with
    /// RL², whose trial) ended in this step. Its discounted return then starts again from 0 in the next step, unless
    /// [`RewardNormaliser::runs_on`] is true. Returns an error for infinite numbers and NaN, and then changes nothing.
    pub fn update(&mut self, rewards: &[f32], done: &[bool]) -> Result<()> {
        self.update_active(rewards, done, None)
    }

    /// Adds a step's `rewards` `[N]` to the statistics, but only those of the environments where `active` `[N]` is
    /// true. See [`RewardNormaliser::update`].
    pub fn update_active(&mut self, rewards: &[f32], done: &[bool], active: Option<&[bool]>) -> Result<()> {
        check_length("rewards [N]", rewards.len(), self.returns.len())?;
        check_length("done [N]", done.len(), self.returns.len())?;
        check_length("active [N]", active.map_or(rewards.len(), <[bool]>::len), self.returns.len())?;
        check_finite("rewards [N]", rewards)?;
        if rewards.is_empty() {
            return Ok(());
        }
        for (sum, &reward) in self.returns.iter_mut().zip(rewards) {
            *sum = *sum * self.gamma + f64::from(reward);
        }
        let counts = |i: &usize| active.is_none_or(|active| active[*i]);
        let counted = (0..rewards.len()).filter(counts);
        let count = counted.clone().count();
        self.moments.take_column(0, count, counted.map(|i| self.returns[i]));
        self.moments.count += count as u64;
        if !self.runs_on {
            self.returns.iter_mut().zip(done).filter(|(_, done)| **done).for_each(|(sum, _)| *sum = 0.0);
        }
        Ok(())
    }

    /// Resets the discounted returns of all environments to 0, unless [`RewardNormaliser::runs_on`] is true. Call this
    /// after resetting environments in the middle of an episode. Does not change the statistics.
    pub fn reset_returns(&mut self) {
        if !self.runs_on {
            self.returns.fill(0.0);
        }
    }

    /// Normalises `rewards` in place, without changing the statistics.
    pub fn normalise(&self, rewards: &mut [f32]) {
        let scale = scale(self.moments.variance(0));
        for reward in rewards {
            *reward = (f64::from(*reward) * scale).clamp(-CLIP, CLIP) as f32;
        }
    }
}

fn scale(variance: f64) -> f64 {
    1.0 / (variance + EPSILON).sqrt()
}

fn check_finite(name: &'static str, numbers: &[f32]) -> Result<()> {
    match numbers.iter().find(|x| !x.is_finite()) {
        Some(&value) => Err(Error::Input { name, value }),
        None => Ok(()),
    }
}
