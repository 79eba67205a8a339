//! A server with an additional environment, which is completely defined in this folder.

pub mod ball;

use crate::{
    common::server::{self, Actor, Session, doubles, floats, open, parameters},
    dm_env_rpc::client::{Agent, double, settings, text, vector},
};
use perturb::{
    config::{Arguments, Config},
    proto::{Comparison, Open, Release, Reset, Version},
    server::{net::listener::Listener, run, security::Security},
    tasks,
};
use std::{
    sync::atomic::Ordering,
    thread::{self, JoinHandle},
};
use tokio::sync::oneshot;

/// A server in a thread of this process, with a catalogue of its own.
struct InThread {
    address: String,
    shutdown: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl InThread {
    async fn start() -> Self {
        let (tell, address) = oneshot::channel();
        let (shutdown, end) = oneshot::channel();
        let thread = thread::spawn(move || {
            let config = Config { workers: 2, ..Config::load(&Arguments::default()).unwrap() };
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async {
                let any = "tcp://127.0.0.1:0".to_owned().try_into().unwrap();
                let listener = Listener::bind(&any, config.socket_mode).await.unwrap();
                tell.send(listener.address().unwrap().to_string()).unwrap();
                let catalogue = tasks::catalogue().with(&ball::SPEC).unwrap();
                let end = async { drop(end.await) };
                run(vec![listener], None, &config, &Security::default(), catalogue, end).await.unwrap();
            });
        });
        Self { address: address.await.unwrap(), shutdown: Some(shutdown), thread: Some(thread) }
    }
}

impl Drop for InThread {
    fn drop(&mut self) {
        drop(self.shutdown.take());
        self.thread.take().unwrap().join().unwrap();
    }
}

#[tokio::test]
async fn another_environment_is_listed_with_all_that_clients_ask_for() {
    let server = InThread::start().await;
    let names: Vec<_> = server::catalogue(&server.address).await.into_iter().map(|e| e.name).collect();
    assert_eq!(names, tasks::catalogue().names().chain(["Ball"]).collect::<Vec<_>>());
    let ball = server::environment(&server.address, "Ball").await;
    assert_eq!((ball.observation.len(), ball.state.len(), ball.parameters.len()), (2, 2, 2));
    assert_eq!(ball.heatmap_axes, ["mass", "drag"]);
    let success = ball.success.unwrap();
    assert_eq!((success.quantity.as_str(), success.unit.as_str(), success.threshold), ("distance", "m", 0.3));
    assert_eq!((success.comparison(), success.steps), (Comparison::AtLeast, 20));
}

#[tokio::test]
async fn toy_environment_is_opened_stepped_drawn_and_saved() {
    let server = InThread::start().await;
    let ball = server::environment(&server.address, "Ball").await;
    let actor = Actor::new(&ball, 3);
    let (mut session, opened) = Session::open(&server.address, open("Ball", 3, 5)).await;
    assert_eq!(opened.environment.as_ref(), Some(&ball));
    session.play(actor, 0, 7).await;

    let edit = Reset { parameters: parameters(&[("mass", &[(2.5, 2.5)])]), ..Reset::default() };
    let started = session.ask(edit).await.started;
    for receipt in started.iter().filter_map(|start| start.receipt.as_ref()) {
        assert_eq!((receipt.requested[0], receipt.applied[0]), (2.5, 2.5), "the edit took effect");
    }
    let snapshots = session.snapshot(&[]).await;
    let picture = session.render(0, (64, 64)).await;
    let after = session.play(actor, 7, 60).await;
    assert_ne!(session.render(0, (64, 64)).await, picture, "the ball moved");
    session.restore(&[], snapshots).await;
    assert_eq!(session.render(0, (64, 64)).await, picture);
    assert_eq!(session.play(actor, 7, 60).await, after, "the same bytes");
    for end in after.iter().flat_map(|response| &server::stepped(response).ended) {
        assert_eq!(end.success, end.achieved.unwrap() >= 0.3, "{end:?}");
    }
}

#[tokio::test]
async fn another_environment_is_what_its_equations_say() {
    let server = InThread::start().await;
    let exact = Open { version: Version::Default.into(), ..open("Ball", 1, 1) };
    let (mut session, _) = Session::open(&server.address, exact).await;
    session.ask(Reset { states: doubles(&[0.0, 0.0]), ..Reset::default() }).await;
    let step = session.step(1.0f32.to_le_bytes().to_vec().into()).await;
    // The ball has a mass of 1 kg and a drag of 0.5. A force of 1 N acts for 0.1 s.
    assert_eq!(floats(&step.observations), [0.01, 0.1]);
    let refused = Open { parameters: parameters(&[("drag", &[(-1.0, -1.0)])]), ..open("Ball", 1, 1) };
    let mut session = Session::connect(&server.address).await;
    let (_, message) = session.refused(refused).await;
    assert!(message.contains("drag"), "{message}");
}

#[tokio::test]
async fn another_environment_is_a_world_of_dm_env_rpc() {
    let server = InThread::start().await;
    let settings = settings("Ball", [("version", text("R")), ("mass", double(2.0))]);
    let (mut agent, _) = Agent::in_world(&server.address, settings).await;
    let first = agent.step(vector(&[0.0])).await;
    assert_eq!(first.observation.len(), 2);
    assert_eq!(agent.read("parameters.mass").await, double(2.0));
    agent.write("parameters.mass", double(3.0)).await;
    agent.reset([].into()).await;
    agent.step(vector(&[0.0])).await;
    assert_eq!(agent.read("applied.mass").await, double(3.0));
}

#[tokio::test]
async fn environments_are_freed_by_a_thread_that_nobody_waits_for() {
    const N: u32 = 1000;
    let server = InThread::start().await;
    let freed = |before: usize| ball::FREED.load(Ordering::Relaxed) - before;
    let before = freed(0);
    let (mut session, _) = Session::open(&server.address, open("Ball", N, 1)).await;
    let mask = [vec![1; 400], vec![0; 600]].concat().into();
    session.ask(Release { mask }).await;
    server::until("those that were released are freed", async || freed(before) >= 400).await;
    drop(session);
    server::until("all are freed", async || freed(before) >= N as usize).await;
}
