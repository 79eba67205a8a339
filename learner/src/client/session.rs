//! A batch of environments, spread over one or more servers.

use std::ops::Range;

use bytes::Bytes;
use perturb_protocol::{Address, ClientError, Distribution, TypedRequest, snapshot_parts};
use tokio::runtime::Handle;

use super::options::{ActorLocation, OpenOptions};
use super::reply::StepReply;
use super::servers::Servers;
use super::shard::ServerShard;
use crate::proto::{self, AutoresetMode};

/// Maximum number of unanswered requests to one server: each request is sent after the previous one was answered.
const MAX_IN_FLIGHT: u32 = 1;

/// A batch of N environments of one or more trainings, in same-step autoreset mode: an environment whose episode ends
/// starts the next one in the same step.
///
/// Each server owns a contiguous range of slots. Environment i of a training has index i, and gives the same bytes with
/// any number of servers and with any other environments in the batch. If a TCP connection is lost but its server still
/// runs, the server's part of the session is [resumed](perturb_protocol::Stream).
#[derive(Debug)]
pub struct ClientSession<'a> {
    pub(super) servers: &'a Servers,
    pub(super) parts: Vec<ServerShard>,
    environment: proto::Environment,
    observation_size: usize,
    num_envs: usize,
    acts: bool,
}

impl<'a> ClientSession<'a> {
    /// Opens environments on all servers, and writes their first observations `[N, O]` to `observations`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's message, [`ClientError::Disagreement`] if servers describe the
    /// environment differently, and connection failures.
    pub fn open(servers: &'a Servers, options: &OpenOptions, observations: &mut Vec<f32>) -> Result<Self, ClientError> {
        Self::open_together(servers, std::slice::from_ref(options), observations)
    }

    /// Opens the environments of several trainings in one batch, in the order of `options`. All options must have the
    /// same environment and the same kind of observation.
    ///
    /// # Errors
    /// The errors of [`ClientSession::open`].
    pub fn open_together(
        servers: &'a Servers,
        options: &[OpenOptions],
        observations: &mut Vec<f32>,
    ) -> Result<Self, ClientError> {
        let num_envs = options.iter().map(|options| options.num_envs).sum();
        let connections = servers.connections();
        let ranges = split(num_envs, connections.len());
        let acts = servers.act() == ActorLocation::Server;
        let environment = proto::Environment::default();
        let mut session = Self { servers, parts: Vec::new(), environment, observation_size: 0, num_envs, acts };
        observations.clear();
        for (connection, range) in connections.iter().zip(ranges) {
            if range.is_empty() {
                continue; // more servers than environments
            }
            // A lease is useless on a Unix socket, which is lost only if its server ends.
            let lease = if matches!(connection.address(), Address::Tcp { .. }) { MAX_IN_FLIGHT } else { 0 };
            let opening = ServerShard::open(connection, options, range, AutoresetMode::SameStep, lease);
            let (mut part, opened) = servers.wait_for(opening)?;
            if let [_, _, ..] = options {
                part.stream.back_off_when_contended(); // other groups often run on the same cores
            }
            let described = opened.environment.unwrap_or_default();
            session.acts &= opened.acts;
            let expected = part.range.len() * described.observation.len();
            let first = observations.len();
            observations.resize(first + expected, 0.0);
            part.stream.decode::<proto::Open>("observations", &opened.observations, &mut observations[first..])?;
            let other = part.stream.address().clone();
            session.parts.push(part);
            match session.parts.as_slice() {
                [first, _, ..] if session.environment != described => {
                    let first = first.stream.address().clone();
                    return Err(ClientError::Disagreement { first, other, environment: described.name });
                }
                _ => session.environment = described,
            }
        }
        session.observation_size = session.environment.observation.len();
        Ok(session)
    }

    /// Returns the environment's description from the servers.
    pub fn environment(&self) -> &proto::Environment {
        &self.environment
    }

    /// Returns N, the number of environments.
    pub fn num_envs(&self) -> usize {
        self.num_envs
    }

    /// Returns whether the servers choose the actions: the configuration asks for it, and all servers support it. See
    /// [`ClientSession::play`].
    pub fn acts(&self) -> bool {
        self.acts
    }

    /// Returns whether a single server plays the whole batch. Only then can the server keep the batch's normalisers and
    /// its random stream of actions.
    pub fn plays_together(&self) -> bool {
        self.acts && self.parts.len() == 1
    }

    /// Returns O, the length of an observation.
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Steps all environments, on all servers at the same time. `actions` are encoded as in the protocol: i32 `[N]` or
    /// f32 `[N, A]`. Replaces the content of `reply`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] if actions are invalid; no environment of that server has then moved. Connection
    /// failures; the environments are then lost.
    pub fn step(&mut self, actions: &[u8], reply: &mut StepReply) -> Result<(), ClientError> {
        let width = actions.len() / self.num_envs.max(1);
        reply.resize(self.num_envs, self.observation_size);
        let size = self.observation_size;
        let request = |part: &mut ServerShard| {
            part.actions.clear();
            part.actions.extend_from_slice(&actions[part.range.start * width..part.range.end * width]);
            Some(proto::Step { actions: part.actions.split().freeze() })
        };
        self.exchange(request, |part, stepped| part.store(stepped, size, reply))
    }

    /// Starts a new trial in the environment of `slot`, and writes its first observation `[O]`. From now on, the named
    /// parameters have the given values, and all others keep the version's distributions. `seed` replaces the
    /// environment's seed, and its episodes are counted from 0 again.
    ///
    /// # Errors
    /// [`ClientError::Refused`] for an unknown parameter or a value out of its bounds, and connection failures.
    pub fn reset_with(
        &mut self,
        slot: usize,
        parameters: &[(&str, f64)],
        seed: u64,
        observation: &mut [f32],
    ) -> Result<(), ClientError> {
        let fixed = |value: f64| proto::Distribution::from(&Distribution::fixed(value));
        let request = proto::Reset {
            seeds: vec![seed],
            parameters: parameters.iter().map(|(name, value)| ((*name).to_owned(), fixed(*value))).collect(),
            ..proto::Reset::default()
        };
        self.reset_slot(slot, request, observation)
    }

    /// Starts the next episode in the environment of `slot`, even if the current one has not ended. Writes the first
    /// observation `[O]`.
    ///
    /// # Errors
    /// Connection failures.
    pub fn reset_one(&mut self, slot: usize, observation: &mut [f32]) -> Result<(), ClientError> {
        self.reset_slot(slot, proto::Reset::default(), observation)
    }

    /// Resets one environment, and writes its first observation `[O]`.
    fn reset_slot(&mut self, slot: usize, request: proto::Reset, observation: &mut [f32]) -> Result<(), ClientError> {
        let Self { servers, parts, .. } = self;
        let Some(part) = parts.iter_mut().find(|part| part.range.contains(&slot)) else { return Ok(()) };
        let mask = part.range.clone().map(|other| u8::from(other == slot)).collect();
        let request = proto::Reset { mask, ..request };
        let done = servers.wait_for(part.stream.ask(request))?;
        part.stream.decode::<proto::Reset>("observations", &done.observations, observation)
    }

    /// Returns an opaque snapshot of each environment in `slots`, in order. Does not change the environments. All
    /// servers work at the same time. If a server's snapshots are together too long for one reply, they are requested
    /// in several rounds.
    ///
    /// # Errors
    /// Connection failures.
    pub fn snapshot(&mut self, slots: Range<usize>) -> Result<Vec<Bytes>, ClientError> {
        let mut snapshots = vec![Bytes::new(); slots.len()];
        let rounds = self.parts.iter().map(|part| part.snapshot_parts(&slots).len()).max().unwrap_or(0);
        for round in 0..rounds {
            let asked = |part: &ServerShard| part.snapshot_parts(&slots).get(round).cloned();
            self.exchange(
                |part| asked(part).and_then(|own| part.mask(&own)).map(|mask| proto::Snapshot { mask }),
                |part, saved| {
                    let own = asked(part).unwrap_or_default();
                    if saved.snapshots.len() != own.len() {
                        let got = format!("{} snapshots", saved.snapshots.len());
                        return Err(part.stream.mismatch::<proto::Snapshot>(got, own.len().to_string()));
                    }
                    snapshots[own.start - slots.start..][..own.len()].clone_from_slice(&saved.snapshots);
                    Ok(())
                },
            )?;
        }
        Ok(snapshots)
    }

    /// Restores the n environments of `slots` from n `snapshots`, in order. Returns the observations `[n, O]` at the
    /// time of the snapshots. The environments then continue exactly as they did after the snapshots. The snapshots may
    /// be from any number of servers, but must be of the same environment.
    ///
    /// # Errors
    /// [`ClientError::Snapshots`] if there are not n snapshots, [`ClientError::Refused`] for a snapshot of something
    /// else, and connection failures. After a refusal or a connection failure, some environments may already have been
    /// restored.
    pub fn restore(&mut self, slots: Range<usize>, snapshots: &[Bytes]) -> Result<Vec<f32>, ClientError> {
        if snapshots.len() != slots.len() {
            return Err(ClientError::Snapshots { got: snapshots.len(), expected: slots.len() });
        }
        let Self { servers, parts, observation_size: size, .. } = self;
        let mut observations = vec![0.0; slots.len() * *size];
        servers.wait_for(async {
            for part in parts.iter_mut() {
                let own = part.overlap(&slots);
                if own.is_empty() {
                    continue;
                }
                let first = own.start - slots.start;
                for cut in snapshot_parts(snapshots[first..][..own.len()].iter().map(Bytes::len)) {
                    let Some(mask) = part.mask(&(own.start + cut.start..own.start + cut.end)) else { continue };
                    let places = first + cut.start..first + cut.end;
                    let request = proto::Restore { mask, snapshots: snapshots[places.clone()].to_vec() };
                    let done = part.stream.ask(request).await?;
                    let out = &mut observations[places.start * *size..places.end * *size];
                    part.stream.decode::<proto::Restore>("observations", &done.observations, out)?;
                }
            }
            Ok(())
        })?;
        Ok(observations)
    }

    /// Starts a new episode in each of the n environments of `slots`, and writes their first observations `[n, O]`.
    ///
    /// # Errors
    /// Connection failures.
    pub fn reset(&mut self, slots: Range<usize>, observations: &mut [f32]) -> Result<(), ClientError> {
        let size = self.observation_size;
        self.exchange(
            |part| part.mask(&slots).map(|mask| proto::Reset { mask, ..proto::Reset::default() }),
            |part, done| {
                let places = part.overlap(&slots);
                let range = (places.start - slots.start) * size..(places.end - slots.start) * size;
                part.stream.decode::<proto::Reset>("observations", &done.observations, &mut observations[range])
            },
        )
    }

    /// Frees the environments of `slots` on the servers. Environments with higher slots move down, so that no slot
    /// stays empty.
    ///
    /// # Errors
    /// Connection failures.
    pub fn release(&mut self, slots: Range<usize>) -> Result<(), ClientError> {
        // Closes the stream of a server that would have no environments left.
        self.close(|part| part.overlap(&slots) == part.range);
        self.exchange(|part| part.mask(&slots).map(|mask| proto::Release { mask }), |_, _| Ok(()))?;
        let mut first = 0;
        for part in &mut self.parts {
            let left = part.range.len() - part.overlap(&slots).len();
            part.range = first..first + left;
            first += left;
        }
        self.num_envs = first;
        Ok(())
    }

    /// Closes the streams of the servers for which `over` is true, so that these servers do not keep the environments
    /// until a lease expires.
    fn close(&mut self, over: impl Fn(&ServerShard) -> bool) {
        let closing = self.parts.extract_if(.., |part| over(part)).map(|part| part.stream.close());
        let closing = futures_util::future::join_all(closing);
        // A thread that is already inside a tokio runtime must not block.
        if Handle::try_current().is_err() && !self.servers.has_given_up() {
            self.servers.block_on(closing);
        }
    }

    /// Sends each server its request, then receives all replies. `request` returns `None` for a server that gets no
    /// request, and `take` handles the reply of a server. Receives all replies even if one fails, so that none is
    /// mistaken for the reply to a later request. Returns the first failure.
    pub(super) fn exchange<A: TypedRequest>(
        &mut self,
        mut request: impl FnMut(&mut ServerShard) -> Option<A>,
        mut take: impl FnMut(&ServerShard, A::Reply) -> Result<(), ClientError>,
    ) -> Result<(), ClientError> {
        let Self { servers, parts, .. } = self;
        servers.wait_for(async {
            for part in parts.iter_mut() {
                let request = request(part);
                part.asked = request.is_some();
                if let Some(request) = request {
                    part.stream.send(request).await?;
                }
            }
            let mut outcome = Ok(());
            for part in parts.iter_mut().filter(|part| part.asked) {
                let taken = part.stream.receive::<A>().await.and_then(|reply| take(part, reply));
                outcome = outcome.and(taken);
            }
            outcome
        })
    }
}

impl Drop for ClientSession<'_> {
    fn drop(&mut self) {
        self.close(|_| true);
    }
}

/// Divides `0..num_envs` into `parts` contiguous ranges whose lengths differ by at most 1.
fn split(num_envs: usize, parts: usize) -> Vec<Range<usize>> {
    (0..parts).map(|part| part * num_envs / parts..(part + 1) * num_envs / parts).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_cover_the_batch_in_order() {
        for (num_envs, parts) in [(8, 1), (8, 2), (7, 3), (2, 5), (1, 2)] {
            let ranges = split(num_envs, parts);
            let all: Vec<usize> = ranges.iter().cloned().flatten().collect();
            assert_eq!(all, (0..num_envs).collect::<Vec<_>>());
            let lengths = ranges.iter().map(ExactSizeIterator::len);
            assert!(lengths.clone().max().unwrap() - lengths.min().unwrap() <= 1);
        }
    }
}
