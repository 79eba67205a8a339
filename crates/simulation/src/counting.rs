//! A session without environments: it counts its steps, whose actions say which number each is.

use bytes::Bytes;
use perturb::proto::{self, session_request::Request, session_response::Response};
use perturb::server::api::perturb_v1::{Error, fields::SESSION_REQUEST};
use perturb::server::limits::Allowance;
use perturb::server::net::access_log::About;
use perturb::server::session::handler::{Dialogue, Turn};
use perturb::server::session::lease::Leases;
use perturb::server::transport::precheck::Field;

use super::{Ledger, MOST_BYTES};

/// A session that counts.
pub(super) struct Counting {
    leases: Leases<proto::SessionResponse>,
    ledger: Ledger,
    is_open: bool,
    steps: u64,
    turn: Option<Turn<proto::SessionResponse>>,
}

impl Counting {
    /// One that is not open.
    pub(super) fn new(leases: Leases<proto::SessionResponse>, ledger: Ledger) -> Self {
        Self { leases, ledger, is_open: false, steps: 0, turn: None }
    }

    fn open(&mut self, open: &proto::Open) -> Result<Response, Error> {
        self.is_open = true;
        let grant = self.leases.give(None, open.lease as usize)?;
        let (lease, time) = grant.as_ref().map(|grant| (grant.name.to_vec(), grant.time())).unwrap_or_default();
        self.turn = grant.map(Turn::Leased);
        let lease_seconds = time.as_secs() as u32;
        Ok(Response::Opened(proto::Opened { lease: lease.into(), lease_seconds, ..Default::default() }))
    }

    /// The number that came, and how many steps there are now.
    fn step(&mut self, step: &proto::Step) -> Result<Response, Error> {
        let number = step.actions[..].try_into().map(u64::from_le_bytes);
        let number = number.map_err(|_| Error::value("step.actions", step.actions.len(), "8 bytes"))?;
        self.ledger.add(number);
        self.steps += 1;
        let numbers = [number, self.steps].map(u64::to_le_bytes).concat();
        Ok(Response::Stepped(proto::Stepped { observations: Bytes::from(numbers), ..Default::default() }))
    }

    async fn resume(&mut self, resume: &proto::Resume) -> Result<Response, Error> {
        let ticket = self.leases.ask(&resume.lease, None, resume.last_reply).await?;
        let last_reply = ticket.last_reply;
        self.turn = Some(Turn::TakesUp(ticket));
        Ok(Response::Resumed(proto::Resumed { last_reply }))
    }
}

impl Dialogue for Counting {
    type Request = proto::SessionRequest;
    type Response = proto::SessionResponse;
    type Error = Error;
    const FIELDS: &'static [Field] = SESSION_REQUEST;
    const TAKES_UP: bool = true;
    const PROTOCOL: &'static str = "perturb.v1";

    fn allowance(&self) -> Allowance {
        Allowance { bytes: MOST_BYTES, entries: 1, covered: 0 }
    }

    fn is_open(&self) -> bool {
        self.is_open
    }

    fn about(&self) -> About {
        About { steps: self.steps, ..About::default() }
    }

    async fn answer(&mut self, request: Self::Request) -> Result<Self::Response, Error> {
        let response = match request.request {
            Some(Request::Open(open)) => self.open(&open),
            Some(Request::Step(step)) => self.step(&step),
            Some(Request::Resume(resume)) => self.resume(&resume).await,
            _ => Err(Error::value("request", "another", "open, step or resume")),
        };
        response.map(|response| proto::SessionResponse { response: Some(response) })
    }

    fn takes_up(request: &Self::Request) -> bool {
        matches!(request.request, Some(Request::Resume(_)))
    }

    fn turn(&mut self) -> Option<Turn<Self::Response>> {
        self.turn.take()
    }

    fn refusal(error: Error) -> Self::Response {
        proto::SessionResponse { response: Some(Response::Error(error.into())) }
    }
}
