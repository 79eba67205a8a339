//! Servers of a user who may have few processes and threads.

use crate::{common::server::command, guarded::entry, lifecycle::finished};
use perturb_faults::processes::with_process_limit;
use rstest::rstest;
use std::os::unix::fs::PermissionsExt;

#[rstest]
#[case::alone(&[])]
#[case::with_two_transport_threads(&["--transport-threads", "2"])]
#[case::with_a_ledger(&["--tokens", "DIR/tokens", "--ledger", "DIR/ledger"])]
#[cfg_attr(feature = "mujoco", case::with_a_task(&["--task", concat!(env!("CARGO_MANIFEST_DIR"), "/examples/tasks/my_arm")]))]
fn a_server_that_may_have_few_threads_names_the_limit(#[case] flags: &[&str]) {
    let mut starts = [false; 2];
    for limit in [1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 32] {
        let directory = tempfile::tempdir().unwrap();
        let folder = directory.path().to_str().unwrap();
        std::fs::set_permissions(folder, PermissionsExt::from_mode(0o777)).unwrap();
        std::fs::write(directory.path().join("tokens"), entry("ann", "correct-horse-battery", "")).unwrap();
        let mut server = command();
        // Standard input is empty, so a server that starts ends at once.
        server.args(["--listen", "tcp://127.0.0.1:0", "--exit-with-stdin", "--workers", "4"]);
        server.args(flags.iter().map(|flag| flag.replace("DIR", folder)));
        let Some(mut server) = with_process_limit(&server, limit) else {
            return eprintln!("skipped: this user may not run the server as another user");
        };
        let output = finished(&mut server);
        let words = String::from_utf8(output.stderr).unwrap();
        let starts_now = output.status.success();
        assert!(!words.contains("panicked"), "{limit} processes: {words}");
        assert!(starts_now || words.contains("ulimit -u"), "{limit} processes: {}: {words}", output.status);
        starts[usize::from(starts_now)] = true;
    }
    assert_eq!(starts, [true; 2], "some limits are too low, and some are not");
}
