//! Valid inputs of the fuzz targets, which a fuzzer mutates.

use std::path::Path;

use perturb::env::ActionSpec;
use perturb::proto::act::Task;
use perturb::proto::dm_env_rpc::v1 as rpc;
use perturb::proto::dm_env_rpc::v1::environment_request::Payload;
use perturb::proto::policy::Role;
use perturb::proto::session_request::Request;
use perturb::proto::session_response::Response;
use perturb::proto::{
    Act, AutoresetMode, Contexts, Distribution, Interval, Open, Policy, RandomStream, Release, Render, Reset,
    SavePlayer, SessionResponse, SlotGroup, Snapshot, Version,
};
use perturb::tasks;
use perturb_checkpoint::Checkpoint;
use perturb_policy::{ActionKind, PolicySpec};
use perturb_records::{Records, StudyEpisodes};
use prost::Message;

use crate::server::{client_bytes, frame, framed, open, replies_to, steps};

/// The name of a stored policy that has a recorded test.
const POLICY: &str = "CartPole-ppo-ff-R-9bd6546b-s7";

/// Returns the stored policy [`POLICY`].
pub(crate) fn stored_policy() -> Checkpoint {
    let file = repository_path("results/policies").join(format!("{POLICY}.safetensors"));
    Checkpoint::load(&file).expect("a policy")
}

/// Returns the recorded episodes of the policy [`POLICY`].
pub(crate) fn stored_records() -> Records {
    let path = StudyEpisodes::path(&repository_path("results"), "beyond/confirm-2");
    let episodes = StudyEpisodes::read_if_exists(&path).expect("readable").expect("a file");
    episodes.of_cell(POLICY).expect("the policy's episodes").clone()
}

/// Returns the valid inputs of the target called `name`.
pub fn seeds(name: &str) -> Vec<Vec<u8>> {
    let environments = tasks::catalogue();
    let names = || environments.names();
    match name {
        "requests" => names().flat_map(sessions).collect(),
        "snapshots" => names().enumerate().flat_map(|(choice, name)| snapshots(choice, name)).collect(),
        "worlds" => names().map(world).collect(),
        "connections" => vec![
            client_bytes(&[open("CartPole", 2), steps("CartPole", 2, 2)].concat()),
            client_bytes(&[]),
            b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n".to_vec(),
        ],
        "checkpoints" => {
            let folder = tempfile::tempdir().expect("a folder");
            stored_policy().save(folder.path(), None).expect("a checkpoint");
            let document = std::fs::read(folder.path().join("checkpoint.json")).expect("a checkpoint");
            let weights = std::fs::read_dir(folder.path()).expect("its folder").flatten();
            let weights = weights.map(|file| file.path()).find(|path| path.extension().is_some_and(|it| it != "json"));
            let weights = std::fs::read(weights.expect("weights")).expect("weights");
            let document: serde_json::Value = serde_json::from_slice(&document).expect("JSON");
            let document = document.to_string();
            let length = u16::try_from(document.len()).expect("a short document");
            vec![[&length.to_le_bytes(), document.as_bytes(), &weights].concat()]
        }
        "records" => {
            let folder = tempfile::tempdir().expect("a folder");
            let file = folder.path().join("episodes.parquet");
            stored_records().write(&file).expect("a file");
            vec![std::fs::read(file).expect("recorded")]
        }
        "plans" => ["quick", "classic-ff", "classic-rc", "paper", "beyond/confirm-2", "questions/pendulum"]
            .map(|name| {
                std::fs::read(repository_path("experiments").join(name).with_extension("toml")).expect("a file")
            })
            .to_vec(),
        "tasks" => ["examples/tasks/reaching_arm/task.toml"]
            .map(|name| std::fs::read(repository_path(name)).expect("a file"))
            .to_vec(),
        "models" => [
            "examples/tasks/reaching_arm/arm.xml",
            "examples/tasks/quadruped/robot.xml",
            "examples/tasks/quadruped/scenery.xml",
        ]
        .map(|name| std::fs::read(repository_path(name)).expect("a file"))
        .to_vec(),
        "ledgers" => vec![include_str!("ledger.jsonl").into()],
        _ => Vec::new(),
    }
}

/// Returns the path of a file, given relative to the repository's root.
pub(crate) fn repository_path(path: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Returns the inputs of three sessions that together contain a request of each kind.
fn sessions(environment: &str) -> [Vec<u8>; 3] {
    let environments = tasks::catalogue();
    let spec = environments.find(environment).expect("it has one");
    let parameter = spec.parameters[0].name.to_owned();
    let distribution = Distribution { intervals: vec![Interval { low: 1.0, high: 1.0 }] };
    let parameters = || [(parameter.clone(), distribution.clone())].into();
    let reset = Reset { mask: vec![1, 0].into(), seeds: vec![3], parameters: parameters(), ..Reset::default() };
    let usual = [
        open(environment, 2),
        steps(environment, 2, 2),
        framed(Request::Reset(reset)),
        framed(Request::Snapshot(Snapshot::default())),
        framed(Request::Render(Render { slot: 1, width: 16, height: 16 })),
        framed(Request::Release(Release { mask: vec![0, 1].into() })),
        steps(environment, 1, 1),
    ];
    let group =
        SlotGroup { size: 2, version: Version::Extreme.into(), parameters: parameters(), ..SlotGroup::default() };
    let contexts = Contexts { names: vec![parameter.clone()], values: vec![1.0; 2] };
    let listed = SlotGroup { parameters: [].into(), contexts: Some(contexts), ..group.clone() };
    let groups = framed(Request::Open(Open {
        environment: environment.into(),
        autoreset_mode: AutoresetMode::NextStep.into(),
        groups: vec![group, listed],
        receipts: true,
        reward_terms: true,
        observe_parameters: true,
        ..Open::default()
    }));
    let action = match spec.action {
        ActionSpec::Discrete(names) => ActionKind::Discrete { n: names.len() },
        ActionSpec::Continuous(channels) => ActionKind::Continuous { size: channels.len() },
    };
    let shape = PolicySpec { observation_size: spec.observation.len(), action, hidden: vec![4], lstm: Some(2) };
    let stream = RandomStream { key: vec![1; 32].into(), ..RandomStream::default() };
    let policy = Policy { hidden: vec![4], lstm: 2, role: Some(Role::Training(stream)), ..Policy::default() };
    let weights = vec![0; 4 * shape.n_weights()].into();
    let act = Act { policy: Some(policy), weights, task: Some(Task::Steps(3)), ..Act::default() };
    let acting =
        [open(environment, 2), framed(Request::Act(act)), framed(Request::SavePlayer(SavePlayer::default()))].concat();
    [usual.concat(), [groups, steps(environment, 4, 2)].concat(), acting]
}

/// Returns two inputs of the target `snapshots`: the state at the start, and a few steps later. `choice` is the number
/// of the environment in the catalogue.
fn snapshots(choice: usize, environment: &str) -> Vec<Vec<u8>> {
    let snapshot = || framed(Request::Snapshot(Snapshot::default()));
    let body = [open(environment, 1), snapshot(), steps(environment, 1, 5), snapshot()].concat();
    let replies = replies_to(body).into_iter().map(|reply| SessionResponse::decode(&reply[..]).expect("a reply"));
    let choice = u8::try_from(choice).expect("few environments");
    let snapshots = replies.filter_map(|reply| match reply.response {
        Some(Response::Snapshot(taken)) => {
            let (snapshot, _checksum) = taken.snapshots[0].split_last_chunk::<4>()?;
            Some([&[choice][..], snapshot].concat())
        }
        _ => None,
    });
    let found: Vec<_> = snapshots.collect();
    assert_eq!(found.len(), 2, "both are answered");
    found
}

/// Returns requests of dm_env_rpc that create, join, step, reset, leave and destroy a world.
fn world(environment: &str) -> Vec<u8> {
    let text = |text: &str| rpc::Tensor {
        payload: Some(rpc::tensor::Payload::Strings(rpc::tensor::StringArray { array: vec![text.into()] })),
        ..rpc::Tensor::default()
    };
    let world_name = "w".to_owned();
    let settings = [("env_id", environment), ("version", "R"), ("world_name", &world_name)];
    let settings = settings.map(|(name, value)| (name.to_owned(), text(value)));
    let payloads = [
        Payload::CreateWorld(rpc::CreateWorldRequest { settings: settings.into() }),
        Payload::JoinWorld(rpc::JoinWorldRequest { world_name: world_name.clone(), ..Default::default() }),
        Payload::Step(rpc::StepRequest { requested_observations: vec![1, 2], ..Default::default() }),
        Payload::Reset(rpc::ResetRequest::default()),
        Payload::ResetWorld(rpc::ResetWorldRequest { world_name: world_name.clone(), ..Default::default() }),
        Payload::LeaveWorld(rpc::LeaveWorldRequest::default()),
        Payload::DestroyWorld(rpc::DestroyWorldRequest { world_name }),
    ];
    let messages = payloads.map(|payload| rpc::EnvironmentRequest { payload: Some(payload) }.encode_to_vec());
    messages.iter().flat_map(|message| frame(message)).collect()
}

/// Sends a session's input to the server. Returns the number of replies, and the messages of the error replies.
pub fn replies(seed: &[u8]) -> (usize, Vec<String>) {
    let replies = replies_to(seed.to_vec());
    let refusal = |reply: &Vec<u8>| match SessionResponse::decode(&reply[..]).expect("a reply").response {
        Some(Response::Error(error)) => Some(error.message),
        _ => None,
    };
    (replies.len(), replies.iter().filter_map(refusal).collect())
}
