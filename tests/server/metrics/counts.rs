//! Tests that counters have the right values after known requests.

use super::Watched;
use crate::{
    acting::game::{Game, PLAIN, play, wire},
    common::server::{Session, channel, client, environment, open, until, within},
    dm_env_rpc::client::{self as worlds, Agent},
};
use perturb::proto::{Act, Open, Policy, Release, act::Task, dm_env_rpc::v1::environment_client::EnvironmentClient};
use std::path::Path;
use tonic::Code;

const ANN: &str = "correct-horse-battery";
const BOB: &str = "staple-correct-horse";
const STEP_DONE: &str = r#"perturb_requests_total{protocol="perturb.v1",kind="step",outcome="done"}"#;

#[tokio::test]
async fn what_happens_in_a_session_is_counted() {
    let watched = Watched::start(&["--max-envs", "100", "--max-sessions", "7", "--max-memory", "2000000"]);
    let (mut session, _) = Session::open(watched.server.tcp(), open("CartPole", 4, 1)).await;
    for _ in 0..5 {
        session.step(vec![0; 16].into()).await;
    }
    session.refused(crate::common::server::step(vec![0; 3])).await;
    session.render(0, (64, 64)).await;
    let page = watched.page();
    for (series, number) in [
        ("perturb_sessions", 1.0),
        ("perturb_sessions_limit", 7.0),
        ("perturb_connections", 1.0),
        ("perturb_environments", 4.0),
        ("perturb_environments_limit", 100.0),
        ("perturb_in_flight_bytes_limit", 2e6),
        (r#"perturb_steps_total{environment="CartPole"}"#, 20.0),
        (r#"perturb_step_seconds_count{environment="CartPole",batch="2-16"}"#, 5.0),
        ("perturb_picture_seconds_count", 1.0),
        (STEP_DONE, 5.0),
        (r#"perturb_requests_total{protocol="perturb.v1",kind="step",outcome="refused"}"#, 1.0),
        (r#"perturb_requests_total{protocol="perturb.v1",kind="open",outcome="done"}"#, 1.0),
        (r#"perturb_refusals_total{code="INVALID_ARGUMENT",reason="bad_value"}"#, 1.0),
        ("perturb_queue_wait_seconds_count", 1.0),
    ] {
        assert_eq!(page.number(series), number, "{series} in\n{}", page.text);
    }
    assert!(page.number("perturb_in_flight_bytes") > 0.0, "an open session keeps what its steps need");
    assert!(page.text.contains(concat!("perturb_build_info{version=\"", env!("CARGO_PKG_VERSION"))));
    assert!(page.number("process_resident_memory_bytes") > 1e6 && page.number("process_open_fds") > 3.0);
    let age = page.number("process_start_time_seconds") - watched.server.started_seconds();
    assert!(age.abs() < 60.0, "it started {age} s before or after its process");

    drop(session);
    watched.until("perturb_sessions", 0.0).await;
    watched.until("perturb_environments", 0.0).await;
    watched.until("perturb_connections", 0.0).await;
    assert_eq!(watched.page().number(r#"perturb_steps_total{environment="CartPole"}"#), 20.0, "counters stay");
}

#[tokio::test]
async fn reset_steps_are_not_counted_and_ended_episodes_are() {
    const REQUESTS: usize = 200;
    let watched = Watched::start(&[]);
    let (mut session, _) = Session::open(watched.server.unix(), open("CartPole", 1, 1)).await;
    let (mut ended, mut begun, mut over) = (0, 0, false);
    for _ in 0..REQUESTS {
        let stepped = session.step(vec![0; 4].into()).await;
        begun += usize::from(over);
        over = stepped.terminated[0] == 1 || stepped.truncated[0] == 1;
        ended += usize::from(over);
    }
    assert!(ended > 2, "{ended} episodes ended");
    let page = watched.page();
    let steps = page.number(r#"perturb_steps_total{environment="CartPole"}"#);
    assert_eq!(steps, (REQUESTS - begun) as f64);
    assert_eq!(page.number(r#"perturb_episodes_total{environment="CartPole"}"#), f64::from(ended as u32));
    assert_eq!(page.number(r#"perturb_step_seconds_count{environment="CartPole",batch="1"}"#), REQUESTS as f64);
}

#[tokio::test]
async fn what_the_server_plays_is_counted() {
    let watched = Watched::start(&[]);
    let game = Game { environment: "Pendulum", n: 8, ..PLAIN };
    let environment = environment(watched.server.unix(), "Pendulum").await;
    let (mut session, _) = Session::open(watched.server.unix(), game.open()).await;
    let acted = session.ask(game.act(&environment, Task::Steps(40))).await;
    assert_eq!(acted.steps, 40);
    let page = watched.page();
    assert_eq!(page.number(r#"perturb_steps_total{environment="Pendulum"}"#), 320.0);
    assert!(page.number("perturb_queue_wait_seconds_count") > 0.0);
    assert!(!page.text.contains("perturb_step_seconds_count{"), "no step was asked for");
}

#[tokio::test]
async fn the_other_protocol_is_counted_too() {
    let watched = Watched::start(&[]);
    let (mut agent, world) = Agent::in_world(watched.server.tcp(), worlds::settings("CartPole", [])).await;
    for _ in 0..4 {
        agent.step(worlds::choice(0)).await;
    }
    agent.refused(worlds::join(&world)).await;
    let page = watched.page();
    // In next-step mode, the first step after an end begins the episode.
    for (series, number) in [
        (r#"perturb_steps_total{environment="CartPole"}"#, 3.0),
        (r#"perturb_requests_total{protocol="dm_env_rpc.v1",kind="step",outcome="done"}"#, 4.0),
        (r#"perturb_requests_total{protocol="dm_env_rpc.v1",kind="join_world",outcome="refused"}"#, 1.0),
        (r#"perturb_refusals_total{code="FAILED_PRECONDITION",reason="already_joined"}"#, 1.0),
        ("perturb_sessions", 1.0),
    ] {
        assert_eq!(page.number(series), number, "{series} in\n{}", page.text);
    }
    agent.close();
    agent.end().await;
    watched.until(r#"perturb_sessions_ended_total{protocol="dm_env_rpc.v1",ending="closed"}"#, 1.0).await;
}

#[tokio::test]
async fn what_may_happen_is_told_before_it_does() {
    // `rate` compares two samples. Without a first sample of 0, the first event of its kind would be invisible.
    const ALREADY_OPEN: &str = r#"perturb_refusals_total{code="FAILED_PRECONDITION",reason="already_open"}"#;
    let watched = Watched::start(&[]);
    let page = watched.page();
    let refusals: Vec<_> = page.text.lines().filter(|line| line.starts_with("perturb_refusals_total{")).collect();
    assert!(refusals.len() > 40, "docs/monitoring.md says some forty: {refusals:#?}");
    assert!(refusals.iter().all(|line| line.ends_with(" 0.0")), "{refusals:#?}");
    for protocol in ["perturb.v1", "dm_env_rpc.v1"] {
        for ending in ["closed", "gone", "broken", "lease_over"] {
            let series = format!("perturb_sessions_ended_total{{protocol=\"{protocol}\",ending=\"{ending}\"}}");
            assert!(page.tells(&series) && page.number(&series) == 0.0, "{series} in\n{}", page.text);
        }
    }
    let (mut session, _) = Session::open(watched.server.tcp(), open("CartPole", 1, 1)).await;
    session.refused(open("CartPole", 1, 1)).await;
    assert_eq!(watched.page().number(ALREADY_OPEN), page.number(ALREADY_OPEN) + 1.0);
}

#[tokio::test]
async fn refusals_are_counted_by_reason() {
    let watched = Watched::start(&["--max-envs", "8", "--max-sessions", "2", "--idle-seconds", "1"]);
    let mut session = Session::connect(watched.server.tcp()).await;
    session.refused(open("Nowhere", 1, 1)).await;
    session.refused(Open { batch_size: 9, ..open("CartPole", 1, 1) }).await;
    session.ask(open("CartPole", 8, 1)).await;
    session.refused(open("CartPole", 8, 1)).await;
    let mut second = Session::connect(watched.server.tcp()).await;
    second.refused(open("CartPole", 1, 1)).await;
    let third = Session::start(&mut client(watched.server.tcp()).await).await;
    assert_eq!(third.err().unwrap().code(), Code::ResourceExhausted);
    assert_eq!(session.end().await.code(), Code::DeadlineExceeded);
    let page = watched.page();
    for (reason, number) in [
        (r#"{code="NOT_FOUND",reason="unknown_environment"}"#, 1.0),
        (r#"{code="RESOURCE_EXHAUSTED",reason="environments_full"}"#, 2.0),
        (r#"{code="FAILED_PRECONDITION",reason="already_open"}"#, 1.0),
        (r#"{code="RESOURCE_EXHAUSTED",reason="sessions_full"}"#, 1.0),
    ] {
        assert_eq!(page.number(&format!("perturb_refusals_total{reason}")), number, "{reason} in\n{}", page.text);
    }
    assert!(page.number(r#"perturb_refusals_total{code="DEADLINE_EXCEEDED",reason="idle"}"#) >= 1.0);
    watched.until(r#"perturb_sessions_ended_total{protocol="perturb.v1",ending="idle"}"#, 2.0).await;
}

fn write_tokens(file: &Path, name: &str) {
    let entry = |name: &str, token: &str| format!("[[token]]\nname = {name:?}\ntoken = \"{token}\"\nmax_envs = 8\n");
    std::fs::write(file, entry(name, ANN) + &entry("bob", BOB)).unwrap();
}

#[tokio::test]
async fn each_token_has_its_numbers_by_its_name() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("tokens.toml");
    write_tokens(&file, "ann \"the\\ first\"");
    let watched = Watched::start(&["--tokens", file.to_str().unwrap()]);
    let mut session = Session::show(&mut client(watched.server.tcp()).await, Some(ANN)).await.unwrap();
    session.ask(open("CartPole", 4, 1)).await;
    for _ in 0..3 {
        session.step(vec![0; 16].into()).await;
    }
    let mut greedy = Session::show(&mut client(watched.server.tcp()).await, Some(ANN)).await.unwrap();
    greedy.refused(open("CartPole", 5, 1)).await;
    let stranger = Session::start(&mut client(watched.server.tcp()).await).await;
    assert_eq!(stranger.err().unwrap().code(), Code::Unauthenticated);
    let mut agents = EnvironmentClient::new(channel(watched.server.tcp()).await);
    let other = Agent::show(&mut agents, Some("no-such-token-at-all")).await;
    assert_eq!(other.err().unwrap().code(), Code::Unauthenticated);

    let page = watched.page();
    let ann = r#"{token="ann \"the\\ first\""}"#;
    for (series, number) in [
        (format!("perturb_token_sessions{ann}"), 2.0),
        (format!("perturb_token_environments{ann}"), 4.0),
        (format!("perturb_token_steps_total{ann}"), 12.0),
        (format!("perturb_token_wait_seconds_total{ann}"), 0.0),
        (r#"perturb_token_in_flight_bytes{token="bob"}"#.into(), 0.0),
        (format!("perturb_token_refusals_total{ann}"), 1.0),
        (r#"perturb_token_steps_total{token="bob"}"#.into(), 0.0),
        (r#"perturb_refusals_total{code="UNAUTHENTICATED",reason="no_token"}"#.into(), 1.0),
        (r#"perturb_refusals_total{code="UNAUTHENTICATED",reason="wrong_token"}"#.into(), 1.0),
        (r#"perturb_refusals_total{code="RESOURCE_EXHAUSTED",reason="token_quota"}"#.into(), 1.0),
    ] {
        assert!(page.tells(&series), "no {series} in\n{}", page.text);
        assert_eq!(page.number(&series), number, "{series} in\n{}", page.text);
    }
    let bytes = page.number(&format!("perturb_token_in_flight_bytes{ann}"));
    assert_eq!(bytes, page.number("perturb_in_flight_bytes"), "nobody else has any");
    assert!(bytes > 0.0, "an open session keeps what its steps need");
    assert!(!page.text.contains(ANN) && !page.text.contains("no-such-token"), "{}", page.text);

    write_tokens(&file, "carol");
    let gone = format!("perturb_token_sessions{ann}");
    crate::common::server::until("that name is told no more", async || !watched.page().tells(&gone)).await;
}

#[tokio::test]
async fn nothing_that_a_client_sends_is_told_or_logged() {
    let watched = Watched::start(&[]);
    let evil = "evil\"} 1\nevil_total 1";
    let mut session = Session::connect(watched.server.tcp()).await;
    session.refused(open(evil, 1, 1)).await;
    session.ask(open("CartPole", 1, 1)).await;
    let mut agent = Agent::connect(watched.server.tcp()).await;
    agent.refused(worlds::join(evil)).await;
    agent.create(worlds::settings("CartPole", [("world_name", worlds::text("evil"))])).await;
    agent.join("evil").await;
    let mut tokens = EnvironmentClient::new(channel(watched.server.tcp()).await);
    within(Agent::show(&mut tokens, Some("evil"))).await.unwrap();
    let (head, _) = super::page::asked(super::page::unix(&watched.socket), "GET /evil");
    assert!(head.starts_with("HTTP/1.1 404"), "{head}");
    drop((session, agent));
    watched.until("perturb_sessions", 0.0).await;
    let (page, log) = (watched.page(), watched.server.log());
    assert!(!page.text.contains("evil"), "{}", page.text);
    assert!(log.contains("a session ended") && !log.contains("evil"), "{log}");
}

#[tokio::test]
async fn metrics_are_described_and_have_all_environments() {
    let watched = Watched::start(&[]);
    let page = watched.page();
    let described = include_str!("../../../docs/monitoring.md");
    for line in page.text.lines().filter_map(|line| line.strip_prefix("# TYPE ")) {
        let (name, kind) = line.split_once(' ').unwrap();
        let total = if kind == "counter" { "_total" } else { "" };
        assert!(described.contains(&format!("`{name}{total}`")), "docs/monitoring.md does not tell of {name}{total}");
    }
    for environment in perturb::tasks::catalogue().names() {
        assert!(page.tells(&format!("perturb_steps_total{{environment=\"{environment}\"}}")), "{environment}");
    }
}

#[tokio::test]
async fn memory_of_a_policy_is_reserved_until_the_policy_is_discarded() {
    const SERIES: &str = "perturb_in_flight_bytes";
    let watched = Watched::start(&[]);
    let game = Game { n: 64, ..PLAIN };
    let (mut session, environment) = game.session(&watched.server).await;
    // A step ends the reservations of the first reply.
    session.step(vec![0; 4 * 64].into()).await;
    // The reading is repeated until it is stable, because bytes of the step's reply may still be in flight.
    let mut open = f64::NAN;
    until("the bytes in flight are stable", async || {
        let before = std::mem::replace(&mut open, watched.page().number(SERIES));
        before == open
    })
    .await;
    let act = game.act(&environment, Task::Steps(3));
    // The weights count as received and as loaded. Each environment has activations of the layers of 9 and 7 units.
    let policy = (2 * act.weights.len() + 64 * (9 + 7) * 16) as f64;
    let weights = act.weights.clone();
    play(&mut session, act).await;
    watched.until(SERIES, open + policy).await;
    play(&mut session, Act { weights, task: Some(Task::Steps(3)), ..Act::default() }).await;
    watched.until(SERIES, open + policy).await;
    // A policy without hidden layers has no activations.
    let linear = game.act(&environment, Task::Steps(3));
    let linear = Act {
        policy: linear.policy.map(|policy| Policy { hidden: Vec::new(), ..policy }),
        weights: vec![0; 4 * (2 * 5 + 5)].into(),
        ..linear
    };
    let weights = (2 * linear.weights.len()) as f64;
    play(&mut session, linear).await;
    watched.until(SERIES, open + weights).await;
    // A policy that fails is discarded. These weights give infinite outputs.
    let failing = game.act(&environment, Task::Steps(3));
    let failing = Act { weights: wire(&vec![1e38; failing.weights.len() / 4]), ..failing };
    let (_, words) = session.refused(failing).await;
    assert!(words.contains("stopped playing the policy"), "{words}");
    watched.until(SERIES, open).await;
    // Released environments discard the policy, too.
    play(&mut session, game.act(&environment, Task::Steps(3))).await;
    watched.until(SERIES, open + policy).await;
    let mask = [vec![1], vec![0; 63]].concat().into();
    session.ask(Release { mask }).await;
    watched.until(SERIES, open).await;
}
