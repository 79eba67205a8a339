//! Tests of the maximum length of replies that the server announces, with which clients avoid replies that are too long
//! for their gRPC library.

use crate::common::server::{Actor, Server, Session, catalogue, client, open, parameters};
use bytes::Bytes;
use perturb::proto::{
    AutoresetMode, ListEnvironmentsRequest, Open, Reset, Resume, SlotGroup, Snapshot, Step, Version,
    session_request::Request, session_response::Response,
};
use prost::Message;
use rstest::rstest;
use tonic::Code;

/// Asserts that `length` is at most `bound`, and that the bound is not many times larger.
fn is_tight(what: &str, length: usize, bound: u64) {
    let length = length as u64;
    assert!(length <= bound, "{what}: {length} bytes are more than {bound}");
    assert!(bound < 3 * length + 1024, "{what}: {bound} is far from {length}");
}

#[rstest]
#[case::plain(false, false)]
#[case::messages(true, false)]
#[case::arrays(true, true)]
#[tokio::test]
async fn the_longest_step_is_within_the_bound_and_near(
    #[case] receipts: bool,
    #[case] receipt_arrays: bool,
    #[values(AutoresetMode::NextStep, AutoresetMode::SameStep)] mode: AutoresetMode,
    #[values(false, true)] observe_parameters: bool,
) {
    const N: u32 = 300;
    let server = Server::start(&[]);
    // Only the step limit ends these episodes, so all end in the same step.
    let asked = Open {
        receipts,
        receipt_arrays,
        observe_parameters,
        autoreset_mode: mode.into(),
        ..open("MountainCar", N, u64::MAX)
    };
    let (mut session, opened) = Session::open(server.unix(), asked).await;
    let bound = opened.max_step_reply_bytes;
    let mut longest = 0;
    for _ in 0..201 {
        let stepped = session.ask(Step { actions: [1_u8, 0, 0, 0].repeat(N as usize).into() }).await;
        longest = longest.max(stepped.encoded_len());
    }
    is_tight("step", longest, bound);
    let reset = session.ask(Reset::default()).await.encoded_len() as u64;
    assert!(reset <= bound, "reset: {reset} bytes are more than {bound}");
}

#[tokio::test]
async fn every_environment_keeps_its_bounds() {
    const N: usize = 9;
    let server = Server::with_folders(&[]);
    for environment in &catalogue(server.unix()).await {
        let asked = Open { autoreset_mode: AutoresetMode::SameStep.into(), ..open(&environment.name, N as u32, 3) };
        let (mut session, opened) = Session::open(server.unix(), asked).await;
        let actor = Actor::new(environment, N);
        for t in 0..u64::from(environment.step_limit.min(300)) {
            let length = session.step(actor.actions(t)).await.encoded_len() as u64;
            assert!(length <= opened.max_step_reply_bytes, "{}: {length}", environment.name);
        }
        let saved: usize = session.snapshot(&[]).await.iter().map(|snapshot| snapshot.len() + 3).sum();
        is_tight(&environment.name, saved, opened.max_snapshot_reply_bytes);
    }
}

#[tokio::test]
async fn the_bound_of_snapshots_holds_for_the_largest_group() {
    let server = Server::start(&[]);
    let intervals: Vec<_> = (0..40).map(|i| (5.0 + f64::from(i) / 10.0, 5.05 + f64::from(i) / 10.0)).collect();
    let group = |version: Version, seed| SlotGroup { size: 2, version: version.into(), seed, ..SlotGroup::default() };
    let wide = SlotGroup {
        parameters: parameters(&[("force", &intervals)]),
        first_environment_index: u32::MAX - 1,
        ..group(Version::RandomOrExtreme, u64::MAX)
    };
    let groups = vec![group(Version::Default, 0), wide];
    let asked = Open { groups, batch_size: 0, seed: 0, version: 0, ..open("CartPole", 0, 0) };
    let (mut session, opened) = Session::open(server.unix(), asked).await;
    let longest = session.snapshot(&[]).await.iter().map(Bytes::len).max().unwrap();
    is_tight("snapshot", 4 * (longest + 3), opened.max_snapshot_reply_bytes);
}

#[tokio::test]
async fn a_lease_rescues_a_session_whose_reply_was_too_long() {
    const N: u32 = 400;
    const LIMIT: usize = 40_000;
    let server = Server::start(&[]);
    let mut limited = client(server.tcp()).await.max_decoding_message_size(LIMIT);
    let mut session = Session::start(&mut limited).await.unwrap();
    let opened = session.ask(Open { lease: 1, receipts: false, ..open("CartPole", N, 1) }).await;
    assert!(opened.max_snapshot_reply_bytes > LIMIT as u64);
    session.send(Request::Snapshot(Snapshot::default())).await;
    assert_eq!(session.receive().await.unwrap_err().code(), Code::OutOfRange);
    drop(session);
    let mut session = Session::connect(server.tcp()).await;
    assert_eq!(session.ask(Resume { lease: opened.lease, last_reply: 0 }).await.last_reply, 1);
    let reply = session.receive().await.unwrap().and_then(|reply| reply.response);
    assert!(matches!(reply, Some(Response::Snapshot(saved)) if saved.snapshots.len() == N as usize));
}

#[rstest]
#[case::with_leases(&[], true)]
#[case::without_leases(&["--lease-seconds", "0"], false)]
#[tokio::test]
async fn the_catalogue_names_what_the_server_knows(#[case] flags: &[&str], #[case] leases: bool) {
    let server = Server::start(flags);
    let listing = client(server.unix()).await.list_environments(ListEnvironmentsRequest {}).await.unwrap();
    let features = listing.into_inner().features;
    assert!(features.is_sorted());
    assert_eq!(features.iter().any(|name| name == "lease"), leases);
    let page = include_str!("../../docs/protocol.md");
    let (_, table) = page.split_once("| feature | the server supports |\n|---|---|\n").unwrap();
    let row = |line: &'static str| line.strip_prefix("| `")?.split('`').next();
    let documented: Vec<_> = table.lines().map_while(row).filter(|&name| leases || name != "lease").collect();
    assert_eq!(features, documented, "docs/protocol.md lists the features");
}
