//! Snapshots of earlier servers can be restored, unless their environment has a new revision. Each snapshot was saved
//! by the server of commit 886bf00, with seed 77 and index 0 in version R, after 20 steps.

#[cfg(feature = "mujoco")]
use crate::common::server::{Actor, environment};
use crate::common::server::{Server, Session, open, refusal};
use bytes::Bytes;
use perturb::proto::Restore;
#[cfg(feature = "mujoco")]
use perturb::proto::{SessionResponse, session_response::Response};

const SEED: u64 = 77;

/// Removes the achieved value from the end of the first episode, because an old snapshot of a robot does not contain
/// the distance so far.
#[cfg(feature = "mujoco")]
fn forget(mut responses: Vec<SessionResponse>) -> Vec<SessionResponse> {
    let steps = responses.iter_mut().filter_map(|response| match &mut response.response {
        Some(Response::Stepped(stepped)) => Some(stepped),
        _ => None,
    });
    steps
        .flat_map(|stepped| &mut stepped.ended)
        .take(1)
        .for_each(|end| (end.achieved, end.code_achieved) = (None, None));
    responses
}

#[cfg(feature = "mujoco")]
#[tokio::test]
async fn what_follows_an_old_snapshot_is_what_follows_without_one() {
    const STEPS: u64 = 20;
    let server = Server::start(&[]);
    let hopper = environment(server.unix(), "Hopper").await;
    let actor = Actor::new(&hopper, 1);
    let (mut played, _) = Session::open(server.unix(), open("Hopper", 1, SEED)).await;
    played.play(actor, 0, STEPS).await;

    let (mut restored, _) = Session::open(server.unix(), open("Hopper", 1, 1)).await;
    restored.restore(&[], vec![Bytes::from_static(include_bytes!("data/snapshots/Hopper"))]).await;
    assert_eq!(forget(restored.play(actor, STEPS, 400).await), forget(played.play(actor, STEPS, 400).await));
    assert_eq!(restored.snapshot(&[]).await, played.snapshot(&[]).await);
}

#[tokio::test]
async fn snapshot_of_another_revision_is_refused() {
    let server = Server::start(&[]);
    let (mut session, _) = Session::open(server.unix(), open("CartPole", 1, SEED)).await;
    let before = session.snapshot(&[]).await;
    let old = Bytes::from_static(include_bytes!("data/snapshots/CartPole"));
    let refused = session.refused(Restore { mask: Bytes::new(), snapshots: vec![old] }).await;
    let expected = "InvalidArgument: the snapshot cannot be restored: it is of CartPole-v0, but this session is of CartPole-v1; take a new \
                    one from a session of the same environment\n";
    assert_eq!(refusal(refused), expected);
    assert_eq!(session.snapshot(&[]).await, before);
}
