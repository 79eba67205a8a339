//! The fields whose entries are counted and limited before a request is decoded.

use crate::server::transport::precheck::{
    Cardinality, Field,
    FieldKind::{Fields, Numbers, Opaque},
    field,
};

const DISTRIBUTION: &[Field] = &[field(1, "intervals", Cardinality::Many, Opaque)];
const PARAMETER: &[Field] = &[field(2, "a distribution", Cardinality::One, Fields(DISTRIBUTION))];
const CONTEXTS: &[Field] = &[field(1, "contexts.names", Cardinality::Many, Opaque)];
const GROUP: &[Field] = &[
    field(3, "open.groups.parameters", Cardinality::Many, Fields(PARAMETER)),
    field(7, "open.groups.contexts", Cardinality::One, Fields(CONTEXTS)),
];
const OPEN: &[Field] = &[
    field(3, "open.parameters", Cardinality::Many, Fields(PARAMETER)),
    field(11, "open.groups", Cardinality::Environments, Fields(GROUP)),
    field(15, "open.contexts", Cardinality::One, Fields(CONTEXTS)),
];
const RESET: &[Field] = &[
    field(2, "reset.seeds", Cardinality::Environments, Numbers),
    field(3, "reset.parameters", Cardinality::Many, Fields(PARAMETER)),
];
const RESTORE: &[Field] = &[field(2, "restore.snapshots", Cardinality::Environments, Opaque)];
const POLICY: &[Field] = &[field(1, "act.policy.hidden", Cardinality::Many, Numbers)];
const ACT: &[Field] = &[field(1, "act.policy", Cardinality::One, Fields(POLICY))];
/// The checked fields of `perturb.v1.SessionRequest`.
pub const SESSION_REQUEST: &[Field] = &[
    field(1, "open", Cardinality::One, Fields(OPEN)),
    field(2, "step", Cardinality::One, Opaque),
    field(3, "reset", Cardinality::One, Fields(RESET)),
    field(5, "restore", Cardinality::One, Fields(RESTORE)),
    field(8, "act", Cardinality::One, Fields(ACT)),
];
