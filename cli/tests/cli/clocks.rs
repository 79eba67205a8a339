//! Clocks that jump while a policy is trained.

use std::path::{Path, PathBuf};
use std::process::Child;
use std::thread;
use std::time::Duration;

use tempfile::TempDir;

use crate::common::{ended, perturb, stderr};
use crate::guarded::weights;
use crate::patience::PPO_CART_POLE;

/// Environment variable that decides about a missing libfaketime. If it is set, the test fails. If it is not set, the
/// test is skipped.
const REQUIRED: &str = "PERTURB_FAKETIME_REQUIRED";
/// Path of libfaketime, relative to the system's library folder.
const LIBRARY: &str = "faketime/libfaketime.so.1";
/// Offsets of the time of day, which are set one after the other.
const JUMPS: [&str; 5] = ["+0", "-2h", "+400d", "-30d", "+3s"];

fn library() -> Option<PathBuf> {
    let folders = ["/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64"];
    folders.iter().map(|folder| Path::new(folder).join(LIBRARY)).find(|path| path.exists())
}

fn train(out: &Path, clock: Option<(&Path, &Path)>) -> Child {
    let settings = out.with_extension("toml");
    std::fs::write(&settings, PPO_CART_POLE).expect("written");
    let mut command = perturb(&["train", "--threads", "1", "--workers", "1", "--config"]);
    command.arg(settings).arg("--out").arg(out);
    if let Some((library, clock)) = clock {
        // Only the time of day jumps. The monotonic clock continues, as on a machine whose clock is set.
        command.env("LD_PRELOAD", library).env("FAKETIME_TIMESTAMP_FILE", clock);
        command.env("FAKETIME_NO_CACHE", "1").env("FAKETIME_DONT_FAKE_MONOTONIC", "1").env("DONT_FAKE_MONOTONIC", "1");
    }
    command.spawn().expect("perturb")
}

#[test]
fn clock_jumps_change_no_weights_and_cause_no_waits() {
    let Some(library) = library() else {
        assert!(std::env::var_os(REQUIRED).is_none(), "{REQUIRED} is set, and no {LIBRARY} is there");
        return eprintln!("skipped: no {LIBRARY}; Debian has it in libfaketime");
    };
    let folder = TempDir::new().expect("a directory");
    let [truth, run, clock] = ["truth", "run", "clock"].map(|name| folder.path().join(name));
    let undisturbed = ended(train(&truth, None));
    assert!(undisturbed.status.success(), "{}", stderr(&undisturbed));
    std::fs::write(&clock, JUMPS[0]).expect("written");
    let mut training = train(&run, Some((&library, &clock)));
    let mut jumps = JUMPS.iter().cycle();
    let mut count = 0;
    while training.try_wait().expect("a child").is_none() {
        std::fs::write(&clock, jumps.next().expect("for ever")).expect("written");
        count += 1;
        thread::sleep(Duration::from_millis(30));
    }
    let disturbed = ended(training);
    assert!(disturbed.status.success(), "{}: {}", disturbed.status, stderr(&disturbed));
    assert!(count > JUMPS.len(), "it ended after {count} jumps");
    assert!(weights(&run) == weights(&truth));
}
