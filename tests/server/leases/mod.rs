//! Leases: sessions that outlive their connections.

mod bounds;
mod ends;
mod streams;
mod taking_up;

use crate::common::server::{Session, environment, open, within};
use bytes::Bytes;
use perturb::proto::{Environment, Open, Opened, Resume, Resumed, SessionResponse, session_response::Response};
use perturb_protocol::TypedRequest;
use tonic::Code;

const ENVS: u32 = 4;

/// An `open` that asks for a lease, with so many requests that wait.
fn leased(lease: u32) -> Open {
    Open { lease, ..open("CartPole", ENVS, 7) }
}

/// An open session with a lease on a connection of its own, and what it is named by.
async fn begin(address: &str, lease: u32) -> (Session, Opened, Environment) {
    let environment = environment(address, "CartPole").await;
    let (session, opened) = Session::open(address, leased(lease)).await;
    assert_eq!(opened.lease.len(), 16);
    (session, opened, environment)
}

/// Takes a session up on a connection of its own.
async fn resume(address: &str, lease: &Bytes, last_reply: u64) -> (Session, Resumed) {
    let mut session = Session::connect(address).await;
    let resumed = session.ask(Resume { lease: lease.clone(), last_reply }).await;
    (session, resumed)
}

/// Why it is not taken up.
async fn not_resumed(address: &str, lease: &Bytes, last_reply: u64) -> (Code, String) {
    Session::connect(address).await.refused(Resume { lease: lease.clone(), last_reply }).await
}

/// What an undisturbed session replies to the first steps.
async fn undisturbed(address: &str, steps: u64) -> Vec<SessionResponse> {
    let environment = environment(address, "CartPole").await;
    let (mut session, _) = Session::open(address, open("CartPole", ENVS, 7)).await;
    let actor = crate::common::server::Actor::new(&environment, ENVS as usize);
    session.play(actor, 0, steps).await
}

/// The next replies.
async fn replies(session: &mut Session, count: u64) -> Vec<SessionResponse> {
    let mut replies = Vec::new();
    for _ in 0..count {
        replies.push(within(session.receive()).await.unwrap().expect("the stream ended"));
    }
    replies
}

/// The reply in a response.
#[track_caller]
fn reply<A: TypedRequest>(response: Response) -> A::Reply {
    A::reply(response).unwrap_or_else(|other| panic!("answered by {other:?}"))
}
