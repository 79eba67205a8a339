//! Snapshots that earlier servers took can be restored: what follows is what would have followed there.

use crate::common::server::{self, Actor, Server, Session, open};
use perturb::proto::{SessionResponse, session_response::Response};
use rstest::rstest;

/// The environment of seed 77 and index 0 in version R, after 20 steps, as the server of commit 886bf00 saved it.
const STEPS: u64 = 20;
const SEED: u64 = 77;

/// The first episode's end without what it achieved: an old snapshot of a robot does not say how far it had come.
fn forget(mut responses: Vec<SessionResponse>) -> Vec<SessionResponse> {
    let steps = responses.iter_mut().filter_map(|response| match &mut response.response {
        Some(Response::Stepped(stepped)) => Some(stepped),
        _ => None,
    });
    steps.flat_map(|stepped| &mut stepped.ended).take(1).for_each(|end| end.achieved = None);
    responses
}

#[rstest]
#[case("CartPole", include_bytes!("data/snapshots/CartPole"))]
#[cfg_attr(feature = "mujoco", case("Hopper", include_bytes!("data/snapshots/Hopper")))]
#[tokio::test]
async fn what_follows_an_old_snapshot_is_what_follows_without_one(#[case] name: &str, #[case] snapshot: &'static [u8]) {
    let server = Server::start(&[]);
    let environment = server::environment(server.unix(), name).await;
    let actor = Actor::new(&environment, 1);
    let (mut played, _) = Session::open(server.unix(), open(name, 1, SEED)).await;
    played.play(actor, 0, STEPS).await;

    let (mut restored, _) = Session::open(server.unix(), open(name, 1, 1)).await;
    restored.restore(&[], vec![snapshot.into()]).await;
    assert_eq!(forget(restored.play(actor, STEPS, 400).await), forget(played.play(actor, STEPS, 400).await));
    assert_eq!(restored.snapshot(&[]).await, played.snapshot(&[]).await);
}
