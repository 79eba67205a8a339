//! A pipelined step starts as soon as the running step ends, and changes no byte.

use crate::{
    common::{
        self, action_bytes,
        server::{Actor, Server, Session, open, step, stepped},
    },
    toy::ball,
};
use bytes::Bytes;
use perturb::{
    env::{EnvironmentSpec, Version},
    pool::{Autoreset, Batch, BatchSettings, Error, Pool, SlotGroupSettings, StepResult},
    proto::{AutoresetMode, Open, SessionResponse, Snapshot, session_request::Request},
    tasks,
};
use std::{
    future::{Future, poll_fn},
    pin::{Pin, pin},
    task::Poll,
    time::{Duration, Instant},
};

/// A batch size for which steps do not run on the session's own thread.
const N: usize = 2000;

fn acrobots(autoreset: Autoreset) -> BatchSettings {
    settings(tasks::catalogue().find("Acrobot").unwrap(), autoreset)
}

fn settings(spec: &'static EnvironmentSpec, autoreset: Autoreset) -> BatchSettings {
    let groups = vec![SlotGroupSettings { size: N, episodes: common::settings(spec, Version::R, 17, 100, 2) }];
    let (receipts, reward_terms) = (true, true);
    BatchSettings { spec, groups, autoreset, receipts, receipt_arrays: false, reward_terms, observe_parameters: false }
}

fn actions(spec: &EnvironmentSpec, t: u64) -> Bytes {
    (0..N as u64).flat_map(|slot| action_bytes(spec, slot, t)).collect()
}

async fn poll_once<F: Future>(mut future: Pin<&mut F>) -> Poll<F::Output> {
    poll_fn(|context| Poll::Ready(future.as_mut().poll(context))).await
}

/// Starts a step and queues a second step behind it. Returns the result of the first step, and whether the first step
/// was still running when the second step was queued.
async fn followed(batch: &mut Batch, first: &[u8], second: Bytes) -> (Result<StepResult, Error>, bool) {
    let queue = batch.step_queue().unwrap();
    let mut stepping = pin!(batch.step(first));
    match poll_once(stepping.as_mut()).await {
        Poll::Ready(stepped) => (stepped, false),
        Poll::Pending => {
            queue.enqueue(second);
            (stepping.await, true)
        }
    }
}

/// Waits until the workers have made a condition true.
async fn wait_until(condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(30);
    while !condition() {
        assert!(Instant::now() < deadline, "not within 30 s");
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

#[tokio::test]
async fn pipelined_step_runs_early_and_gives_the_same_bytes() {
    let pool = Pool::new(2, 2 * N).unwrap();
    let settings = acrobots(Autoreset::SameStep);
    let spec = settings.spec;
    let (mut batch, ..) = Batch::open(&pool, settings.clone()).await.unwrap();
    let (mut twin, ..) = Batch::open(&pool, settings).await.unwrap();
    let mut followed = 0;
    for t in (0..40).step_by(2) {
        let (first, second) = (actions(spec, t), actions(spec, t + 1));
        let before = batch.steps();
        let (stepped, was_under_way) = self::followed(&mut batch, &first, second.clone()).await;
        let stepped = stepped.unwrap();
        if was_under_way {
            // The second step does not run if the first step had ended before the second step was queued.
            let start = Instant::now();
            while batch.steps() < before + 2 * N as u64 && start.elapsed() < Duration::from_millis(200) {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            followed += u64::from(batch.steps() == before + 2 * N as u64);
        }
        assert!(stepped == twin.step(&first).await.unwrap(), "step {t}");
        assert!(batch.step(&second).await.unwrap() == twin.step(&second).await.unwrap(), "step {}", t + 1);
        assert_eq!(batch.steps(), twin.steps());
    }
    assert!(followed > 0, "none followed");
}

#[tokio::test]
async fn a_batch_with_a_step_that_follows_settles_and_can_be_dropped() {
    let pool = Pool::new(2, 2 * N).unwrap();
    let settings = acrobots(Autoreset::SameStep);
    let spec = settings.spec;
    let (mut batch, ..) = Batch::open(&pool, settings.clone()).await.unwrap();
    let (mut twin, ..) = Batch::open(&pool, settings).await.unwrap();
    let first = actions(spec, 50);
    for t in 0..10 {
        let before = batch.steps();
        let queue = batch.step_queue().unwrap();
        let _ = poll_once(pin!(batch.step(&actions(spec, t)))).await;
        queue.enqueue(actions(spec, t));
        batch.finish_abandoned().await;
        for _ in 0..(batch.steps() - before) / N as u64 {
            twin.step(&actions(spec, t)).await.unwrap();
        }
        let next = actions(spec, 100 + t);
        assert!(batch.step(&next).await.unwrap() == twin.step(&next).await.unwrap(), "step {t}");
    }
    // If the session does not request the queued step, it is finished before the next request.
    let before = batch.steps();
    followed(&mut batch, &first, first.clone()).await.0.unwrap();
    let saved = batch.snapshot((0..N).collect()).await.unwrap();
    for _ in 0..(batch.steps() - before) / N as u64 {
        twin.step(&first).await.unwrap();
    }
    assert!(saved == twin.snapshot((0..N).collect()).await.unwrap());

    let queue = batch.step_queue().unwrap();
    let _ = poll_once(pin!(batch.step(&first))).await;
    queue.enqueue(first);
    drop((batch, queue));
    wait_until(|| pool.environments() == N).await;
}

#[tokio::test]
async fn failing_pipelined_step_loses_its_batch_and_no_worker() {
    let pool = Pool::new(2, 2 * N).unwrap();
    let (mut other, ..) = Batch::open(&pool, acrobots(Autoreset::SameStep)).await.unwrap();
    let spec = other.settings().spec;
    let forces = |force: f32| Bytes::from(force.to_le_bytes().repeat(N));
    for t in 0..10 {
        let (mut balls, ..) = Batch::open(&pool, settings(&ball::SPEC, Autoreset::SameStep)).await.unwrap();
        let (good, fatal) = (forces(0.5), forces(ball::FATAL));
        let _ = followed(&mut balls, &good, fatal.clone()).await; // the first step may already fail
        assert_eq!(balls.step(&fatal).await, Err(Error::Defect));
        assert_eq!(balls.step(&good).await, Err(Error::Defect));
        assert_eq!(balls.snapshot(vec![0]).await, Err(Error::Defect));
        assert_eq!(balls.release(&[0]).await, Err(Error::Defect));
        drop(balls);
        let next = actions(spec, t);
        let stepping = other.step(&next);
        tokio::time::timeout(Duration::from_secs(30), stepping).await.expect("its workers are there").unwrap();
        wait_until(|| pool.environments() == N).await;
    }
}

#[tokio::test]
async fn no_step_is_pipelined_that_needs_the_last_result() {
    let pool = Pool::new(1, N).unwrap();
    let (batch, ..) = Batch::open(&pool, acrobots(Autoreset::Disabled)).await.unwrap();
    assert!(batch.step_queue().is_none());
}

/// Returns the responses to these requests. The requests are sent all at once if `at_once`, otherwise each after the
/// response to the previous request.
async fn responses(server: &Server, open: Open, requests: &[Request], at_once: bool) -> Vec<SessionResponse> {
    let (mut session, _) = Session::open(server.unix(), open).await;
    let mut responses = Vec::new();
    if at_once {
        for request in requests {
            session.send(request.clone()).await;
        }
    }
    for request in requests {
        if !at_once {
            session.send(request.clone()).await;
        }
        responses.push(session.receive().await.unwrap().expect("the stream ended"));
    }
    responses
}

#[tokio::test]
async fn whatever_follows_a_step_gets_the_response_that_it_gets_alone() {
    let server = Server::start(&["--workers", "2"]);
    let environment = common::server::environment(server.unix(), "Acrobot").await;
    let actor = Actor::new(&environment, N);
    let short = step(vec![0; 4 * N - 4]);
    let outside = step(7_i32.to_le_bytes().repeat(N));
    let snapshot = Request::Snapshot(Snapshot { mask: Bytes::new() });
    let mut requests: Vec<Request> = (0..30).map(|t| step(actor.actions(t))).collect();
    for (place, request) in [(5, short.clone()), (9, outside.clone()), (10, outside), (14, snapshot), (20, short)] {
        requests.insert(place, request);
    }
    for mode in [AutoresetMode::SameStep, AutoresetMode::NextStep, AutoresetMode::Disabled] {
        let open = || Open { autoreset_mode: mode.into(), ..open("Acrobot", N as u32, 3) };
        let alone = responses(&server, open(), &requests, false).await;
        assert!(responses(&server, open(), &requests, true).await == alone, "{mode:?}");
        assert!(!stepped(&alone[0]).observations.is_empty());
    }
}
