//! Checks a server's replies for all clients. A reply that violates the protocol becomes an error, so that no policy
//! learns from it.

use crate::proto;

/// The error for a reply that violates the protocol.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{got}; expected {expected}")]
pub struct Malformed {
    /// The wrong part of the reply, e.g. "8 bytes of rewards".
    pub got: String,
    /// The value that the protocol requires instead.
    pub expected: String,
}

impl Malformed {
    fn new(got: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { got: got.into(), expected: expected.into() }
    }
}

/// Checks the reply to a step of N environments with observations of length O:
///
/// - The arrays have the lengths that follow from N and O.
/// - Flags are 0 or 1, and numbers are finite. Only an observation of diverged physics may hold any numbers.
/// - `ended` lists exactly the environments that are flagged as terminated or truncated, each once, by ascending slot.
///
/// # Errors
/// [`Malformed`] with the first violation.
pub fn check_step(stepped: &proto::Stepped, num_envs: usize, observation_size: usize) -> Result<(), Malformed> {
    let proto::Stepped { observations, rewards, terminated, truncated, ended, final_observations, .. } = stepped;
    let size = |rows: usize| rows.saturating_mul(observation_size).saturating_mul(4);
    check_length("observations", observations, size(num_envs))?;
    check_length("rewards", rewards, num_envs.saturating_mul(4))?;
    check_length("final_observations", final_observations, size(ended.len()))?;
    check_flags("terminated", terminated, num_envs)?;
    check_flags("truncated", truncated, num_envs)?;
    if let Some(slot) = first_not_finite(rewards) {
        return Err(Malformed::new(format!("the reward {} of slot {slot}", number(rewards, slot)), "a finite number"));
    }
    check_ended(ended, terminated, truncated)?;
    if first_not_finite(observations).is_some() {
        check_rows(observations, observation_size, ended)?;
    }
    Ok(())
}

/// Checks the first observations of episodes, float32 `[M, O]`: their length, and that they are finite. M is `rows`, O
/// is `observation_size`.
///
/// # Errors
/// [`Malformed`] with the first violation.
pub fn check_observations(observations: &[u8], rows: usize, observation_size: usize) -> Result<(), Malformed> {
    check_length("observations", observations, rows.saturating_mul(observation_size).saturating_mul(4))?;
    check_rows(observations, observation_size, &[])
}

fn check_length(field: &str, bytes: &[u8], expected: usize) -> Result<(), Malformed> {
    let got = bytes.len();
    if got == expected { Ok(()) } else { Err(Malformed::new(format!("{got} bytes of {field}"), expected.to_string())) }
}

fn check_flags(field: &str, flags: &[u8], num_envs: usize) -> Result<(), Malformed> {
    check_length(field, flags, num_envs)?;
    match flags.iter().position(|&flag| flag > 1) {
        Some(slot) => Err(Malformed::new(format!("the flag {} of {field} in slot {slot}", flags[slot]), "0 or 1")),
        None => Ok(()),
    }
}

fn check_ended(ended: &[proto::EpisodeEnd], terminated: &[u8], truncated: &[u8]) -> Result<(), Malformed> {
    let flagged = terminated.iter().zip(truncated).filter(|(terminated, truncated)| (**terminated | **truncated) != 0);
    let (flagged, mut next) = (flagged.count(), 0);
    for end in ended {
        let slot = end.slot as usize;
        if slot < next {
            return Err(Malformed::new(
                format!("an ended episode of slot {slot} again or late"),
                "slots in ascending order",
            ));
        }
        next = slot + 1;
        let flag =
            terminated.get(slot).zip(truncated.get(slot)).map_or(0, |(terminated, truncated)| terminated | truncated);
        if flag == 0 {
            let got = format!("an ended episode of slot {slot}, which is not flagged as ended");
            return Err(Malformed::new(got, "an episode of a slot that terminated or truncated flags"));
        }
    }
    if flagged != ended.len() {
        return Err(Malformed::new(
            format!("{} ended episodes", ended.len()),
            format!("{flagged}, the number of environments flagged as ended"),
        ));
    }
    Ok(())
}

fn check_rows(observations: &[u8], observation_size: usize, ended: &[proto::EpisodeEnd]) -> Result<(), Malformed> {
    for (slot, row) in observations.chunks(observation_size.max(1) * 4).enumerate() {
        let diverged = || ended.iter().any(|end| end.diverged && end.slot as usize == slot);
        if let Some(place) = first_not_finite(row).filter(|_| !diverged()) {
            let got = format!("the number {} in the observation of slot {slot}", number(row, place));
            return Err(Malformed::new(got, "finite numbers"));
        }
    }
    Ok(())
}

/// The exponent bits of a float32. In NaN and infinities all of them are set.
const EXPONENT: u32 = 0x7f80_0000;

/// Returns the index of the first little-endian float32 that is not finite.
fn first_not_finite(bytes: &[u8]) -> Option<usize> {
    let words = bytes.as_chunks::<4>().0;
    let wrong = |word: &[u8; 4]| u32::from_le_bytes(*word) & EXPONENT == EXPONENT;
    // First checks all numbers in a fast loop without branches. The slower search for an index is rarely needed,
    // because nearly all arrays are finite.
    if !words.iter().fold(false, |found, word| found | wrong(word)) {
        return None;
    }
    words.iter().position(wrong)
}

fn number(bytes: &[u8], index: usize) -> f32 {
    bytes.as_chunks::<4>().0.get(index).map_or(f32::NAN, |word| f32::from_le_bytes(*word))
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: usize = 3;
    const O: usize = 2;

    fn floats(numbers: &[f32]) -> bytes::Bytes {
        numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
    }

    fn end(slot: u32) -> proto::EpisodeEnd {
        proto::EpisodeEnd { slot, ..proto::EpisodeEnd::default() }
    }

    /// A reply in which the episode of slot 1 ended.
    fn reply() -> proto::Stepped {
        proto::Stepped {
            observations: floats(&[0.0; N * O]),
            rewards: floats(&[1.0; N]),
            terminated: vec![0, 1, 0].into(),
            truncated: vec![0, 0, 0].into(),
            final_observations: floats(&[0.0; O]),
            ended: vec![end(1)],
            ..proto::Stepped::default()
        }
    }

    fn refusal(change: impl FnOnce(&mut proto::Stepped)) -> String {
        let mut reply = reply();
        change(&mut reply);
        check_step(&reply, N, O).unwrap_err().to_string()
    }

    #[test]
    fn correct_reply_is_accepted() {
        assert_eq!(check_step(&reply(), N, O), Ok(()));
        let both = proto::Stepped { truncated: vec![0, 1, 0].into(), ..reply() };
        assert_eq!(check_step(&both, N, O), Ok(()), "terminated at the step limit");
    }

    #[test]
    fn numbers_that_are_not_finite_are_refused() {
        for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let error = refusal(|it| it.rewards = floats(&[1.0, 1.0, wrong]));
            assert_eq!(error, format!("the reward {wrong} of slot 2; expected a finite number"));
            let error = refusal(|it| it.observations = floats(&[0.0, 0.0, 0.0, 0.0, 0.0, wrong]));
            assert_eq!(error, format!("the number {wrong} in the observation of slot 2; expected finite numbers"));
        }
    }

    #[test]
    fn first_observations_are_checked() {
        assert_eq!(check_observations(&floats(&[0.0; N * O]), N, O), Ok(()));
        let short = check_observations(&floats(&[0.0; O]), N, O).unwrap_err().to_string();
        assert_eq!(short, "8 bytes of observations; expected 24");
        assert!(check_observations(&floats(&[0.0, f32::NAN]), 1, O).is_err());
    }

    #[test]
    fn diverged_episode_may_have_any_observation() {
        let mut reply = reply();
        reply.observations = floats(&[0.0, 0.0, f32::NAN, 0.0, 0.0, 0.0]);
        assert!(check_step(&reply, N, O).is_err());
        reply.ended[0].diverged = true;
        assert_eq!(check_step(&reply, N, O), Ok(()));
    }

    #[test]
    fn flags_other_than_0_and_1_are_refused() {
        let error = refusal(|it| it.terminated = vec![0, 7, 0].into());
        assert_eq!(error, "the flag 7 of terminated in slot 1; expected 0 or 1");
        let error = refusal(|it| it.truncated = vec![2, 0, 0].into());
        assert_eq!(error, "the flag 2 of truncated in slot 0; expected 0 or 1");
    }

    #[test]
    fn episodes_and_flags_must_agree() {
        let again = refusal(|it| {
            it.ended.push(end(1));
            it.final_observations = floats(&[0.0; 2 * O]);
        });
        assert!(again.contains("slot 1 again or late"), "{again}");
        let other = refusal(|it| it.ended[0].slot = 2);
        assert!(other.contains("slot 2, which is not flagged"), "{other}");
        let beyond = refusal(|it| it.ended[0].slot = 9);
        assert!(beyond.contains("slot 9, which is not flagged"), "{beyond}");
        let missing = refusal(|it| {
            it.ended.clear();
            it.final_observations = bytes::Bytes::new();
        });
        assert_eq!(missing, "0 ended episodes; expected 1, the number of environments flagged as ended");
    }

    #[test]
    fn arrays_of_other_lengths_are_refused() {
        let empty = bytes::Bytes::new;
        assert_eq!(refusal(|it| it.observations = empty()), "0 bytes of observations; expected 24");
        assert_eq!(refusal(|it| it.rewards = empty()), "0 bytes of rewards; expected 12");
        assert_eq!(refusal(|it| it.terminated = empty()), "0 bytes of terminated; expected 3");
        assert_eq!(refusal(|it| it.truncated = empty()), "0 bytes of truncated; expected 3");
        assert_eq!(refusal(|it| it.final_observations = empty()), "0 bytes of final_observations; expected 8");
    }
}
