//! Servers that are stopped during a training, and continue after a while.

use rstest::rstest;

use crate::common::{ended, kill, wait_for};
use crate::patience::{A2C_PENDULUM, Named, PPO_CART_POLE, result, train, undisturbed};
use perturb_faults::{FaultPlan, FaultyProxy, SeededRng};

/// Sends SIGSTOP to a server, and waits until all its threads are stopped. A server with running threads may still
/// answer.
fn freeze(server: &Named) {
    kill("-STOP", server.id());
    let is_stopped = |task: std::io::Result<std::fs::DirEntry>| {
        let stat = task.and_then(|task| std::fs::read_to_string(task.path().join("stat")));
        stat.is_ok_and(|stat| stat.contains(") T "))
    };
    let tasks = format!("/proc/{}/task", server.id());
    wait_for("a server that does nothing", || std::fs::read_dir(&tasks).expect("a process").all(is_stopped));
}

fn thaw(server: &Named) {
    kill("-CONT", server.id());
}

#[rstest]
#[case::the_only_one(PPO_CART_POLE, &["a"])]
#[case::one_of_two(A2C_PENDULUM, &["a", "b"])]
fn a_briefly_silent_server_is_waited_for(#[case] text: &str, #[case] names: &[&str]) {
    let folder = tempfile::tempdir().expect("a directory");
    let mut dice = SeededRng::new();
    let named: Vec<Named> = names.iter().map(|name| Named::new(folder.path(), name)).collect();
    let list = named.iter().map(Named::address).collect::<Vec<_>>().join(",");
    let (mut child, out, said) = train(&folder, text, &["--server", &list]);
    wait_for("a training", || out.join("progress.csv").exists());
    let mut stops = 0;
    while stops < 5 && child.try_wait().expect("a child").is_none() {
        let server = &named[dice.below(named.len() as u64) as usize];
        freeze(server);
        dice.wait(0, 300);
        thaw(server);
        stops += 1;
        dice.wait(0, 100);
    }
    let status = ended(child).status;
    let said = std::fs::read_to_string(said).expect("words");
    assert!(status.success(), "{status}: {said}");
    assert!(stops > 0, "it ended before anything was stopped");
    assert!(!said.contains("lost the server"), "{said}");
    assert_eq!(result(&out), undisturbed(text), "after {stops} stops");
}

/// The client connects over TCP to a proxy, because clients request no lease over a Unix socket.
#[test]
fn a_session_resumes_when_a_silent_server_answers_again() {
    let folder = tempfile::tempdir().expect("a directory");
    let server = Named::new(folder.path(), "a");
    let line = FaultyProxy::start(&server.address(), |_| FaultPlan::default()).expect("a port");
    let (child, out, said) = train(&folder, A2C_PENDULUM, &["--server", &line.address()]);
    wait_for("a checkpoint", || out.join("checkpoint/checkpoint.json").exists());
    freeze(&server);
    let before = line.connections();
    wait_for("the end of the learner's patience", || line.connections() > before);
    thaw(&server);
    let status = ended(child).status;
    let said = std::fs::read_to_string(said).expect("words");
    assert!(status.success(), "{status}: {said}");
    assert!(said.contains("resumed the session") && !said.contains("waiting for it"), "{said}");
    assert_eq!(result(&out), undisturbed(A2C_PENDULUM));
}

#[test]
fn a_silent_server_of_two_is_replaced_by_the_other() {
    let folder = tempfile::tempdir().expect("a directory");
    let two = ["a", "b"].map(|name| Named::new(folder.path(), name));
    let list = two.iter().map(Named::address).collect::<Vec<_>>().join(",");
    let (child, out, said) = train(&folder, A2C_PENDULUM, &["--server", &list]);
    wait_for("a checkpoint", || out.join("checkpoint/checkpoint.json").exists());
    freeze(&two[0]);
    let alone = format!("going on with {} alone", two[1].address());
    let words = || std::fs::read_to_string(&said).expect("words");
    wait_for("the end of the learner's patience", || words().contains(&alone));
    thaw(&two[0]);
    let status = ended(child).status;
    assert!(status.success(), "{status}: {}", words());
    assert!(words().contains(&format!("lost the server at {} ", two[0].address())), "{}", words());
    assert_eq!(result(&out), undisturbed(A2C_PENDULUM));
}
