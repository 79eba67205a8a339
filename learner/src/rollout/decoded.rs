//! Decodes rollouts that a server played.

use crate::proto;
use perturb_policy::{ActionKind, PolicySpec, RolloutStep};

/// The decoded arrays of a reply. Reuse the same value for all replies, so that its memory is allocated once.
#[derive(Debug, Default)]
pub struct DecodedRollout {
    observations: Vec<f32>,
    starts: Vec<bool>,
    actions: Vec<f32>,
    log_probs: Vec<f32>,
    values: Vec<f32>,
    rewards: Vec<f32>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    truncation_values: Vec<f32>,
    last_values: Vec<f32>,
}

impl DecodedRollout {
    /// Decodes the reply `acted`, which a policy of shape `spec` played. Replaces all arrays.
    ///
    /// # Errors
    /// A text with the name and the fault of an invalid array.
    pub fn decode(&mut self, acted: &proto::Acted, spec: &PolicySpec) -> Result<(), String> {
        read(&mut self.observations, "observations", &acted.observations, f32::from_le_bytes)?;
        if let ActionKind::Discrete { n } = spec.action {
            read(&mut self.actions, "actions", &acted.actions, |word| i32::from_le_bytes(word) as f32)?;
            if let Some(action) = self.actions.iter().find(|&&action| !(0.0..n as f32).contains(&action)) {
                return Err(format!("action {action} of {n}"));
            }
        } else {
            read(&mut self.actions, "actions", &acted.actions, f32::from_le_bytes)?;
        }
        read(&mut self.log_probs, "log_probs", &acted.log_probs, f32::from_le_bytes)?;
        read(&mut self.values, "values", &acted.values, f32::from_le_bytes)?;
        read(&mut self.rewards, "rewards", &acted.rewards, f32::from_le_bytes)?;
        read(&mut self.truncation_values, "truncation_values", &acted.truncation_values, f32::from_le_bytes)?;
        read(&mut self.last_values, "last_values", &acted.last_values, f32::from_le_bytes)?;
        flags(&mut self.starts, &acted.starts);
        flags(&mut self.terminated, &acted.terminated);
        flags(&mut self.truncated, &acted.truncated);
        Ok(())
    }

    /// Returns the steps as arrays `[T, N, …]`.
    pub fn steps(&self) -> RolloutStep<'_> {
        RolloutStep {
            observations: &self.observations,
            starts: &self.starts,
            actions: &self.actions,
            log_probs: &self.log_probs,
            values: &self.values,
            rewards: &self.rewards,
            terminated: &self.terminated,
            truncated: &self.truncated,
            truncation_values: &self.truncation_values,
        }
    }

    /// Returns the values `[N]` of the observations after the last step. Empty unless the rollout is finished.
    pub fn last_values(&self) -> &[f32] {
        &self.last_values
    }
}

/// Decodes an array of 4-byte numbers. `name` names it in the error.
fn read(out: &mut Vec<f32>, name: &str, bytes: &[u8], number: impl Fn([u8; 4]) -> f32) -> Result<(), String> {
    let (words, rest) = bytes.as_chunks::<4>();
    out.clear();
    out.extend(words.iter().map(|word| number(*word)));
    if rest.is_empty() { Ok(()) } else { Err(format!("{} bytes of {name}", bytes.len())) }
}

/// Decodes an array of flags, one byte each.
fn flags(out: &mut Vec<bool>, bytes: &[u8]) {
    out.clear();
    out.extend(bytes.iter().map(|&flag| flag != 0));
}
