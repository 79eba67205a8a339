//! What answers the requests of a session, whatever its protocol.

use super::{
    Error,
    lease::{Grant, Ticket},
};
use crate::{
    pool::Follower,
    server::{
        error::RequestError,
        limits::Allowance,
        net::access_log::About,
        transport::{budget::Outbox, precheck::Field},
    },
};
use std::future::Future;

/// What becomes of a stream after a response.
pub enum Turn<R> {
    /// Its session has a lease, and outlives it.
    Leased(Grant<R>),
    /// It goes on with the session that it has taken up.
    TakesUp(Ticket<R>),
}

/// The server's part of a conversation. Dropping it frees what it holds.
pub trait Dialogue: Send + 'static {
    /// What the client sends.
    type Request: prost::Message + Default + 'static;
    /// What it gets.
    type Response: prost::Message + Clone + 'static;
    /// Why a request is refused: by the dialogue, or by its transport.
    type Error: RequestError + From<Error> + Send;
    /// The parts of a request that are counted before it is decoded.
    const FIELDS: &'static [Field];
    /// What the protocol is called.
    const PROTOCOL: &'static str;

    /// What the client may send now.
    fn allowance(&self) -> Allowance;

    /// Whether it holds something that a shutdown should wait for.
    fn is_open(&self) -> bool;

    /// What has come of it so far.
    fn about(&self) -> About;

    /// Answers a request.
    fn answer(&mut self, request: Self::Request) -> impl Future<Output = Result<Self::Response, Self::Error>> + Send;

    /// Where the request after this one is told of that comes before it is answered; none if it must wait for its turn.
    fn follower(&self, _request: &Self::Request) -> Option<Follower> {
        None
    }

    /// Tells of it. It will be the next that is answered.
    fn follow(_follower: &Follower, _request: Self::Request) {}

    /// Takes note of a request that was refused before it was decoded.
    fn undecoded(&self, _error: &Self::Error) {}

    /// Whether there are requests that take up another session.
    const TAKES_UP: bool = false;

    /// Whether a request does.
    fn takes_up(_request: &Self::Request) -> bool {
        false
    }

    /// What becomes of the stream after the response that was just given, if not what was before; told once.
    fn turn(&mut self) -> Option<Turn<Self::Response>> {
        None
    }

    /// Its responses go by another stream now, or by none: this is where their shares go.
    fn attach(&mut self, _outbox: Outbox) {}

    /// The answer to a request that is refused.
    fn refusal(error: Self::Error) -> Self::Response;
}
