//! Optimisers over a policy's P weights as one array, in plain f32 loops.
//!
//! libtorch's own optimisers do not hand out their state through tch; these can be stored and resumed exactly.

use tch::Tensor;

use crate::error::{Error, Result};
use crate::policy::{Evaluated, NamedArray, Policy, check_arrays};

/// Numbers that are summed side by side; the order of a sum is fixed by it.
const LANES: usize = 8;

/// Changes weights against a gradient.
pub(super) trait Optimiser: Send {
    /// One step on `weights` `[P]` against `gradient` `[P]`; `update` counts the steps before this one.
    fn step(&mut self, update: u64, learning_rate: f64, weights: &mut [f32], gradient: &[f32]);

    /// The running averages, by name, each `[P]`.
    fn averages(&self) -> Vec<(&'static str, &[f32])>;

    /// The same, to be overwritten.
    fn averages_mut(&mut self) -> Vec<(&'static str, &mut [f32])>;
}

/// RMSProp (Hinton, 2012, lecture 6e) as TensorFlow's and so the reference's: for i = 0 … P-1,
///
/// s_i ← α s_i + (1 - α) g_i²,
/// w_i ← w_i - η g_i/√(s_i + ε),
///
/// where s starts at 1 and ε is inside the root. libtorch's starts s at 0 and adds ε outside, which makes the first
/// steps ten times as long: A2C is known to be less stable with it.
pub(super) struct RmsProp {
    alpha: f32,
    epsilon: f32,
    mean_square: Vec<f32>,
}

impl RmsProp {
    pub(super) fn new(alpha: f64, epsilon: f64, n_weights: usize) -> Self {
        RmsProp { alpha: alpha as f32, epsilon: epsilon as f32, mean_square: vec![1.0; n_weights] }
    }
}

impl Optimiser for RmsProp {
    fn step(&mut self, _update: u64, learning_rate: f64, weights: &mut [f32], gradient: &[f32]) {
        let learning_rate = learning_rate as f32;
        for ((w, s), g) in weights.iter_mut().zip(&mut self.mean_square).zip(gradient) {
            *s = self.alpha * *s + (1.0 - self.alpha) * g * g;
            *w -= learning_rate * g / (*s + self.epsilon).sqrt();
        }
    }

    fn averages(&self) -> Vec<(&'static str, &[f32])> {
        vec![("mean_square", &self.mean_square)]
    }

    fn averages_mut(&mut self) -> Vec<(&'static str, &mut [f32])> {
        vec![("mean_square", &mut self.mean_square)]
    }
}

/// Adam, Kingma and Ba (2015), arXiv:1412.6980, algorithm 1, with β₁ = 0.9 and β₂ = 0.999: for i = 0 … P-1 and
/// t = 1, 2, …,
///
/// m_i ← β₁ m_i + (1 - β₁) g_i,
/// v_i ← β₂ v_i + (1 - β₂) g_i²,
/// w_i ← w_i - η/(1 - β₁ᵗ) m_i/(√(v_i/(1 - β₂ᵗ)) + ε).
///
/// As libtorch's. TensorFlow's, the reference's, adds ε to √v_i before the correction instead, so that its ε is larger
/// by up to √1000 in the first steps; with ε = 1e-5 this matters only to weights whose gradient is that small.
pub(super) struct Adam {
    epsilon: f32,
    mean: Vec<f32>,
    mean_square: Vec<f32>,
}

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;

impl Adam {
    pub(super) fn new(epsilon: f64, n_weights: usize) -> Self {
        Adam { epsilon: epsilon as f32, mean: vec![0.0; n_weights], mean_square: vec![0.0; n_weights] }
    }
}

impl Optimiser for Adam {
    fn step(&mut self, update: u64, learning_rate: f64, weights: &mut [f32], gradient: &[f32]) {
        let t = (update + 1) as f64;
        let step_size = (learning_rate / (1.0 - BETA_1.powf(t))) as f32;
        let root_correction = (1.0 / (1.0 - BETA_2.powf(t)).sqrt()) as f32;
        let (beta_1, rest_1) = (BETA_1 as f32, (1.0 - BETA_1) as f32);
        let (beta_2, rest_2) = (BETA_2 as f32, (1.0 - BETA_2) as f32);
        let averages = self.mean.iter_mut().zip(&mut self.mean_square);
        for ((w, (m, v)), g) in weights.iter_mut().zip(averages).zip(gradient) {
            *m = beta_1 * *m + rest_1 * g;
            *v = beta_2 * *v + rest_2 * g * g;
            *w -= step_size * *m / (v.sqrt() * root_correction + self.epsilon);
        }
    }

    fn averages(&self) -> Vec<(&'static str, &[f32])> {
        vec![("mean", &self.mean), ("mean_square", &self.mean_square)]
    }

    fn averages_mut(&mut self) -> Vec<(&'static str, &mut [f32])> {
        vec![("mean", &mut self.mean), ("mean_square", &mut self.mean_square)]
    }
}

/// Takes gradient steps on a policy: gradient, clipping by global norm, optimiser.
pub(super) struct Descent {
    optimiser: Box<dyn Optimiser>,
    max_grad_norm: f64,
    n_updates: u64,
    /// `[P]` room for the weights.
    weights: Vec<f32>,
    /// `[P]` room for the gradient.
    gradient: Vec<f32>,
}

impl Descent {
    pub(super) fn new(optimiser: impl Optimiser + 'static, max_grad_norm: f64, policy: &Policy) -> Self {
        let size = policy.n_weights();
        let (weights, gradient) = (vec![0.0; size], vec![0.0; size]);
        Descent { optimiser: Box::new(optimiser), max_grad_norm, n_updates: 0, weights, gradient }
    }

    /// Gradient steps so far.
    pub(super) fn n_updates(&self) -> u64 {
        self.n_updates
    }

    /// One step down `loss`, which was computed from `evaluated`. Gives the gradient's global norm before clipping. A loss or a gradient that is not finite
    /// is an error and changes nothing.
    ///
    /// Clipping scales the whole gradient by max_grad_norm/norm where norm > max_grad_norm, exactly, as TensorFlow's
    /// `clip_by_global_norm`; libtorch adds 1e-6 to the norm.
    pub(super) fn step(
        &mut self,
        policy: &mut Policy,
        evaluated: &Evaluated,
        loss: &Tensor,
        learning_rate: f64,
    ) -> Result<f64> {
        self.check_finite("the loss", loss.double_value(&[]))?;
        policy.gradient(evaluated, loss, &mut self.gradient)?;
        let norm = norm(&self.gradient);
        self.check_finite("the norm of the gradient", norm)?;
        if norm > self.max_grad_norm {
            let scale = (self.max_grad_norm / norm) as f32;
            self.gradient.iter_mut().for_each(|g| *g *= scale);
        }
        policy.read(&mut self.weights);
        self.optimiser.step(self.n_updates, learning_rate, &mut self.weights, &self.gradient);
        policy.write(&self.weights)?;
        self.n_updates += 1;
        Ok(norm)
    }

    fn check_finite(&self, what: &'static str, value: f64) -> Result<()> {
        if value.is_finite() { Ok(()) } else { Err(Error::NotFinite { what, value, update: self.n_updates }) }
    }

    /// The running averages as named arrays, each `[P]`.
    pub(super) fn state(&self) -> Vec<NamedArray> {
        let array = |(name, data): (&str, &[f32])| NamedArray {
            name: name.to_owned(),
            shape: vec![data.len()],
            data: data.to_vec(),
        };
        self.optimiser.averages().into_iter().map(array).collect()
    }

    /// Goes on from a saved state.
    pub(super) fn load_state(&mut self, n_updates: u64, arrays: &[NamedArray]) -> Result<()> {
        let size = self.weights.len();
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

/// √ Σ_i g_i² in f64, in [`LANES`] sums side by side.
fn norm(gradient: &[f32]) -> f64 {
    let mut sums = [0.0f64; LANES];
    for chunk in gradient.chunks(LANES) {
        for (sum, &g) in sums.iter_mut().zip(chunk) {
            *sum += f64::from(g) * f64::from(g);
        }
    }
    sums.iter().sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use tch::nn::{self, OptimizerConfig};
    use tch::{Device, Kind};

    use super::*;
    use crate::fixture::{fixture, fixture_f32};
    use crate::policy::{ActionKind, PolicySpec, Sequences};

    fn run(mut optimiser: impl Optimiser) -> Vec<f32> {
        let mut weights = fixture_f32("optimisers", "weights");
        for (t, gradient) in fixture_f32("optimisers", "gradients").chunks(3).enumerate() {
            optimiser.step(t as u64, 0.01, &mut weights, gradient);
        }
        weights
    }

    /// Five steps of weights below 2 in f32, each rounded to 2⁻²⁴.
    const TOLERANCE: f64 = 1e-6;

    #[test]
    fn adam_agrees_with_numpy_and_with_libtorch() {
        let got = run(Adam::new(0.25, 3));
        let store = nn::VarStore::new(Device::Cpu);
        let mut w = store.root().zeros("w", &[3]);
        tch::no_grad(|| w.copy_(&Tensor::of_slice(&fixture_f32("optimisers", "weights"))));
        let mut adam = nn::Adam::default().eps(0.25).build(&store, 0.01).expect("libtorch's Adam");
        for gradient in fixture_f32("optimisers", "gradients").chunks(3) {
            adam.backward_step(&(&w * Tensor::of_slice(gradient)).sum(Kind::Float)); // its gradient is `gradient`
        }
        let torch: Vec<f32> = w.into();
        for ((got, numpy), torch) in got.iter().zip(fixture("optimisers", "adam")).zip(torch) {
            assert!((f64::from(*got) - numpy).abs() < TOLERANCE, "{got} {numpy}");
            assert!((f64::from(*got) - f64::from(torch)).abs() < TOLERANCE, "{got} {torch}");
        }
    }

    #[test]
    fn rms_prop_agrees_with_numpy() {
        for (got, numpy) in run(RmsProp::new(0.99, 0.25, 3)).iter().zip(fixture("optimisers", "rms_prop")) {
            assert!((f64::from(*got) - numpy).abs() < TOLERANCE, "{got} {numpy}");
        }
    }

    /// Records the gradients that it is given.
    struct Recorder(Vec<f32>);

    impl Optimiser for Recorder {
        fn step(&mut self, _update: u64, _learning_rate: f64, weights: &mut [f32], gradient: &[f32]) {
            weights.copy_from_slice(gradient);
        }
        fn averages(&self) -> Vec<(&'static str, &[f32])> {
            vec![("recorder", &self.0)]
        }
        fn averages_mut(&mut self) -> Vec<(&'static str, &mut [f32])> {
            vec![("recorder", &mut self.0)]
        }
    }

    #[test]
    fn long_gradients_are_scaled_to_the_largest_norm_and_short_ones_left_alone() {
        let spec =
            PolicySpec { observation_size: 2, action: ActionKind::Discrete { n: 2 }, hidden: vec![3], lstm: None };
        let policy = Policy::new(spec, 1).expect("a policy");
        let one = Sequences::new(policy.spec(), 1, &[1.0, -2.0], &[true], &[]).expect("one observation");
        let loss = |policy: &Policy| {
            let evaluated = policy.evaluate(&one, &Tensor::of_slice(&[1.0f32]).view((1, 1)));
            let loss = (&evaluated.log_probs + &evaluated.values * 3.0).sum(Kind::Float);
            (evaluated, loss)
        };
        let mut gradient = vec![0.0; policy.n_weights()];
        let (evaluated, sum) = loss(&policy);
        policy.gradient(&evaluated, &sum, &mut gradient).expect("a gradient");
        let full = gradient.iter().map(|&g| f64::from(g).powi(2)).sum::<f64>().sqrt();
        for (largest, scale) in [(0.5, 0.5 / full), (2.0 * full, 1.0)] {
            let mut fresh = Policy::from_weights(policy.spec().clone(), &policy.weights()).expect("a policy");
            let (evaluated, loss) = loss(&fresh);
            let mut descent = Descent::new(Recorder(vec![]), largest, &fresh);
            let reported = descent.step(&mut fresh, &evaluated, &loss, 1.0).expect("a step");
            assert!((reported - full).abs() < 1e-12 * full, "the sum in another order");
            let mut given = vec![0.0; gradient.len()];
            fresh.read(&mut given);
            for (given, g) in given.iter().zip(&gradient) {
                // Two roundings to f32: of the scale and of the product.
                assert!((f64::from(*given) - scale * f64::from(*g)).abs() <= 1.2e-7 * scale * f64::from(g.abs()));
            }
        }
    }
}
