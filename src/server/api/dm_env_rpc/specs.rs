//! The specs (uid, name, type and bounds) of actions and observations. Converts actions from tensors, and observations
//! to tensors.

use super::{Error, runner::WorldStep, tensors};
use crate::{
    env::{ActionSpec, ChannelSpec, EnvironmentSpec},
    proto::dm_env_rpc::v1::{
        ActionObservationSpecs, DataType, StepResponse, Tensor, TensorSpec,
        tensor::{BoolArray, FloatArray, Int32Array, Payload},
        tensor_spec::{Value, value},
    },
};
use std::collections::BTreeMap;

/// The uid of the only action.
const ACTION: u64 = 1;

/// The uids of the observations start at 1, because dm_env_rpc reserves 0.
const OBSERVATION: u64 = 1;
const REWARD: u64 = 2;
const TRUNCATED: u64 = 3;
const SUCCESS: u64 = 4;
const DIVERGED: u64 = 5;

/// Returns the specs of an environment's actions and observations.
///
/// There is no `discount` among the observations. Clients derive it from the state, and would misread a `discount` with
/// the first observation of an episode.
pub(super) fn action_observation_specs(spec: &EnvironmentSpec) -> ActionObservationSpecs {
    let scalar = |name: &str, dtype: DataType| TensorSpec {
        name: name.into(),
        shape: Vec::new(),
        dtype: dtype.into(),
        min: None,
        max: None,
    };
    let (min, max) = bounds(spec.observation);
    let observation =
        TensorSpec { shape: length(spec.observation), min, max, ..scalar("observation", DataType::Float) };
    let action = match spec.action {
        ActionSpec::Discrete(names) => {
            let bound =
                |choice| Some(Value { payload: Some(value::Payload::Int32s(Int32Array { array: vec![choice] })) });
            TensorSpec { min: bound(0), max: bound(last(names)), ..scalar("action", DataType::Int32) }
        }
        ActionSpec::Continuous(channels) => {
            let (min, max) = bounds(channels);
            TensorSpec { shape: length(channels), min, max, ..scalar("action", DataType::Float) }
        }
    };
    ActionObservationSpecs {
        actions: BTreeMap::from([(ACTION, action)]),
        observations: BTreeMap::from([
            (OBSERVATION, observation),
            (REWARD, scalar("reward", DataType::Float)),
            (TRUNCATED, scalar("truncated", DataType::Bool)),
            (SUCCESS, scalar("success", DataType::Bool)),
            (DIVERGED, scalar("diverged", DataType::Bool)),
        ]),
    }
}

/// Checks that all requested uids are uids of observations.
///
/// # Errors
/// [`Error::Unknown`] with the first unknown uid.
pub(super) fn check_requested(uids: &[u64]) -> Result<(), Error> {
    match uids.iter().find(|uid| !(OBSERVATION..=DIVERGED).contains(uid)) {
        Some(uid) => Err(unknown("observation", *uid, format!("observations are {OBSERVATION} … {DIVERGED}"))),
        None => Ok(()),
    }
}

/// Checks a step's actions. Returns them in the pool's format, little-endian: an i32, or f32 `[A]`.
///
/// # Errors
/// If the action is missing or does not fit its spec, or if there is an action with an unknown uid.
pub(super) fn actions(spec: &EnvironmentSpec, actions: &BTreeMap<u64, Tensor>) -> Result<Vec<u8>, Error> {
    if let Some(uid) = actions.keys().find(|uid| **uid != ACTION) {
        return Err(unknown("action", *uid, format!("the only action is {ACTION}")));
    }
    let field = format!("action {ACTION}");
    let tensor = actions.get(&ACTION).ok_or_else(|| {
        Error::value(field.clone(), "missing", "a tensor: every step while an episode runs takes an action")
    })?;
    Ok(match spec.action {
        ActionSpec::Discrete(names) => {
            let choice = tensors::int32s(&field, tensor, &[], &[(0, last(names))])?;
            choice.iter().flat_map(|x| x.to_le_bytes()).collect()
        }
        ActionSpec::Continuous(channels) => {
            let bounds: Vec<_> = channels.iter().map(|c| (c.low as f32, c.high as f32)).collect();
            let vector = tensors::floats(&field, tensor, &[channels.len()], &bounds)?;
            vector.iter().flat_map(|x| x.to_le_bytes()).collect()
        }
    })
}

/// Makes the response to a step, with the requested observations only.
pub(super) fn response(outcome: &WorldStep, requested: &[u64]) -> StepResponse {
    let bool = |x| tensors::tensor(Payload::Bools(BoolArray { array: vec![x] }), &[]);
    let floats = |array, shape: &[usize]| tensors::tensor(Payload::Floats(FloatArray { array }), shape);
    let observation = |uid| match uid {
        OBSERVATION => {
            let words = outcome.observation.as_chunks::<4>().0;
            floats(words.iter().map(|word| f32::from_le_bytes(*word)).collect(), &[words.len()])
        }
        REWARD => floats(vec![outcome.reward], &[]),
        TRUNCATED => bool(outcome.truncated),
        SUCCESS => bool(outcome.success),
        // Only `DIVERGED` is left, because the caller has checked the uids.
        _ => bool(outcome.diverged),
    };
    StepResponse {
        state: outcome.state.into(),
        // Each observation is sent only once, even if it is requested several times. Otherwise a small request could
        // have a large reply.
        observations: (OBSERVATION..=DIVERGED)
            .filter(|uid| requested.contains(uid))
            .map(|uid| (uid, observation(uid)))
            .collect(),
    }
}

/// Returns the index of the last choice of a discrete action.
fn last(names: &[&str]) -> i32 {
    names.len() as i32 - 1
}

fn length(channels: &[ChannelSpec]) -> Vec<i32> {
    vec![channels.len() as i32]
}

/// Returns the minima and maxima of the channels, or `None` if any is infinite. If all channels have the same bounds,
/// there is only one minimum and one maximum.
fn bounds(channels: &[ChannelSpec]) -> (Option<Value>, Option<Value>) {
    if !channels.iter().all(|c| c.low.is_finite() && c.high.is_finite()) {
        return (None, None);
    }
    let alike = channels.windows(2).all(|w| (w[0].low, w[0].high) == (w[1].low, w[1].high));
    let shown = if alike { &channels[..channels.len().min(1)] } else { channels };
    let value = |bound: fn(&ChannelSpec) -> f64| {
        let array = shown.iter().map(|c| bound(c) as f32).collect();
        Some(Value { payload: Some(value::Payload::Floats(FloatArray { array })) })
    };
    (value(|c| c.low), value(|c| c.high))
}

fn unknown(what: &'static str, uid: u64, known: String) -> Error {
    Error::Unknown { what, name: uid.to_string(), known }
}
