//! Worlds of dm_env_rpc: their lifetime, effects of resets and properties, limits, shutdown, and effects on other
//! sessions.

use super::client::{
    Agent, Seen, Settings, boolean, choice, create, destroy, double, floats, int64, join, list, property, read,
    settings, step, text, uint64, vector, write,
};
use crate::common::server::{self, Actor, Server, Session, environment, open, refusal, until};
use insta::assert_snapshot;
use perturb::proto::{
    SessionResponse,
    dm_env_rpc::v1::{
        self as rpc, DataType, EnvironmentStateType as State, environment_client::EnvironmentClient,
        environment_request::Payload as Request, environment_response::Payload as Response,
        extensions::properties::PropertySpec, tensor::Payload,
    },
};
use tonic::{Code, transport::Channel};
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};

fn none() -> Settings {
    Settings::new()
}

/// Takes steps with the same action.
async fn play(agent: &mut Agent, action: i32, steps: usize) -> Vec<Seen> {
    let mut seen = Vec::new();
    for _ in 0..steps {
        seen.push(agent.step(choice(action)).await);
    }
    seen
}

/// Returns the steps of a new world with these settings.
async fn reference(address: &str, settings: Settings, action: i32, steps: usize) -> Vec<Seen> {
    let (mut agent, _) = Agent::in_world(address, settings).await;
    play(&mut agent, action, steps).await
}

/// Waits until the stream can make a world, and makes it. Returns its name.
async fn created(agent: &mut Agent, settings: Settings) -> String {
    let mut world = String::new();
    until("there is room for a world", async || match agent.ask(create(settings.clone())).await {
        Response::CreateWorld(response) => {
            world = response.world_name;
            true
        }
        Response::Error(error) if error.code == Code::ResourceExhausted as i32 => false,
        other => panic!("{other:?}"),
    })
    .await;
    world
}

/// Waits until the stream can join a world that another agent is leaving.
async fn joined(agent: &mut Agent, world: &str) {
    until("the world has no agent", async || match agent.ask(join(world)).await {
        Response::JoinWorld(_) => true,
        Response::Error(error) if error.code == Code::FailedPrecondition as i32 => false,
        other => panic!("{other:?}"),
    })
    .await;
}

#[tokio::test]
async fn a_world_has_one_agent_at_a_time_and_is_open_to_every_stream() {
    let server = Server::start(&[]);
    let mut maker = Agent::connect(server.tcp()).await;
    let (first, second) = (maker.create(settings("CartPole", [])).await, maker.create(settings("CartPole", [])).await);
    assert_ne!(first, second);
    let mut agent = Agent::connect(server.unix()).await;
    let specs = agent.join(&first).await;
    let (code, message) = maker.refused(join(&first)).await;
    assert!(
        code == Code::FailedPrecondition && message.contains(&first) && message.contains("has an agent"),
        "{message}"
    );
    let (code, message) = maker.refused(destroy(&first)).await;
    assert!(code == Code::FailedPrecondition && message.contains("destroy_world"), "{message}");
    let (code, message) = agent.refused(join(&second)).await;
    assert!(code == Code::FailedPrecondition && message.contains(&first), "still in its world: {message}");
    agent.step(choice(0)).await;
    agent.leave().await;
    assert_eq!(maker.join(&first).await, specs);
    assert_eq!(agent.join(&second).await, specs);
    maker.leave().await;
    agent.leave().await;
    maker.destroy(&first).await;
    let (code, message) = maker.refused(destroy(&first)).await;
    assert!(code == Code::NotFound && message.contains(&format!("world {first:?} is unknown")), "{message}");
    maker.destroy(&second).await;
}

#[tokio::test]
async fn a_world_outlives_its_maker_only_as_long_as_it_has_an_agent() {
    let server = Server::start(&["--max-envs", "2"]);
    let mut maker = Agent::connect(server.tcp()).await;
    let (kept, left) = (maker.create(settings("CartPole", [])).await, maker.create(settings("CartPole", [])).await);
    let mut agent = Agent::connect(server.tcp()).await;
    agent.join(&kept).await;
    drop(maker);
    let mut other = Agent::connect(server.tcp()).await;
    created(&mut other, settings("Acrobot", [])).await;
    assert_eq!(other.refused(join(&left)).await.0, Code::NotFound, "it went with its maker");
    assert_eq!(agent.step(choice(0)).await.state, State::Running, "the agent's world is still there");
    assert_eq!(other.refused(create(settings("Acrobot", []))).await.0, Code::ResourceExhausted);
    agent.leave().await;
    other.create(settings("Acrobot", [])).await;
    assert_eq!(agent.refused(join(&kept)).await.0, Code::NotFound, "it went with its agent");
}

#[tokio::test]
async fn a_dropped_stream_frees_its_worlds_and_one_that_closes_too() {
    const WORLDS: usize = 40;
    let server = Server::start(&["--max-envs", "40", "--max-sessions", "3"]);
    for round in 0..6 {
        let mut agent = Agent::connect(if round % 2 == 0 { server.tcp() } else { server.unix() }).await;
        let mut world = String::new();
        for _ in 0..WORLDS {
            world = created(&mut agent, settings("CartPole", [])).await;
        }
        agent.join(&world).await;
        let (code, message) = agent.refused(create(settings("CartPole", []))).await;
        assert!(code == Code::ResourceExhausted && message.contains("40 of this server's 40 are in use"), "{message}");
        match round {
            0 | 1 => agent.close(),
            2 | 3 => {
                // The stream ends during a step, and while it makes a world.
                agent.leave().await;
                agent.destroy(&world).await;
                for _ in 0..100 {
                    agent.send(Some(create(settings("CartPole", [])))).await;
                }
            }
            _ => {
                for _ in 0..100 {
                    agent.send(Some(step(choice(1)))).await;
                }
            }
        }
    }
}

#[tokio::test]
async fn world_continues_after_its_agent_vanishes_mid_step() {
    let server = Server::start(&["--workers", "1"]);
    let catalogue = server::catalogue(server.tcp()).await;
    // Takes the environment with the most expensive step among those that this build has.
    let (name, action) = match catalogue.iter().any(|e| e.name == "HalfCheetah") {
        true => ("HalfCheetah", vector(&[0.5; 6])),
        false => ("Acrobot", choice(2)),
    };
    let seeded = |seed| settings(name, [("version", text("R")), ("seed", int64(seed))]);
    let mut maker = Agent::connect(server.tcp()).await;
    let world = maker.create(seeded(1)).await;
    for round in 0..15 {
        let mut vanishing = Agent::connect(server.tcp()).await;
        joined(&mut vanishing, &world).await;
        for _ in 0..40 {
            vanishing.send(Some(step(action.clone()))).await;
        }
        for _ in 0..round {
            vanishing.receive().await.unwrap().unwrap();
        }
        drop(vanishing);
        let mut next = Agent::connect(server.tcp()).await;
        joined(&mut next, &world).await;
        let first = next.step(action.clone()).await;
        assert_eq!((first.state, first.reward), (State::Running, 0.0), "a new episode");
        next.reset(Settings::from([("seed".into(), int64(round))])).await;
        let (mut fresh, _) = Agent::in_world(server.tcp(), seeded(round)).await;
        for _ in 0..20 {
            assert_eq!(next.step(action.clone()).await, fresh.step(action.clone()).await, "round {round}");
        }
    }
}

#[tokio::test]
async fn reset_begins_the_next_episode_and_skips_none() {
    let server = Server::start(&[]);
    let cart = || settings("CartPole", [("version", text("R")), ("seed", int64(4))]);
    let (mut agent, world) = Agent::in_world(server.tcp(), cart()).await;
    // The first episode is episode 0, no matter how often the world was reset or left before.
    let episode_0 = reference(server.tcp(), cart(), 1, 5).await;
    agent.reset(none()).await;
    agent.reset_world(&world, none()).await;
    agent.leave().await;
    agent.join(&world).await;
    assert_eq!(play(&mut agent, 1, 5).await, episode_0);
    agent.reset(none()).await;
    agent.reset(none()).await;
    agent.reset_world(&world, none()).await;
    let episode_1 = play(&mut agent, 1, 5).await;
    assert_ne!(episode_0, episode_1);
    assert_eq!(agent.read("episode_index").await, uint64(1));
    // A new seed applies to the next episode. After this episode, the counts continue.
    agent.reset(Settings::from([("seed".into(), int64(4))])).await;
    agent.reset(none()).await;
    assert_eq!(play(&mut agent, 1, 5).await, episode_0);
    agent.reset_world(&world, none()).await;
    assert_eq!(play(&mut agent, 1, 5).await, episode_1);
    // Leaving interrupts the episode.
    agent.leave().await;
    agent.join(&world).await;
    assert_eq!(agent.step(choice(1)).await.reward, 0.0);
    assert_eq!(agent.read("episode_index").await, uint64(2));
}

#[tokio::test]
async fn a_reset_may_change_seed_version_and_parameters() {
    let server = Server::start(&[]);
    let given = settings("CartPole", [("force", double(7.0)), ("shared", boolean(true))]);
    let (mut agent, world) = Agent::in_world(server.tcp(), given).await;
    let change = [("version".into(), text("E")), ("mass".into(), double(0.3)), ("seed".into(), int64(6))];
    agent.reset(Settings::from(change.clone())).await;
    assert_eq!(agent.read("version").await, text("D"), "not before the next episode");
    let seen = play(&mut agent, 0, 5).await;
    let same = settings("CartPole", [("version", text("E")), ("mass", double(0.3)), ("seed", int64(6))]);
    assert_eq!(seen, reference(server.tcp(), same, 0, 5).await, "the fixed force went with the version D");
    assert_eq!(agent.read("version").await, text("E"));
    assert_eq!(agent.read("parameters.mass").await, double(0.3));
    // Other settings stay in force, also for other agents, and also if another stream has set them.
    agent.leave().await;
    let mut other = Agent::connect(server.tcp()).await;
    other.reset_world(&world, Settings::from([("length".into(), double(0.2))])).await;
    agent.join(&world).await;
    agent.step(choice(0)).await;
    for (key, value) in [("parameters.mass", 0.3), ("parameters.length", 0.2), ("applied.length", 0.2)] {
        assert_eq!(agent.read(key).await, double(value), "{key}");
    }
    assert_eq!((agent.read("version").await, agent.read("seed").await), (text("E"), uint64(6)));
}

#[tokio::test]
async fn a_reset_of_the_world_interrupts_its_agent_once() {
    let server = Server::start(&[]);
    let seeded = |seed| settings("CartPole", [("seed", int64(seed))]);
    let shared = settings("CartPole", [("seed", int64(1)), ("shared", boolean(true))]);
    let (mut agent, world) = Agent::in_world(server.tcp(), shared).await;
    let mut other = Agent::connect(server.tcp()).await;
    let undisturbed = reference(server.tcp(), seeded(1), 1, 4).await;
    let seen = play(&mut agent, 1, 3).await;
    assert_eq!(seen, undisturbed[..3]);
    other.reset_world(&world, Settings::from([("seed".into(), int64(2))])).await;
    let last = agent.step(choice(1)).await;
    assert_eq!(last, Seen { state: State::Interrupted, ..undisturbed[3].clone() }, "the step itself is carried out");
    assert!(!last.truncated, "the step limit has no part in it");
    assert_eq!(play(&mut agent, 1, 4).await, reference(server.tcp(), seeded(2), 1, 4).await, "with the new seed");
    // An agent is not interrupted if its episode has ended, or if it resets first.
    agent.reset(none()).await;
    other.reset_world(&world, none()).await;
    assert!(play(&mut agent, 1, 4).await.iter().all(|seen| seen.state == State::Running));
    other.reset_world(&world, none()).await;
    agent.reset(none()).await;
    assert!(play(&mut agent, 1, 4).await.iter().all(|seen| seen.state == State::Running));
    // If the task ends the episode in the interrupted step, the episode counts as terminated.
    let mut length = 0;
    let until_end = reference(server.tcp(), seeded(3), 1, 50).await;
    while until_end[length].state == State::Running {
        length += 1;
    }
    agent.reset(Settings::from([("seed".into(), int64(3))])).await;
    play(&mut agent, 1, length).await;
    other.reset_world(&world, none()).await;
    assert_eq!(agent.step(choice(1)).await, until_end[length]);
    assert_eq!(until_end[length].state, State::Terminated);
}

/// Returns all properties of the agent's world, including those in folders.
async fn properties(agent: &mut Agent) -> Vec<PropertySpec> {
    let mut listed = agent.list("").await;
    assert!(listed.len() > 10);
    for folder in ["parameters", "applied"] {
        listed.extend(agent.list(folder).await);
    }
    listed
}

#[tokio::test]
async fn without_a_world_there_are_the_servers_properties() {
    let server = Server::start(&[]);
    let mut agent = Agent::connect(server.tcp()).await;
    let keys: Vec<_> = agent.list("").await.into_iter().map(|p| p.spec.unwrap().name).collect();
    assert_eq!(keys, ["server_version", "environments"]);
    assert_eq!(agent.refused(property(read("seed"))).await.0, Code::NotFound);
}

#[tokio::test]
async fn properties_are_listed_read_and_written_as_their_specs_say() {
    let server = Server::start(&[]);
    for e in &server::catalogue(server.tcp()).await {
        let given = settings(&e.name, [("version", text("E")), ("seed", uint64(u64::MAX))]);
        let (mut agent, _) = Agent::in_world(server.tcp(), given).await;
        for p in properties(&mut agent).await {
            let spec = p.spec.as_ref().unwrap();
            assert!(!p.description.is_empty() && p.is_listable != p.is_readable, "{p:?}");
            if p.is_listable {
                assert_eq!((spec.dtype(), p.is_writable), (DataType::InvalidDataType, false));
                let (code, message) = agent.refused(property(read(&spec.name))).await;
                assert!(code == Code::PermissionDenied && message.contains(&spec.name), "{message}");
                continue;
            }
            let value = agent.read(&spec.name).await;
            let dtype = match value.payload.as_ref().unwrap() {
                Payload::Strings(_) => DataType::String,
                Payload::Uint32s(_) => DataType::Uint32,
                Payload::Uint64s(_) => DataType::Uint64,
                Payload::Doubles(_) => DataType::Double,
                other => panic!("{other:?}"),
            };
            assert_eq!((dtype, &value.shape), (spec.dtype(), &spec.shape), "{p:?}");
            if p.is_writable {
                agent.write(&spec.name, value).await;
            } else {
                let (code, message) = agent.refused(property(write(&spec.name, value))).await;
                assert!(code == Code::PermissionDenied && message.contains(&spec.name), "{message}");
            }
            let (code, message) = agent.refused(property(list(&spec.name))).await;
            assert!(code == Code::PermissionDenied && message.contains("cannot be listed"), "{message}");
        }
        // The properties are written: the version, the seed, and every parameter, fixed at the value that had been
        // drawn.
        let before: Vec<_> = values(&mut agent, e).await;
        agent.step(choice(0)).await;
        assert_eq!(values(&mut agent, e).await, before, "{}", e.name);
        assert_eq!(agent.read("seed").await, uint64(u64::MAX));
    }
}

#[tokio::test]
async fn parameter_beyond_its_bounds_is_refused() {
    let server = Server::start(&[]);
    for e in &server::catalogue(server.tcp()).await {
        let (mut agent, _) = Agent::in_world(server.tcp(), settings(&e.name, [])).await;
        for p in &e.parameters {
            let beyond = write(&format!("parameters.{}", p.name), double(p.high * 2.0));
            let (code, message) = agent.refused(property(beyond)).await;
            assert!(code == Code::InvalidArgument && message.contains(&p.name), "{message}");
        }
    }
}

#[tokio::test]
async fn wrong_properties_are_refused_by_name() {
    let server = Server::start(&[]);
    let (mut agent, _) = Agent::in_world(server.tcp(), settings("CartPole", [])).await;
    let mut refusals = String::new();
    for (key, value) in [
        ("parameters.mass", double(2e3)),
        ("parameters.mass", double(f64::NAN)),
        ("parameters.mass", int64(1)),
        ("parameters.colour", double(1.0)),
        ("seed", int64(-1)),
        ("seed", floats(&[], &[])),
        ("version", text("Q")),
    ] {
        refusals += &refusal(agent.refused(property(write(key, value))).await);
    }
    assert_snapshot!(refusals);
}

/// Returns the values of all parameters.
async fn values(agent: &mut Agent, e: &perturb::proto::Environment) -> Vec<rpc::Tensor> {
    let mut values = Vec::new();
    for p in &e.parameters {
        values.push(agent.read(&format!("parameters.{}", p.name)).await);
    }
    values
}

#[tokio::test]
async fn sessions_of_both_protocols_share_one_limit() {
    let server = Server::start(&["--max-sessions", "2", "--max-envs", "5"]);
    let (session, _) = Session::open(server.tcp(), open("CartPole", 4, 1)).await;
    let mut client: EnvironmentClient<Channel> = EnvironmentClient::new(server::channel(server.tcp()).await);
    let mut agent = Agent::start(&mut client).await.unwrap();
    let status = Agent::start(&mut client).await.err().expect("a third stream is refused");
    assert!(
        status.code() == Code::ResourceExhausted && status.message().contains("all of this server's 2"),
        "{status:?}"
    );
    agent.create(settings("CartPole", [])).await;
    let (code, message) = agent.refused(create(settings("CartPole", []))).await;
    assert!(code == Code::ResourceExhausted && message.contains("5 of this server's 5 are in use"), "{message}");
    drop(session);
    until("there is room for a stream", async || Agent::start(&mut client).await.is_ok()).await;
    created(&mut agent, settings("CartPole", [])).await;
}

#[tokio::test]
async fn an_idle_stream_is_ended_and_its_worlds_freed() {
    let server = Server::start(&["--idle-seconds", "1", "--max-envs", "1"]);
    let (mut idle, _) = Agent::in_world(server.tcp(), settings("CartPole", [])).await;
    let status = idle.end().await;
    assert!(status.code() == Code::DeadlineExceeded && status.message().contains("idle for 1 s"), "{status:?}");
    created(&mut Agent::connect(server.tcp()).await, settings("CartPole", [])).await;
}

#[tokio::test]
async fn oversized_message_ends_its_stream() {
    let server = Server::start(&["--max-message-bytes", "1000000", "--max-envs", "1"]);
    let (mut agent, _) = Agent::in_world(server.tcp(), settings("CartPole", [])).await;
    agent.step(choice(0)).await;
    let (code, message) = agent.refused(step(vector(&vec![0.0; 200_000]))).await;
    assert!(code == Code::InvalidArgument && message.contains("elements: 200000"), "{message}");
    agent.send(Some(step(vector(&vec![0.0; 300_000])))).await;
    let status = agent.end().await;
    assert!(status.code() == Code::OutOfRange && status.message().contains("1000000"), "{status:?}");
    created(&mut Agent::connect(server.tcp()).await, settings("CartPole", [])).await;
}

async fn health(address: &str) -> ServingStatus {
    let mut client = HealthClient::new(server::channel(address).await);
    let request = HealthCheckRequest { service: "dm_env_rpc.v1.Environment".into() };
    server::within(client.check(request)).await.unwrap().into_inner().status()
}

#[tokio::test]
async fn while_the_server_drains_agents_go_on_and_nothing_begins() {
    let mut server = Server::start(&["--grace-seconds", "100000"]);
    let (mut agent, _) = Agent::in_world(server.tcp(), settings("CartPole", [])).await;
    let mut maker = Agent::connect(server.tcp()).await;
    let world = maker.create(settings("CartPole", [])).await;
    let mut unused = Agent::connect(server.tcp()).await;
    let mut client: EnvironmentClient<Channel> = EnvironmentClient::new(server::channel(server.tcp()).await);
    assert_eq!(health(server.tcp()).await, ServingStatus::Serving);
    server.signal("TERM");
    until("health tells of the end", async || health(server.tcp()).await == ServingStatus::NotServing).await;
    let status = Agent::start(&mut client).await.err().expect("a new stream is refused");
    assert_eq!(status.code(), Code::Unavailable, "{status:?}");
    unused.send(Some(join(&world))).await;
    assert_eq!(unused.end().await.code(), Code::Unavailable, "a stream without a world is ended");
    let (code, message) = agent.refused(create(settings("CartPole", []))).await;
    assert!(code == Code::Unavailable && message.contains("shutting down"), "{message}");
    let seen = play(&mut agent, 0, 30).await;
    assert!(seen.iter().any(|seen| seen.state == State::Terminated), "episodes go on");
    maker.join(&world).await;
    maker.step(choice(0)).await;
    drop((agent, maker));
    assert_eq!(server.ended().await.code(), Some(0));
}

#[tokio::test]
async fn at_the_end_of_the_grace_period_agents_get_unavailable() {
    let mut server = Server::start(&["--grace-seconds", "1"]);
    let (mut agent, _) = Agent::in_world(server.tcp(), settings("CartPole", [])).await;
    server.signal("TERM");
    let status = agent.end().await;
    assert!(status.code() == Code::Unavailable && status.message().contains("shutting down"), "{status:?}");
    assert_eq!(server.ended().await.code(), Some(0));
}

#[tokio::test]
async fn session_beside_busy_agents_gives_the_same_bytes() {
    let server = Server::start(&["--workers", "2"]);
    let e = environment(server.tcp(), "Pendulum").await;
    let run = async || -> Vec<SessionResponse> {
        let (mut session, _) = Session::open(server.tcp(), open("Pendulum", 8, 3)).await;
        session.play(Actor::new(&e, 8), 0, 600).await
    };
    let alone = run().await;
    let unknown = Request::Step(rpc::StepRequest { requested_observations: vec![99], ..Default::default() });
    let neighbours: Vec<_> = (0..4)
        .map(|seed| {
            let (address, unknown) = (server.unix().to_owned(), unknown.clone());
            tokio::spawn(async move {
                let (mut agent, world) = Agent::in_world(&address, settings("CartPole", [("seed", int64(seed))])).await;
                for t in 0.. {
                    agent.step(choice(t % 2)).await;
                    match t % 50 {
                        0 => drop(agent.refused(unknown.clone()).await),
                        1 => drop(agent.refused(create(settings("Nothing", []))).await),
                        2 => agent.reset_world(&world, Settings::from([("force".into(), double(20.0))])).await,
                        3 => drop(Agent::in_world(&address, settings("Pendulum", [])).await),
                        _ => {}
                    }
                }
            })
        })
        .collect();
    let beside = run().await;
    for neighbour in &neighbours {
        assert!(!neighbour.is_finished(), "the agents were busy all the time");
        neighbour.abort();
    }
    assert!(alone == beside);
    assert!(!server.log().contains("panicked"), "{}", server.log());
}
