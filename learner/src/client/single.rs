//! One environment that is looked at.

use tonic::Code;

use super::error::ClientError;
use super::servers::Servers;
use super::session::{OpenOptions, Part, StepReply, open_part};
use crate::proto::{self, AutoresetMode, session_request::Request, session_response::Response};

/// An episode that began.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BegunEpisode {
    /// Counts the environment's episodes from 0.
    pub episode_index: u64,
    /// Counts its trials from 0.
    pub trial_index: u64,
    /// Counts the trial's episodes from 0.
    pub episode_in_trial: u32,
    /// The parameters, in the catalogue's order.
    pub parameters: Vec<f64>,
}

/// A picture of an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// In pixels.
    pub width: u32,
    /// In pixels.
    pub height: u32,
    /// `[height, width, 3]`: red, green, blue; the first row is the uppermost.
    pub pixels: bytes::Bytes,
}

/// One environment that waits at the end of an episode, so that its last state can be drawn.
///
/// Requests are made and answered apart: a server draws while the learner computes. Answers must be taken in the order
/// of their requests, and no more than three requests may wait for theirs.
#[derive(Debug)]
pub struct Single<'a> {
    servers: &'a Servers,
    part: Part,
    environment: proto::Environment,
    size: (u32, u32),
}

const STEP: &str = "a step";
const RESET: &str = "a reset";
const PICTURE: &str = "a picture";

impl<'a> Single<'a> {
    /// Opens one environment on the first server, whatever number `options` says, and writes its first observation
    /// `[O]`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's sentence, and the failures of a connection.
    pub fn open(
        servers: &'a Servers,
        options: &OpenOptions,
        observation: &mut Vec<f32>,
    ) -> Result<(Self, BegunEpisode), ClientError> {
        let what = "to open a session";
        let Some(link) = servers.links().first() else {
            let source = std::io::ErrorKind::NotConnected.into();
            return Err(ClientError::System { action: "open an environment", source });
        };
        let opening = open_part(servers, link, options, 0..1, AutoresetMode::Disabled);
        let (part, opened) = servers.runtime().block_on(opening)?;
        let environment = opened.environment.unwrap_or_default();
        observation.resize(environment.observation.len(), 0.0);
        part.decode(what, "observations", &opened.observations, observation)?;
        let single = Self { servers, part, environment, size: (0, 0) };
        let begun = single.begun_of(what, opened.started)?;
        Ok((single, begun))
    }

    /// What was opened.
    pub fn environment(&self) -> &proto::Environment {
        &self.environment
    }

    /// Asks for a step with an action as the protocol wants it, i32 or f32 `[A]`.
    ///
    /// # Errors
    /// The failures of a connection, as of all requests.
    pub fn request_step(&mut self, action: &[u8]) -> Result<(), ClientError> {
        let actions = bytes::Bytes::copy_from_slice(action);
        self.request(STEP, Request::Step(proto::Step { actions }))
    }

    /// Asks for the next episode; the trial goes on, if it has another one.
    ///
    /// # Errors
    /// The failures of a connection.
    pub fn request_reset(&mut self) -> Result<(), ClientError> {
        self.request(RESET, Request::Reset(proto::Reset::default()))
    }

    /// Asks for a picture of so many pixels of the state after the requests before.
    ///
    /// # Errors
    /// The failures of a connection.
    pub fn request_picture(&mut self, width: u32, height: u32) -> Result<(), ClientError> {
        self.size = (width, height);
        self.request(PICTURE, Request::Render(proto::Render { slot: 0, width, height }))
    }

    /// Takes the answer to [`Self::request_step`]. Replaces what is in `reply`, whose N is 1; `observations` is the last
    /// one of an episode that ended.
    ///
    /// # Errors
    /// [`ClientError::Refused`] if the action is wrong, and the failures of a connection.
    pub fn stepped(&mut self, reply: &mut StepReply) -> Result<(), ClientError> {
        let size = self.environment.observation.len();
        reply.resize(1, size);
        match self.response(STEP)? {
            Response::Stepped(stepped) => self.part.store(stepped, size, reply),
            other => Err(self.part.unexpected(STEP, &other, "Stepped")),
        }
    }

    /// Takes the answer to [`Self::request_reset`], and writes the first observation `[O]`.
    ///
    /// # Errors
    /// The failures of a connection.
    pub fn begun(&mut self, observation: &mut [f32]) -> Result<BegunEpisode, ClientError> {
        match self.response(RESET)? {
            Response::Reset(done) => {
                self.part.decode(RESET, "observations", &done.observations, observation)?;
                self.begun_of(RESET, done.started)
            }
            other => Err(self.part.unexpected(RESET, &other, "ResetDone")),
        }
    }

    /// Takes the answer to [`Self::request_picture`].
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's sentence if it cannot draw, and the failures of a connection.
    pub fn picture(&mut self) -> Result<Picture, ClientError> {
        let (width, height) = self.size;
        let rendered = match self.response(PICTURE) {
            Ok(Response::Render(rendered)) => rendered,
            Ok(other) => return Err(self.part.unexpected(PICTURE, &other, "Rendered")),
            // Sizes are checked before they are sent: a server that calls the request wrong does not know it.
            Err(ClientError::Refused { address, request, code, message }) if code == Code::InvalidArgument as i32 => {
                let message = format!("{message}; is the server older than this program?");
                return Err(ClientError::Refused { address, request, code, message });
            }
            Err(error) => return Err(error),
        };
        let proto::Rendered { pixels, width: got_width, height: got_height } = rendered;
        if (got_width, got_height) != (width, height) || pixels.len() as u64 != u64::from(width) * u64::from(height) * 3
        {
            let got = format!("{got_width} × {got_height} pixels in {} bytes", pixels.len());
            return Err(self.part.mismatch(PICTURE, got, format!("{width} × {height}, three bytes each")));
        }
        Ok(Picture { width, height, pixels })
    }

    fn request(&mut self, what: &'static str, request: Request) -> Result<(), ClientError> {
        let Self { servers, part, .. } = self;
        servers.runtime().block_on(part.send(what, request, servers))
    }

    fn response(&mut self, what: &'static str) -> Result<Response, ClientError> {
        let Self { servers, part, .. } = self;
        servers.runtime().block_on(part.receive(what, servers))
    }

    fn begun_of(&self, what: &'static str, started: Vec<proto::EpisodeStart>) -> Result<BegunEpisode, ClientError> {
        let count = started.len();
        let start = started.into_iter().next().and_then(|start| Some((start.episode?, start.receipt?)));
        let Some((episode, receipt)) = start.filter(|_| count == 1) else {
            return Err(self.part.mismatch(what, format!("{count} begun episodes"), "one with its receipt".into()));
        };
        Ok(BegunEpisode {
            episode_index: episode.episode_index,
            trial_index: episode.trial_index,
            episode_in_trial: episode.episode_in_trial,
            parameters: receipt.requested,
        })
    }
}
