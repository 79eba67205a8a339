//! The server of dm_env_rpc, tested through the protocol: the compliance tests of the Python package, and further
//! cases.

use super::client::{
    self, ACTION, ALL, Agent, PROPERTIES, Seen, choice, create, destroy, double, floats, int64, join, leave, property,
    read, settings, step, text, uint64, vector,
};
use crate::common::server::{self, Server, Session, action, environment, open, refusal};
use insta::assert_snapshot;
use perturb::proto::{
    self, Environment, Open, Version,
    action_space::Kind,
    dm_env_rpc::v1::{
        self as rpc, DataType, EnvironmentStateType as State, Tensor, environment_request::Payload as Request,
        environment_response::Payload as Response, tensor, tensor_spec::value,
    },
};
use prost_types::Any;
use rstest::rstest;
use std::{collections::BTreeMap, path::Path, process::Command};
use tonic::Code;

/// The environment variable with a Python that has the packages of tests/server/dm_env_rpc/requirements.txt.
const PYTHON: &str = "PERTURB_TEST_DM_ENV_RPC_PYTHON";

/// Runs a program of tests/server/dm_env_rpc with the Python of [`PYTHON`]. Returns its output, or `None` if this
/// variable is not set.
fn python(program: &str, arguments: &[&str]) -> Option<String> {
    let Ok(python) = std::env::var(PYTHON) else {
        eprintln!(
            "{program} was not run: it needs the Python package dm-env-rpc. `make test` installs it and sets {PYTHON}."
        );
        return None;
    };
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/server/dm_env_rpc").join(program);
    let mut command = Command::new(&python);
    command.arg(path).args(arguments).env("PYTHONDONTWRITEBYTECODE", "1").env("no_proxy", "*");
    let output = command.output().unwrap_or_else(|error| panic!("{PYTHON} is {python}, which cannot be run: {error}"));
    let (stdout, stderr) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{program}: {}\n{stdout}\n{stderr}", output.status);
    Some(stdout)
}

#[tokio::test]
async fn compliance_cases_of_the_package_pass() {
    let server = Server::with_folders(&[]);
    let catalogue = server::catalogue(server.tcp()).await;
    let has = |name: &&str| catalogue.iter().any(|e| e.name == **name);
    let names: Vec<&str> =
        ["CartPole", "Pendulum", "Hopper", "ReachingArm"].into_iter().filter(|name| has(name)).collect();
    if let Some(output) = python("compliance.py", &[&[server.port()], &names[..]].concat()) {
        let expected: String = names.iter().map(|name| format!("{name}: 44 cases, 0 not passed\n")).collect();
        assert_eq!(output, expected);
    }
}

#[tokio::test]
async fn adaptor_and_examples_of_the_package_run() {
    let server = Server::start(&[]);
    let document = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/dm_env_rpc.md");
    python("adaptor.py", &[server.port(), document.to_str().unwrap()]);
}

#[test]
fn the_definitions_are_the_packages() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("descriptors.bin");
    std::fs::write(&file, proto::DESCRIPTORS).unwrap();
    if let Some(output) = python("descriptors.py", &[file.to_str().unwrap()]) {
        assert_eq!(output, "3 files are equal\n");
    }
}

/// Returns the action at time `t`, within its bounds, encoded for both protocols.
fn actions(e: &Environment, t: u64) -> (Vec<u8>, Tensor) {
    let bytes = action(e, 0, t);
    match e.action.as_ref().unwrap().kind.as_ref().unwrap() {
        Kind::Discrete(_) => {
            let tensor = choice(i32::from_le_bytes(bytes.as_slice().try_into().unwrap()));
            (bytes, tensor)
        }
        Kind::Continuous(space) => {
            let clamped = server::floats(&bytes).into_iter().zip(&space.channels);
            let clamped: Vec<f32> = clamped.map(|(x, c)| x.clamp(c.low as f32, c.high as f32)).collect();
            (clamped.iter().flat_map(|x| x.to_le_bytes()).collect(), vector(&clamped))
        }
    }
}

#[tokio::test]
async fn world_plays_the_same_bytes_as_a_session() {
    let server = Server::start(&["--workers", "2"]);
    let mut ends = BTreeMap::new();
    for e in &server::catalogue(server.tcp()).await {
        let (p, x) = (&e.parameters[0], e.parameters[0].default_value * 1.1);
        let request = Open {
            first_environment_index: 7,
            episodes_per_trial: 2,
            version: Version::Extreme.into(),
            parameters: server::parameters(&[(&p.name, &[(x, x)])]),
            ..open(&e.name, 1, u64::MAX)
        };
        let (mut session, opened) = Session::open(server.tcp(), request).await;
        let given = settings(
            &e.name,
            [
                ("version", text("E")),
                ("seed", uint64(u64::MAX)),
                ("environment_index", int64(7)),
                ("episodes_per_trial", choice(2)),
                (p.name.as_str(), double(x)),
            ],
        );
        let (mut agent, _) = Agent::in_world(server.unix(), given).await;
        let first = agent.step(actions(e, 0).1).await;
        assert_eq!(first.observation, server::floats(&opened.observations), "{}", e.name);
        for t in 0..3 * u64::from(e.step_limit) / 2 {
            let (bytes, tensor) = actions(e, t);
            let (theirs, ours) = (session.step(bytes.into()).await, agent.step(tensor).await);
            let end = theirs.ended.first();
            let expected = Seen {
                state: match (theirs.terminated[0], theirs.truncated[0]) {
                    (0, 0) => State::Running,
                    (0, 1) => State::Interrupted,
                    _ => State::Terminated,
                },
                observation: server::floats(&theirs.observations),
                reward: server::floats(&theirs.rewards)[0],
                truncated: theirs.truncated[0] == 1,
                success: end.is_some_and(|end| end.success),
                diverged: end.is_some_and(|end| end.diverged),
            };
            assert_eq!(ours, expected, "{}, step {t}", e.name);
            *ends.entry(ours.state).or_insert(0) += 1;
        }
    }
    assert!(ends[&State::Terminated] > 2 && ends[&State::Interrupted] >= 2, "both kinds of ends were seen: {ends:?}");
}

#[tokio::test]
async fn observations_are_within_their_specs() {
    let server = Server::start(&[]);
    for e in &server::catalogue(server.tcp()).await {
        let (mut agent, _) = Agent::in_world(server.tcp(), settings(&e.name, [("version", text("R"))])).await;
        let specs = agent.reset(client::Settings::new()).await;
        assert_eq!(specs.actions.keys().copied().collect::<Vec<_>>(), [ACTION]);
        assert_eq!(specs.observations.keys().copied().collect::<Vec<_>>(), ALL);
        let names: Vec<_> = specs.observations.values().map(|spec| spec.name.as_str()).collect();
        assert_eq!(names, ["observation", "reward", "truncated", "success", "diverged"]);
        let observation = &specs.observations[&1];
        assert_eq!((observation.dtype(), &observation.shape[..]), (DataType::Float, &[e.observation.len() as i32][..]));
        let bounds = |bound: &Option<rpc::tensor_spec::Value>, n: usize| {
            bound.as_ref().map(|bound| match bound.payload.as_ref().unwrap() {
                value::Payload::Floats(floats) if floats.array.len() == 1 => vec![floats.array[0]; n],
                value::Payload::Floats(floats) => floats.array.clone(),
                other => panic!("{other:?}"),
            })
        };
        let n = e.observation.len();
        let bounded = e.observation.iter().all(|c| c.low.is_finite() && c.high.is_finite());
        let (low, high) = (bounds(&observation.min, n), bounds(&observation.max, n));
        assert_eq!((low.is_some(), high.is_some()), (bounded, bounded), "{}", e.name);
        assert_eq!(bounded, e.name != "CartPole", "CartPole alone has none");
        if let Kind::Continuous(space) = e.action.as_ref().unwrap().kind.as_ref().unwrap() {
            let spec = &specs.actions[&ACTION];
            assert_eq!((spec.dtype(), &spec.shape[..]), (DataType::Float, &[space.channels.len() as i32][..]));
            let ends: Vec<f32> = space.channels.iter().map(|c| c.high as f32).collect();
            assert_eq!(bounds(&spec.max, ends.len()), Some(ends));
        }
        for t in 0..300 {
            let seen = agent.step(actions(e, t).1).await;
            for (i, x) in seen.observation.iter().enumerate() {
                let within = |bounds: &Option<Vec<f32>>, ok: fn(f32, f32) -> bool| {
                    bounds.as_ref().is_none_or(|bounds| ok(*x, bounds[i]))
                };
                assert!(within(&low, |x, low| x >= low) && within(&high, |x, high| x <= high), "{}: {seen:?}", e.name);
            }
        }
    }
}

/// Returns a step request for the observation only.
fn observe(actions: BTreeMap<u64, Tensor>) -> Request {
    Request::Step(rpc::StepRequest { actions, requested_observations: vec![ALL[0]] })
}

/// Returns actions that Pendulum refuses.
fn wrong_vectors() -> Vec<BTreeMap<u64, Tensor>> {
    let doubles = tensor::Payload::Doubles(tensor::DoubleArray { array: vec![0.5] });
    let alone = [
        vector(&[f32::NAN]),
        vector(&[f32::INFINITY]),
        vector(&[2.0000002]),
        vector(&[-2.5]),
        floats(&[0.5], &[]),
        floats(&[0.5], &[1, 1]),
        floats(&[0.5], &[-1, -1]),
        floats(&[0.5], &[i32::MAX]),
        floats(&[0.5], &[0]),
        floats(&[0.5], &vec![i32::MAX; 100_000]),
        floats(&[0.5; 100_000], &[1]),
        floats(&[], &[-1]),
        Tensor { payload: Some(doubles), shape: vec![1] },
        Tensor { payload: None, shape: vec![1] },
        choice(0),
    ];
    let one_too_many = BTreeMap::from([(ACTION, vector(&[0.5])), (u64::MAX, choice(0))]);
    alone.map(|action| BTreeMap::from([(ACTION, action)])).into_iter().chain([BTreeMap::new(), one_too_many]).collect()
}

/// Returns actions that CartPole refuses.
fn wrong_choices() -> Vec<BTreeMap<u64, Tensor>> {
    let alone = [choice(2), choice(-1), int64(1), Tensor { shape: vec![1], ..choice(1) }, vector(&[1.0])];
    alone.map(|action| BTreeMap::from([(ACTION, action)])).into_iter().chain([BTreeMap::new()]).collect()
}

#[rstest]
#[case::continuous("Pendulum", wrong_vectors())]
#[case::discrete("CartPole", wrong_choices())]
#[tokio::test]
async fn wrong_actions_are_refused_by_name_and_change_nothing(
    #[case] name: &str,
    #[case] wrong: Vec<BTreeMap<u64, Tensor>>,
) {
    let server = Server::start(&[]);
    let e = environment(server.tcp(), name).await;
    let (mut agent, _) = Agent::in_world(server.tcp(), settings(name, [])).await;
    let (mut twin, _) = Agent::in_world(server.tcp(), settings(name, [])).await;
    assert_eq!(agent.step(actions(&e, 0).1).await, twin.step(actions(&e, 0).1).await);
    let mut refusals = String::new();
    for (t, wrong) in (1..).zip(wrong) {
        // Resets the world, because actions are ignored if the last step ended the episode.
        agent.reset(client::Settings::new()).await;
        twin.reset(client::Settings::new()).await;
        let good = actions(&e, t).1;
        assert_eq!(agent.step(good.clone()).await, twin.step(good.clone()).await, "{wrong:?}");
        refusals += &refusal(agent.refused(observe(wrong.clone())).await);
        assert_eq!(agent.step(good.clone()).await, twin.step(good).await, "{wrong:?} changed something");
    }
    assert_snapshot!(format!("actions_that_{name}_refuses"), refusals);
}

#[tokio::test]
async fn an_unknown_observation_is_refused_before_anything_is_done() {
    let server = Server::start(&[]);
    let e = environment(server.tcp(), "CartPole").await;
    let (mut agent, _) = Agent::in_world(server.tcp(), settings("CartPole", [])).await;
    let (mut twin, _) = Agent::in_world(server.tcp(), settings("CartPole", [])).await;
    let actions = BTreeMap::from([(ACTION, choice(0))]);
    let unknown = Request::Step(rpc::StepRequest { actions, requested_observations: vec![1, 6, 2] });
    let mut refusals = String::new();
    for t in 0..3 {
        // The refusal is checked before the first episode, during the first episode, and before the second episode.
        if t == 2 {
            agent.reset(client::Settings::new()).await;
            twin.reset(client::Settings::new()).await;
        }
        refusals += &refusal(agent.refused(unknown.clone()).await);
        let action = self::actions(&e, t).1;
        assert_eq!(agent.step(action.clone()).await, twin.step(action).await);
    }
    assert_snapshot!(refusals, @r"
    NotFound: observation 6 is unknown; observations are 1 … 5
    NotFound: observation 6 is unknown; observations are 1 … 5
    NotFound: observation 6 is unknown; observations are 1 … 5
    ");
}

#[tokio::test]
async fn one_element_stands_for_all_and_one_dimension_may_be_inferred() {
    let server = Server::start(&[]);
    for e in &server::catalogue(server.tcp()).await {
        let Kind::Continuous(space) = e.action.as_ref().unwrap().kind.as_ref().unwrap() else { continue };
        let n = space.channels.len() as i32;
        let mut seen = Vec::new();
        for tensor in [vector(&vec![0.25; n as usize]), floats(&[0.25], &[n]), floats(&vec![0.25; n as usize], &[-1])] {
            let (mut agent, _) = Agent::in_world(server.tcp(), settings(&e.name, [])).await;
            agent.step(tensor.clone()).await;
            seen.push(agent.step(tensor).await);
        }
        assert!(seen[0] == seen[1] && seen[0] == seen[2], "{}: {seen:?}", e.name);
        if n > 1 {
            // A dimension of -1 is inferred as the number of elements: 1, which is not n.
            let (mut agent, _) = Agent::in_world(server.tcp(), settings(&e.name, [])).await;
            agent.step(vector(&[])).await;
            let (code, message) = agent.refused(step(floats(&[0.25], &[-1]))).await;
            assert!(code == Code::InvalidArgument && message.contains("shape [-1], elements: 1"), "{message}");
        }
    }
}

/// Returns settings of `create_world` that are refused.
fn wrong_settings() -> Vec<client::Settings> {
    let cart = |name, tensor| settings("CartPole", [(name, tensor)]);
    let two = tensor::Payload::Strings(tensor::StringArray { array: vec!["CartPole".into(), "Pendulum".into()] });
    vec![
        client::Settings::from([("seed".into(), int64(1))]),
        client::Settings::from([("env_id".into(), int64(1))]),
        client::Settings::from([("env_id".into(), Tensor { payload: Some(two), shape: vec![2] })]),
        settings("cartpol", []),
        settings("perturb/CartPole-v9", []),
        cart("colour", text("blue")),
        cart("torque", double(1.0)),
        cart("version", text("x")),
        cart("version", int64(1)),
        cart("seed", int64(-1)),
        cart("seed", double(1.0)),
        cart("seed", Tensor { shape: vec![1], ..int64(1) }),
        cart("environment_index", int64(1 << 32)),
        cart("episodes_per_trial", choice(0)),
        cart("mass", double(f64::NAN)),
        cart("mass", double(f64::NEG_INFINITY)),
        cart("mass", double(0.0)),
        cart("mass", int64(1)),
        cart("mass", floats(&[1.0], &[])),
    ]
}

#[tokio::test]
async fn wrong_settings_of_a_world_are_refused_by_name() {
    let server = Server::start(&["--max-envs", "1"]);
    let mut agent = Agent::connect(server.tcp()).await;
    let mut refusals = String::new();
    for settings in wrong_settings() {
        refusals += &refusal(agent.refused(create(settings)).await);
    }
    assert_snapshot!(refusals);
    agent.create(settings("CartPole", [("seed", int64(i64::MAX)), ("mass", double(0.5))])).await;
    let full = agent.refused(create(settings("CartPole", []))).await;
    assert_snapshot!(refusal(full), @"ResourceExhausted: 1 environments were asked for, but 1 of this server's 1 are in use; open fewer, or try again later");
}

#[tokio::test]
async fn wrong_settings_of_a_join_or_reset_are_refused_by_name() {
    let server = Server::start(&[]);
    let mut agent = Agent::connect(server.tcp()).await;
    let world = agent.create(settings("CartPole", [("mass", double(0.5))])).await;
    let seed = client::Settings::from([("seed".into(), int64(1))]);
    let join = Request::JoinWorld(rpc::JoinWorldRequest { world_name: world.clone(), settings: seed });
    let mut refusals = refusal(agent.refused(join).await);
    agent.join(&world).await;
    let wrong = [("env_id", text("CartPole")), ("seed", text("1")), ("version", text("X")), ("length", double(1e9))];
    for (name, tensor) in wrong {
        let settings = client::Settings::from([("mass".into(), double(0.1)), (name.into(), tensor)]);
        refusals += &refusal(agent.refused(Request::Reset(rpc::ResetRequest { settings: settings.clone() })).await);
        refusals += &refusal(agent.refused(client::reset_world(&world, settings)).await);
    }
    assert_snapshot!(refusals);
    agent.step(choice(0)).await;
    assert_eq!(agent.read("parameters.mass").await, double(0.5), "what was refused changed nothing");
}

#[tokio::test]
async fn every_request_is_answered_once_in_order() {
    let server = Server::start(&[]);
    let mut agent = Agent::connect(server.tcp()).await;
    let world = "pole";
    let reset = || Some(Request::Reset(rpc::ResetRequest::default()));
    let step = || Some(step(choice(1)));
    let wrong_type = Any { type_url: "type.googleapis.com/google.protobuf.Empty".into(), value: vec![] };
    let garbage = Any { type_url: PROPERTIES.into(), value: vec![0xFF; 9] };
    let empty = Any { type_url: PROPERTIES.into(), value: vec![] };
    let extension = |any: &Any| Some(Request::Extension(any.clone()));
    let expected: Vec<(Option<Request>, Result<&str, Code>)> = vec![
        (None, Err(Code::InvalidArgument)),
        (step(), Err(Code::FailedPrecondition)),
        (reset(), Err(Code::FailedPrecondition)),
        (Some(leave()), Ok("LeaveWorld")),
        (Some(join(world)), Err(Code::NotFound)),
        (Some(destroy(world)), Err(Code::NotFound)),
        (Some(client::reset_world(world, client::Settings::new())), Err(Code::NotFound)),
        (Some(create(settings("CartPole", [("world_name", text(world))]))), Ok("CreateWorld")),
        (Some(client::reset_world(world, client::Settings::new())), Ok("ResetWorld")),
        (Some(join(world)), Ok("JoinWorld")),
        (Some(join(world)), Err(Code::FailedPrecondition)),
        (step(), Ok("Step")),
        (step(), Ok("Step")),
        (Some(destroy(world)), Err(Code::FailedPrecondition)),
        (reset(), Ok("Reset")),
        (reset(), Ok("Reset")),
        (extension(&wrong_type), Err(Code::Unimplemented)),
        (extension(&garbage), Err(Code::InvalidArgument)),
        (extension(&empty), Err(Code::InvalidArgument)),
        (Some(property(read("seed"))), Ok("Extension")),
        (step(), Ok("Step")),
        (Some(client::reset_world(world, client::Settings::new())), Ok("ResetWorld")),
        (Some(leave()), Ok("LeaveWorld")),
        (Some(leave()), Ok("LeaveWorld")),
        (step(), Err(Code::FailedPrecondition)),
        (Some(destroy(world)), Ok("DestroyWorld")),
        (Some(join(world)), Err(Code::NotFound)),
    ];
    for (request, _) in &expected {
        agent.send(request.clone()).await;
    }
    agent.close();
    for (request, expected) in expected {
        let response = agent.receive().await.unwrap().unwrap().payload.unwrap();
        match (&response, expected) {
            (Response::Error(status), Err(code)) => {
                assert_eq!(Code::from_i32(status.code), code, "{request:?}: {status:?}");
            }
            (response, Ok(variant)) => {
                assert!(format!("{response:?}").starts_with(variant), "{request:?}: {response:?}")
            }
            (response, Err(code)) => panic!("{request:?} was answered by {response:?}, not refused as {code:?}"),
        }
    }
    assert_eq!(agent.receive().await.unwrap(), None, "nothing follows the last response");
}

#[tokio::test]
async fn an_observation_that_is_asked_for_many_times_is_made_once() {
    let server = Server::start(&[]);
    let mut agent = Agent::in_world(server.tcp(), settings("CartPole", [])).await.0;
    let step = |times| {
        let actions = BTreeMap::from([(ACTION, choice(1))]);
        Request::Step(rpc::StepRequest { actions, requested_observations: vec![ALL[0]; times] })
    };
    let response = agent.ask(step(1_000)).await;
    let Response::Step(stepped) = response else { panic!("{response:?}") };
    assert!(stepped.observations.keys().eq([&ALL[0]]));
    // A request above the limit is refused, and the world continues.
    let (code, message) = agent.refused(step(500_000)).await;
    assert!(code == Code::InvalidArgument && message.contains("step.requested_observations"), "{message}");
    let Response::Step(_) = agent.ask(step(1)).await else { panic!("the stream ended") };
}
