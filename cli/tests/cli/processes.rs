//! Programs of a user who may have few processes and threads.

use std::os::unix::fs::PermissionsExt;

use perturb_faults::processes::with_process_limit;
use perturb_learner::client::Servers;
use rstest::rstest;

use crate::common::{addresses, ended, perturb, run, server, stderr};

/// Limits of processes and threads: some are too low, and some are not.
const LIMITS: [u32; 13] = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 16, 48];

#[rstest]
#[case::train(&["train", "--env", "CartPole", "--episodes", "20", "--threads", "2", "--out", "OUT"])]
#[case::evaluate(&["evaluate", "--checkpoint", "RUN", "--episodes", "2"])]
#[case::demo(&["demo", "--env", "CartPole", "--episodes", "20", "--test-episodes", "2", "--out", "OUT"])]
fn a_command_that_may_have_few_threads_names_the_limit(#[case] arguments: &[&str]) {
    let (trained, _) = {
        let servers = [server(1)];
        let servers = Servers::connect(&addresses(&servers)).expect("a server");
        run(&servers, "environment = 'CartPole'\nepisodes = 2\nnum_envs = 2\nn_steps = 32")
    };
    let out = tempfile::tempdir().expect("a folder");
    for folder in [&trained, &out] {
        std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(0o777)).expect("permissions");
    }
    let trained = trained.path().display().to_string();
    let mut succeeds = [false; 2];
    for limit in LIMITS {
        let out = out.path().join(limit.to_string()).display().to_string();
        let arguments: Vec<_> =
            arguments.iter().map(|argument| argument.replace("OUT", &out).replace("RUN", &trained)).collect();
        let command = perturb(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
        let Some(mut limited) = with_process_limit(&command, limit) else {
            return eprintln!("skipped: this user may not run the program as another user");
        };
        let output = ended(limited.spawn().expect("perturb"));
        let words = stderr(&output);
        assert!(!words.contains("panicked"), "{limit} processes: {words}");
        let succeeds_now = output.status.success();
        assert!(succeeds_now || words.contains("ulimit -u"), "{limit} processes: {}: {words}", output.status);
        succeeds[usize::from(succeeds_now)] = true;
    }
    assert_eq!(succeeds, [true; 2], "some limits are too low, and some are not");
}
