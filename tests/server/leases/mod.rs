//! Leases, with which sessions outlive their connections.

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

/// Returns an `open` that requests a lease with `lease` unanswered requests.
fn leased(lease: u32) -> Open {
    Open { lease, ..open("CartPole", ENVS, 7) }
}

/// Opens a session with a lease on a new connection. Returns it with the name of the lease.
async fn begin(address: &str, lease: u32) -> (Session, Opened, Environment) {
    let environment = environment(address, "CartPole").await;
    let (session, opened) = Session::open(address, leased(lease)).await;
    assert_eq!(opened.lease.len(), 16);
    (session, opened, environment)
}

/// Resumes a session on a new connection.
async fn resume(address: &str, lease: &Bytes, last_reply: u64) -> (Session, Resumed) {
    let mut session = Session::connect(address).await;
    let resumed = session.ask(Resume { lease: lease.clone(), last_reply }).await;
    (session, resumed)
}

/// Tries to resume a session, which must fail. Returns the code and the message.
async fn not_resumed(address: &str, lease: &Bytes, last_reply: u64) -> (Code, String) {
    Session::connect(address).await.refused(Resume { lease: lease.clone(), last_reply }).await
}

/// Returns the replies of an undisturbed session to the first steps.
async fn undisturbed(address: &str, steps: u64) -> Vec<SessionResponse> {
    let environment = environment(address, "CartPole").await;
    let (mut session, _) = Session::open(address, open("CartPole", ENVS, 7)).await;
    let actor = crate::common::server::Actor::new(&environment, ENVS as usize);
    session.play(actor, 0, steps).await
}

/// Receives the next `count` replies.
async fn replies(session: &mut Session, count: u64) -> Vec<SessionResponse> {
    let mut replies = Vec::new();
    for _ in 0..count {
        replies.push(within(session.receive()).await.unwrap().expect("the stream ended"));
    }
    replies
}

/// Returns the reply in a response.
#[track_caller]
fn reply<A: TypedRequest>(response: Response) -> A::Reply {
    A::reply(response).unwrap_or_else(|other| panic!("answered by {other:?}"))
}
