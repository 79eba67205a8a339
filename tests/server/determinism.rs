//! A session gives the same bytes for every number of threads, every transport, and every split of the batch.

use crate::common::server::{Actor, Server, Session, catalogue, open, stepped};
use perturb::proto::{EpisodeEnd, EpisodeStart, Open, Reset, SessionResponse, Stepped, session_response::Response};
use prost::Message;
use sha2::{Digest, Sha256};
use std::io::Write;

const STEPS: u64 = 2_000;
const BATCH: u32 = 8;

/// Returns all responses to the same requests: open, steps, snapshot, reset.
async fn transcript(address: &str, open: Open, actor: Actor<'_>, steps: u64) -> Vec<SessionResponse> {
    let (mut session, opened) = Session::open(address, open).await;
    let mut all = vec![SessionResponse { response: Some(Response::Opened(opened)) }];
    all.extend(session.play(actor, 0, steps).await);
    for snapshot in session.snapshot(&[]).await {
        all.push(SessionResponse {
            response: Some(Response::Snapshot(perturb::proto::Snapshotted { snapshots: vec![snapshot] })),
        });
    }
    all.push(SessionResponse { response: Some(Response::Reset(session.ask(Reset::default()).await)) });
    all
}

fn hash(responses: &[SessionResponse]) -> String {
    let mut hash = Sha256::new();
    responses.iter().for_each(|response| hash.update(response.encode_length_delimited_to_vec()));
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

#[tokio::test]
async fn bytes_depend_neither_on_threads_nor_on_the_transport() {
    let one = Server::with_folders(&["--workers", "1"]);
    let four = Server::with_folders(&["--workers", "4", "--transport-threads", "2"]);
    let places = [
        ("1 worker, TCP", one.tcp()),
        ("1 worker, Unix socket", one.unix()),
        ("4 workers, TCP", four.tcp()),
        ("4 workers, Unix socket", four.unix()),
    ];
    for environment in &catalogue(one.tcp()).await {
        let name = &environment.name;
        let mut hashes = Vec::new();
        for (place, address) in places {
            let actor = Actor::new(environment, BATCH as usize);
            let responses = transcript(address, open(name, BATCH, 42), actor, STEPS).await;
            let ended: usize = responses.iter().skip(1).take(STEPS as usize).map(|r| stepped(r).ended.len()).sum();
            assert!(ended >= BATCH as usize, "{name}: only {ended} episodes ended: too little was compared");
            hashes.push((place, hash(&responses)));
        }
        // The line is written to standard error directly, because the test harness hides the output of tests that pass.
        writeln!(std::io::stderr(), "{name}, {STEPS} steps of {BATCH}: SHA-256 {}", hashes[0].1).unwrap();
        assert!(hashes.iter().all(|(_, hash)| *hash == hashes[0].1), "{name}: {hashes:#?}");
    }
}

#[tokio::test]
async fn bytes_do_not_depend_on_how_many_shards_a_batch_has() {
    // The batch is large enough to be cut into shards, and one worker cuts it differently than three workers.
    const BATCH: u32 = 1200;
    let (one, three) = (Server::with_folders(&["--workers", "1"]), Server::with_folders(&["--workers", "3"]));
    for environment in &catalogue(one.tcp()).await {
        let actor = Actor::new(environment, BATCH as usize);
        let mut hashes = Vec::new();
        for address in [one.unix(), three.unix()] {
            hashes.push(hash(&transcript(address, open(&environment.name, BATCH, 7), actor, 60).await));
        }
        assert_eq!(hashes[0], hashes[1], "{}", environment.name);
    }
}

#[tokio::test]
async fn other_sessions_on_the_same_server_change_nothing() {
    let server = Server::with_folders(&["--workers", "2", "--transport-threads", "2"]);
    for environment in &catalogue(server.tcp()).await {
        let actor = Actor::new(environment, BATCH as usize);
        let run = || transcript(server.unix(), open(&environment.name, BATCH, 3), actor, 300);
        let alone = hash(&run().await);
        let (a, b, c) = tokio::join!(run(), run(), run());
        assert_eq!([&a, &b, &c].map(|responses| hash(responses)), [(); 3].map(|()| alone.clone()));
    }
}

#[tokio::test]
async fn a_batch_split_over_two_servers_equals_the_whole() {
    const FIRST: usize = 3;
    let (left, right) = (Server::with_folders(&["--workers", "1"]), Server::with_folders(&["--workers", "2"]));
    for environment in &catalogue(left.tcp()).await {
        let part = |first: usize, n: usize| {
            let open = Open { first_environment_index: first as u32, ..open(&environment.name, n as u32, 11) };
            (open, Actor { environment, first: first as u64, n })
        };
        let n = BATCH as usize;
        let ((a_open, a), (b_open, b), (whole_open, whole)) = (part(0, FIRST), part(FIRST, n - FIRST), part(0, n));
        let a = transcript(left.tcp(), a_open, a, 1_100).await;
        let b = transcript(right.unix(), b_open, b, 1_100).await;
        let whole = transcript(right.tcp(), whole_open, whole, 1_100).await;
        for (t, ((a, b), whole)) in a.iter().zip(&b).zip(&whole).enumerate().skip(1).take(1_100) {
            assert_eq!(joined(stepped(a), stepped(b), FIRST as u32), *stepped(whole), "{}, step {t}", environment.name);
        }
    }
}

/// Joins the results of two parts of a batch to the result of the whole batch. `second` is the first slot of the second
/// part.
fn joined(a: &Stepped, b: &Stepped, second: u32) -> Stepped {
    let both = |field: fn(&Stepped) -> &bytes::Bytes| [&field(a)[..], &field(b)[..]].concat().into();
    let ended = b.ended.iter().cloned().map(|e| EpisodeEnd { slot: e.slot + second, ..e });
    let started = b.started.iter().cloned().map(|s| EpisodeStart { slot: s.slot + second, ..s });
    Stepped {
        observations: both(|s| &s.observations),
        rewards: both(|s| &s.rewards),
        terminated: both(|s| &s.terminated),
        truncated: both(|s| &s.truncated),
        final_observations: both(|s| &s.final_observations),
        reward_terms: both(|s| &s.reward_terms),
        ended: a.ended.iter().cloned().chain(ended).collect(),
        started: a.started.iter().cloned().chain(started).collect(),
        ..Stepped::default()
    }
}
