//! Optimisers over a policy's P weights as one array.

use pulp::Simd;

use crate::error::{Error, Result, check_length};
use crate::kernel::{Kernel, run};
use crate::weights::{NamedArray, check_arrays};

/// Number of partial sums that are computed side by side. It fixes the order of a sum.
const SUMS: usize = 8;

/// The rule that turns a gradient into a step.
#[derive(Clone, Debug)]
pub enum UpdateRule {
    /// RMSProp.
    RmsProp(RmsProp),
    /// Adam.
    Adam(Adam),
}

/// RMSProp (Hinton, 2012, lecture 6e) in TensorFlow's form, which the reference uses: for i = 0 … P-1,
///
/// s_i ← α s_i + (1 - α) g_i²,
/// w_i ← w_i - η g_i/√(s_i + ε),
///
/// where s starts at 1 and ε is inside the root. libtorch starts s at 0 and adds ε outside, which makes the first steps ten
/// times as long: A2C is known to be less stable with it.
#[derive(Clone, Debug)]
pub struct RmsProp {
    alpha: f32,
    epsilon: f32,
    mean_square: Vec<f32>,
}

/// Adam, Kingma and Ba (2015), arXiv:1412.6980, algorithm 1, with β₁ = 0.9 and β₂ = 0.999: for i = 0 … P-1 and
/// t = 1, 2, …,
///
/// m_i ← β₁ m_i + (1 - β₁) g_i,
/// v_i ← β₂ v_i + (1 - β₂) g_i²,
/// w_i ← w_i - η/(1 - β₁ᵗ) m_i/(√(v_i/(1 - β₂ᵗ)) + ε).
///
/// This is libtorch's form. TensorFlow, which the reference uses, adds ε to √v_i before the correction. So its ε is larger
/// by up to √1000 in the first steps. With ε = 1e-5 this matters only to weights whose gradient is that small.
#[derive(Clone, Debug)]
pub struct Adam {
    epsilon: f32,
    mean: Vec<f32>,
    mean_square: Vec<f32>,
}

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;

impl UpdateRule {
    /// RMSProp with decay α and ε for `n_weights` weights.
    pub fn rms_prop(alpha: f64, epsilon: f64, n_weights: usize) -> Self {
        let mean_square = vec![1.0; n_weights];
        UpdateRule::RmsProp(RmsProp { alpha: alpha as f32, epsilon: epsilon as f32, mean_square })
    }

    /// Adam with ε for `n_weights` weights.
    pub fn adam(epsilon: f64, n_weights: usize) -> Self {
        let mean = vec![0.0; n_weights];
        let mean_square = vec![0.0; n_weights];
        UpdateRule::Adam(Adam { epsilon: epsilon as f32, mean, mean_square })
    }

    /// Makes a step on `weights` `[P]` against a gradient; `update` counts the steps before this one.
    fn step(&mut self, update: u64, step: GradientStep<'_>) {
        match self {
            UpdateRule::RmsProp(state) => run(RmsPropStep { state, step }),
            UpdateRule::Adam(state) => run(AdamStep { state, update, step }),
        }
    }

    /// P.
    fn size(&self) -> usize {
        match self {
            UpdateRule::RmsProp(state) => state.mean_square.len(),
            UpdateRule::Adam(state) => state.mean.len(),
        }
    }

    /// The running averages, by name, each `[P]`.
    fn averages(&self) -> Vec<(&'static str, &[f32])> {
        match self {
            UpdateRule::RmsProp(state) => vec![("mean_square", &state.mean_square)],
            UpdateRule::Adam(state) => vec![("mean", &state.mean), ("mean_square", &state.mean_square)],
        }
    }

    /// The running averages by name, to be overwritten.
    fn averages_mut(&mut self) -> Vec<(&'static str, &mut [f32])> {
        match self {
            UpdateRule::RmsProp(state) => vec![("mean_square", &mut state.mean_square)],
            UpdateRule::Adam(state) => vec![("mean", &mut state.mean), ("mean_square", &mut state.mean_square)],
        }
    }
}

/// The inputs of a step.
struct GradientStep<'a> {
    learning_rate: f64,
    /// `[P]`
    weights: &'a mut [f32],
    /// `[P]`
    gradient: &'a [f32],
    /// The share of the gradient that is left after clipping, 0 … 1.
    scale: f32,
    /// The share of each weight that is left after decay, 0 … 1.
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

/// Takes gradient steps: clips the gradient by its global norm, applies the update rule, and lets all weights decay,
///
/// w_i ← (1 - η λ) w_i - the rule's step,
///
/// Loshchilov and Hutter (2019), arXiv:1711.05101, as libtorch's AdamW. The decay is decoupled: the update rule scales
/// gradients, but not the decay.
#[derive(Clone, Debug)]
pub struct Optimiser {
    optimiser: UpdateRule,
    max_grad_norm: f64,
    weight_decay: f64,
    n_updates: u64,
}

impl Optimiser {
    /// A fresh optimiser. Gradients longer than `max_grad_norm` are scaled down to it, and no weight decays.
    pub fn new(optimiser: UpdateRule, max_grad_norm: f64) -> Self {
        Optimiser { optimiser, max_grad_norm, weight_decay: 0.0, n_updates: 0 }
    }

    /// Sets the decay λ = `weight_decay`, at least 0.
    #[must_use]
    pub fn with_weight_decay(self, weight_decay: f64) -> Self {
        Optimiser { weight_decay, ..self }
    }

    /// Gradient steps so far.
    pub fn n_updates(&self) -> u64 {
        self.n_updates
    }

    /// Makes a step of `weights` `[P]` down the `gradient` `[P]` of a loss whose value is `loss`. Returns the gradient's global
    /// norm before clipping.
    ///
    /// Clipping scales the whole gradient by max_grad_norm/norm where norm > max_grad_norm, exactly, as TensorFlow's
    /// `clip_by_global_norm`; libtorch adds 1e-6 to the norm.
    ///
    /// # Errors
    /// [`Error::NotFinite`] for a loss or a gradient that is not finite, [`Error::Length`]; nothing is changed then.
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

    /// The running averages as named arrays, each `[P]`.
    pub fn state(&self) -> Vec<NamedArray> {
        let array = |(name, data): (&str, &[f32])| NamedArray {
            name: name.to_owned(),
            shape: vec![data.len()],
            data: data.to_vec(),
        };
        self.optimiser.averages().into_iter().map(array).collect()
    }

    /// Restores a saved state.
    ///
    /// # Errors
    /// [`Error::Arrays`] if it is another optimiser's.
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

/// √ Σ_i g_i² in f64, in [`SUMS`] sums side by side.
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
