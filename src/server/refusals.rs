//! How many requests and calls were refused, and why.

use super::{leases, status::Refusal, tokens::Bearer};
use crate::{env, pool, render};
use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, PoisonError},
};
use tonic::Code;

/// Refusals since the server began, by their code and [`reason`].
#[derive(Clone, Default)]
pub struct Refusals(Arc<Mutex<BTreeMap<(i32, &'static str), u64>>>);

impl Refusals {
    /// Adds one, to who has this token.
    pub fn count(&self, refusal: &Refusal, bearer: Option<&Bearer>) {
        let key = (refusal.code() as i32, reason(refusal));
        *self.0.lock().unwrap_or_else(PoisonError::into_inner).entry(key).or_default() += 1;
        if let Some(bearer) = bearer {
            bearer.refused();
        }
    }

    /// Each code and reason that there was, and how often.
    pub fn counts(&self) -> Vec<(Code, &'static str, u64)> {
        let counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        counts.iter().map(|((code, reason), count)| (Code::from_i32(*code), *reason, *count)).collect()
    }
}

/// The kind of a refusal, of which there are so many as stand here: nothing that a client sent is in it.
pub fn reason(refusal: &Refusal) -> &'static str {
    match refusal {
        Refusal::Environment(error) | Refusal::Pool(pool::Error::Environment(error)) => match error {
            env::Error::UnknownEnvironment(_) => "unknown_environment",
            env::Error::UnknownParameter { .. } => "unknown_parameter",
            env::Error::Snapshot { .. } => "bad_snapshot",
            env::Error::Model { .. } => "model",
            _ => "bad_parameter",
        },
        Refusal::Pool(pool::Error::Full { .. }) => "environments_full",
        Refusal::Pool(pool::Error::Ended { .. }) => "episode_ended",
        Refusal::Pool(pool::Error::Policy(_)) => "bad_policy",
        Refusal::Pool(pool::Error::Defect) | Refusal::Render(render::Error::Defect) => "defect",
        Refusal::Render(render::Error::NoThread { .. }) => "no_thread",
        Refusal::Render(render::Error::Missing { .. }) => "no_opengl",
        Refusal::Render(render::Error::Failed { .. }) => "drawing_failed",
        Refusal::Lease(error) => match error {
            leases::Error::Unknown => "unknown_lease",
            leases::Error::OtherToken => "other_token",
            leases::Error::NoReply { .. } => "no_such_reply",
            leases::Error::Forgotten { .. } => "reply_not_kept",
            leases::Error::TakenUp => "taken_up",
        },
        Refusal::NothingToDraw { .. } => "nothing_to_draw",
        Refusal::Value { .. } => "bad_value",
        Refusal::NotOpen { .. } => "not_open",
        Refusal::AlreadyOpen => "already_open",
        Refusal::Order { .. } => "wrong_order",
        Refusal::TooManySessions { .. } => "sessions_full",
        Refusal::TooManyOfAPeer { .. } => "peer_quota",
        Refusal::NoToken => "no_token",
        Refusal::WrongToken => "wrong_token",
        Refusal::RevokedToken { .. } => "revoked_token",
        Refusal::TooManyOfAToken { .. } => "token_quota",
        Refusal::TooFast { .. } => "token_rate",
        Refusal::NotAllowed { .. } => "role",
        Refusal::NoLedger { .. } => "no_ledger",
        Refusal::NoMemory { .. } => "memory_full",
        Refusal::Unfinished { .. } => "unfinished_message",
        Refusal::TooLarge { .. } => "too_large",
        Refusal::Idle { .. } => "idle",
        Refusal::Draining => "draining",
        Refusal::Unknown { .. } => "unknown_name",
        Refusal::NotJoined { .. } => "not_joined",
        Refusal::AlreadyJoined { .. } => "already_joined",
        Refusal::Occupied { .. } => "occupied",
        Refusal::NotYours { .. } => "not_yours",
        Refusal::Taken { .. } => "name_taken",
        Refusal::NoRandomness => "no_randomness",
        Refusal::Forbidden { .. } => "forbidden_property",
        Refusal::UnknownExtension { .. } => "unknown_extension",
    }
}
