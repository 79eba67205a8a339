//! Optimisers, which change a policy's P weights by gradient steps. The weights are one array.

use pulp::Simd;

use crate::error::{Error, Result, check_length};
use crate::kernel::{Kernel, run};
use crate::weights::{NamedArray, check_arrays};

/// Number of partial sums in which the squares of a gradient's elements are added. It fixes the order of additions, and
/// so the rounding.
const SUMS: usize = 8;

/// The rule that turns a gradient into a change of the weights.
#[derive(Clone, Debug)]
pub enum UpdateRule {
    /// RMSProp.
    RmsProp(RmsProp),
    /// Adam.
    Adam(Adam),
}

/// RMSProp (Hinton, 2012, lecture 6e) in TensorFlow's form, which OpenAI Baselines uses. For i = 0 … P-1, with the
/// gradient g and the learning rate η:
///
/// s_i ← α s_i + (1 - α) g_i²,
/// w_i ← w_i - η g_i/√(s_i + ε).
///
/// The averages s start at 1, and ε is inside of the root. libtorch starts s at 0 and adds ε outside of the root. This
/// makes its first steps ten times as long, and A2C is known to be less stable with it.
#[derive(Clone, Debug)]
pub struct RmsProp {
    alpha: f32,
    epsilon: f32,
    mean_square: Vec<f32>,
}

/// Adam, Kingma and Ba (2015), arXiv:1412.6980, algorithm 1, with β₁ = 0.9 and β₂ = 0.999. For i = 0 … P-1 and t = 1,
/// 2, …, with the gradient g and the learning rate η:
///
/// m_i ← β₁ m_i + (1 - β₁) g_i,
/// v_i ← β₂ v_i + (1 - β₂) g_i²,
/// w_i ← w_i - η/(1 - β₁ᵗ) m_i/(√(v_i/(1 - β₂ᵗ)) + ε).
///
/// This is libtorch's form. TensorFlow, which OpenAI Baselines uses, adds ε to √v_i before the correction by √(1 -
/// β₂ᵗ). This makes TensorFlow's ε effectively larger, by up to √1000 in the first steps. With ε = 1e-5 the difference
/// matters only to weights whose gradient is about as small as ε.
#[derive(Clone, Debug)]
pub struct Adam {
    epsilon: f32,
    mean: Vec<f32>,
    mean_square: Vec<f32>,
}

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;

impl UpdateRule {
    /// Creates RMSProp for `n_weights` weights, with the decay α = `alpha` of the averages and ε = `epsilon`.
    pub fn rms_prop(alpha: f64, epsilon: f64, n_weights: usize) -> Self {
        let mean_square = vec![1.0; n_weights];
        UpdateRule::RmsProp(RmsProp { alpha: alpha as f32, epsilon: epsilon as f32, mean_square })
    }

    /// Creates Adam for `n_weights` weights, with ε = `epsilon`.
    pub fn adam(epsilon: f64, n_weights: usize) -> Self {
        let mean = vec![0.0; n_weights];
        let mean_square = vec![0.0; n_weights];
        UpdateRule::Adam(Adam { epsilon: epsilon as f32, mean, mean_square })
    }

    /// Changes the weights by one step against the gradient. `update` is the number of steps before this one.
    fn step(&mut self, update: u64, step: GradientStep<'_>) {
        match self {
            UpdateRule::RmsProp(state) => run(RmsPropStep { state, step }),
            UpdateRule::Adam(state) => run(AdamStep { state, update, step }),
        }
    }

    /// Returns P, the number of weights.
    fn size(&self) -> usize {
        match self {
            UpdateRule::RmsProp(state) => state.mean_square.len(),
            UpdateRule::Adam(state) => state.mean.len(),
        }
    }

    /// Returns the running averages with their names, each `[P]`.
    fn averages(&self) -> Vec<(&'static str, &[f32])> {
        match self {
            UpdateRule::RmsProp(state) => vec![("mean_square", &state.mean_square)],
            UpdateRule::Adam(state) => vec![("mean", &state.mean), ("mean_square", &state.mean_square)],
        }
    }

    /// Returns the running averages with their names, for writing.
    fn averages_mut(&mut self) -> Vec<(&'static str, &mut [f32])> {
        match self {
            UpdateRule::RmsProp(state) => vec![("mean_square", &mut state.mean_square)],
            UpdateRule::Adam(state) => vec![("mean", &mut state.mean), ("mean_square", &mut state.mean_square)],
        }
    }
}

/// The inputs of one gradient step.
struct GradientStep<'a> {
    learning_rate: f64,
    /// `[P]` weights, which the step changes.
    weights: &'a mut [f32],
    /// `[P]` gradient of the loss, not clipped.
    gradient: &'a [f32],
    /// Factor by which the gradient is multiplied to clip its norm, 0 … 1.
    scale: f32,
    /// Factor by which each weight is multiplied for weight decay, 0 … 1.
    keep: f32,
}

struct RmsPropStep<'a> {
    state: &'a mut RmsProp,
    step: GradientStep<'a>,
}

impl Kernel for RmsPropStep<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let RmsProp { alpha, epsilon, mean_square } = self.state;
        let GradientStep { learning_rate, weights, gradient, scale, keep } = self.step;
        let alpha = *alpha;
        let epsilon = *epsilon;
        let learning_rate = learning_rate as f32;
        for ((w, s), g) in weights.iter_mut().zip(mean_square).zip(gradient) {
            let g = scale * g;
            *s = alpha * *s + (1.0 - alpha) * g * g;
            *w = keep * *w - learning_rate * g / (*s + epsilon).sqrt();
        }
    }
}

struct AdamStep<'a> {
    state: &'a mut Adam,
    update: u64,
    step: GradientStep<'a>,
}

impl Kernel for AdamStep<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let GradientStep { learning_rate, weights, gradient, scale, keep } = self.step;
        let t = (self.update + 1) as f64;
        let step_size = (learning_rate / (1.0 - libm::pow(BETA_1, t))) as f32;
        let root_correction = (1.0 / (1.0 - libm::pow(BETA_2, t)).sqrt()) as f32;
        let beta_1 = BETA_1 as f32;
        let rest_1 = (1.0 - BETA_1) as f32;
        let beta_2 = BETA_2 as f32;
        let rest_2 = (1.0 - BETA_2) as f32;
        let Adam { epsilon, mean, mean_square } = self.state;
        let epsilon = *epsilon;
        for ((w, (m, v)), g) in weights.iter_mut().zip(mean.iter_mut().zip(mean_square)).zip(gradient) {
            let g = scale * g;
            *m = beta_1 * *m + rest_1 * g;
            *v = beta_2 * *v + rest_2 * g * g;
            *w = keep * *w - step_size * *m / (v.sqrt() * root_correction + epsilon);
        }
    }
}

/// Changes weights by gradient steps. Each step clips the gradient by its global norm, applies the update rule, and
/// decays all weights:
///
/// w_i ← (1 - η λ) w_i - the rule's step,
///
/// with the learning rate η and the decay λ (Loshchilov and Hutter, 2019, arXiv:1711.05101, as in libtorch's AdamW).
/// The decay is decoupled from the gradient: the rule's running averages do not scale it.
#[derive(Clone, Debug)]
pub struct Optimiser {
    optimiser: UpdateRule,
    max_grad_norm: f64,
    weight_decay: f64,
    n_updates: u64,
}

impl Optimiser {
    /// Creates an optimiser without weight decay. A gradient whose norm exceeds `max_grad_norm` is scaled down to this
    /// norm.
    pub fn new(optimiser: UpdateRule, max_grad_norm: f64) -> Self {
        Optimiser { optimiser, max_grad_norm, weight_decay: 0.0, n_updates: 0 }
    }

    /// Sets the weight decay λ = `weight_decay`, at least 0.
    #[must_use]
    pub fn with_weight_decay(self, weight_decay: f64) -> Self {
        Optimiser { weight_decay, ..self }
    }

    /// Returns the number of gradient steps so far.
    pub fn n_updates(&self) -> u64 {
        self.n_updates
    }

    /// Changes `weights` `[P]` by one step against the `gradient` `[P]` of a loss whose value is `loss`. Returns the
    /// gradient's global norm before clipping.
    ///
    /// Clipping multiplies a gradient whose norm exceeds `max_grad_norm` by exactly max_grad_norm/norm, as TensorFlow's
    /// `clip_by_global_norm` does. libtorch adds 1e-6 to the norm.
    ///
    /// # Errors
    /// [`Error::NotFinite`] if the loss or the gradient is not finite, [`Error::Length`] if an array has the wrong
    /// length. The weights are then unchanged.
    pub fn step(&mut self, loss: f64, gradient: &[f32], weights: &mut [f32], learning_rate: f64) -> Result<f64> {
        check_length("gradient [P]", gradient.len(), self.optimiser.size())?;
        check_length("weights [P]", weights.len(), self.optimiser.size())?;
        self.check_finite("the loss", loss)?;
        let mut norm = 0.0;
        run(Norm { gradient, norm: &mut norm });
        self.check_finite("the norm of the gradient", norm)?;
        let scale = if norm > self.max_grad_norm { (self.max_grad_norm / norm) as f32 } else { 1.0 };
        let keep = (1.0 - learning_rate * self.weight_decay) as f32;
        self.optimiser.step(self.n_updates, GradientStep { learning_rate, weights, gradient, scale, keep });
        self.n_updates += 1;
        Ok(norm)
    }

    fn check_finite(&self, what: &'static str, value: f64) -> Result<()> {
        if value.is_finite() { Ok(()) } else { Err(Error::NotFinite { what, value, update: self.n_updates }) }
    }

    /// Returns the running averages as named arrays, each `[P]`.
    pub fn state(&self) -> Vec<NamedArray> {
        let array = |(name, data): (&str, &[f32])| NamedArray {
            name: name.to_owned(),
            shape: vec![data.len()],
            data: data.to_vec(),
        };
        self.optimiser.averages().into_iter().map(array).collect()
    }

    /// Restores the number of gradient steps and the running averages that [`Optimiser::state`] returned.
    ///
    /// # Errors
    /// [`Error::Arrays`] if names or shapes differ, for example because the arrays are from another update rule.
    pub fn load_state(&mut self, n_updates: u64, arrays: &[NamedArray]) -> Result<()> {
        let size = self.optimiser.size();
        let mut averages = self.optimiser.averages_mut();
        let layout: Vec<_> = averages.iter().map(|(name, _)| ((*name).to_owned(), vec![size])).collect();
        check_arrays(arrays, &layout)?;
        for ((_, average), array) in averages.iter_mut().zip(arrays) {
            average.copy_from_slice(&array.data);
        }
        self.n_updates = n_updates;
        Ok(())
    }
}

/// The arguments of the vectorised norm √(Σ_i g_i²). It is computed in f64, in [`SUMS`] partial sums.
struct Norm<'a> {
    gradient: &'a [f32],
    norm: &'a mut f64,
}

impl Kernel for Norm<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let mut sums = [0.0f64; SUMS];
        let (chunks, rest) = self.gradient.as_chunks::<SUMS>();
        for chunk in chunks {
            for lane in 0..SUMS {
                sums[lane] += f64::from(chunk[lane]) * f64::from(chunk[lane]);
            }
        }
        for (sum, &g) in sums.iter_mut().zip(rest) {
            *sum += f64::from(g) * f64::from(g);
        }
        *self.norm = sums.iter().sum::<f64>().sqrt();
    }
}

#[cfg(test)]
mod tests;
