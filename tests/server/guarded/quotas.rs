//! Quotas and rate limits of tokens.

use super::{
    logged,
    tokens::{ANN, BOB, Guarded, entry},
};
use crate::{
    acting::game::{Game, PLAIN, play},
    common::server::{Session, channel, client, open, parameters, until},
    dm_env_rpc::client::{self as worlds, Agent},
};
use bytes::Bytes;
use perturb::proto::{
    Act, AutoresetMode, ListEnvironmentsRequest, Open, Render, Reset, Restore, Resume, Snapshot, Step, act::Task,
    dm_env_rpc::v1::environment_client::EnvironmentClient, perturb_client::PerturbClient, session_request::Request,
    session_response::Response,
};
use rstest::rstest;
use std::time::{Duration, Instant};
use tonic::{Code, transport::Channel};

/// Opens a session with this token on a new connection.
async fn session(guarded: &Guarded, token: &str, open: Open) -> Session {
    let mut session = Session::show(&mut client(guarded.server.tcp()).await, Some(token)).await.unwrap();
    session.ask(open).await;
    session
}

/// Takes `count` steps with `envs` environments. Returns the observations and the time.
async fn timed(session: &mut Session, envs: usize, count: usize) -> (Vec<Bytes>, Duration) {
    let start = Instant::now();
    let mut seen = Vec::new();
    for _ in 0..count {
        seen.push(session.step(vec![0; 4 * envs].into()).await.observations);
    }
    (seen, start.elapsed())
}

#[tokio::test]
async fn sessions_of_a_token_share_its_rate() {
    const ENVS: usize = 20;
    let rate = "max_steps_per_second = 200";
    let guarded = Guarded::start(&(entry("ann", ANN, rate) + &entry("bob", BOB, "")));
    let open = |seed| open("CartPole", ENVS as u32, seed);
    let (mut one, mut other) = (session(&guarded, ANN, open(1)).await, session(&guarded, ANN, open(2)).await);
    let mut bob = session(&guarded, BOB, open(1)).await;
    let ((slow, took), (_, its)) = tokio::join!(timed(&mut one, ENVS, 10), timed(&mut other, ENVS, 10));
    // The sessions take 400 steps in total, at 200 steps a second. No request waits for the last step of a session, and
    // an idle token may run one second's steps at once.
    let least = Duration::from_secs_f64((400.0 - 2.0 * ENVS as f64) / 200.0 - 1.0);
    assert!(took.max(its) > least, "{took:?}, {its:?}");
    let (fast, took) = timed(&mut bob, ENVS, 10).await;
    println!("another's ten steps took {took:?}");
    assert!(fast == slow, "a rate changes no number");
    // The following steps exceed the rate by some seconds, so the session waits, however long each request takes.
    let (_, took) = timed(&mut one, ENVS, 20).await;
    assert!(took > Duration::from_secs_f64(0.8), "{took:?}");
    // Over the Unix socket no token is required, and no rate applies.
    let (mut neighbour, _) = Session::open(guarded.server.unix(), open(1)).await;
    assert!(timed(&mut neighbour, ENVS, 10).await.0 == slow);
}

#[tokio::test]
async fn what_the_server_plays_is_cut_by_the_rate_and_the_same_bytes() {
    let game = Game { n: 5, ..PLAIN };
    let guarded = Guarded::start(&entry("ann", ANN, "max_steps_per_second = 50"));
    let (mut neighbour, environment) = game.session(&guarded.server).await;
    let mut ann = session(&guarded, ANN, game.open()).await;
    let act = || Act { most_steps: 0, ..game.act(&environment, Task::Steps(30)) };
    let (whole, replies) = play(&mut neighbour, act()).await;
    assert_eq!(replies, 1);
    let start = Instant::now();
    let (slow, replies) = play(&mut ann, act()).await;
    assert_eq!(replies, 3, "a second's worth in each");
    assert!(slow == whole);
    assert!(start.elapsed() > Duration::from_millis(900), "{:?}", start.elapsed());
}

#[tokio::test]
async fn an_agent_of_the_other_protocol_steps_at_the_rate_too() {
    let guarded = Guarded::start(&entry("ann", ANN, "max_steps_per_second = 10"));
    let mut client = EnvironmentClient::new(channel(guarded.server.tcp()).await);
    let mut agent = Agent::show(&mut client, Some(ANN)).await.unwrap();
    let world = agent.create(worlds::settings("Pendulum", [])).await;
    agent.join(&world).await;
    let start = Instant::now();
    for _ in 0..24 {
        agent.step(worlds::vector(&[0.0])).await;
    }
    assert!(start.elapsed() > Duration::from_secs(1), "{:?}", start.elapsed());
}

#[tokio::test]
async fn client_far_ahead_is_told_and_freed_by_a_new_file() {
    let guarded = Guarded::start(&entry("ann", ANN, "max_steps_per_second = 1"));
    let mut session = session(&guarded, ANN, open("CartPole", 100, 1)).await;
    let (code, words) = session.refused(crate::common::server::step(vec![0; 400])).await;
    assert_eq!(code, Code::ResourceExhausted, "{words}");
    assert!(words.contains("\"ann\" may take 1 steps per second") && words.contains(" s ahead"), "{words}");
    std::fs::write(&guarded.file, entry("ann", ANN, "")).unwrap();
    logged(&guarded.server, "read tokens again").await;
    timed(&mut session, 100, 3).await;
}

#[tokio::test]
async fn who_waits_for_a_rate_is_told_when_the_token_is_revoked() {
    let guarded = Guarded::start(&entry("ann", ANN, "max_steps_per_second = 8"));
    let mut session = session(&guarded, ANN, open("CartPole", 100, 1)).await;
    session.send(crate::common::server::step(vec![0; 400])).await;
    std::fs::write(&guarded.file, entry("bob", BOB, "")).unwrap();
    let start = Instant::now();
    let status = session.end().await;
    assert_eq!(status.code(), Code::Unauthenticated, "{status:?}");
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
}

#[tokio::test]
async fn a_token_has_so_many_bytes_in_flight_and_no_more() {
    let quota = entry("ann", ANN, "max_bytes = 4000000");
    let guarded = Guarded::start(&(quota + &entry("bob", BOB, "")));
    let picture = || Render { slot: 0, width: 1024, height: 1024 };
    let one = || Open { autoreset_mode: AutoresetMode::SameStep.into(), ..open("CartPole", 1, 1) };
    let mut ann = session(&guarded, ANN, one()).await;
    let large = Open { batch_size: 1_000, ..one() };
    let mut other = session(&guarded, ANN, large.clone()).await;
    let (code, words) = ann.refused(picture()).await;
    assert_eq!(code, Code::ResourceExhausted, "{words}");
    assert!(words.contains("\"ann\" may have 4000000 bytes in flight here"), "{words}");
    // A request above the whole quota gets another code, because a retry cannot help.
    let (code, words) = other.refused(Render { slot: 0, width: 2048, height: 2048 }).await;
    assert_eq!(code, Code::InvalidArgument, "{words}");
    let (code, words) = ann.refused(Act { weights: vec![0; 5_000_000].into(), ..Act::default() }).await;
    assert_eq!(code, Code::ResourceExhausted, "{words}");
    for (session, envs) in [(&mut ann, 1), (&mut other, 1_000)] {
        timed(session, envs, 3).await;
    }
    let mut bob = session(&guarded, BOB, large).await;
    bob.ask(picture()).await;
    drop(other);
    until("the bytes are free again", async || matches!(ann.answer(picture()).await, Response::Render(_))).await;
    // The memory of each picture is free once the picture is written.
    for _ in 0..5 {
        ann.ask(picture()).await;
    }
}

#[tokio::test]
async fn session_is_resumed_although_its_token_is_ahead_of_its_rate() {
    let guarded = Guarded::start(&entry("ann", ANN, "max_steps_per_second = 1"));
    let mut connection = client(guarded.server.tcp()).await;
    let mut lost = Session::show(&mut connection, Some(ANN)).await.unwrap();
    let opened = lost.ask(Open { lease: 1, ..open("CartPole", 40, 1) }).await;
    let step = || Step { actions: vec![0; 4 * 40].into() };
    assert_eq!(lost.refused(step()).await.0, Code::ResourceExhausted, "opening costs more than half a minute");
    drop(lost);
    let mut session = Session::show(&mut connection, Some(ANN)).await.unwrap();
    assert_eq!(session.ask(Resume { lease: opened.lease, last_reply: 1 }).await.last_reply, 1);
    assert_eq!(session.refused(step()).await.0, Code::ResourceExhausted, "40 s are too long to wait");
}

/// Returns the time that `count` further requests take, for a token with a rate of 1000 steps a second.
async fn paced(session: &mut Session, count: usize, request: impl Fn() -> Request) -> Duration {
    let start = Instant::now();
    for _ in 0..count {
        let answer = session.answer(request()).await;
        assert!(!matches!(answer, Response::Error(_)), "{answer:?}");
    }
    start.elapsed()
}

#[rstest]
#[case::reset("reset", 100)]
#[case::new_trial("trial", 100)]
#[case::snapshot("snapshot", 100)]
#[case::restore("restore", 25)]
#[case::render("render", 50)]
#[tokio::test]
async fn requests_cost_as_much_of_the_rate_as_steps(#[case] kind: &str, #[case] count: usize) {
    const ENVS: usize = 20;
    let guarded = Guarded::start(&entry("ann", ANN, "max_steps_per_second = 1000"));
    let same_step = Open { autoreset_mode: AutoresetMode::SameStep.into(), ..open("CartPole", ENVS as u32, 1) };
    let mut session = session(&guarded, ANN, same_step).await;
    let snapshots = session.snapshot(&[]).await;
    let took = paced(&mut session, count, || match kind {
        "reset" => Request::Reset(Reset::default()),
        "trial" => Request::Reset(Reset { seeds: vec![7; ENVS], ..Reset::default() }),
        "snapshot" => Request::Snapshot(Snapshot::default()),
        "restore" => Request::Restore(Restore { snapshots: snapshots.clone(), ..Restore::default() }),
        _ => Request::Render(Render { slot: 0, width: 200, height: 200 }),
    })
    .await;
    // Each request costs at least 20 steps, or 39 for a picture. An idle token may run one second's steps at once, and
    // no request waits for the last request.
    assert!(took.as_secs_f64() >= 0.9, "{kind}: {took:?}");
}

/// Opens sessions of `envs` environments one after the other, and ends each. Returns the time.
async fn open_and_end(connection: &mut PerturbClient<Channel>, envs: u32, count: usize) -> Duration {
    let start = Instant::now();
    for _ in 0..count {
        let mut session = Session::show(connection, Some(ANN)).await.unwrap();
        session.ask(open("CartPole", envs, 1)).await;
        session.close();
        assert_eq!(session.end().await.code(), Code::Ok);
    }
    start.elapsed()
}

#[tokio::test]
async fn opens_and_catalogues_cost_as_much_of_the_rate_as_steps() {
    let guarded = Guarded::start(&entry("ann", ANN, "max_steps_per_second = 1000"));
    let mut connection = client(guarded.server.tcp()).await;
    // The price is 16 for the session and 4 for its environments, plus the ledger's line.
    let opens = open_and_end(&mut connection, 4, 60).await;
    assert!(opens.as_secs_f64() > 1.1, "{opens:?}");
    let start = Instant::now();
    for _ in 0..100 {
        let mut call = tonic::Request::new(ListEnvironmentsRequest {});
        call.metadata_mut().insert("authorization", format!("Bearer {ANN}").parse().unwrap());
        connection.list_environments(call).await.unwrap();
    }
    let listings = start.elapsed();
    assert!(listings.as_secs_f64() > 0.5, "{listings:?}");
}

#[tokio::test]
async fn environments_of_an_open_cost_as_much_as_begun_episodes() {
    const ENVS: u32 = 100;
    let guarded = Guarded::without_ledger(&entry("ann", ANN, "max_steps_per_second = 1000"));
    let mut connection = client(guarded.server.tcp()).await;
    // 20 opens cost 320 steps, and their environments 2000. An idle token may run one second's steps at once, and no
    // request waits for the last open.
    let opens = open_and_end(&mut connection, ENVS, 20).await;
    assert!(opens.as_secs_f64() > 1.1, "{opens:?}");
}

#[rstest]
#[case::create_and_destroy("create", 10)]
#[case::reset("reset", 60)]
#[case::reset_world("reset_world", 60)]
#[case::leave_and_join("join", 90)]
#[case::property("property", 180)]
#[tokio::test]
async fn requests_about_worlds_cost_as_much_of_the_rate_as_steps(#[case] kind: &str, #[case] count: usize) {
    let guarded = Guarded::without_ledger(&entry("ann", ANN, "max_steps_per_second = 100"));
    let mut client = EnvironmentClient::new(channel(guarded.server.tcp()).await);
    let mut agent = Agent::show(&mut client, Some(ANN)).await.unwrap();
    let settings = || worlds::settings("CartPole", []);
    let world = agent.create(settings()).await;
    agent.join(&world).await;
    let start = Instant::now();
    for _ in 0..count {
        match kind {
            "create" => {
                let other = agent.create(settings()).await;
                agent.destroy(&other).await;
            }
            "reset" => drop(agent.reset(worlds::Settings::new()).await),
            "reset_world" => agent.reset_world(&world, worlds::Settings::new()).await,
            "join" => {
                agent.leave().await;
                agent.join(&world).await;
            }
            _ => drop(agent.list("").await),
        }
    }
    let took = start.elapsed();
    // All requests together cost 180 steps. An idle token may run one second's steps at once, and no request waits for
    // the last request.
    assert!(took.as_secs_f64() >= 0.7, "{kind}: {took:?}");
}

#[tokio::test]
async fn a_rate_bounds_how_fast_the_ledger_grows() {
    const RATE: u64 = 1_000;
    let guarded = Guarded::start(&entry("ann", ANN, &format!("max_steps_per_second = {RATE}")));
    let mut session = session(&guarded, ANN, open("CartPole", 64, 1)).await;
    let start = Instant::now();
    for round in 0..12 {
        let seeds = (0..64).map(|slot| u64::MAX - 64 * round - slot).collect();
        session.ask(Reset { seeds, ..Reset::default() }).await;
    }
    let seconds = start.elapsed().as_secs_f64();
    let bytes = std::fs::metadata(guarded.directory.path().join("ledger")).unwrap().len() as f64;
    // docs/access.md says that 16 bytes cost a step. An idle token may run one second's steps at once, and the last
    // request does not wait.
    let most = 16.0 * RATE as f64 * (seconds + 1.0) + 10_000.0;
    println!("{bytes} bytes in {seconds} s, at most {most}");
    assert!(bytes < most, "{bytes} bytes in {seconds} s");
}

#[tokio::test]
async fn a_line_of_the_ledger_costs_by_its_length() {
    const RATE: u64 = 1_000;
    let guarded = Guarded::start(&entry("ann", ANN, &format!("max_steps_per_second = {RATE}")));
    let mut session = session(&guarded, ANN, open("CartPole", 1, 1)).await;
    let start = Instant::now();
    for round in 0..20 {
        // The 64 intervals make a long line of a reset that costs few steps by itself.
        let low = |i: u32| 0.3 + 0.005 * f64::from(i) + 1e-6 * f64::from(round);
        let intervals: Vec<(f64, f64)> = (0..64).map(|i| (low(i), low(i) + 0.001)).collect();
        session.ask(Reset { parameters: parameters(&[("length", &intervals)]), ..Reset::default() }).await;
    }
    let seconds = start.elapsed().as_secs_f64();
    let bytes = std::fs::metadata(guarded.directory.path().join("ledger")).unwrap().len() as f64;
    // An idle token may run one second's steps at once, and the last request does not wait.
    let most = 16.0 * RATE as f64 * (seconds + 1.0) + 5_000.0;
    assert!(bytes > 30_000.0 && bytes < most, "{bytes} bytes in {seconds} s, at most {most}");
}
