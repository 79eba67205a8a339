//! A batch of environments, spread over one or several servers.

use std::ops::Range;

use bytes::{Bytes, BytesMut};
use perturb_protocol::{Ask, ClientError, Connection, Distribution, Stream, Version};
use perturb_study::sets::Parameters;

use super::servers::Servers;
use crate::proto::{self, AutoresetMode};

/// What to open.
#[derive(Clone, Debug)]
pub struct OpenOptions {
    /// A name from the catalogue.
    pub environment: String,
    /// Where parameters come from.
    pub version: Version,
    /// What replaces the version's distributions of some parameters.
    pub parameters: Parameters,
    /// N, at least 1.
    pub num_envs: usize,
    /// Fixes all randomness of the environments.
    pub seed: u64,
    /// Episodes in a trial.
    pub episodes_per_trial: u32,
}

/// An episode that ended, with the parameters that it ran with.
#[derive(Clone, Debug, PartialEq)]
pub struct EndedEpisode {
    /// Where in the batch, 0 … N-1.
    pub slot: usize,
    /// The environment's index; equal to `slot` unless environments were restored from elsewhere.
    pub environment_index: u32,
    /// Counts the environment's episodes from 0.
    pub episode_index: u64,
    /// Counts the environment's trials from 0.
    pub trial_index: u64,
    /// Counts the trial's episodes from 0.
    pub episode_in_trial: u32,
    /// The undiscounted sum of its rewards.
    pub episode_return: f64,
    /// Its number of steps.
    pub length: u32,
    /// Whether it was a success.
    pub success: bool,
    /// Whether the task ended it, as opposed to the step limit alone.
    pub terminated: bool,
    /// Whether the physics diverged.
    pub diverged: bool,
    /// What it achieved of what the environment's success rule compares; `None` if nothing.
    pub achieved: Option<f64>,
    /// The parameters that were drawn or given and what the physics had, in the catalogue's order.
    pub receipt: proto::Receipt,
}

/// The outcome of a step, in buffers that are used again.
#[derive(Clone, Debug, Default)]
pub struct StepReply {
    /// `[N, O]` observations; where an episode ended, the first one of the next.
    pub observations: Vec<f32>,
    /// `[N]` rewards.
    pub rewards: Vec<f32>,
    /// `[N]` whether the task ended the episode.
    pub terminated: Vec<bool>,
    /// `[N]` whether the step limit ended it.
    pub truncated: Vec<bool>,
    /// `[K, O]` last observations of the episodes that ended, in the order of `ended`.
    pub final_observations: Vec<f32>,
    /// The K episodes that ended, in order of slots.
    pub ended: Vec<EndedEpisode>,
}

/// So many snapshots are restored by one request: of HalfCheetah some 600 kB, far below what a server accepts.
const RESTORED_AT_ONCE: usize = 1024;

/// N environments in same-step autoreset mode. Environment i of the batch has index i and gives the same bytes however
/// many servers share the batch: each server owns a contiguous range.
#[derive(Debug)]
pub struct Session<'a> {
    servers: &'a Servers,
    parts: Vec<Part>,
    environment: proto::Environment,
    observation_size: usize,
    num_envs: usize,
    episodes_per_trial: u32,
}

/// The part of a batch that one server owns.
#[derive(Debug)]
pub(super) struct Part {
    pub(super) stream: Stream,
    range: Range<usize>,
    /// Encoded actions; its memory comes back when a request has been sent.
    actions: BytesMut,
}

impl<'a> Session<'a> {
    /// Opens the environments and writes their first observations `[N, O]` to `observations`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's sentence, [`ClientError::Disagreement`] between servers, and the
    /// failures of a connection.
    pub fn open(servers: &'a Servers, options: &OpenOptions, observations: &mut Vec<f32>) -> Result<Self, ClientError> {
        let ranges = split(options.num_envs, servers.connections().len());
        let mut parts: Vec<Part> = Vec::new();
        let mut environment: Option<proto::Environment> = None;
        observations.clear();
        for (connection, range) in servers.connections().iter().zip(ranges) {
            if range.is_empty() {
                continue; // more servers than environments
            }
            let opening = open_part(connection, options, range, AutoresetMode::SameStep);
            let (part, opened) = servers.runtime().block_on(opening).map_err(|error| servers.explain(error))?;
            let described = opened.environment.unwrap_or_default();
            let expected = part.range.len() * described.observation.len();
            let first = observations.len();
            observations.resize(first + expected, 0.0);
            part.stream.decode::<proto::Open>("observations", &opened.observations, &mut observations[first..])?;
            match &environment {
                Some(known) if *known != described => {
                    return Err(ClientError::Disagreement {
                        first: parts[0].stream.address().clone(),
                        other: part.stream.address().clone(),
                        environment: options.environment.clone(),
                    });
                }
                _ => environment = Some(described),
            }
            parts.push(part);
        }
        let environment = environment.unwrap_or_default();
        let observation_size = environment.observation.len();
        let OpenOptions { num_envs, episodes_per_trial, .. } = *options;
        Ok(Self { servers, parts, environment, observation_size, num_envs, episodes_per_trial })
    }

    /// What was opened.
    pub fn environment(&self) -> &proto::Environment {
        &self.environment
    }

    /// N.
    pub fn num_envs(&self) -> usize {
        self.num_envs
    }

    /// Episodes in a trial.
    pub fn episodes_per_trial(&self) -> u32 {
        self.episodes_per_trial
    }

    /// O.
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Advances every environment. `actions` are those of all N environments as the protocol wants them, i32 `[N]` or
    /// f32 `[N, A]`. All servers compute at the same time. Replaces what is in `reply`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] if the actions are wrong: then no environment of that server has moved. The failures of
    /// a connection, after which the environments are gone.
    pub fn step(&mut self, actions: &[u8], reply: &mut StepReply) -> Result<(), ClientError> {
        let width = actions.len() / self.num_envs.max(1);
        reply.resize(self.num_envs, self.observation_size);
        let size = self.observation_size;
        let request = |part: &mut Part| {
            part.actions.clear();
            part.actions.extend_from_slice(&actions[part.range.start * width..part.range.end * width]);
            proto::Step { actions: part.actions.split().freeze() }
        };
        self.exchange(request, |part, stepped| part.store(stepped, size, reply))
    }

    /// Begins a new trial in the environment of `slot`, whose named parameters have the given values from now on; the
    /// others keep the version's distributions. `seed` replaces its seed, and its episodes count from 0 again. Writes the
    /// first observation `[O]` to its place in `observations` `[N, O]`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] if there is no such parameter, or if a value is out of its bounds; the failures of a
    /// connection.
    pub fn reset_with(
        &mut self,
        slot: usize,
        parameters: &[(&str, f64)],
        seed: u64,
        observations: &mut [f32],
    ) -> Result<(), ClientError> {
        let fixed = |value: f64| proto::Distribution::from(&Distribution::fixed(value));
        let request = proto::Reset {
            seeds: vec![seed],
            parameters: parameters.iter().map(|(name, value)| ((*name).to_owned(), fixed(*value))).collect(),
            ..proto::Reset::default()
        };
        self.reset_slot(slot, request, observations)
    }

    /// Begins the next episode in the environment of `slot`, whether or not the present one has ended, and writes its first
    /// observation `[O]` to its place in `observations` `[N, O]`.
    ///
    /// # Errors
    /// The failures of a connection.
    pub fn reset_one(&mut self, slot: usize, observations: &mut [f32]) -> Result<(), ClientError> {
        self.reset_slot(slot, proto::Reset::default(), observations)
    }

    fn reset_slot(&mut self, slot: usize, request: proto::Reset, observations: &mut [f32]) -> Result<(), ClientError> {
        let Self { servers, parts, observation_size: size, .. } = self;
        let Some(part) = parts.iter_mut().find(|part| part.range.contains(&slot)) else { return Ok(()) };
        let mask = part.range.clone().map(|other| u8::from(other == slot)).collect();
        let request = proto::Reset { mask, ..request };
        let done = servers.runtime().block_on(part.stream.ask(request)).map_err(|error| servers.explain(error))?;
        let first = &mut observations[slot * *size..][..*size];
        part.stream.decode::<proto::Reset>("observations", &done.observations, first)
    }

    /// Saves every environment whole: N opaque snapshots in order of slots. Changes nothing. All servers work at the same
    /// time.
    ///
    /// # Errors
    /// The failures of a connection.
    pub fn snapshot(&mut self) -> Result<Vec<Bytes>, ClientError> {
        let mut snapshots = Vec::with_capacity(self.num_envs);
        self.exchange(
            |_| proto::Snapshot::default(),
            |part, saved| {
                if saved.snapshots.len() != part.range.len() {
                    let got = format!("{} snapshots", saved.snapshots.len());
                    return Err(part.stream.mismatch::<proto::Snapshot>(got, part.range.len().to_string()));
                }
                snapshots.extend(saved.snapshots);
                Ok(())
            },
        )?;
        Ok(snapshots)
    }

    /// Brings environments back from N snapshots in order of slots, taken of this environment on any number of servers,
    /// and writes the observations `[N, O]` at which they were saved. What follows is what followed the snapshots.
    ///
    /// # Errors
    /// [`ClientError::Snapshots`] if there are not N, [`ClientError::Refused`] if one is of something else, and the
    /// failures of a connection. After the latter two some environments may have been restored.
    pub fn restore(&mut self, snapshots: &[Bytes], observations: &mut [f32]) -> Result<(), ClientError> {
        if snapshots.len() != self.num_envs {
            return Err(ClientError::Snapshots { got: snapshots.len(), expected: self.num_envs });
        }
        let Self { servers, parts, observation_size: size, .. } = self;
        let restored = servers.runtime().block_on(async {
            for part in parts.iter_mut() {
                for slots in chunks(part.range.clone()) {
                    let mask = part.range.clone().map(|slot| u8::from(slots.contains(&slot))).collect();
                    let request = proto::Restore { mask, snapshots: snapshots[slots.clone()].to_vec() };
                    let done = part.stream.ask(request).await?;
                    let out = &mut observations[slots.start * *size..slots.end * *size];
                    part.stream.decode::<proto::Restore>("observations", &done.observations, out)?;
                }
            }
            Ok(())
        });
        restored.map_err(|error| servers.explain(error))
    }

    /// Begins a new episode in every environment and writes its first observations `[N, O]`.
    ///
    /// # Errors
    /// The failures of a connection.
    pub fn reset(&mut self, observations: &mut [f32]) -> Result<(), ClientError> {
        let size = self.observation_size;
        self.exchange(
            |_| proto::Reset::default(),
            |part, done| {
                let range = part.range.start * size..part.range.end * size;
                part.stream.decode::<proto::Reset>("observations", &done.observations, &mut observations[range])
            },
        )
    }

    /// Sends every server its request and takes its reply. All are heard before the first failure is returned, so that
    /// no reply is left for a later request.
    fn exchange<A: Ask>(
        &mut self,
        mut request: impl FnMut(&mut Part) -> A,
        mut take: impl FnMut(&Part, A::Reply) -> Result<(), ClientError>,
    ) -> Result<(), ClientError> {
        let Self { servers, parts, .. } = self;
        let exchanged = servers.runtime().block_on(async {
            for part in parts.iter_mut() {
                let request = request(part);
                part.stream.send(request).await?;
            }
            let mut outcome = Ok(());
            for part in parts.iter_mut() {
                let taken = part.stream.receive::<A>().await.and_then(|reply| take(part, reply));
                outcome = outcome.and(taken);
            }
            outcome
        });
        exchanged.map_err(|error| servers.explain(error))
    }
}

impl StepReply {
    pub(super) fn resize(&mut self, num_envs: usize, observation_size: usize) {
        self.observations.resize(num_envs * observation_size, 0.0);
        self.rewards.resize(num_envs, 0.0);
        self.terminated.resize(num_envs, false);
        self.truncated.resize(num_envs, false);
        self.final_observations.clear();
        self.ended.clear();
    }
}

impl Part {
    /// Puts one server's reply in its place in the batch's.
    pub(super) fn store(&self, stepped: proto::Stepped, size: usize, reply: &mut StepReply) -> Result<(), ClientError> {
        let Range { start, end } = self.range;
        self.decode("observations", &stepped.observations, &mut reply.observations[start * size..end * size])?;
        self.decode("rewards", &stepped.rewards, &mut reply.rewards[start..end])?;
        self.decode_flags("terminated", &stepped.terminated, &mut reply.terminated[start..end])?;
        self.decode_flags("truncated", &stepped.truncated, &mut reply.truncated[start..end])?;
        let first = reply.final_observations.len();
        reply.final_observations.resize(first + stepped.ended.len() * size, 0.0);
        let finals = &mut reply.final_observations[first..];
        self.decode("final_observations", &stepped.final_observations, finals)?;
        for end in stepped.ended {
            let slot = start + end.slot as usize;
            let named = end.episode.zip(end.receipt).filter(|_| self.range.contains(&slot));
            let Some((episode, receipt)) = named else {
                let expected = "a named episode with its receipt";
                return Err(self.mismatch(format!("an ended episode of slot {slot}"), expected.into()));
            };
            reply.ended.push(EndedEpisode {
                slot,
                environment_index: episode.environment_index,
                episode_index: episode.episode_index,
                trial_index: episode.trial_index,
                episode_in_trial: episode.episode_in_trial,
                episode_return: end.r#return,
                length: end.length,
                success: end.success,
                terminated: reply.terminated[slot],
                diverged: end.diverged,
                achieved: end.achieved,
                receipt,
            });
        }
        Ok(())
    }

    fn decode(&self, field: &'static str, bytes: &Bytes, out: &mut [f32]) -> Result<(), ClientError> {
        self.stream.decode::<proto::Step>(field, bytes, out)
    }

    fn decode_flags(&self, field: &'static str, bytes: &Bytes, out: &mut [bool]) -> Result<(), ClientError> {
        if bytes.len() != out.len() {
            return Err(self.mismatch(format!("{} bytes of {field}", bytes.len()), out.len().to_string()));
        }
        out.iter_mut().zip(bytes.iter()).for_each(|(out, byte)| *out = *byte != 0);
        Ok(())
    }

    fn mismatch(&self, got: String, expected: String) -> ClientError {
        self.stream.mismatch::<proto::Step>(got, expected)
    }
}

pub(super) async fn open_part(
    connection: &Connection,
    options: &OpenOptions,
    range: Range<usize>,
    autoreset_mode: AutoresetMode,
) -> Result<(Part, proto::Opened), ClientError> {
    let index = |index: usize| {
        u32::try_from(index).map_err(|_| ClientError::Refused {
            address: connection.address().clone(),
            request: proto::Open::NAME,
            code: tonic::Code::InvalidArgument,
            message: format!("{index} environments are more than the protocol can number (2^32 - 1)"),
        })
    };
    let open = proto::Open {
        environment: options.environment.clone(),
        version: options.version.to_proto().into(),
        parameters: options.parameters.iter().map(|(name, values)| (name.clone(), values.into())).collect(),
        batch_size: index(range.len())?,
        seed: options.seed,
        first_environment_index: index(range.start)?,
        episodes_per_trial: options.episodes_per_trial,
        autoreset_mode: autoreset_mode.into(),
        receipts: true,
        ..proto::Open::default()
    };
    let (stream, opened) = Stream::open(connection, open).await?;
    Ok((Part { stream, range, actions: BytesMut::new() }, opened))
}

/// Cuts 0 … `num_envs` into `parts` contiguous ranges, whose lengths differ by at most 1.
fn split(num_envs: usize, parts: usize) -> Vec<Range<usize>> {
    (0..parts).map(|part| part * num_envs / parts..(part + 1) * num_envs / parts).collect()
}

/// Cuts `slots` into ranges that one request restores.
fn chunks(slots: Range<usize>) -> impl Iterator<Item = Range<usize>> {
    let end = slots.end;
    slots.step_by(RESTORED_AT_ONCE).map(move |first| first..end.min(first + RESTORED_AT_ONCE))
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

    #[test]
    fn requests_to_restore_cover_a_part_in_order() {
        for slots in [0..1, 5..RESTORED_AT_ONCE, 7..7 + RESTORED_AT_ONCE, 1..3 * RESTORED_AT_ONCE] {
            let all: Vec<usize> = chunks(slots.clone()).flatten().collect();
            assert_eq!(all, slots.clone().collect::<Vec<_>>());
            assert!(chunks(slots).all(|chunk| (1..=RESTORED_AT_ONCE).contains(&chunk.len())));
        }
    }
}
