//! A session without environments, which counts its steps. The client sends a number of its choice as the action of
//! each step.

use bytes::Bytes;
use perturb::proto::{self, session_request::Request, session_response::Response};
use perturb::server::api::perturb_v1::{Error, fields::SESSION_REQUEST};
use perturb::server::limits::RequestLimits;
use perturb::server::net::access_log::SessionStats;
use perturb::server::session::handler::{Reply, SessionHandler, StreamHandover};
use perturb::server::session::lease::Leases;
use perturb::server::transport::precheck::Field;

use super::{MAX_BYTES, StepLog};

/// A session that counts its steps.
pub(super) struct CountingSession {
    leases: Leases<proto::SessionResponse>,
    ledger: StepLog,
    is_open: bool,
    steps: u64,
}

impl CountingSession {
    /// Creates a session that is not open yet. Steps are recorded in `ledger`.
    pub(super) fn new(leases: Leases<proto::SessionResponse>, ledger: StepLog) -> Self {
        Self { leases, ledger, is_open: false, steps: 0 }
    }

    fn open(&mut self, open: &proto::Open) -> Result<CountingReply, Error> {
        self.is_open = true;
        let grant = self.leases.grant(None, open.lease as usize)?;
        let (lease, time) = grant.as_ref().map(|grant| (grant.name.to_vec(), grant.time())).unwrap_or_default();
        let lease_seconds = time.as_secs() as u32;
        let opened = proto::Opened { lease: lease.into(), lease_seconds, ..Default::default() };
        Ok(Reply { handover: grant.map(StreamHandover::Lease), ..reply(Response::Opened(opened)) })
    }

    /// Records a step. The reply contains the number from the request, and the number of steps so far.
    fn step(&mut self, step: &proto::Step) -> Result<CountingReply, Error> {
        let number = step.actions[..].try_into().map(u64::from_le_bytes);
        let number = number.map_err(|_| Error::value("step.actions", step.actions.len(), "8 bytes"))?;
        self.ledger.add(number);
        self.steps += 1;
        let numbers = [number, self.steps].map(u64::to_le_bytes).concat();
        Ok(reply(Response::Stepped(proto::Stepped { observations: Bytes::from(numbers), ..Default::default() })))
    }

    async fn resume(&mut self, resume: &proto::Resume) -> Result<CountingReply, Error> {
        let ticket = self.leases.resume(&resume.lease, None, resume.last_reply).await?;
        let resumed = proto::Resumed { last_reply: ticket.last_reply };
        Ok(Reply { handover: Some(StreamHandover::Resume(ticket)), ..reply(Response::Resumed(resumed)) })
    }
}

/// A reply of the protocol `perturb.v1`.
type CountingReply = Reply<proto::SessionResponse>;

fn reply(response: Response) -> CountingReply {
    Reply::new(proto::SessionResponse { response: Some(response) })
}

impl SessionHandler for CountingSession {
    type Request = proto::SessionRequest;
    type Response = proto::SessionResponse;
    type Error = Error;
    const FIELDS: &'static [Field] = SESSION_REQUEST;
    const PROTOCOL: &'static str = "perturb.v1";
    const KINDS: &'static [&'static str] = &["open", "step", "resume", "unknown"];
    const RESUMES: Option<fn(&Self::Request) -> bool> =
        Some(|request| matches!(request.request, Some(Request::Resume(_))));

    fn kind(request: &Self::Request) -> &'static str {
        match request.request {
            Some(Request::Open(_)) => "open",
            Some(Request::Step(_)) => "step",
            Some(Request::Resume(_)) => "resume",
            _ => "unknown",
        }
    }

    fn request_limits(&self) -> RequestLimits {
        RequestLimits { bytes: MAX_BYTES, entries: 1, covered: 0 }
    }

    fn is_open(&self) -> bool {
        self.is_open
    }

    fn stats(&self) -> SessionStats {
        SessionStats { steps: self.steps, ..SessionStats::default() }
    }

    /// Returns 0: a step costs nothing, since the server has no rate limits.
    fn price(&self, _request: &Self::Request) -> u64 {
        0
    }

    /// Does nothing, since there are no environments to free.
    async fn close(&mut self) {}

    async fn answer(&mut self, request: Self::Request) -> Result<CountingReply, Error> {
        match request.request {
            Some(Request::Open(open)) => self.open(&open),
            Some(Request::Step(step)) => self.step(&step),
            Some(Request::Resume(resume)) => self.resume(&resume).await,
            _ => Err(Error::value("request", "another", "open, step or resume")),
        }
    }

    /// Returns `None`, since steps run without a worker pool and cannot be pipelined.
    fn pipeline(&self, _request: &Self::Request) -> Option<impl FnOnce(Self::Request) + Send + use<>> {
        None::<fn(Self::Request)>
    }

    fn error_response(error: Error) -> Self::Response {
        proto::SessionResponse { response: Some(Response::Error(error.into())) }
    }
}
