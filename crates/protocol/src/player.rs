//! Conversions between protocol messages and the types of [`perturb_policy`] that make up a player: the policy with its
//! normalisers, random streams and memory.

use bytes::Bytes;
use perturb_policy::{CollectUntil, ObservationNormaliser, PlayerTrainingState, RewardNormaliser, RunningMoments};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use crate::proto;

/// The error for a message that cannot be decoded.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field} is {got}, expected {expected}")]
pub struct DecodeError {
    /// The path of the wrong field, e.g. "mean" or "moments.mean".
    pub field: String,
    /// The received value, e.g. "7 bytes".
    pub got: String,
    /// The expected value.
    pub expected: &'static str,
}

impl DecodeError {
    fn new(field: &str, got: impl Into<String>, expected: &'static str) -> Self {
        Self { field: field.into(), got: got.into(), expected }
    }

    /// Puts the name of the enclosing message's field before the path.
    pub fn within(self, field: &str) -> Self {
        Self { field: format!("{field}.{}", self.field), ..self }
    }
}

impl From<CollectUntil> for proto::act::Task {
    fn from(until: CollectUntil) -> Self {
        match until {
            CollectUntil::Steps(count) => Self::Steps(count as u32),
            CollectUntil::Episodes(count) => Self::Episodes(count as u32),
        }
    }
}

impl From<proto::act::Task> for CollectUntil {
    fn from(task: proto::act::Task) -> Self {
        match task {
            proto::act::Task::Steps(count) => Self::Steps(count as usize),
            proto::act::Task::Episodes(count) => Self::Episodes(count as usize),
        }
    }
}

impl From<&RunningMoments> for proto::Moments {
    fn from(moments: &RunningMoments) -> Self {
        Self { count: moments.count(), mean: doubles(moments.mean()), squares: doubles(moments.squares()) }
    }
}

impl TryFrom<&proto::Moments> for RunningMoments {
    type Error = DecodeError;

    fn try_from(moments: &proto::Moments) -> Result<Self, DecodeError> {
        /// Maximal count of observations: larger whole numbers are not exact in float64.
        const MAX_COUNT: u64 = 1 << 53;
        if moments.count > MAX_COUNT {
            return Err(DecodeError::new("count", moments.count.to_string(), "at most 2^53"));
        }
        let mean = read_doubles("mean", &moments.mean)?;
        let squares = read_doubles("squares", &moments.squares)?;
        Ok(Self::from_parts(moments.count, mean, squares))
    }
}

/// Builds a normaliser for observations of O = `observation_size` entries. If the message has statistics for fewer
/// entries, the last entries of an observation are not normalised.
///
/// # Errors
/// [`DecodeError`] if the message is malformed, or has statistics for more than O entries.
pub fn observation_normaliser(
    moments: &proto::Moments,
    observation_size: usize,
) -> Result<ObservationNormaliser, DecodeError> {
    let moments = RunningMoments::try_from(moments)?;
    let got = moments.mean().len();
    let too_many = || DecodeError::new("mean", format!("of {got} numbers"), "at most those of an observation");
    let left_alone = observation_size.checked_sub(got).ok_or_else(too_many)?;
    Ok(ObservationNormaliser::from_moments(moments).leaving_alone(left_alone))
}

impl From<&RewardNormaliser> for proto::RewardMoments {
    fn from(rewards: &RewardNormaliser) -> Self {
        let returns = doubles(rewards.returns());
        let moments = Some(rewards.moments().into());
        Self { gamma: rewards.gamma(), returns, moments, runs_on: rewards.runs_on() }
    }
}

impl TryFrom<&proto::RewardMoments> for RewardNormaliser {
    type Error = DecodeError;

    fn try_from(rewards: &proto::RewardMoments) -> Result<Self, DecodeError> {
        let given = rewards.moments.as_ref();
        let moments = given.ok_or_else(|| DecodeError::new("moments", "missing", "their statistics"))?;
        let returns = read_doubles("returns", &rewards.returns)?;
        let moments = RunningMoments::try_from(moments).map_err(|wrong| wrong.within("moments"))?;
        Ok(Self::from_parts(rewards.gamma, returns, moments).running_on(rewards.runs_on))
    }
}

impl From<&ChaCha8Rng> for proto::RandomStream {
    /// Converts a random stream. Its position, in 32-bit words, is taken modulo 2^64.
    fn from(stream: &ChaCha8Rng) -> Self {
        let key = stream.get_seed().to_vec().into();
        let position = stream.get_word_pos() as u64;
        Self { key, stream: stream.get_stream(), position }
    }
}

impl TryFrom<&proto::RandomStream> for ChaCha8Rng {
    type Error = DecodeError;

    fn try_from(stream: &proto::RandomStream) -> Result<Self, DecodeError> {
        let key = <[u8; 32]>::try_from(&stream.key[..]);
        let key = key.map_err(|_| DecodeError::new("key", format!("{} bytes", stream.key.len()), "32 bytes"))?;
        let mut rng = Self::from_seed(key);
        rng.set_stream(stream.stream);
        rng.set_word_pos(stream.position.into());
        Ok(rng)
    }
}

impl From<&PlayerTrainingState> for proto::PlayerState {
    /// Converts all fields except the random stream of the actions.
    fn from(state: &PlayerTrainingState) -> Self {
        Self {
            observations: floats(&state.observations),
            starts: state.starts.iter().map(|&start| u8::from(start)).collect(),
            outcomes: floats(&state.previous_steps),
            memory: floats(&state.memory),
        }
    }
}

/// Builds a player's state from a message and the random stream of its next actions. The caller must check the lengths
/// of the arrays.
///
/// # Errors
/// [`DecodeError`] if an array is malformed or a number is not finite.
pub fn player_state(state: &proto::PlayerState, actions: ChaCha8Rng) -> Result<PlayerTrainingState, DecodeError> {
    if let Some(slot) = state.starts.iter().position(|&flag| flag > 1) {
        let got = format!("{} in slot {slot}", state.starts[slot]);
        return Err(DecodeError::new("starts", got, "0 or 1"));
    }
    Ok(PlayerTrainingState {
        observations: read_floats("observations", &state.observations)?,
        starts: state.starts.iter().map(|&flag| flag == 1).collect(),
        previous_steps: read_floats("outcomes", &state.outcomes)?,
        memory: read_floats("memory", &state.memory)?,
        actions,
    })
}

/// Encodes numbers as little-endian float32.
pub fn floats(numbers: &[f32]) -> Bytes {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}

/// Encodes numbers as little-endian float64.
pub fn doubles(numbers: &[f64]) -> Bytes {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}

/// Decodes finite little-endian float32 numbers.
///
/// # Errors
/// [`DecodeError`] if the length is not a multiple of 4 bytes or a number is not finite. `field` names the array in it.
pub fn read_floats(field: &str, bytes: &[u8]) -> Result<Vec<f32>, DecodeError> {
    let (words, rest) = bytes.as_chunks::<4>();
    if !rest.is_empty() {
        return Err(DecodeError::new(field, format!("{} bytes", bytes.len()), "4 bytes for each float32"));
    }
    let numbers: Vec<f32> = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
    match numbers.iter().position(|x| !x.is_finite()) {
        Some(i) => Err(DecodeError::new(field, format!("{} in element {i}", numbers[i]), "finite numbers")),
        None => Ok(numbers),
    }
}

fn read_doubles(field: &str, bytes: &[u8]) -> Result<Vec<f64>, DecodeError> {
    let (words, rest) = bytes.as_chunks::<8>();
    if !rest.is_empty() {
        return Err(DecodeError::new(field, format!("{} bytes", bytes.len()), "8 bytes for each float64"));
    }
    Ok(words.iter().map(|word| f64::from_le_bytes(*word)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments() -> RunningMoments {
        RunningMoments::from_parts(7, vec![0.5, -2.0], vec![3.0, 1e-9])
    }

    #[test]
    fn messages_survive_a_round_trip() {
        assert_eq!(RunningMoments::try_from(&proto::Moments::from(&moments())), Ok(moments()));
        let rewards = RewardNormaliser::from_parts(0.97, vec![1.5], moments()).running_on(true);
        let read = RewardNormaliser::try_from(&proto::RewardMoments::from(&rewards)).unwrap();
        assert_eq!(
            (read.gamma(), read.returns(), read.moments(), read.runs_on()),
            (0.97, &[1.5][..], &moments(), true)
        );
        let mut stream = ChaCha8Rng::from_seed([9; 32]);
        stream.set_stream(4);
        stream.set_word_pos(1 << 40);
        assert_eq!(ChaCha8Rng::try_from(&proto::RandomStream::from(&stream)), Ok(stream.clone()));
        let state = PlayerTrainingState {
            observations: vec![1.0, 2.0],
            starts: vec![true, false],
            previous_steps: vec![0.0],
            memory: vec![-1.0],
            actions: stream.clone(),
        };
        let read = player_state(&proto::PlayerState::from(&state), stream).unwrap();
        assert_eq!(format!("{read:?}"), format!("{state:?}"));
    }

    #[test]
    fn normaliser_may_have_fewer_means_than_observations() {
        let given = proto::Moments::from(&moments());
        assert!(observation_normaliser(&given, 2).is_ok() && observation_normaliser(&given, 5).is_ok());
        let error = observation_normaliser(&given, 1).unwrap_err();
        assert_eq!(error.to_string(), "mean is of 2 numbers, expected at most those of an observation");
    }

    #[test]
    fn malformed_messages_are_refused() {
        let good = proto::Moments::from(&moments());
        let wrong = |error: Result<RunningMoments, DecodeError>| error.unwrap_err().to_string();
        let many = proto::Moments { count: (1 << 53) + 1, ..good.clone() };
        assert_eq!(wrong((&many).try_into()), "count is 9007199254740993, expected at most 2^53");
        let odd = proto::Moments { squares: Bytes::from_static(&[0; 7]), ..good };
        assert_eq!(wrong((&odd).try_into()), "squares is 7 bytes, expected 8 bytes for each float64");
        let rewards = proto::RewardMoments { moments: Some(many), ..Default::default() };
        assert!(RewardNormaliser::try_from(&rewards).unwrap_err().to_string().starts_with("moments.count is "));
        let short = proto::RandomStream { key: Bytes::from_static(&[0; 31]), ..Default::default() };
        assert_eq!(ChaCha8Rng::try_from(&short).unwrap_err().to_string(), "key is 31 bytes, expected 32 bytes");
        assert!(
            RewardNormaliser::try_from(&proto::RewardMoments::default()).unwrap_err().to_string().contains("missing")
        );
        let state = |state| player_state(&state, ChaCha8Rng::from_seed([0; 32])).unwrap_err().to_string();
        let flags = proto::PlayerState { starts: Bytes::from_static(&[1, 2]), ..Default::default() };
        assert_eq!(state(flags), "starts is 2 in slot 1, expected 0 or 1");
        let numbers = proto::PlayerState { memory: floats(&[0.0, f32::NAN]), ..Default::default() };
        assert_eq!(state(numbers), "memory is NaN in element 1, expected finite numbers");
        assert!(read_floats("memory", &[0; 3]).unwrap_err().to_string().contains("3 bytes"));
    }
}
