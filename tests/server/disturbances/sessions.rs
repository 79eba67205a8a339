//! Sessions with disturbances: their `open`, and that their bytes depend on nothing but seed and indices.

use crate::{
    common::server::{Actor, Server, Session, catalogue, environment, open, parameters, refusal, stepped},
    dm_env_rpc::client::{Agent, double, settings},
};
use bytes::Bytes;
use perturb::proto::{Environment, Open, Reset, Restore, SlotGroup, Version};

/// Adds disturbances that every environment supports, drawn anew in each episode.
fn disturbed(open: Open) -> Open {
    let values = parameters(&[
        ("action_delay", &[(0.0, 3.0)]),
        ("action_hold", &[(0.1, 0.3)]),
        ("push", &[(0.0, 0.1)]),
        ("push_interval", &[(5.0, 10.0)]),
        ("change_probability", &[(0.0, 0.2)]),
        ("sensor_delay", &[(0.0, 2.0)]),
        ("sensor_noise", &[(0.0, 0.1)]),
        ("sensor_dropout", &[(0.0, 0.1)]),
    ]);
    Open { parameters: values, ..open }
}

/// Returns the responses to an open, to steps, to a snapshot, and to its restore in another session.
async fn transcript(address: &str, open: Open, actor: Actor<'_>, steps: u64) -> Vec<String> {
    let (mut session, opened) = Session::open(address, open.clone()).await;
    let mut all = vec![format!("{opened:?}")];
    all.extend(session.play(actor, 0, steps).await.iter().map(|response| format!("{:?}", stepped(response))));
    let snapshots = session.snapshot(&[]).await;
    all.push(format!("{snapshots:?}"));
    let (mut restored, _) = Session::open(address, Open { seed: 1, ..open }).await;
    restored.restore(&[], snapshots).await;
    let rest = (session.play(actor, steps, steps + 20).await, restored.play(actor, steps, steps + 20).await);
    assert_eq!(rest.0, rest.1);
    all
}

#[tokio::test]
async fn disturbed_bytes_do_not_depend_on_how_a_batch_is_cut() {
    const BATCH: u32 = 400;
    let (one, three) = (Server::with_folders(&["--workers", "1"]), Server::with_folders(&["--workers", "3"]));
    for environment in &catalogue(one.tcp()).await {
        let actor = Actor::new(environment, BATCH as usize);
        let open = disturbed(open(&environment.name, BATCH, 7));
        let (a, b) =
            (transcript(one.unix(), open.clone(), actor, 30).await, transcript(three.tcp(), open, actor, 30).await);
        assert!(a == b, "{}", environment.name);
    }
}

#[tokio::test]
async fn a_disturbed_batch_on_two_servers_equals_the_whole() {
    const FIRST: u32 = 3;
    let (left, right) = (Server::with_folders(&["--workers", "1"]), Server::with_folders(&["--workers", "2"]));
    for environment in &catalogue(left.tcp()).await {
        let play = async |address: &str, first: u32, n: u32| {
            let open = Open { first_environment_index: first, ..disturbed(open(&environment.name, n, 11)) };
            let actor = Actor { environment, first: first.into(), n: n as usize };
            let (mut session, opened) = Session::open(address, open).await;
            let played = session.play(actor, 0, 700).await;
            let observations = played.iter().map(|response| stepped(response).observations.clone());
            let rows: Vec<Bytes> = std::iter::once(opened.observations).chain(observations).collect();
            let rewards: Vec<Bytes> = played.iter().map(|response| stepped(response).rewards.clone()).collect();
            (rows, rewards)
        };
        let a = play(left.tcp(), 0, FIRST).await;
        let b = play(right.unix(), FIRST, 8 - FIRST).await;
        let whole = play(right.tcp(), 0, 8).await;
        let joined = |a: &[Bytes], b: &[Bytes]| {
            a.iter().zip(b).map(|(a, b)| Bytes::from([&a[..], &b[..]].concat())).collect::<Vec<_>>()
        };
        assert_eq!(joined(&a.0, &b.0), whole.0, "{}", environment.name);
        assert_eq!(joined(&a.1, &b.1), whole.1, "{}", environment.name);
    }
}

#[tokio::test]
async fn sessions_with_a_disturbance_have_all_as_parameters() {
    let server = Server::with_folders(&[]);
    for environment in &catalogue(server.tcp()).await {
        let opened = |open: Open| async { Session::open(server.unix(), open).await.1 };
        let plain = opened(open(&environment.name, 2, 1)).await;
        assert_eq!(plain.environment.as_ref(), Some(environment));
        let late = Open { parameters: parameters(&[("action_delay", &[(2.0, 2.0)])]), ..open(&environment.name, 2, 1) };
        let group = |parameters| SlotGroup {
            size: 1,
            version: Version::Random.into(),
            parameters,
            seed: 1,
            ..SlotGroup::default()
        };
        let grouped = Open {
            groups: vec![group(Default::default()), group(late.parameters.clone())],
            version: 0,
            batch_size: 0,
            seed: 0,
            parameters: Default::default(),
            ..late.clone()
        };
        let expected = environment.disturbed();
        for (open, delays) in [(late, [2.0, 2.0]), (grouped, [0.0, 2.0])] {
            let observing = Open { observe_parameters: true, ..open.clone() };
            let opened_late = opened(open).await;
            assert_eq!(opened_late.environment.as_ref(), Some(&expected));
            for (start, delay) in opened_late.started.iter().zip(delays) {
                let receipt = start.receipt.as_ref().unwrap();
                let lengths = (receipt.requested.len(), receipt.applied.len());
                assert_eq!(lengths, (expected.parameters.len(), expected.applied.len()));
                assert_eq!(receipt.requested[environment.parameters.len()], delay);
                assert_eq!(receipt.applied[environment.applied.len()], delay);
            }
            assert_eq!(opened(observing).await.environment, Some(expected.observed(true)));
        }
    }
}

#[tokio::test]
async fn a_session_without_disturbances_refuses_them_later() {
    let server = Server::start(&[]);
    let (mut session, _) = Session::open(server.unix(), open("Pendulum", 1, 1)).await;
    let late = Reset { parameters: parameters(&[("action_delay", &[(2.0, 2.0)])]), ..Reset::default() };
    assert_eq!(
        refusal(session.refused(late.clone()).await),
        "FailedPrecondition: Pendulum was opened without disturbances, so \"action_delay\" cannot change; open it \
         again with a disturbance, such as \"action_delay\" at its default value\n"
    );
    let named = Open { parameters: parameters(&[("sensor_noise", &[(0.0, 0.0)])]), ..open("Pendulum", 1, 1) };
    let (mut named, _) = Session::open(server.unix(), named).await;
    let started = named.ask(late).await.started;
    assert_eq!(started[0].receipt.as_ref().unwrap().requested[2], 2.0);
    let snapshots = named.snapshot(&[]).await;
    let refused = refusal(session.refused(Restore { mask: Bytes::new(), snapshots }).await);
    assert!(refused.contains("it does not have the 2 parameters of Pendulum"), "{refused}");
    let half = Open { parameters: parameters(&[("action_delay", &[(0.5, 0.5)])]), ..open("Pendulum", 1, 1) };
    let refused = refusal(Session::connect(server.unix()).await.refused(half).await);
    assert_eq!(
        refused,
        "InvalidArgument: parameter \"action_delay\" of Pendulum takes whole numbers, and 0.5 has none; give whole \
         numbers, such as 2 or 0..4\n"
    );
}

#[tokio::test]
async fn worlds_take_disturbances_as_settings() {
    let server = Server::start(&[]);
    let pendulum: Environment = environment(server.tcp(), "Pendulum").await;
    let (mut late, _) = Agent::in_world(server.tcp(), settings("Pendulum", [("action_delay", double(3.0))])).await;
    assert_eq!(late.read("parameters.action_delay").await, double(3.0));
    assert_eq!(late.read("applied.action_delay").await, double(3.0));
    assert_eq!(late.read("parameters.sensor_noise").await, double(0.0));
    let keys = late.list("parameters").await.len();
    assert_eq!(keys, pendulum.parameters.len() + pendulum.disturbances.len());
    let (mut plain, _) = Agent::in_world(server.tcp(), settings("Pendulum", [])).await;
    assert_eq!(plain.list("parameters").await.len(), pendulum.parameters.len());
}
