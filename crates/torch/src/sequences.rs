//! The sequences that a policy is evaluated on.

use tch::{Device, Kind, Tensor};

use crate::error::Result;
use perturb_policy::PolicySpec;
use perturb_policy::check_length;

/// M sequences of L steps, on libtorch. Flattened to B = L·M samples, sample l·M + m is step l of sequence m. Shorter
/// sequences are padded; padding is no sample, so B is then less.
///
/// A sequence is what a policy must see whole. A recurrent policy needs the steps of an environment in order: M = N, L = T.
/// A feed-forward policy takes every step by itself: M = T·N, L = 1. In both cases the samples have the rollout's order,
/// and a minibatch is a set of sequences.
#[derive(Debug)]
pub struct Sequences {
    /// `[L, M, O]`.
    observations: Tensor,
    /// `[L, M]`: 1 where an episode starts, else 0.
    starts: Tensor,
    /// `[M, S]`, S = [`PolicySpec::memory_size`].
    memory: Tensor,
    /// The mask of the samples; `None` if all L·M steps are samples.
    padding: Option<Padding>,
}

/// A mask of the steps, L·M, that are samples.
#[derive(Debug)]
struct Padding {
    /// `[L, M]`: 1 for samples, 0 for padding.
    mask: Tensor,
    /// `[B]`: places of the samples in the flattened mask.
    samples: Tensor,
}

impl Padding {
    /// The first `lengths` `[M]` steps of every sequence are samples.
    fn new(n_steps: i64, lengths: &[usize]) -> Result<Self> {
        let lengths: Vec<i64> = lengths.iter().map(|&length| length as i64).collect();
        let steps = Tensor::f_arange(n_steps, (Kind::Int64, Device::Cpu))?.f_unsqueeze(1)?;
        Padding::from_mask(steps.f_lt_tensor(&Tensor::f_of_slice(&lengths)?.f_unsqueeze(0)?)?)
    }

    fn from_mask(mask: Tensor) -> Result<Self> {
        Ok(Padding { samples: mask.f_flatten(0, 1)?.f_nonzero()?.f_squeeze_dim(1)?, mask })
    }
}

impl Sequences {
    /// The sequences of T steps of N environments: normalised `observations` `[T, N, O]`, `starts` `[T, N]`, whether an
    /// episode starts with that step, and `memory` `[N, S]` before the first. N is the length of `starts` / `n_steps`.
    ///
    /// # Errors
    /// Lengths that do not fit.
    pub fn new(
        spec: &PolicySpec,
        n_steps: usize,
        observations: &[f32],
        starts: &[bool],
        memory: &[f32],
    ) -> Result<Self> {
        let n_envs = starts.len() / n_steps.max(1);
        check_length("starts [T, N]", starts.len(), n_steps * n_envs)?;
        check_length("observations [T, N, O]", observations.len(), starts.len() * spec.observation_size)?;
        check_length("memory [N, S]", memory.len(), n_envs * spec.memory_size())?;
        let (steps, count) = if spec.lstm.is_some() { (n_steps, n_envs) } else { (1, starts.len()) };
        let steps = steps as i64;
        let count = count as i64;
        Ok(Sequences {
            observations: Tensor::f_of_slice(observations)?.f_view((steps, count, spec.observation_size as i64))?,
            starts: Tensor::f_of_slice(starts)?.f_to_kind(Kind::Float)?.f_view((steps, count))?,
            memory: Tensor::f_of_slice(memory)?.f_view((count, spec.memory_size() as i64))?,
            padding: None,
        })
    }

    /// Makes only the first `lengths[m]` steps of sequence m samples; the others are padding.
    ///
    /// # Errors
    /// A number of lengths other than M.
    pub fn with_lengths(self, lengths: &[usize]) -> Result<Self> {
        check_length("lengths [M]", lengths.len(), self.count() as usize)?;
        let padding = Some(Padding::new(self.n_steps(), lengths)?);
        Ok(Sequences { padding, ..self })
    }

    /// L, the number of steps.
    pub fn n_steps(&self) -> i64 {
        self.starts.size()[0]
    }

    /// M, the number of sequences.
    pub fn count(&self) -> i64 {
        self.starts.size()[1]
    }

    /// The sequences at `indices`.
    pub(crate) fn select(&self, indices: &Tensor) -> Result<Self> {
        Ok(Sequences {
            observations: self.observations.f_index_select(1, indices)?,
            starts: self.starts.f_index_select(1, indices)?,
            memory: self.memory.f_index_select(0, indices)?,
            padding: match &self.padding {
                Some(padding) => Some(Padding::from_mask(padding.mask.f_index_select(1, indices)?)?),
                None => None,
            },
        })
    }

    /// The samples' rows of `rows` `[L, M, …]`: `[B, …]`.
    pub(crate) fn samples(&self, rows: &Tensor) -> Result<Tensor> {
        let flat = rows.f_flatten(0, 1)?;
        Ok(match &self.padding {
            Some(padding) => flat.f_index_select(0, &padding.samples)?,
            None => flat,
        })
    }

    /// The samples' rows of `rows` `[L·M, …]`: `[B, …]`.
    pub(super) fn without_padding(&self, rows: Tensor) -> Tensor {
        match &self.padding {
            Some(padding) => rows.index_select(0, &padding.samples),
            None => rows,
        }
    }

    /// The observations of all samples `[B, O]`.
    pub(super) fn flat_observations(&self) -> Tensor {
        self.observations.flatten(0, 1)
    }

    /// `[L, M, 1]`: 0 where an episode starts, else 1.
    pub(super) fn keep(&self) -> Tensor {
        (1f64 - &self.starts).unsqueeze(2)
    }

    /// `[L]`: whether an episode starts in any sequence.
    pub(super) fn steps_with_starts(&self) -> Vec<bool> {
        let counts = self.starts.sum_dim_intlist(Some([1i64].as_slice()), false, Kind::Float);
        Vec::<f32>::from(counts).into_iter().map(|count| count > 0.0).collect()
    }

    /// The memory's halves before the first step, h and c, `[M, H]` each.
    pub(super) fn initial_memory(&self, width: i64) -> (Tensor, Tensor) {
        (self.memory.narrow(1, 0, width), self.memory.narrow(1, width, width))
    }
}
