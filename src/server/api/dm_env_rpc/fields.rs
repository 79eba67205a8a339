//! The fields whose entries are counted and limited before a request is decoded.

use crate::server::transport::precheck::{
    Cardinality, Field,
    FieldKind::{Fields, Numbers, Opaque},
    field,
};

const SETTINGS_FIRST: &[Field] = &[field(1, "settings", Cardinality::Many, Opaque)];
const SETTINGS_SECOND: &[Field] = &[field(2, "settings", Cardinality::Many, Opaque)];
const AGENT_STEP: &[Field] = &[
    field(1, "step.actions", Cardinality::Many, Opaque),
    field(2, "step.requested_observations", Cardinality::Many, Numbers),
];
/// The checked fields of `dm_env_rpc.v1.EnvironmentRequest`.
pub const ENVIRONMENT_REQUEST: &[Field] = &[
    field(1, "create_world", Cardinality::One, Fields(SETTINGS_FIRST)),
    field(2, "join_world", Cardinality::One, Fields(SETTINGS_SECOND)),
    field(3, "step", Cardinality::One, Fields(AGENT_STEP)),
    field(4, "reset", Cardinality::One, Fields(SETTINGS_FIRST)),
    field(5, "reset_world", Cardinality::One, Fields(SETTINGS_SECOND)),
];
