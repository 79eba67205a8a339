//! Checks and converts `act` requests, with their policies, and converts rollouts to replies.

use super::{Error, convert};
use crate::{
    env::ActionSpec,
    pool::{Autoreset, Batch, PolicyRole, PolicyRunner, ReceivedPolicy, Rollout, RolloutEpisodeEnd, RolloutRequest},
    proto,
};
use bytes::Bytes;
use perturb_policy::{
    ActionKind, CollectUntil, Inputs, Normalisers, ObservationNormaliser, PlayerTrainingState, PolicySpec,
};
use perturb_protocol::player::{DecodeError, player_state, read_floats};
use rand_chacha::ChaCha8Rng;

/// The maximum number of hidden layers of a policy.
const MAX_HIDDEN_LAYERS: usize = 8;
/// The maximum width of a hidden layer or of the LSTM.
const MAX_LAYER_WIDTH: u32 = 1024;
/// The maximum number of activations of a policy, summed over all environments.
const MAX_ACTIVATIONS: usize = 1 << 25;
/// The maximum computing time of the steps in one reply, µs. The limit bounds the time that a client waits for an
/// answer.
const MAX_REPLY_COST_US: f64 = 1e6;
/// The estimated number of a policy's weights that a processor evaluates per microsecond.
const WEIGHTS_PER_US: f64 = 5000.0;

/// The dimensions of a batch's arrays.
#[derive(Clone, Copy)]
struct Sizes {
    /// N, the number of environments.
    envs: usize,
    /// O, the number of entries of an observation.
    observation: usize,
    /// The number of entries of an observation that are the episode's parameters.
    parameters: usize,
    action: ActionKind,
}

/// Checks an `act` request against the batch and its current policy, and converts it. `rate` is the maximum number of
/// steps per second that the client's token allows.
pub fn rollout_request(batch: &Batch, rate: Option<u32>, request: proto::Act) -> Result<RolloutRequest, Error> {
    let (settings, n_envs) = (batch.settings(), batch.size());
    let order = |when: &'static str, advice| Error::Order { request: "act", when: when.into(), advice };
    if settings.autoreset != Autoreset::SameStep {
        let advice = "open one with AUTORESET_MODE_SAME_STEP (2)";
        return Err(order("in a session whose autoreset mode is not same-step", advice));
    }
    let Some(episodes_per_trial) = settings.episodes_per_trial() else {
        let advice = "open groups that agree in episodes_per_trial, or a session for each number";
        return Err(order("in a session whose groups have trials of different lengths", advice));
    };
    let action = match settings.spec.action {
        ActionSpec::Discrete(names) => ActionKind::Discrete { n: names.len() },
        ActionSpec::Continuous(channels) => ActionKind::Continuous { size: channels.len() },
    };
    let observation = settings.observation_size();
    let parameters = observation - settings.spec.observation.len();
    let sizes = Sizes { envs: n_envs, observation, parameters, action };
    let proto::Act { policy: given, weights: given_weights, task: given_task, most_steps, only_ended } = request;
    let task = task(given_task)?;
    // The request has a new policy with its weights, or continues the current policy, maybe with new weights.
    let (policy, given_weights) = match (given, batch.policy_runner()) {
        (Some(_), _) if given_weights.is_empty() => {
            return Err(order("with a new policy but without its weights", "send both together"));
        }
        (Some(given), _) => (Some(policy(given, &given_weights, sizes, episodes_per_trial)?), None),
        (None, None) => {
            let advice = "send a policy with its weights, also after a step, reset, restore or release";
            return Err(order("without a policy while none plays", advice));
        }
        (None, Some(runner)) => {
            let new_weights = (!given_weights.is_empty()).then(|| weights(&given_weights, runner.spec()));
            (None, new_weights.transpose()?)
        }
    };
    // The request must have a new task, unless the current policy has an unfinished task.
    let unfinished = policy.is_none() && batch.policy_runner().is_some_and(|runner| !runner.task().is_done());
    match (&task, unfinished) {
        (None, false) => return Err(order("without a task and none is unfinished", "name steps or episodes")),
        (Some(_), true) => {
            let advice = "finish it by requests without a task, or send another policy";
            return Err(order("with a task while the previous task is unfinished", advice));
        }
        _ => {}
    }
    if unfinished && given_weights.is_some() {
        let advice = "finish it by requests without weights, or send another policy";
        return Err(order("with weights while a task is unfinished", advice));
    }
    // The maximum number of steps, by computing time and by the token's rate.
    let spec = policy.as_ref().map(|policy| &policy.spec).or_else(|| batch.policy_runner().map(PolicyRunner::spec));
    let policy_cost_us = spec.map_or(0.0, |spec| spec.n_weights() as f64 / WEIGHTS_PER_US);
    if policy_cost_us * n_envs as f64 > MAX_REPLY_COST_US {
        let got = format!("with {} weights in {n_envs} environments", spec.map_or(0, PolicySpec::n_weights));
        return Err(Error::value("act.policy", got, "fewer, so that a step takes less than about a second"));
    }
    let affordable =
        (MAX_REPLY_COST_US / ((settings.spec.step_cost + policy_cost_us) * n_envs as f64)).max(1.0) as usize;
    // Limits a reply to the steps that the rate allows in a second, so the client does not wait long for its next
    // reply.
    let allowed = rate.map_or(usize::MAX, |rate| (rate as usize / n_envs.max(1)).max(1));
    let affordable = affordable.min(allowed);
    let max_steps = if most_steps == 0 { affordable } else { affordable.min(most_steps as usize) };
    Ok(RolloutRequest { policy, weights: given_weights, task, max_steps, only_ended })
}

fn task(task: Option<proto::act::Task>) -> Result<Option<CollectUntil>, Error> {
    use proto::act::Task::{Episodes, Steps};
    match task {
        None => Ok(None),
        Some(Steps(0)) => Err(Error::value("act.steps", 0, "at least 1")),
        Some(Episodes(0)) => Err(Error::value("act.episodes", 0, "at least 1")),
        Some(task) => Ok(Some(task.into())),
    }
}

fn policy(
    policy: proto::Policy,
    given: &Bytes,
    sizes: Sizes,
    episodes_per_trial: u32,
) -> Result<ReceivedPolicy, Error> {
    let inputs = Inputs::new(sizes.observation, sizes.action, sizes.envs, policy.outcomes);
    let spec = spec(&policy, inputs.size(), sizes)?;
    let weights = weights(given, &spec)?;
    let normalisers = Normalisers {
        observations: read("act.policy.observations", &policy.observations)?
            .map(|moments| ObservationNormaliser::from_moments(moments).leaving_alone(sizes.parameters)),
        rewards: read("act.policy.rewards", &policy.rewards)?,
    };
    normalisers.check(sizes.envs, sizes.observation, sizes.parameters).map_err(|error| {
        Error::value("act.policy", format!("with statistics that do not fit: {error}"), "those of this session")
    })?;
    let role = match policy.role {
        Some(proto::policy::Role::Training(stream)) => {
            PolicyRole::Training((&stream).try_into().map_err(in_message("act.policy.training"))?)
        }
        Some(proto::policy::Role::Testing(proto::TestStreams { seed })) => PolicyRole::Testing { seed },
        None => return Err(Error::value("act.policy.role", "missing", "training or testing")),
    };
    let state = match (policy.state, &role) {
        (None, _) => None,
        (Some(given), PolicyRole::Training(stream)) => {
            Some(state(&given, sizes, inputs.size() - sizes.observation, spec.memory_size(), stream.clone())?)
        }
        (Some(_), PolicyRole::Testing { .. }) => {
            return Err(Error::value("act.policy.state", "given in testing", "none: each trial begins anew"));
        }
    };
    Ok(ReceivedPolicy { spec, inputs, normalisers, role, state, weights, episodes_per_trial })
}

/// Checks the layer sizes of a policy, and returns its [`PolicySpec`]. The policy's input has `input_size` numbers.
fn spec(policy: &proto::Policy, input_size: usize, sizes: Sizes) -> Result<PolicySpec, Error> {
    const FIELD: &str = "act.policy.hidden";
    if policy.hidden.len() > MAX_HIDDEN_LAYERS {
        let got = format!("{} layers", policy.hidden.len());
        return Err(Error::value(FIELD, got, format!("at most {MAX_HIDDEN_LAYERS}")));
    }
    let widths = 1..=MAX_LAYER_WIDTH;
    if let Some(width) = policy.hidden.iter().find(|width| !widths.contains(width)) {
        return Err(Error::value(
            FIELD,
            format!("with a width of {width}"),
            format!("widths of 1 … {MAX_LAYER_WIDTH}"),
        ));
    }
    if policy.lstm > MAX_LAYER_WIDTH {
        let expected = format!("a width of 1 … {MAX_LAYER_WIDTH}, or 0 for a feed-forward policy");
        return Err(Error::value("act.policy.lstm", policy.lstm, expected));
    }
    let hidden: Vec<usize> = policy.hidden.iter().map(|&width| width as usize).collect();
    let lstm = (policy.lstm > 0).then_some(policy.lstm as usize);
    let width = hidden.iter().sum::<usize>() + lstm.unwrap_or(0);
    if width * sizes.envs > MAX_ACTIVATIONS {
        let got = format!("of widths whose sum is {width}, in {} environments", sizes.envs);
        return Err(Error::value("act.policy", got, format!("a product of at most {MAX_ACTIVATIONS}")));
    }
    Ok(PolicySpec { observation_size: input_size, action: sizes.action, hidden, lstm })
}

fn weights(given: &Bytes, spec: &PolicySpec) -> Result<Vec<f32>, Error> {
    check_length("act.weights", given, spec.n_weights(), "float32 [P]")?;
    read_floats("weights", given).map_err(in_message("act"))
}

/// Converts the message `given` to a `T`. Returns `None` if the message is absent.
///
/// # Errors
/// If the message is invalid. The error names the wrong field, with the prefix `field`.
fn read<'a, M, T: TryFrom<&'a M, Error = DecodeError>>(
    field: &'static str,
    given: &'a Option<M>,
) -> Result<Option<T>, Error> {
    given.as_ref().map(T::try_from).transpose().map_err(in_message(field))
}

/// Returns a function that converts a decoding error to an [`Error`], with the prefix `message` before the field's
/// name.
fn in_message(message: &'static str) -> impl Fn(DecodeError) -> Error {
    move |wrong| {
        let DecodeError { field, got, expected } = wrong.within(message);
        Error::value(field, got, expected)
    }
}

fn state(
    given: &proto::PlayerState,
    sizes: Sizes,
    extra: usize,
    memory_size: usize,
    actions: ChaCha8Rng,
) -> Result<PlayerTrainingState, Error> {
    let n = sizes.envs;
    if given.starts.len() != n {
        let got = format!("{} bytes", given.starts.len());
        return Err(Error::value("act.policy.state.starts", got, format!("{n} bytes: uint8 [N] with N = {n}")));
    }
    let check_floats = |field, bytes, size, shape| check_length(field, bytes, n * size, shape);
    check_floats("act.policy.state.observations", &given.observations, sizes.observation, "float32 [N, O]")?;
    check_floats("act.policy.state.outcomes", &given.outcomes, extra, "float32 [N, I - O]")?;
    check_floats("act.policy.state.memory", &given.memory, memory_size, "float32 [N, 2H]")?;
    player_state(given, actions).map_err(in_message("act.policy.state"))
}

/// Checks that `bytes` has exactly `count` numbers of four bytes. `shape` describes the array in the error.
fn check_length(field: &'static str, bytes: &Bytes, count: usize, shape: &str) -> Result<(), Error> {
    let expected = || format!("{} bytes: {shape}, {count} numbers", 4 * count);
    let got = || format!("{} bytes", bytes.len());
    if bytes.len() == 4 * count { Ok(()) } else { Err(Error::value(field, got(), expected())) }
}

/// Converts a rollout to the response to an `act`.
pub fn rollout_response(rollout: Rollout) -> proto::Acted {
    proto::Acted {
        steps: rollout.steps as u32,
        observations: rollout.observations.freeze(),
        starts: rollout.starts.freeze(),
        actions: rollout.actions.freeze(),
        log_probs: rollout.log_probs.freeze(),
        values: rollout.values.freeze(),
        rewards: rollout.rewards.freeze(),
        terminated: rollout.terminated.freeze(),
        truncated: rollout.truncated.freeze(),
        truncation_values: rollout.truncation_values.freeze(),
        ended: rollout.ended.into_iter().map(ended_at).collect(),
        finished: rollout.finished,
        last_values: rollout.last_values.freeze(),
        memory: rollout.memory.freeze(),
    }
}

fn ended_at(RolloutEpisodeEnd { step, slot, end, terminated, truncated }: RolloutEpisodeEnd) -> proto::EndedAt {
    proto::EndedAt { step: step as u32, end: Some(convert::ended((slot, end))), terminated, truncated }
}

/// Returns the state of the batch's current policy, without its weights.
pub fn player_saved(batch: &Batch) -> Result<proto::PlayerSaved, Error> {
    let order = |when: &'static str, advice| Err(Error::Order { request: "save_player", when: when.into(), advice });
    let Some(runner) = batch.policy_runner() else {
        return order("while no policy plays", "send act with a policy first; step, reset, restore and release end it");
    };
    if !runner.task().is_done() {
        return order("in the middle of a task", "finish it by act without a task");
    }
    let Some(state) = runner.player().state() else {
        return order("in a test, which has nothing to save", "save in training");
    };
    if state.actions.get_word_pos() > u64::MAX.into() {
        return order("after 2^64 words of the stream of actions", "begin another stream");
    }
    let Normalisers { observations, rewards } = runner.player().normalisers();
    Ok(proto::PlayerSaved {
        observations: observations.as_ref().map(|it| it.moments().into()),
        rewards: rewards.as_ref().map(Into::into),
        actions: Some((&state.actions).into()),
        state: Some((&state).into()),
    })
}
