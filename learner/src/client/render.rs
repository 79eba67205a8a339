//! A session with a single environment, for rendering pictures.

use tonic::Code;

use perturb_protocol::{ClientError, TypedRequest};

use super::options::OpenOptions;
use super::reply::StepReply;
use super::servers::Servers;
use super::shard::ServerShard;
use crate::proto::{self, AutoresetMode};

/// Describes an episode that has just started.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BegunEpisode {
    /// The index of the episode in its environment, from 0.
    pub episode_index: u64,
    /// The index of the trial in its environment, from 0.
    pub trial_index: u64,
    /// The index of the episode in its trial, from 0.
    pub episode_in_trial: u32,
    /// The values of all parameters, in the catalogue's order.
    pub parameters: Vec<f64>,
}

/// A rendered picture of an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedPicture {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// The pixels `[height, width, 3]`, with one byte each for red, green and blue. The first row is the top row.
    pub pixels: bytes::Bytes,
}

/// A session with a single environment, for rendering pictures. After the end of an episode the environment waits for a
/// reset, so that the last state can be rendered.
///
/// Requests and replies are separate calls, so that the server can render while the learner computes. Receive replies
/// in the order of their requests. At most three requests may be unanswered at a time.
#[derive(Debug)]
pub struct RenderSession<'a> {
    servers: &'a Servers,
    part: ServerShard,
    environment: proto::Environment,
    size: (u32, u32),
}

impl<'a> RenderSession<'a> {
    /// Opens one environment on the first server, and writes its first observation `[O]`. Ignores `options.num_envs`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's message, and connection failures.
    pub fn open(
        servers: &'a Servers,
        options: &OpenOptions,
        observation: &mut Vec<f32>,
    ) -> Result<(Self, BegunEpisode), ClientError> {
        let connections = servers.connections();
        let Some(connection) = connections.first() else {
            let source = std::io::ErrorKind::NotConnected.into();
            return Err(ClientError::System { action: "open an environment", source });
        };
        let opening = ServerShard::open(connection, std::slice::from_ref(options), 0..1, AutoresetMode::Disabled, 0);
        let (part, opened) = servers.wait_for(opening)?;
        let environment = opened.environment.unwrap_or_default();
        observation.resize(environment.observation.len(), 0.0);
        part.stream.decode::<proto::Open>("observations", &opened.observations, observation)?;
        let single = Self { servers, part, environment, size: (0, 0) };
        let begun = single.begun_of::<proto::Open>(opened.started)?;
        Ok((single, begun))
    }

    /// Returns the environment's description from the server.
    pub fn environment(&self) -> &proto::Environment {
        &self.environment
    }

    /// Requests a step. `action` is encoded as in the protocol: an i32, or f32 `[A]`.
    ///
    /// # Errors
    /// Connection failures.
    pub fn request_step(&mut self, action: &[u8]) -> Result<(), ClientError> {
        let actions = bytes::Bytes::copy_from_slice(action);
        self.request(proto::Step { actions })
    }

    /// Requests the next episode. It belongs to the same trial unless the trial has ended.
    ///
    /// # Errors
    /// Connection failures.
    pub fn request_reset(&mut self) -> Result<(), ClientError> {
        self.request(proto::Reset::default())
    }

    /// Requests a picture, `width` × `height` pixels large, of the state after all earlier requests.
    ///
    /// # Errors
    /// Connection failures.
    pub fn request_picture(&mut self, width: u32, height: u32) -> Result<(), ClientError> {
        self.size = (width, height);
        self.request(proto::Render { slot: 0, width, height })
    }

    /// Receives the reply to [`Self::request_step`] into `reply`, whose N is 1. If the episode ended, `observations` is
    /// its last observation.
    ///
    /// # Errors
    /// [`ClientError::Refused`] if the action is invalid, and connection failures.
    pub fn stepped(&mut self, reply: &mut StepReply) -> Result<(), ClientError> {
        let size = self.environment.observation.len();
        reply.resize(1, size);
        let stepped = self.reply::<proto::Step>()?;
        self.part.store(stepped, size, reply)
    }

    /// Receives the reply to [`Self::request_reset`], and writes the first observation `[O]` of the episode.
    ///
    /// # Errors
    /// Connection failures.
    pub fn begun(&mut self, observation: &mut [f32]) -> Result<BegunEpisode, ClientError> {
        let done = self.reply::<proto::Reset>()?;
        self.part.stream.decode::<proto::Reset>("observations", &done.observations, observation)?;
        self.begun_of::<proto::Reset>(done.started)
    }

    /// Receives the reply to [`Self::request_picture`].
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's message if it cannot render, and connection failures.
    pub fn picture(&mut self) -> Result<RenderedPicture, ClientError> {
        let (width, height) = self.size;
        let rendered = match self.reply::<proto::Render>() {
            Ok(rendered) => rendered,
            // The size was checked before it was sent. A server that still refuses the request probably does not know
            // this kind of request.
            Err(ClientError::Refused { address, request, code, message }) if code == Code::InvalidArgument => {
                let message = format!("{message}; is the server older than this program?");
                return Err(ClientError::Refused { address, request, code, message });
            }
            Err(error) => return Err(error),
        };
        let proto::Rendered { pixels, width: got_width, height: got_height } = rendered;
        if (got_width, got_height) != (width, height) || pixels.len() as u64 != u64::from(width) * u64::from(height) * 3
        {
            let got = format!("{got_width} × {got_height} pixels in {} bytes", pixels.len());
            return Err(self
                .part
                .stream
                .mismatch::<proto::Render>(got, format!("{width} × {height}, three bytes each")));
        }
        Ok(RenderedPicture { width, height, pixels })
    }

    /// Sends a request without waiting for its reply.
    fn request(&mut self, request: impl TypedRequest) -> Result<(), ClientError> {
        let Self { servers, part, .. } = self;
        servers.wait_for(part.stream.send(request))
    }

    /// Receives the reply to the oldest unanswered request, which must be of the type `A`.
    fn reply<A: TypedRequest>(&mut self) -> Result<A::Reply, ClientError> {
        let Self { servers, part, .. } = self;
        servers.wait_for(part.stream.receive::<A>())
    }

    /// Converts the start of an episode from a reply to the request `A`.
    fn begun_of<A: TypedRequest>(&self, started: Vec<proto::EpisodeStart>) -> Result<BegunEpisode, ClientError> {
        let count = started.len();
        let start = started.into_iter().next().and_then(|start| Some((start.episode?, start.receipt?)));
        let Some((episode, receipt)) = start.filter(|_| count == 1) else {
            return Err(self
                .part
                .stream
                .mismatch::<A>(format!("{count} begun episodes"), "one with its receipt".into()));
        };
        Ok(BegunEpisode {
            episode_index: episode.episode_index,
            trial_index: episode.trial_index,
            episode_in_trial: episode.episode_in_trial,
            parameters: receipt.requested,
        })
    }
}
