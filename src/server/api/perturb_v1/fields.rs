//! The fields of requests whose entries are counted before anything is made of them.

use crate::server::transport::precheck::{
    Field,
    Inside::{Fields, Numbers, Opaque},
    Most, field,
};

const DISTRIBUTION: &[Field] = &[field(1, "intervals", Most::Many, Opaque)];
const PARAMETER: &[Field] = &[field(2, "a distribution", Most::One, Fields(DISTRIBUTION))];
const GROUP: &[Field] = &[field(3, "open.groups.parameters", Most::Many, Fields(PARAMETER))];
const OPEN: &[Field] = &[
    field(3, "open.parameters", Most::Many, Fields(PARAMETER)),
    field(11, "open.groups", Most::Environments, Fields(GROUP)),
];
const RESET: &[Field] = &[
    field(2, "reset.seeds", Most::Environments, Numbers),
    field(3, "reset.parameters", Most::Many, Fields(PARAMETER)),
];
const RESTORE: &[Field] = &[field(2, "restore.snapshots", Most::Environments, Opaque)];
const POLICY: &[Field] = &[field(1, "act.policy.hidden", Most::Many, Numbers)];
const ACT: &[Field] = &[field(1, "act.policy", Most::One, Fields(POLICY))];
/// Those of `perturb.v1.SessionRequest`.
pub const SESSION_REQUEST: &[Field] = &[
    field(1, "open", Most::One, Fields(OPEN)),
    field(2, "step", Most::One, Opaque),
    field(3, "reset", Most::One, Fields(RESET)),
    field(5, "restore", Most::One, Fields(RESTORE)),
    field(8, "act", Most::One, Fields(ACT)),
];
