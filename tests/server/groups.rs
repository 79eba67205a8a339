//! Groups of slots with settings of their own, and the release of environments.

use crate::common::server::{Actor, Server, Session, contexts, floats, open, parameters, refusal, until};
use bytes::Bytes;
use insta::assert_snapshot;
use perturb::proto::{AutoresetMode, Open, Release, Reset, SlotGroup, Stepped, Version};
use prost::Message;
use rstest::rstest;
use tonic::Code;

/// Returns groups that differ in all settings.
fn groups() -> Vec<SlotGroup> {
    let group = |size, version: Version, seed, first_environment_index, episodes_per_trial| SlotGroup {
        size,
        version: version.into(),
        parameters: std::collections::HashMap::new(),
        seed,
        first_environment_index,
        episodes_per_trial,
        contexts: None,
    };
    vec![
        group(3, Version::Random, 5, 100, 2),
        SlotGroup { parameters: parameters(&[("length", &[(0.4, 0.5)])]), ..group(150, Version::Default, 5, 0, 0) },
        group(1, Version::Extreme, 6, u32::MAX, 1),
        group(1, Version::RandomOrExtreme, u64::MAX, 0, 3),
    ]
}

fn with(groups: Vec<SlotGroup>) -> Open {
    let (environment, autoreset_mode) = ("CartPole".into(), AutoresetMode::SameStep.into());
    Open { environment, autoreset_mode, receipts: true, reward_terms: true, groups, ..Open::default() }
}

/// Returns the part of a batch's reply for `size` slots from `first` on, renumbered from 0.
fn part(stepped: &Stepped, first: u32, size: u32) -> Stepped {
    let n = stepped.rewards.len() as u32 / 4;
    let rows = |bytes: &Bytes| {
        let each = bytes.len() as u32 / n;
        bytes.slice((first * each) as usize..((first + size) * each) as usize)
    };
    let ended = stepped.ended.iter().enumerate().filter(|(_, end)| (first..first + size).contains(&end.slot));
    let each = stepped.final_observations.len() / stepped.ended.len().max(1);
    let finals = ended.clone().flat_map(|(k, _)| stepped.final_observations[k * each..][..each].to_vec()).collect();
    let mut here = Stepped {
        observations: rows(&stepped.observations),
        rewards: rows(&stepped.rewards),
        terminated: rows(&stepped.terminated),
        truncated: rows(&stepped.truncated),
        reward_terms: rows(&stepped.reward_terms),
        final_observations: finals,
        ended: ended.map(|(_, end)| end.clone()).collect(),
        started: stepped.started.clone(),
        ..Stepped::default()
    };
    here.started.retain(|start| (first..first + size).contains(&start.slot));
    here.ended.iter_mut().for_each(|end| end.slot -= first);
    here.started.iter_mut().for_each(|start| start.slot -= first);
    here
}

#[tokio::test]
async fn group_gives_the_bytes_of_a_session_of_its_own() {
    let server = Server::start(&["--workers", "3"]);
    let (mut together, opened) = Session::open(server.unix(), with(groups())).await;
    assert!(opened.acts);
    let environment = opened.environment.as_ref().unwrap();
    let groups = groups();
    let mut alone = Vec::new();
    let mut first = 0;
    for group in &groups {
        let open = Open {
            version: group.version,
            parameters: group.parameters.clone(),
            batch_size: group.size,
            seed: group.seed,
            first_environment_index: group.first_environment_index,
            episodes_per_trial: group.episodes_per_trial,
            ..with(Vec::new())
        };
        let (session, own) = Session::open(server.unix(), open).await;
        let rows = first as usize * 16..(first + group.size) as usize * 16;
        assert_eq!(opened.observations.slice(rows), own.observations);
        let actor = Actor { environment, first: group.first_environment_index.into(), n: group.size as usize };
        alone.push((session, actor, first));
        first += group.size;
    }
    let mut ended = 0;
    for t in 0..250 {
        let actions: Vec<u8> = alone.iter().flat_map(|(_, actor, _)| actor.actions(t)).collect();
        let stepped = together.step(actions.into()).await;
        ended += stepped.ended.len();
        for (session, actor, first) in &mut alone {
            assert_eq!(part(&stepped, *first, actor.n as u32), session.step(actor.actions(t)).await);
        }
    }
    assert!(ended > 1000, "{ended} episodes ended");
}

#[tokio::test]
async fn parameters_of_r_and_e_replace_those_of_both() {
    let server = Server::start(&[]);
    let given = || parameters(&[("length", &[(0.3, 0.3)])]);
    let of = |parameters| Open { version: Version::RandomOrExtreme.into(), parameters, ..open("CartPole", 60, 4) };
    let (_, at_open) = Session::open(server.unix(), of(given())).await;
    let (mut session, _) = Session::open(server.unix(), of(Default::default())).await;
    let at_reset = session.ask(Reset { parameters: given(), ..Reset::default() }).await;
    for started in [at_open.started, at_reset.started] {
        let requested: Vec<Vec<f64>> = started.into_iter().map(|start| start.receipt.unwrap().requested).collect();
        assert!(requested.iter().all(|values| values[1] == 0.3));
        // Version R's force is within 5 … 15, version E's is not.
        let of_r = requested.iter().filter(|values| (5.0..15.0).contains(&values[0])).count();
        assert!((15..45).contains(&of_r), "{of_r} of 60");
        let mass_of_r = |values: &&Vec<f64>| (0.05..0.5).contains(&values[2]) == (5.0..15.0).contains(&values[0]);
        assert_eq!(requested.iter().filter(mass_of_r).count(), 60, "all parameters are of one version");
    }
}

fn spoiled(spoil: impl FnOnce(&mut Vec<SlotGroup>)) -> Open {
    let mut groups = groups();
    spoil(&mut groups);
    with(groups)
}

#[tokio::test]
async fn bad_groups_are_refused() {
    let server = Server::start(&["--max-envs", "200"]);
    let both = || with(groups());
    let opens = [
        Open { version: 1, ..both() },
        Open { parameters: parameters(&[("length", &[(0.4, 0.5)])]), ..both() },
        Open { batch_size: 155, ..both() },
        Open { seed: 1, ..both() },
        Open { first_environment_index: 1, ..both() },
        Open { episodes_per_trial: 1, ..both() },
        Open { contexts: Some(contexts(&["length"], &[0.5])), ..both() },
        spoiled(|groups| groups[1].size = 0),
        spoiled(|groups| groups[0].version = 0),
        spoiled(|groups| groups[0].version = 9),
        spoiled(|groups| groups[2].size = 2),
        spoiled(|groups| groups[3].parameters = parameters(&[("colour", &[(1.0, 1.0)])])),
        spoiled(|groups| groups[3].parameters = parameters(&[("length", &[(-1.0, 1.0)])])),
        spoiled(|groups| groups[1].size = 196),
        spoiled(|groups| groups[1].size = u32::MAX),
    ];
    let mut session = Session::connect(server.unix()).await;
    let mut lines = String::new();
    for open in opens {
        lines += &refusal(session.refused(open).await);
    }
    assert_snapshot!(lines);
    session.ask(with(groups())).await;
}

#[rstest]
#[tokio::test]
async fn release_leaves_the_other_environments_as_they_are(#[values("1", "3")] workers: &str) {
    const N: usize = 200;
    let server = Server::start(&["--workers", workers]);
    let asked = Open { autoreset_mode: AutoresetMode::SameStep.into(), ..open("CartPole", N as u32, 1) };
    let (mut session, opened) = Session::open(server.unix(), asked.clone()).await;
    let (mut twin, _) = Session::open(server.unix(), asked).await;
    let actor = Actor::new(opened.environment.as_ref().unwrap(), N);
    let mut stays: Vec<usize> = (0..N).collect();
    // Extracts the bytes of the environments that stay from the bytes of all environments.
    let of = |stays: &[usize], bytes: &Bytes| -> Bytes {
        let each = bytes.len() / N;
        stays.iter().flat_map(|slot| bytes[slot * each..][..each].to_vec()).collect()
    };
    for t in 0..120 {
        if t % 40 == 20 {
            let goes = |i: usize| (i as u64 + t).is_multiple_of(3);
            let mask: Vec<u8> = (0..stays.len()).map(|i| goes(i).into()).collect();
            session.ask(Release { mask: mask.into() }).await;
            let mut i = 0..;
            stays.retain(|_| !goes(i.next().unwrap()));
        }
        if t == 70 {
            let mask: Bytes = (0..N).map(|slot| u8::from(stays.contains(&slot))).collect();
            let twins = twin.ask(Reset { mask, ..Reset::default() }).await;
            assert_eq!(session.ask(Reset::default()).await.observations, twins.observations);
        }
        let (actions, whole) = (of(&stays, &actor.actions(t)), twin.step(actor.actions(t)).await);
        let stepped = session.step(actions).await;
        assert_eq!(stepped.observations, of(&stays, &whole.observations));
        assert_eq!(stepped.rewards, of(&stays, &whole.rewards));
        assert_eq!(stepped.terminated, of(&stays, &whole.terminated));
        assert_eq!(stepped.reward_terms, of(&stays, &whole.reward_terms));
        let expected = whole.ended.into_iter().filter_map(|end| {
            let slot = stays.iter().position(|&slot| slot == end.slot as usize)? as u32;
            Some(perturb::proto::EpisodeEnd { slot, ..end })
        });
        assert_eq!(stepped.ended, expected.collect::<Vec<_>>());
    }
    assert_eq!(floats(&session.step(of(&stays, &actor.actions(0))).await.rewards).len(), stays.len());
}

#[tokio::test]
async fn released_environments_make_room_at_once() {
    let server = Server::start(&["--max-envs", "10"]);
    let (mut session, _) = Session::open(server.unix(), open("CartPole", 10, 1)).await;
    let mut mask = vec![1; 10];
    mask[4] = 0;
    session.ask(Release { mask: mask.into() }).await;
    let (mut other, _) = Session::open(server.unix(), open("CartPole", 8, 1)).await;
    let (code, message) = Session::connect(server.unix()).await.refused(open("CartPole", 2, 1)).await;
    assert_eq!(code, Code::ResourceExhausted);
    assert!(message.starts_with("2 environments were asked for, but 9 of this server's 10 are in use"), "{message}");
    assert_eq!(session.step(vec![0; 4].into()).await.rewards.len(), 4);
    assert_eq!(other.step(vec![0; 32].into()).await.rewards.len(), 32);
    drop((session, other));
    until("all are free", async || {
        let mut session = Session::connect(server.unix()).await;
        matches!(session.answer(open("CartPole", 10, 1)).await, perturb::proto::session_response::Response::Opened(_))
    })
    .await;
}

#[rstest]
#[case(&[], "release.mask is all of the 3 environments; expected at least one environment to free and one to keep")]
#[case(&[1, 1, 1], "release.mask is all of the 3 environments")]
#[case(&[0, 0, 0], "release.mask is without a selected environment")]
#[case(&[1, 0], "release.mask is 2 bytes; expected one byte for each of the 3 environments")]
#[case(&[0, 1, 2], "release.mask is 2 in slot 2; expected 0 or 1")]
#[tokio::test]
async fn a_release_of_all_none_or_others_is_refused(#[case] mask: &'static [u8], #[case] words: &str) {
    let server = Server::start(&[]);
    let (mut session, _) = Session::open(server.unix(), open("CartPole", 3, 1)).await;
    let (code, message) = session.refused(Release { mask: Bytes::from_static(mask) }).await;
    assert_eq!(code, Code::InvalidArgument);
    assert!(message.starts_with(words), "{message}");
    assert_eq!(session.step(vec![0; 12].into()).await.rewards.len(), 12);
}

#[tokio::test]
async fn thousands_of_groups_with_parameters_fit_in_an_open() {
    let server = Server::start(&[]);
    let group = |seed| SlotGroup {
        size: 1,
        version: Version::Random.into(),
        parameters: parameters(&[("length", &[(0.4, 0.5)]), ("mass", &[(0.1, 0.2)]), ("force", &[(9.0, 10.0)])]),
        seed,
        ..SlotGroup::default()
    };
    let request = with((0..2_000).map(group).collect());
    let length = request.encoded_len();
    assert!((64 << 10..1 << 20).contains(&length), "{length} bytes");
    let (_, opened) = Session::open(server.tcp(), request).await;
    assert_eq!(opened.observations.len(), 2_000 * 4 * 4);
}
