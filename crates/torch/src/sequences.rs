//! The sequences of steps on which a policy is evaluated.

use tch::{Device, Kind, Tensor};

use crate::error::Result;
use perturb_policy::PolicySpec;
use perturb_policy::check_length;

/// M sequences of L steps, as tensors. Sample l·M + m is step l of sequence m, and there are B = L·M samples. Shorter
/// sequences are padded; padding is not a sample, so B is then smaller.
///
/// A sequence is a series of steps that a minibatch cannot split. A recurrent policy needs the steps of an environment
/// in order: M = N, L = T. For a feed-forward policy each step is a sequence: M = T·N, L = 1. In both cases the samples
/// have the order of the rollout, and a minibatch is a set of sequences.
#[derive(Debug)]
pub struct Sequences {
    /// `[L, M, O]` normalised observations.
    observations: Tensor,
    /// `[L, M]`: 1 at the start of an episode, else 0.
    starts: Tensor,
    /// `[M, S]` memory before the first step, with S = [`PolicySpec::memory_size`].
    memory: Tensor,
    /// The mask that excludes padding; `None` if there is no padding.
    padding: Option<Padding>,
}

/// A mask of the L·M steps that are samples rather than padding.
#[derive(Debug)]
struct Padding {
    /// `[L, M]`: 1 for samples, 0 for padding.
    mask: Tensor,
    /// `[B]` indices of the samples in the flattened mask.
    samples: Tensor,
}

impl Padding {
    /// Creates the mask in which the first `lengths` `[M]` steps of each sequence are samples.
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
    /// Creates the sequences of T steps of N environments. `observations` `[T, N, O]` are normalised, `starts` `[T, N]`
    /// says whether an episode starts with the step, and `memory` `[N, S]` is the policy's memory before the first
    /// step. N is the length of `starts` divided by `n_steps`.
    ///
    /// # Errors
    /// An error if an array has the wrong length.
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

    /// Marks the steps of sequence m after its first `lengths[m]` steps as padding.
    ///
    /// # Errors
    /// An error if the number of lengths is not M.
    pub fn with_lengths(self, lengths: &[usize]) -> Result<Self> {
        check_length("lengths [M]", lengths.len(), self.count() as usize)?;
        let padding = Some(Padding::new(self.n_steps(), lengths)?);
        Ok(Sequences { padding, ..self })
    }

    /// Returns L, the number of steps.
    pub fn n_steps(&self) -> i64 {
        self.starts.size()[0]
    }

    /// Returns M, the number of sequences.
    pub fn count(&self) -> i64 {
        self.starts.size()[1]
    }

    /// Returns the sequences at `indices`.
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

    /// Returns the rows of `rows` `[L, M, …]` that are samples, `[B, …]`.
    pub(crate) fn samples(&self, rows: &Tensor) -> Result<Tensor> {
        let flat = rows.f_flatten(0, 1)?;
        Ok(match &self.padding {
            Some(padding) => flat.f_index_select(0, &padding.samples)?,
            None => flat,
        })
    }

    /// Returns the rows of `rows` `[L·M, …]` that are samples, `[B, …]`.
    pub(super) fn without_padding(&self, rows: Tensor) -> Tensor {
        match &self.padding {
            Some(padding) => rows.index_select(0, &padding.samples),
            None => rows,
        }
    }

    /// Returns the observations of all L·M steps, `[L·M, O]`.
    pub(super) fn flat_observations(&self) -> Tensor {
        self.observations.flatten(0, 1)
    }

    /// Returns a tensor `[L, M, 1]` with 0 at the start of an episode, else 1.
    pub(super) fn keep(&self) -> Tensor {
        (1f64 - &self.starts).unsqueeze(2)
    }

    /// Returns for each step `[L]` whether an episode starts there in any sequence.
    pub(super) fn steps_with_starts(&self) -> Vec<bool> {
        let counts = self.starts.sum_dim_intlist(Some([1i64].as_slice()), false, Kind::Float);
        Vec::<f32>::from(counts).into_iter().map(|count| count > 0.0).collect()
    }

    /// Returns the two halves of the memory before the first step: h and c, `[M, H]` each.
    pub(super) fn initial_memory(&self, width: i64) -> (Tensor, Tensor) {
        (self.memory.narrow(1, 0, width), self.memory.narrow(1, width, width))
    }
}
