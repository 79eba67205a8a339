//! The samples of a rollout, from which gradients are computed.

use crate::error::{Result, check_length};
use crate::objective::Acting;
use crate::spec::PolicySpec;

/// B samples of a rollout.
#[derive(Clone, Copy, Debug)]
pub struct Samples<'a> {
    /// `[B, O]` normalised observations.
    pub observations: &'a [f32],
    /// `[B, A]` actions. A discrete action has A = 1 and is its index.
    pub actions: &'a [f32],
    /// `[B]` log-probabilities of the actions under the policy that acted.
    pub old_log_probs: &'a [f32],
    /// `[B]` values V that the policy computed when it acted.
    pub old_values: &'a [f32],
    /// `[B]` advantages.
    pub advantages: &'a [f32],
    /// `[B]` target values for V.
    pub returns: &'a [f32],
    /// The action distributions of the policy that acted, if the loss has a KL divergence.
    pub acting: Option<Acting<'a>>,
}

/// Sequences of T steps of N environments. A recurrent policy needs each sequence as a whole. There are B = T·N
/// samples; step t of environment n is sample t·N + n.
#[derive(Clone, Copy, Debug)]
pub struct SequenceSamples<'a> {
    /// The samples, whose arrays are `[T, N, …]`.
    pub samples: Samples<'a>,
    /// T, the number of steps.
    pub n_steps: usize,
    /// `[T, N]` whether the step is the first of an episode.
    pub starts: &'a [bool],
    /// `[N, S]` memory of the policy before the first step, with S = [`PolicySpec::memory_size`].
    pub memory: &'a [f32],
    /// `[N]` number of steps of each environment that are samples; later steps are padding. `None` if there is no
    /// padding.
    pub lengths: Option<&'a [usize]>,
}

impl Samples<'_> {
    /// Checks that all arrays have the same number of samples and fit a policy of shape `spec`.
    pub(crate) fn check(&self, spec: &PolicySpec) -> Result<()> {
        let Samples { observations, actions, old_log_probs, old_values, advantages, returns, acting } = self;
        let n = returns.len();
        check_length("observations [B, O]", observations.len(), n * spec.observation_size)?;
        check_length("actions [B, A]", actions.len(), n * spec.action.width())?;
        for (name, got) in
            [("old_log_probs [B]", old_log_probs), ("old_values [B]", old_values), ("advantages [B]", advantages)]
        {
            check_length(name, got.len(), n)?;
        }
        let Some(acting) = acting else { return Ok(()) };
        check_length("acting outputs [B, n]", acting.outputs.len(), n * spec.action.outputs())?;
        check_length("acting log_std [A]", acting.log_std.len(), spec.action.log_stds())
    }

    /// Returns the mean of the advantages at `indices`, and 1/(standard deviation + 10⁻⁸).
    pub(crate) fn mean_and_scale(&self, indices: &[u32]) -> (f32, f32) {
        let picked = || indices.iter().map(|&i| f64::from(self.advantages[i as usize]));
        let n = indices.len() as f64;
        let mean = picked().sum::<f64>() / n;
        let variance = picked().map(|x| (x - mean) * (x - mean)).sum::<f64>() / n;
        (mean as f32, (1.0 / (variance.sqrt() + 1e-8)) as f32)
    }
}

impl SequenceSamples<'_> {
    /// Returns the indices t·N + n of all samples that are not padding, in order.
    pub fn indices(&self) -> Vec<u32> {
        let count = self.samples.returns.len();
        let Some(lengths) = self.lengths else { return (0..count as u32).collect() };
        let n_envs = lengths.len();
        let places = (0..self.n_steps).flat_map(|t| (0..n_envs).map(move |n| (t, n)));
        places.filter(|&(t, n)| t < lengths[n]).map(|(t, n)| (t * n_envs + n) as u32).collect()
    }
}
