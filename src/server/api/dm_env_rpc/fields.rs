//! The fields of requests whose entries are counted before anything is made of them.

use crate::server::transport::precheck::{
    Field,
    Inside::{Fields, Numbers, Opaque},
    Most, field,
};

const SETTINGS_FIRST: &[Field] = &[field(1, "settings", Most::Many, Opaque)];
const SETTINGS_SECOND: &[Field] = &[field(2, "settings", Most::Many, Opaque)];
const AGENT_STEP: &[Field] =
    &[field(1, "step.actions", Most::Many, Opaque), field(2, "step.requested_observations", Most::Many, Numbers)];
/// Those of `dm_env_rpc.v1.EnvironmentRequest`.
pub const ENVIRONMENT_REQUEST: &[Field] = &[
    field(1, "create_world", Most::One, Fields(SETTINGS_FIRST)),
    field(2, "join_world", Most::One, Fields(SETTINGS_SECOND)),
    field(3, "step", Most::One, Fields(AGENT_STEP)),
    field(4, "reset", Most::One, Fields(SETTINGS_FIRST)),
    field(5, "reset_world", Most::One, Fields(SETTINGS_SECOND)),
];
