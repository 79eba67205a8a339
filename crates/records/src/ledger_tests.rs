//! Tests of the audit with artificial ledgers.

use std::path::{Path, PathBuf};

use perturb_protocol::Version::*;
use perturb_protocol::ledger::{Chain, DrawEnd, DrawRecord, DrawStart, LedgerEvent, LedgerSession};
use perturb_protocol::region::Region;
use perturb_protocol::{Version, proto};
use perturb_settings::TrainConfig;
use toml::Table;

use crate::fixture;
use crate::ledger::{Ledgers, Proof};
use crate::records::{RecordedTest, Records, RecordsMetadata};

fn environment() -> proto::Environment {
    let drawn = |low, high| Some(proto::Distribution { intervals: vec![proto::Interval { low, high }] });
    let length = proto::Parameter {
        name: "length".into(),
        default_value: 1.0,
        random: drawn(0.5, 2.0),
        extreme: drawn(3.0, 4.0),
        ..Default::default()
    };
    proto::Environment { name: "CartPole".into(), parameters: vec![length], ..Default::default() }
}

/// Audits a training on version R with seed 1, 100 episodes and two environments. The policy's tests on R and E have
/// seed 7, and one episode each: environment 0, episode 5.
fn prove(ledgers: &Ledgers) -> Proof {
    let table: Table = toml::from_str("environment = 'CartPole'\nversion = 'R'\nseed = 1\nnum_envs = 2").unwrap();
    let training = TrainConfig::load(None, &[], table).unwrap().common;
    let mut records = Records::new(RecordsMetadata::new(&environment(), "policy".into(), 1));
    for version in [R, E] {
        let mut episode = fixture::episode(&version.to_string(), 0, 1.0, 9, true);
        (episode.seed, episode.environment_index, episode.episode_index) = (7, 0, 5);
        records.add(RecordedTest { set: version.into(), seed: 7, axes: None }, vec![episode]);
    }
    ledgers.prove(&training, 100, &environment(), &records)
}

fn written(directory: &Path, name: &str, events: &[LedgerEvent]) -> PathBuf {
    let (path, mut chain) = (directory.join(name), Chain::default());
    let began = LedgerEvent::Began { version: "0.1.0".into(), commit: name.into(), unfinished: 0 };
    let events = std::iter::once(&began).chain(events);
    let text: String = (0..).zip(events).map(|(time, event)| chain.add(event, 1000 * time).unwrap()).collect();
    std::fs::write(&path, text).unwrap();
    path
}

fn proof(events: &[LedgerEvent]) -> Proof {
    let directory = tempfile::tempdir().unwrap();
    let path = written(directory.path(), "ledger", events);
    prove(&Ledgers::read(&[path], &[]).unwrap())
}

fn who(session: u64, token: &str) -> LedgerSession {
    LedgerSession { session, token: Some(token.into()), environment: "CartPole".into(), revision: 1 }
}

/// Returns the record of a session in which `count` environments, from `index` on, begin to draw parameters from
/// `version` at episode `episode`.
fn begins(
    session: u64,
    token: &str,
    version: Version,
    (seed, index, count, episode): (u64, u32, u32, u64),
) -> LedgerEvent {
    let region = Region::from_version(&environment(), version, &Default::default());
    let begins = vec![DrawStart { seed, index, count, region: 0, episode }];
    LedgerEvent::Draws(DrawRecord { who: who(session, token), regions: vec![region], begins, ends: Vec::new() })
}

/// Returns the record of a session in which `count` environments, from `index` on, stop drawing parameters. Their last
/// episode was `episode`.
fn ends(session: u64, token: &str, (seed, index, count, episode): (u64, u32, u32, u64)) -> LedgerEvent {
    let ends = vec![DrawEnd { seed, index, count, episode: Some(episode) }];
    LedgerEvent::Draws(DrawRecord { who: who(session, token), regions: Vec::new(), begins: Vec::new(), ends })
}

/// Returns the ledger's events of the training, with ann's token.
fn trained() -> [LedgerEvent; 2] {
    [begins(0, "ann", R, (1, 0, 2, 0)), ends(0, "ann", (1, 0, 2, 49))]
}

/// Asserts that the audit has exactly one finding, and that its description contains `part`.
#[track_caller]
fn says(proof: &Proof, part: &str) {
    assert!(proof.against.len() == 1 && proof.against[0].contains(part), "{proof:?}");
}

#[test]
fn a_training_that_drew_only_from_its_distribution_is_clean() {
    let [begun, ended] = trained();
    let neighbours = [begins(1, "bob", E, (9, 0, 9, 0)), begins(2, "bob", R, (7, 0, 9, 0))];
    let afterwards = begins(3, "ann", E, (9, 0, 1, 0));
    let found = proof(&[&neighbours[..], &[begun, ended, afterwards]].concat());
    assert!(found.against.is_empty() && found.sessions == 1, "{found:?}");
    assert!(found.tokens.iter().eq([&Some("ann".to_owned())]));
}

#[test]
fn early_draws_from_test_sets_count_against_a_policy() {
    let [begun, ended] = trained();
    let with = |event: LedgerEvent| proof(&[begun.clone(), event, ended.clone()]);
    says(&with(begins(1, "ann", E, (9, 0, 1, 0))), "line 3 of ");
    says(&with(begins(1, "ann", RE, (9, 0, 1, 0))), "of the test set E, had been drawn");
    // The tests on R and E both have seed 7, so this draw has the episodes of both.
    assert_eq!(with(begins(1, "ann", R, (7, 0, 1, 0))).against.len(), 2);
    for (seed, index, count, episode) in [(7, 1, 9, 0), (7, 0, 1, 6), (8, 0, 9, 0)] {
        assert!(with(begins(1, "ann", R, (seed, index, count, episode))).against.is_empty(), "another episode");
    }
    let few = [begun.clone(), begins(1, "ann", R, (7, 0, 1, 0)), ends(1, "ann", (7, 0, 1, 4)), ended.clone()];
    assert!(proof(&few).against.is_empty(), "it ended before that episode");
}

#[test]
fn a_training_that_is_not_there_or_not_whole_is_not_believed() {
    says(&proof(&[]), "record only 0 of the 100 episodes of its training (CartPole, seed 1, trained on R)");
    says(&proof(&[begins(0, "ann", R, (1, 0, 2, 0)), ends(0, "ann", (1, 0, 2, 48))]), "record only 98 of the ");
    says(&proof(&[begins(0, "ann", D, (1, 0, 2, 0)), ends(0, "ann", (1, 0, 2, 99))]), "record only 0 of the ");
    let elsewhere = [begins(0, "ann", R, (1, 2, 2, 0)), ends(0, "ann", (1, 2, 2, 99))];
    says(&proof(&elsewhere), "record only 0 of the ");
}

#[test]
fn a_session_without_an_end_lasts_as_long_as_its_server() {
    let leak = begins(1, "ann", E, (9, 0, 1, 0));
    let [begun, _] = trained();
    let again = LedgerEvent::Began { version: "0.1.0".into(), commit: "0".into(), unfinished: 3 };
    says(&proof(&[begun.clone(), leak.clone(), again.clone()]), "of the test set E");
    assert!(proof(&[begun.clone(), again.clone(), leak.clone()]).against.is_empty(), "its server had ended by then");
    says(&proof(&[begun.clone(), leak.clone()]), "of the test set E");
    // A session 0 of another server process is a different session.
    let other = [begun, again, begins(0, "bob", E, (9, 0, 1, 0)), ends(0, "bob", (1, 0, 2, 0))];
    assert!(proof(&other).against.is_empty());
}

#[test]
fn sessions_on_several_servers_are_found_in_all_their_ledgers() {
    let directory = tempfile::tempdir().unwrap();
    let half = |index| [begins(0, "ann", R, (1, index, 1, 0)), ends(0, "ann", (1, index, 1, 49))];
    let paths = [written(directory.path(), "one", &half(0)), written(directory.path(), "two", &half(1))];
    let both = Ledgers::read(&paths, &[]).unwrap();
    let digests: Vec<String> = both.heads().iter().map(|head| head.digest.clone()).collect();
    assert!(prove(&both).against.is_empty());
    says(&prove(&Ledgers::read(&paths[..1], &digests[..1]).unwrap()), "record only 50 of the ");
    let missing = Ledgers::read(&paths[..1], &digests).unwrap_err();
    assert!(missing.contains(&digests[1]), "{missing}");
}

#[test]
fn an_end_belongs_to_open_draws_and_not_to_later_ones() {
    let [begun, ended] = trained();
    // The same environment begins twice to draw parameters. Its second draws have no recorded end.
    let again = begins(1, "ann", R, (7, 0, 1, 0));
    let reset = [begun.clone(), again.clone(), ends(1, "ann", (7, 0, 1, 0)), again, ended.clone()];
    let found = proof(&reset);
    assert_eq!(found.against.len(), 2, "{found:?}");
    // Nine times, two environments draw 5 episodes each: 90 episodes in total, although the episode numbers repeat.
    let short: Vec<LedgerEvent> =
        (0..9).flat_map(|_| [begins(0, "ann", R, (1, 0, 2, 0)), ends(0, "ann", (1, 0, 2, 4))]).collect();
    says(&proof(&short), "record only 90 of the ");
    // One of the training's two environments is freed early. The training has not ended, because the other still draws.
    let early = [begun.clone(), ends(0, "ann", (1, 0, 1, 49)), begins(1, "ann", E, (9, 0, 1, 0))];
    says(&proof(&early), "of the test set E");
    // The server draws nothing for a refused request.
    let withdrawn = LedgerEvent::Draws(DrawRecord {
        who: who(1, "ann"),
        regions: Vec::new(),
        begins: Vec::new(),
        ends: vec![DrawEnd { seed: 9, index: 0, count: 1, episode: None }],
    });
    assert!(proof(&[begun, begins(1, "ann", E, (9, 0, 1, 0)), withdrawn, ended]).against.is_empty());
}
