//! The part of a batch that is on one server.

use std::ops::Range;

use bytes::{Bytes, BytesMut};
use perturb_protocol::{
    Address, ClientError, Connection, EndedEpisode, Stream, TypedRequest, check_step, snapshot_parts,
};

use super::options::{OpenOptions, open_request};
use super::reply::StepReply;
use crate::proto::{self, AutoresetMode};

/// The part of a batch that is on one server, with the stream to that server.
#[derive(Debug)]
pub(super) struct ServerShard {
    pub(super) stream: Stream,
    /// The server's slots in the whole batch.
    pub(super) range: Range<usize>,
    /// An upper bound of the length of one snapshot, bytes; 0 from older servers.
    snapshot_bytes: usize,
    /// Buffer for encoded actions. Its memory is reused after a request has been sent.
    pub(super) actions: BytesMut,
    /// Whether the last request to this server is still unanswered.
    pub(super) asked: bool,
}

impl ServerShard {
    /// Opens the slots of `range` on a server. Slots are numbered over all `options` together. `lease` is the maximum
    /// number of unanswered requests in a leased session; 0 opens a session without a lease.
    pub(super) async fn open(
        connection: &Connection,
        options: &[OpenOptions],
        range: Range<usize>,
        autoreset_mode: AutoresetMode,
        lease: u32,
    ) -> Result<(Self, proto::Opened), ClientError> {
        let open = open_request(options, range.clone(), autoreset_mode, lease).ok_or_else(|| ClientError::Refused {
            address: connection.address().clone(),
            request: proto::Open::NAME,
            code: tonic::Code::InvalidArgument,
            message: format!("environments {range:?} are more than the protocol can number (2^32 - 1)"),
        })?;
        let asked = open.observe_parameters;
        let has_contexts = open.contexts.is_some() || open.groups.iter().any(|group| group.contexts.is_some());
        let (stream, opened) = Stream::open(connection, open).await?;
        check_observed(connection.address(), asked, &opened)?;
        if has_contexts && !opened.supports_contexts {
            return Err(ClientError::NoContexts { address: connection.address().clone() });
        }
        let snapshot_bytes = opened.max_snapshot_reply_bytes as usize / range.len().max(1);
        Ok((Self { stream, range, snapshot_bytes, actions: BytesMut::new(), asked: false }, opened))
    }

    /// Returns the part of `slots` that is on this server.
    pub(super) fn overlap(&self, slots: &Range<usize>) -> Range<usize> {
        let start = slots.start.clamp(self.range.start, self.range.end);
        start..slots.end.clamp(start, self.range.end)
    }

    /// Returns a mask with one byte per environment of this server: 1 if its slot is in `slots`, else 0. Returns `None`
    /// if this server has no environment in `slots`.
    pub(super) fn mask(&self, slots: &Range<usize>) -> Option<Bytes> {
        let own = self.overlap(slots);
        (!own.is_empty()).then(|| self.range.clone().map(|slot| u8::from(own.contains(&slot))).collect())
    }

    /// Divides the part of `slots` that is on this server into ranges whose snapshots fit in one reply each.
    pub(super) fn snapshot_parts(&self, slots: &Range<usize>) -> Vec<Range<usize>> {
        let own = self.overlap(slots);
        let cuts = snapshot_parts(own.clone().map(|_| self.snapshot_bytes));
        cuts.into_iter().map(|cut| own.start + cut.start..own.start + cut.end).collect()
    }

    /// Decodes this server's reply `stepped` into the parts of `reply` for its slots. `size` is O, the length of an
    /// observation.
    pub(super) fn store(&self, stepped: proto::Stepped, size: usize, reply: &mut StepReply) -> Result<(), ClientError> {
        let Range { start, end } = self.range;
        check_step(&stepped, self.range.len(), size).map_err(|it| self.mismatch(it.got, it.expected))?;
        self.decode("observations", &stepped.observations, &mut reply.observations[start * size..end * size])?;
        self.decode("rewards", &stepped.rewards, &mut reply.rewards[start..end])?;
        set_flags(&stepped.terminated, &mut reply.terminated[start..end]);
        set_flags(&stepped.truncated, &mut reply.truncated[start..end]);
        let first = reply.final_observations.len();
        reply.final_observations.resize(first + stepped.ended.len() * size, 0.0);
        let finals = &mut reply.final_observations[first..];
        self.decode("final_observations", &stepped.final_observations, finals)?;
        for end in stepped.ended {
            let slot = start + end.slot as usize;
            let named = self.range.contains(&slot).then(|| EndedEpisode::from_proto(end, slot, reply.terminated[slot]));
            let Some(ended) = named.flatten() else {
                let expected = "a named episode with its receipt";
                return Err(self.mismatch(format!("an ended episode of slot {slot}"), expected.into()));
            };
            reply.ended.push(ended);
        }
        Ok(())
    }

    /// Decodes a field of a reply to `Step`.
    fn decode(&self, field: &'static str, bytes: &Bytes, out: &mut [f32]) -> Result<(), ClientError> {
        self.stream.decode::<proto::Step>(field, bytes, out)
    }

    /// Returns the error for a malformed reply to `Step`.
    fn mismatch(&self, got: String, expected: String) -> ClientError {
        self.stream.mismatch::<proto::Step>(got, expected)
    }
}

/// Converts flags from bytes to booleans. The lengths were checked before.
fn set_flags(bytes: &[u8], out: &mut [bool]) {
    out.iter_mut().zip(bytes).for_each(|(out, byte)| *out = *byte != 0);
}

/// Checks that observations contain parameters if and only if this was requested. An older server leaves them out
/// without an error.
fn check_observed(address: &Address, asked: bool, opened: &proto::Opened) -> Result<(), ClientError> {
    if opened.observes_parameters == asked {
        Ok(())
    } else {
        Err(ClientError::NoParameters { address: address.clone() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn server_without_parameters_as_observations_is_named() {
        let address = "127.0.0.1:7447".parse().unwrap();
        let of = |asked, observes_parameters| {
            check_observed(&address, asked, &proto::Opened { observes_parameters, ..proto::Opened::default() })
        };
        assert!(of(true, true).is_ok() && of(false, false).is_ok());
        let error = of(true, false).unwrap_err();
        assert!(error.to_string().contains("127.0.0.1:7447") && error.to_string().contains("older than this program"));
        assert!(error.can_be_retried(), "with another server");
    }
}
