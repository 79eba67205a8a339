//! The ledger records every draw.

use super::{
    connect, logged,
    tokens::{ANN, BOB, Guarded, entry},
};
use crate::{
    common::server::{Server, channel, command, contexts, open, until, within},
    dm_env_rpc::client::{Agent, Settings, choice, create, double, reset_world, settings, text, uint64},
    metrics::Page,
};
use perturb::proto::{
    AutoresetMode, Open, Release, Reset, Restore, Snapshot, Step, dm_env_rpc::v1::environment_client::EnvironmentClient,
};
use perturb_faults::disk;
use perturb_protocol::{
    Stream,
    ledger::{DrawEnd, DrawRecord, DrawStart, LedgerEntry, LedgerEvent, read},
};
use rstest::rstest;
use std::path::Path;
use tonic::Code;

fn entries(path: &Path) -> Vec<LedgerEntry> {
    let mut entries = Vec::new();
    read(path, |entry, _| entries.push(entry)).unwrap();
    entries
}

fn draws(path: &Path) -> Vec<DrawRecord> {
    let of = |entry: LedgerEntry| match entry.event {
        LedgerEvent::Draws(draws) => Some(draws),
        _ => None,
    };
    entries(path).into_iter().filter_map(of).collect()
}

async fn steps(session: &mut Stream, envs: usize, count: usize) {
    for _ in 0..count {
        super::steps(session, envs).await.unwrap();
    }
}

#[tokio::test]
async fn equal_draws_of_successive_environments_are_one_entry() {
    let guarded = Guarded::start(&entry("ann", ANN, ""));
    let request = Open { first_environment_index: 5, ..open("CartPole", 4, 7) };
    let (mut session, _) = within(Stream::open(&guarded.connect(ANN).await, request)).await.unwrap();
    within(session.ask(Reset { seeds: vec![11; 4], ..Reset::default() })).await.unwrap();
    let line = draws(&guarded.directory.path().join("ledger")).pop().unwrap();
    assert_eq!(line.begins, [DrawStart { seed: 11, index: 5, count: 4, region: 0, episode: 0 }]);
    assert_eq!(line.ends, [DrawEnd { seed: 7, index: 5, count: 4, episode: Some(0) }]);
}

#[tokio::test]
async fn ledger_has_every_context() {
    let guarded = Guarded::start(&entry("ann", ANN, ""));
    let lengths: Vec<f64> = (0..6).map(|row| 0.3 + f64::from(row) / 64.0).collect();
    let request = Open { contexts: Some(contexts(&["length"], &lengths)), ..open("CartPole", 4, 7) };
    let (mut session, _) = within(Stream::open(&guarded.connect(ANN).await, request)).await.unwrap();
    let path = guarded.directory.path().join("ledger");
    let line = draws(&path).pop().unwrap();
    assert_eq!((line.regions.len(), line.begins[0].count), (1, 4));
    let drawn: Vec<f64> =
        line.regions[0].boxes().iter().map(|values| values["length"].fixed_value().unwrap()).collect();
    assert_eq!(drawn, lengths);
    let region = line.regions[0].to_string();
    assert!(region.ends_with("or force [5, 15], length 0.346875, mass [0.05, 0.5], or 2 others"), "{region}");

    // A restored environment draws from the contexts in its snapshot.
    let snapshots = within(session.ask(Snapshot::default())).await.unwrap().snapshots;
    within(session.ask(Restore { snapshots, ..Restore::default() })).await.unwrap();
    assert_eq!(draws(&path).pop().unwrap().regions, line.regions);
}

#[tokio::test]
async fn ledger_has_draws_before_they_happen_and_their_ends() {
    let guarded = Guarded::start(&entry("ann", ANN, ""));
    let path = guarded.directory.path().join("ledger");
    let ann = guarded.connect(ANN).await;
    let request = Open { first_environment_index: 5, ..open("CartPole", 4, 7) };
    let (mut session, _) = within(Stream::open(&ann, request)).await.unwrap();
    let first = draws(&path);
    assert_eq!(first[0].begins, [DrawStart { seed: 7, index: 5, count: 4, region: 0, episode: 0 }]);
    assert_eq!(first[0].who.token.as_deref(), Some("ann"));
    assert_eq!((first[0].who.environment.as_str(), first[0].regions.len(), first[0].ends.len()), ("CartPole", 1, 0));
    let region = first[0].regions[0].to_string();
    assert_eq!(region, "force [5, 15], length [0.25, 0.75], mass [0.05, 0.5]");

    // Pushing to the left ends every episode within ten steps or so.
    steps(&mut session, 4, 60).await;
    within(session.ask(Reset { mask: vec![0, 0, 0, 1].into(), seeds: vec![9], ..Reset::default() })).await.unwrap();
    within(session.ask(Reset::default())).await.unwrap();
    let reset = draws(&path).pop().unwrap();
    assert_eq!(reset.begins, [DrawStart { seed: 9, index: 8, count: 1, region: 0, episode: 0 }]);
    assert!(
        matches!(reset.ends[..], [DrawEnd { seed: 7, index: 8, count: 1, episode: Some(2..) }]),
        "{:?}",
        reset.ends
    );
    assert_eq!(draws(&path).len(), 2, "an empty reset draws on");

    within(session.ask(Release { mask: vec![1, 0, 0, 0].into() })).await.unwrap();
    until("the release is there", async || draws(&path).len() == 3).await;
    assert!(matches!(draws(&path)[2].ends[..], [DrawEnd { seed: 7, index: 5, count: 1, episode: Some(3..) }]));
    drop(session);
    until("its end is there", async || draws(&path).len() == 4).await;
    let end = draws(&path).pop().unwrap();
    let of_nine = end.ends.iter().find(|end| end.seed == 9).unwrap();
    assert_eq!((of_nine.index, of_nine.episode, end.begins.len()), (8, Some(1), 0));
    assert_eq!(end.ends.iter().map(|end| end.count).sum::<u32>(), 3);
}

#[tokio::test]
async fn refusals_are_written_down_and_a_server_that_ends_says_so() {
    let role = "[[role]]\nname = \"train\"\ndraws = [\"D\"]\n";
    let mut guarded = Guarded::start(&(entry("ann", ANN, "role = \"train\"") + &entry("bob", BOB, "") + role));
    let path = guarded.directory.path().join("ledger");
    let ann = guarded.connect(ANN).await;
    assert!(within(Stream::open(&ann, open("CartPole", 1, 1))).await.is_err());
    let bob = guarded.connect(BOB).await;
    drop(within(Stream::open(&bob, open("CartPole", 1, 1))).await.unwrap());
    drop((ann, bob));
    guarded.server.signal("TERM");
    assert!(guarded.server.ended().await.success());
    let entries = entries(&path);
    let kinds: Vec<&str> = entries
        .iter()
        .map(|entry| match &entry.event {
            LedgerEvent::Began { .. } => "began",
            LedgerEvent::Refused { who, .. } => who.token.as_deref().unwrap(),
            LedgerEvent::Draws(draws) if draws.ends.is_empty() => "begins",
            LedgerEvent::Draws(_) => "ends",
            LedgerEvent::Ended => "ended",
        })
        .collect();
    assert_eq!(kinds, ["began", "ann", "begins", "ends", "ended"]);
    assert!(guarded.server.log().contains("head="), "{}", guarded.server.log());

    // Another server continues the ledger, but refuses a ledger that was changed.
    let flags = ["--ledger", path.to_str().unwrap()];
    let server = Server::start(&flags);
    assert_eq!(self::entries(&path).len(), 6);
    let second = command().args(flags).args(["--listen", "tcp://127.0.0.1:0"]).output().unwrap();
    let words = String::from_utf8(second.stderr).unwrap();
    assert!(words.contains("another server is writing to it") && second.status.code() == Some(2), "{words}");
    drop(server);
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replacen("bob", "eve", 1)).unwrap();
    let third = command().args(flags).args(["--listen", "tcp://127.0.0.1:0"]).output().unwrap();
    let words = String::from_utf8(third.stderr).unwrap();
    assert!(words.contains("line 3") && words.contains("was changed") && third.status.code() == Some(2), "{words}");
}

#[tokio::test]
async fn nothing_is_drawn_that_cannot_be_written_down() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("ledger");
    // Limits the size of the server's files in blocks, which has the same effect as a full disk.
    let limited = |blocks: u32, path: &Path| {
        let mut server = command();
        server.arg("--ledger").arg(path).args(["--listen", "tcp://127.0.0.1:0"]);
        disk::with_file_limit(&server, blocks)
    };
    for (mut command, part) in
        [(limited(0, &path), "File too large"), (limited(9, Path::new("/dev/full")), "regular file")]
    {
        let server = command.output().unwrap();
        let words = String::from_utf8(server.stderr).unwrap();
        assert!(words.contains("--ledger") && words.contains(part) && server.status.code() == Some(2), "{words}");
    }
    let server = Server::spawn(limited(8, &path), directory, 1);
    let connection = connect(server.tcp(), &[]).await.unwrap();
    let mut sessions = Vec::new();
    let refusal = loop {
        match within(Stream::open(&connection, open("CartPole", 1, 1))).await {
            Ok((session, _)) => sessions.push(session),
            Err(error) => break error.to_string(),
        }
        assert!(sessions.len() < 100, "all were written down");
    };
    assert!(refusal.contains("must record each draw in its ledger, and cannot") && !sessions.is_empty(), "{refusal}");
    for session in &mut sessions {
        super::steps(session, 1).await.expect("what is drawn already goes on");
    }
    assert_eq!(draws(&path).len(), sessions.len(), "no half of a line is there");
}

#[tokio::test]
async fn worlds_are_in_the_ledger_and_under_roles_too() {
    let role = "[[role]]\nname = \"train\"\ndraws = [\"D\"]\n";
    let guarded = Guarded::start(&(entry("ann", ANN, "role = \"train\"") + role));
    let path = guarded.directory.path().join("ledger");
    let mut client = EnvironmentClient::new(channel(guarded.server.tcp()).await);
    let mut agent = Agent::show(&mut client, Some(ANN)).await.unwrap();
    let of = |version: &str| settings("CartPole", [("version", text(version)), ("seed", uint64(3))]);
    let (code, words) = agent.refused(create(of("E"))).await;
    assert!(code == Code::PermissionDenied && words.contains("role \"train\""), "{words}");
    let world = agent.create(of("D")).await;
    agent.join(&world).await;
    for wrong in [("length", double(0.9)), ("version", text("E"))] {
        let (code, _) = agent.refused(reset_world(&world, Settings::from([(wrong.0.into(), wrong.1)]))).await;
        assert_eq!(code, Code::PermissionDenied);
    }
    agent.step(choice(0)).await;
    agent.reset_world(&world, Settings::from([("seed".into(), uint64(4))])).await;
    agent.step(choice(0)).await;
    drop(agent);
    until("its end is there", async || draws(&path).len() == 3).await;
    let lines = draws(&path);
    assert_eq!(lines[0].begins, [DrawStart { seed: 3, index: 0, count: 1, region: 0, episode: 0 }]);
    assert_eq!(lines[1].begins, [DrawStart { seed: 4, index: 0, count: 1, region: 0, episode: 0 }]);
    assert_eq!(lines[1].ends, [DrawEnd { seed: 3, index: 0, count: 1, episode: Some(0) }]);
    assert_eq!(lines[2].ends, [DrawEnd { seed: 4, index: 0, count: 1, episode: Some(0) }]);
    let refused = |entry: &&LedgerEntry| matches!(entry.event, LedgerEvent::Refused { .. });
    assert_eq!(entries(&path).iter().filter(refused).count(), 3);
}

#[tokio::test]
async fn ledger_withdraws_draws_that_did_not_happen() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("ledger");
    let server = Server::start(&["--ledger", path.to_str().unwrap(), "--max-envs", "2"]);
    let connection = connect(server.tcp(), &[]).await.unwrap();
    let (mut session, _) = within(Stream::open(&connection, open("CartPole", 2, 1))).await.unwrap();
    assert!(within(Stream::open(&connection, open("CartPole", 1, 9))).await.is_err(), "the server is full");
    until("it is taken back", async || draws(&path).len() == 3).await;
    assert_eq!(draws(&path)[2].ends, [DrawEnd { seed: 9, index: 0, count: 1, episode: None }]);

    // Takes a snapshot of an ended episode. A session in same-step mode refuses such a snapshot.
    drop(session);
    until("there is room", async || draws(&path).len() == 4).await;
    let disabled = Open { autoreset_mode: AutoresetMode::Disabled.into(), ..open("CartPole", 1, 5) };
    let (mut ended, _) = within(Stream::open(&connection, disabled)).await.unwrap();
    while within(ended.ask(Step { actions: vec![0; 4].into() })).await.unwrap().ended.is_empty() {}
    let snapshots = within(ended.ask(Snapshot::default())).await.unwrap().snapshots;
    drop(ended);
    until("there is room again", async || draws(&path).len() == 6).await;
    let same_step = Open { autoreset_mode: AutoresetMode::SameStep.into(), ..open("CartPole", 1, 6) };
    (session, _) = within(Stream::open(&connection, same_step)).await.unwrap();
    assert!(within(session.ask(Restore { snapshots, ..Restore::default() })).await.is_err());
    until("it goes on as before", async || draws(&path).len() == 9).await;
    let last = draws(&path).pop().unwrap();
    assert_eq!(last.ends, [DrawEnd { seed: 5, index: 0, count: 1, episode: None }]);
    assert_eq!(last.begins, [DrawStart { seed: 6, index: 0, count: 1, region: 0, episode: 0 }]);
}

#[derive(Clone, Copy, Debug)]
enum Tampering {
    Deleted,
    Replaced,
    Truncated,
    Lengthened,
}

#[rstest]
#[case::deleted(Tampering::Deleted, "the file is gone")]
#[case::replaced(Tampering::Replaced, "another file has taken its place")]
#[case::truncated(Tampering::Truncated, "the file has 10 bytes, but the server wrote")]
#[case::lengthened(Tampering::Lengthened, "bytes, but the server wrote")]
#[tokio::test]
async fn a_ledger_that_was_tampered_with_is_noticed(#[case] tampering: Tampering, #[case] part: &str) {
    let directory = tempfile::tempdir().unwrap();
    let (path, aside) = (directory.path().join("ledger"), directory.path().join("aside"));
    let metrics = directory.path().join("metrics");
    let flags = ["--ledger", path.to_str().unwrap(), "--metrics", &format!("unix:{}", metrics.display())];
    let server = Server::start(&flags);
    let connection = connect(server.tcp(), &[]).await.unwrap();
    let (mut session, _) = within(Stream::open(&connection, open("CartPole", 1, 1))).await.unwrap();
    let whole = std::fs::read(&path).unwrap();
    match tampering {
        Tampering::Deleted => std::fs::rename(&path, &aside).unwrap(),
        Tampering::Replaced => {
            std::fs::rename(&path, &aside).unwrap();
            std::fs::write(&path, &whole).unwrap();
        }
        Tampering::Truncated => std::fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(10).unwrap(),
        Tampering::Lengthened => std::fs::write(&path, [&whole[..], b"x"].concat()).unwrap(),
    }
    logged(&server, part).await;
    assert_eq!(Page::scrape(&metrics).number("perturb_ledger_intact"), 0.0);
    let refusal = within(Stream::open(&connection, open("CartPole", 1, 2))).await.unwrap_err().to_string();
    assert!(refusal.contains("must record each draw in its ledger, and cannot") && refusal.contains(part), "{refusal}");
    super::steps(&mut session, 1).await.expect("what is drawn already goes on");
    // After the file is restored, the server continues to write it.
    match tampering {
        Tampering::Deleted | Tampering::Replaced => std::fs::rename(&aside, &path).unwrap(),
        Tampering::Truncated | Tampering::Lengthened => std::fs::write(&path, &whole).unwrap(),
    }
    logged(&server, "is intact again").await;
    let (other, _) = within(Stream::open(&connection, open("CartPole", 1, 3))).await.unwrap();
    assert_eq!(Page::scrape(&metrics).number("perturb_ledger_intact"), 1.0);
    assert!(Page::scrape(&metrics).number("perturb_ledger_bytes") > whole.len() as f64);
    drop((other, session));
    read(&path, |_, _| {}).expect("the chain is whole");
}

#[test]
fn a_file_that_is_no_ledger_is_left_as_it_is() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("token");
    for text in ["correct-horse-battery", "{}\n", "a\nb"] {
        std::fs::write(&path, text).unwrap();
        let refused = command().arg("--ledger").arg(&path).args(["--listen", "tcp://127.0.0.1:0"]).output().unwrap();
        let words = String::from_utf8(refused.stderr).unwrap();
        assert!(words.contains("--ledger") && words.contains("not a ledger"), "{words}");
        assert_eq!((refused.status.code(), std::fs::read_to_string(&path).unwrap().as_str()), (Some(2), text));
    }
}
