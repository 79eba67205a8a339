//! Roles limit what a token's sessions may draw.

use super::{
    connect,
    tokens::{ANN, BOB, Guarded, entry},
};
use crate::common::server::{contexts, open, within};
use perturb::proto::{Distribution, Interval, Open, Reset, Restore, SlotGroup, Snapshot, Version};
use perturb_protocol::{ClientError, Stream};
use rstest::rstest;
use std::collections::HashMap;
use tonic::Code;

const ROLES: &str = r#"
[[set]]
name = "holdout"
environment = "CartPole"
version = "R"
parameters = { length = "0.6..0.7" }

[[role]]
name = "train"
draws = ["D", "R"]
never = ["holdout"]
"#;

fn guarded() -> Guarded {
    Guarded::start(&(entry("ann", ANN, "role = \"train\"") + &entry("bob", BOB, "") + ROLES))
}

fn of(version: Version, parameters: &[(&str, f64, f64)]) -> Open {
    Open { version: version.into(), parameters: values(parameters), ..open("CartPole", 2, 1) }
}

fn listed(lengths: &[f64]) -> Open {
    Open { contexts: Some(contexts(&["length"], lengths)), ..of(Version::Random, &[]) }
}

fn values(parameters: &[(&str, f64, f64)]) -> HashMap<String, Distribution> {
    let interval = |low, high| Distribution { intervals: vec![Interval { low, high }] };
    parameters.iter().map(|&(name, low, high)| (name.to_owned(), interval(low, high))).collect()
}

/// Returns the message of an error for a draw that the role forbids.
#[track_caller]
fn denied<T>(result: Result<T, ClientError>) -> String {
    match result.err().expect("it is refused") {
        ClientError::Refused { code: Code::PermissionDenied, message, .. } => message,
        other => panic!("{other:?}"),
    }
}

#[rstest]
#[case::default(of(Version::Default, &[]), None)]
#[case::narrower(of(Version::Random, &[("length", 0.3, 0.5)]), None)]
#[case::fixed(of(Version::Random, &[("length", 0.3, 0.3)]), None)]
#[case::extreme(of(Version::Extreme, &[]), Some("only from D and R"))]
#[case::both(of(Version::RandomOrExtreme, &[("length", 0.3, 0.4)]), Some("only from D and R"))]
#[case::one_of_e(of(Version::Default, &[("length", 1.1, 1.2)]), Some("length [1.1, 1.2]"))]
#[case::held_out(of(Version::Random, &[("length", 0.65, 0.8)]), Some("never draw from \"holdout\""))]
#[case::held_out_point(of(Version::Random, &[("length", 0.65, 0.65)]), Some("never draw from \"holdout\""))]
#[case::contexts(listed(&[0.3, 0.5]), None)]
#[case::context_of_e(listed(&[0.3, 0.9]), Some("only from D and R"))]
#[case::held_out_context(listed(&[0.3, 0.65]), Some("never draw from \"holdout\""))]
#[case::all_of_it(of(Version::Random, &[]), Some("never draw from \"holdout\""))]
#[tokio::test]
async fn a_role_says_what_its_tokens_draw_from(#[case] open: Open, #[case] refusal: Option<&str>) {
    let guarded = guarded();
    let [ann, bob] = [guarded.connect(ANN).await, guarded.connect(BOB).await];
    let opened = within(Stream::open(&ann, open.clone())).await;
    match refusal {
        None => drop(opened.unwrap()),
        Some(part) => {
            let words = denied(opened);
            assert!(words.contains(part) && words.contains("role \"train\""), "{words}");
        }
    }
    within(Stream::open(&bob, open)).await.expect("without a role anything can be drawn from");
}

#[tokio::test]
async fn no_other_way_leads_around_a_role() {
    let guarded = guarded();
    let ann = guarded.connect(ANN).await;
    let short = of(Version::Random, &[("length", 0.3, 0.4)]);
    let (mut session, _) = within(Stream::open(&ann, short.clone())).await.unwrap();
    denied(within(session.ask(Reset { parameters: values(&[("length", 1.5, 1.5)]), ..Reset::default() })).await);
    let long = of(Version::Random, &[("length", 0.6, 0.6)]);
    let group = |open: &Open| SlotGroup {
        size: 1,
        version: open.version,
        parameters: open.parameters.clone(),
        ..SlotGroup::default()
    };
    let groups = Open {
        groups: vec![group(&short), group(&long)],
        version: 0,
        batch_size: 0,
        seed: 0,
        parameters: HashMap::new(),
        ..short.clone()
    };
    denied(within(Stream::open(&ann, groups)).await);

    // Takes a snapshot in a session of another token.
    let bob = guarded.connect(BOB).await;
    let (mut other, _) = within(Stream::open(&bob, of(Version::Extreme, &[]))).await.unwrap();
    let foreign = within(other.ask(Snapshot::default())).await.unwrap().snapshots;
    denied(within(session.ask(Restore { snapshots: foreign, ..Restore::default() })).await);
    // Forges snapshots with values outside the snapshot's distributions. The server would never draw such values, but
    // after a restore they would stay in force until the trial ends.
    let (mut fixed, _) = within(Stream::open(&bob, of(Version::Random, &[("length", 0.35, 0.35)]))).await.unwrap();
    let own = within(fixed.ask(Snapshot::default())).await.unwrap().snapshots;
    let forged = own.iter().map(|snapshot| with_length(snapshot, 1.5)).collect();
    denied(within(session.ask(Restore { snapshots: forged, ..Restore::default() })).await);
    within(session.ask(Restore { snapshots: own, ..Restore::default() })).await.expect("its own");
    super::steps(&mut session, 2).await.expect("refusals change nothing");

    let neighbour = connect(guarded.server.unix(), &[]).await.unwrap();
    within(Stream::open(&neighbour, of(Version::Extreme, &[]))).await.expect("a Unix socket has its own guard");
}

/// Returns a snapshot of a pole of length 0.35 m with its current length changed to `length`, and with a correct
/// checksum.
fn with_length(snapshot: &[u8], length: f64) -> bytes::Bytes {
    let mut forged = snapshot[..snapshot.len() - 4].to_vec();
    let old = 0.35f64.to_le_bytes();
    // The length occurs three times in the snapshot: twice in the distribution, and then as the current value.
    let places: Vec<usize> = (0..forged.len() - 8).filter(|&place| forged[place..place + 8] == old).collect();
    assert_eq!(places.len(), 3);
    forged[places[2]..places[2] + 8].copy_from_slice(&length.to_le_bytes());
    let sum = crc32c::crc32c(&forged);
    forged.extend(sum.to_le_bytes());
    forged.into()
}
