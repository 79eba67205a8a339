//! Upper bounds and estimates of the lengths of requests and replies, by which memory is reserved in the budget
//! beforehand.

use crate::{
    env::{self, ActionSpec},
    pool::{self, Autoreset, Batch, BatchSettings, RolloutRequest},
    proto,
    render::Size,
};

/// The part of a request's maximum length that does not depend on the batch size, bytes. It has room for parameters,
/// and for invalid requests that are a little too long, so that such requests get an in-band error.
const REQUEST_OVERHEAD_BYTES: usize = 1 << 20;
/// The maximum encoded length of an integer field with its tag, bytes.
const MAX_VARINT_FIELD_BYTES: usize = 11;
/// The estimated memory of an ended episode without a receipt, bytes. The episode is in memory twice: as a value, and
/// encoded in the reply.
const EPISODE_END_BYTES: usize = 300;
/// The estimated memory of a distribution, which mostly has one or two intervals, bytes.
const DISTRIBUTION_BYTES: usize = 72;
/// The estimated memory of an ended or started episode with a receipt, without the receipt's numbers, bytes.
const RECEIPT_OVERHEAD_BYTES: usize = 400;
/// An upper bound of the total length of a reply's tags, lengths and non-repeated fields, bytes.
const FRAMING_BYTES: usize = 256;
/// The number of integers in a row of `Stepped.receipt_episodes`.
const RECEIPT_INDICES: usize = 5;

/// Returns the estimated memory of an ended or started episode with its receipt, bytes. Each number is in memory twice:
/// as a value, and encoded in the reply.
fn receipt_bytes(settings: &BatchSettings) -> usize {
    let numbers = settings.spec.parameters.len() + settings.spec.applied.len();
    RECEIPT_OVERHEAD_BYTES + 2 * size_of::<f64>() * numbers
}

/// Returns A, the number of entries of an action.
fn action_width(settings: &BatchSettings) -> usize {
    match settings.spec.action {
        ActionSpec::Discrete(_) => 1,
        ActionSpec::Continuous(channels) => channels.len(),
    }
}

/// Returns an upper bound of the length of a valid request to a batch, bytes. In [`Autoreset::SameStep`] there is no
/// bound, because such a session may send a policy with any number of weights.
pub fn max_request_bytes(batch: &Batch) -> usize {
    let settings = batch.settings();
    if settings.autoreset == Autoreset::SameStep {
        return usize::MAX;
    }
    let reset = 1 + MAX_VARINT_FIELD_BYTES + 8 * settings.spec.state.len();
    let restore = 1 + 2 * MAX_VARINT_FIELD_BYTES + env::MAX_SNAPSHOT_BYTES;
    REQUEST_OVERHEAD_BYTES.saturating_add(batch.size().saturating_mul(reset.max(restore)))
}

/// Returns the length of a step's actions, bytes.
pub fn step_request(settings: &BatchSettings, envs: usize) -> usize {
    envs.saturating_mul(4 * action_width(settings))
}

/// Returns the memory that a session reserves when it is opened, bytes: the distributions of all environments, two step
/// requests, and three replies (one being computed, one waiting, one being sent). With this reservation, no step is
/// refused because of the memory that other sessions use.
pub fn session(settings: &BatchSettings, envs: usize) -> usize {
    let numbers = 2 * settings.observation_size() + 1 + settings.spec.reward_terms.len();
    let ends = if settings.receipts { 2 * receipt_bytes(settings) } else { EPISODE_END_BYTES };
    let reply = envs.saturating_mul(4 * numbers + 2 + ends);
    // Environments of a group share their distributions at first. After resets and restores each may have its own.
    let of_group = |group: &pool::SlotGroupSettings| group.size.saturating_mul(group.episodes.distributions.len());
    let distributions = settings.groups.iter().map(of_group).fold(0, usize::saturating_add);
    let fixed = distributions.saturating_mul(DISTRIBUTION_BYTES);
    fixed.saturating_add(step_request(settings, envs).saturating_mul(2)).saturating_add(reply.saturating_mul(3))
}

/// Returns the memory that these snapshots take, bytes.
pub fn snapshot_bytes(snapshots: &[bytes::Bytes]) -> usize {
    snapshots.iter().map(|snapshot| snapshot.len() + size_of::<bytes::Bytes>()).sum()
}

/// Returns the memory of a picture of this size, bytes.
pub fn picture(size: Size) -> usize {
    3 * usize::from(size.width) * usize::from(size.height)
}

/// Returns the memory that the new weights of an `act` take, bytes: as received and as loaded.
pub fn weights(request: &proto::Act) -> usize {
    2 * request.weights.len()
}

/// Returns the memory that the activations of the new policy of an `act` take in `envs` environments, bytes.
pub fn activations(request: &proto::Act, envs: usize) -> usize {
    let widths = request.policy.as_ref().map_or(0, |policy| {
        policy.hidden.iter().chain([&policy.lstm]).map(|&width| width as usize).fold(0, usize::saturating_add)
    });
    envs.saturating_mul(widths).saturating_mul(16)
}

/// Returns an upper bound of the length of the reply to an `act`, bytes.
pub fn max_rollout_bytes(request: &RolloutRequest, batch: &Batch) -> usize {
    let settings = batch.settings();
    // Actions count twice: as sampled, and as inputs of the policy. The 10 covers flags, values and similar numbers.
    let numbers = settings.observation_size() + 2 * action_width(settings) + 10;
    let step = batch.size().saturating_mul(4 * numbers + receipt_bytes(settings));
    step.saturating_mul(request.max_steps).min(MAX_ROLLOUT_BYTES.saturating_add(step))
}

/// The approximate length at which a rollout is cut into several replies, bytes.
const MAX_ROLLOUT_BYTES: usize = 4_000_000;

/// Returns an upper bound of the length of a reply to `step`, `reset` or `restore` of `size` environments, bytes. The
/// bound is reached when all episodes end in the same step with the largest counters. `environment` is the
/// environment's entry in the catalogue.
pub fn max_step_reply_bytes(settings: &BatchSettings, environment: &proto::Environment, size: usize) -> usize {
    let receipt = proto::Receipt {
        requested: vec![1.0; environment.parameters.len()],
        applied: vec![1.0; environment.applied.len()],
        model_hash: environment.model_hash.clone(),
    };
    let episode = proto::Episode {
        environment_index: u32::MAX,
        trial_index: u64::MAX,
        episode_index: u64::MAX,
        episode_in_trial: u32::MAX,
    };
    let slot = u32::try_from(size).unwrap_or(u32::MAX);
    let has_messages = settings.receipts && !settings.receipt_arrays;
    let start = proto::EpisodeStart { slot, episode: Some(episode), receipt: Some(receipt.clone()) };
    let end = proto::EpisodeEnd {
        slot,
        episode: Some(episode),
        r#return: 1.0,
        length: u32::MAX,
        success: true,
        diverged: true,
        receipt: has_messages.then_some(receipt),
        achieved: Some(1.0),
        code_achieved: Some(1.0),
    };
    let receipt_row = 8 * (RECEIPT_INDICES + environment.parameters.len() + environment.applied.len());
    let array_row = if settings.receipts && settings.receipt_arrays { receipt_row } else { 0 };
    let observation = 4 * settings.observation_size();
    let start_message = if settings.receipts { entry(&start) } else { 0 };
    let ended = entry(&end) + observation + array_row;
    let started = if has_messages { start_message } else { array_row };
    let events = match settings.autoreset {
        Autoreset::SameStep => ended + started,
        Autoreset::NextStep => ended.max(started), // no episode both begins and ends in one step
        Autoreset::Disabled => ended,
    };
    let reward_terms = if settings.reward_terms { 4 * settings.spec.reward_terms.len() } else { 0 };
    // The reward and the two flags of a step take six bytes. A reply to `reset` has receipts as messages even if steps
    // have them as arrays.
    let row = observation + (6 + reward_terms + events).max(start_message);
    size.saturating_mul(row).saturating_add(FRAMING_BYTES)
}

/// Returns an upper bound of the length of the reply to a request for snapshots of `size` environments, bytes. Each of
/// these snapshots has at most `snapshot` bytes.
pub fn max_snapshot_reply_bytes(size: usize, snapshot: usize) -> usize {
    size.saturating_mul(1 + prost::length_delimiter_len(snapshot) + snapshot).saturating_add(FRAMING_BYTES)
}

/// Returns the encoded length, in bytes, of an entry of a repeated field. `message` is the entry, and the field's tag
/// has one byte.
fn entry(message: &impl prost::Message) -> usize {
    let length = message.encoded_len();
    1 + prost::length_delimiter_len(length) + length
}
