//! Trainings over faulty connections give the same weights as without faults.

use std::path::Path;
use std::time::Duration;

use perturb_faults::{FaultKind, FaultPlan, FaultyProxy, SeededRng};
use rstest::rstest;
use tempfile::TempDir;

use crate::common::{ended, perturb, server, stderr};
use crate::guarded::{ALL, Guarded, weights};
use crate::patience::PPO_CART_POLE;

/// Number of connections with a fault. Later connections have none, so that the training can finish.
const FAULTY: usize = 4;
/// The minimum number of bytes before the fault of the first connection. The reply to its first request, the catalogue,
/// has 21 kB. If the first requests failed, the client would end at once instead of reconnecting.
const BEGUN: usize = 64_000;
/// Upper bound of the random position of a fault, in bytes. The connection of an uninterrupted training carries more
/// bytes than this in each direction, so the faults can occur.
const MOST: u64 = 200_000;

/// Trains a policy with the server at `address`.
fn train(address: &str, out: &Path, guarded: Option<&Guarded>) -> (String, Vec<u8>) {
    let settings = out.with_extension("toml");
    std::fs::write(&settings, PPO_CART_POLE).expect("written");
    let mut command = perturb(&["train", "--server", address, "--server-wait", "200", "--threads", "1", "--config"]);
    command.arg(settings).arg("--out").arg(out);
    if let Some(guarded) = guarded {
        guarded.equip(&mut command, ALL);
    }
    let trained = ended(command.spawn().expect("perturb"));
    assert!(trained.status.success(), "{}: {}", trained.status, stderr(&trained));
    weights(out)
}

/// Returns the faults of the connection with this number.
fn course(dice: &mut SeededRng, number: usize) -> FaultPlan {
    let mut course = FaultPlan { delay: Duration::from_micros(dice.below(1000)), ..FaultPlan::default() };
    if number < FAULTY {
        let mut fault = dice.fault(&FaultKind::LOSSES, MOST);
        fault.at += if number == 0 { BEGUN } else { 0 };
        let is_servers = dice.below(2) == 0;
        *(if is_servers { &mut course.from_server } else { &mut course.from_client }) = Some(fault);
    }
    println!("connection {number}: {course:?}");
    course
}

#[rstest]
#[case::plain(false)]
#[case::encrypted(true)]
fn a_training_over_a_faulty_line_gives_same_weights(#[case] encrypted: bool) {
    let out = TempDir::new().expect("a directory");
    let guarded = encrypted.then(Guarded::start);
    let own = (!encrypted).then(|| server(1));
    let address = match (&guarded, &own) {
        (Some(guarded), _) => guarded.address.clone(),
        (None, own) => own.as_ref().expect("one of both").address().to_string(),
    };
    let truth = train(&address, &out.path().join("truth"), guarded.as_ref());
    let mut dice = SeededRng::new();
    let line = FaultyProxy::start(&address, move |number| course(&mut dice, number)).expect("a port");
    let scheme = if encrypted { "https://" } else { "" };
    let got = train(&format!("{scheme}{}", line.address()), &out.path().join("run"), guarded.as_ref());
    println!("{} faults on {} connections", line.faults(), line.connections());
    assert!(line.faults() > 0, "nothing happened");
    assert!(got == truth, "{} and not {}", got.0, truth.0);
}
