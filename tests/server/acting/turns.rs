//! A long rollout does not delay other sessions, and it ends when its session ends.

use super::game::{PLAIN, SEED};
use crate::common::{
    self,
    server::{Server, Session, until},
};
use perturb::{
    env::Version,
    pool::{Autoreset, Batch, BatchSettings, PolicyRole, Pool, ReceivedPolicy, RolloutRequest, SlotGroupSettings},
    proto::{act::Task as Asked, session_response::Response},
    tasks,
};
use perturb_policy::{
    ActionKind, CollectUntil, Inputs, Normalisers, PolicySpec,
    random::{Purpose, stream},
};
use rstest::rstest;
use std::{
    future::Future,
    pin::Pin,
    task::{Context, Poll, Waker},
};

async fn mountain_cars(pool: &Pool, size: usize) -> Batch {
    let spec = tasks::catalogue().find("MountainCar").unwrap();
    let groups = vec![SlotGroupSettings { size, episodes: common::settings(spec, Version::R, 1, 0, 1) }];
    let autoreset = Autoreset::SameStep;
    let settings = BatchSettings {
        spec,
        groups,
        autoreset,
        receipts: false,
        receipt_arrays: false,
        reward_terms: false,
        observe_parameters: false,
    };
    Batch::open(pool, settings).await.unwrap().0
}

/// Returns a request for a rollout that takes seconds: it records only the ends of episodes, so its reply stays small.
fn endless(size: usize) -> RolloutRequest {
    let spec = PolicySpec::feed_forward(2, ActionKind::Discrete { n: 3 });
    let policy = ReceivedPolicy {
        inputs: Inputs::new(2, spec.action, size, false),
        weights: vec![0.1; spec.n_weights()],
        spec,
        normalisers: Normalisers::default(),
        role: PolicyRole::Training(stream(SEED, Purpose::Actions)),
        state: None,
        episodes_per_trial: 1,
    };
    let task = Some(CollectUntil::Steps(usize::MAX));
    RolloutRequest { policy: Some(policy), weights: None, task, max_steps: usize::MAX, only_ended: true }
}

fn poll<F: Future>(future: &mut Pin<Box<F>>) -> Poll<F::Output> {
    future.as_mut().poll(&mut Context::from_waker(Waker::noop()))
}

#[rstest]
#[tokio::test]
async fn others_step_while_a_policy_plays(#[values(4, 2000)] size: usize) {
    let pool = Pool::new(1, 3000).unwrap();
    let (mut played, mut stepped) = (mountain_cars(&pool, size).await, mountain_cars(&pool, 8).await);
    let mut playing = Box::pin(played.act(endless(size)));
    for _ in 0..20 {
        assert!(poll(&mut playing).is_pending(), "it was played to its end before others had their turns");
        stepped.step(&[0; 32]).await.unwrap();
    }
    drop(playing);
    drop(played);
    until("the played environments are free", async || pool.environments() == 8).await;
}

#[rstest]
#[tokio::test]
async fn a_play_that_nobody_waits_for_ends_and_the_batch_goes_on(#[values(4, 2000)] size: usize) {
    let pool = Pool::new(2, size).unwrap();
    let mut batch = mountain_cars(&pool, size).await;
    let mut playing = Box::pin(batch.act(endless(size)));
    assert!(poll(&mut playing).is_pending());
    drop(playing);
    batch.finish_abandoned().await;
    assert!(batch.policy_runner().is_none());
    batch.step(&vec![0; 4 * size]).await.unwrap();
    let short = RolloutRequest { task: Some(CollectUntil::Steps(3)), ..endless(size) };
    assert_eq!(batch.act(short).await.unwrap().steps, 3);
}

#[tokio::test]
async fn a_pool_ends_while_a_policy_plays() {
    let pool = Pool::new(2, 4).unwrap();
    let mut batch = mountain_cars(&pool, 4).await;
    let mut playing = Box::pin(batch.act(endless(4)));
    assert!(poll(&mut playing).is_pending());
    drop(pool);
    let steps = playing.await.unwrap().steps;
    assert!(steps < 1_000_000, "{steps}: a reply has room for the ends of two million");
}

#[tokio::test]
async fn environments_are_freed_when_a_client_leaves_mid_rollout() {
    let server = Server::start(&["--max-envs", "5"]);
    let (session, environment) = PLAIN.session(&server).await;
    session.send(PLAIN.act(&environment, Asked::Steps(u32::MAX))).await;
    drop(session);
    until("the environments are free", async || {
        let mut other = Session::connect(server.unix()).await;
        matches!(other.answer(PLAIN.open()).await, Response::Opened(_))
    })
    .await;
}
