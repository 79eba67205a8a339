//! The private server of a killed learner ends and leaves no files.

use std::path::{Path, PathBuf};
use std::process::Command;

use tempfile::TempDir;

use crate::common::{child_server, is_running, perturb, wait_for};
use perturb_learner::checkpoint::Checkpoint;

/// Folders for a learner's run and for its private server.
struct Place(TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        std::fs::create_dir(place.path("tmp")).expect("a folder");
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Starts a training that does not end by itself.
    fn training(&self) -> Command {
        let mut command = perturb(&["train", "--env", "CartPole", "--episodes", "1000000", "--out"]);
        command.arg(self.path("run")).env("TMPDIR", self.path("tmp"));
        command
    }

    /// Returns the number of folders of private servers.
    fn folders(&self) -> usize {
        self.path("tmp").read_dir().expect("a list").count()
    }
}

#[test]
fn a_killed_learner_ends_its_server_and_its_folder() {
    let place = Place::new();
    let mut child = place.training().spawn().expect("perturb");
    wait_for("a checkpoint", || place.path("run/checkpoint/checkpoint.json").exists());
    let server = child_server(child.id()).expect("a private server");
    assert_eq!(place.folders(), 1);
    child.kill().expect("kill -9");
    child.wait().expect("it ends");
    wait_for("the server's end", || !is_running(server));
    assert_eq!(place.folders(), 0);
    Checkpoint::load(&place.path("run")).expect("a whole checkpoint");
}

/// The server starts reading its standard input only after the learner, which holds the other end of the pipe, was
/// killed.
#[test]
fn a_server_ends_when_its_learner_is_killed_at_the_start() {
    let place = Place::new();
    let late = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cli/fixtures/late_server.sh");
    let program = Path::new(env!("CARGO_BIN_EXE_perturb")).with_file_name("perturb-server");
    let mut command = place.training();
    command.env("PERTURB_SERVER", late).env("LATE_FOLDER", place.path("")).env("LATE_PROGRAM", program);
    let mut child = command.spawn().expect("perturb");
    let begun = || std::fs::read_to_string(place.path("begun")).unwrap_or_default();
    wait_for("the start of the late server", || begun().ends_with('\n'));
    let server = begun().trim().parse().expect("a process's number");
    assert_eq!((place.folders(), is_running(server)), (1, true));
    child.kill().expect("kill -9");
    child.wait().expect("it ends");
    std::fs::write(place.path("go"), "").expect("written");
    wait_for("the server's end", || !is_running(server));
    assert_eq!(place.folders(), 0);
}
