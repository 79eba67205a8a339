//! Experiments with real worker processes and servers.

mod exports;
mod faults;
mod groups;
mod marks;
mod reference;
mod reports;
mod running;
mod selection;
mod servers;
mod stopping;

use std::collections::BTreeMap;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{Child, Command, Output};

use perturb_experiment::{Cell, CellResult, CellState, ExperimentFolder, Plan};

use crate::common::{is_running, kill, perturb, stderr, wait_for};
use tempfile::TempDir;

/// A plan with eight cells of about a second.
const PLAN: &str = "
environments = ['CartPole', 'Pendulum']
versions = ['D', 'E']
test_versions = ['D', 'R']
test_episodes = 12
settings = { episodes = 40, num_envs = 4 }

[[algorithm]]
name = 'a2c'
architectures = ['ff']
grid = { learning_rate = [7e-3, 7e-4] }
";

struct Experiment {
    directory: TempDir,
    plan: Plan,
}

impl Experiment {
    fn new(text: &str) -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        std::fs::write(directory.path().join("file.toml"), text).expect("written");
        let plan = Plan::parse("file.toml", text.into()).unwrap_or_else(|error| panic!("{error}"));
        Self { directory, plan }
    }

    fn out(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    fn command(&self, name: &str, arguments: &[&str]) -> Command {
        let mut command = perturb(&["run"]);
        command.arg(self.directory.path().join("file.toml")).arg("--out").arg(self.out(name)).args(arguments);
        // With this filter the log says whether a training begins or resumes.
        command.env("RUST_LOG", "warn,perturb_learner::training=debug");
        command
    }

    fn run(&self, name: &str, arguments: &[&str]) -> Output {
        let child = self.command(name, arguments).spawn().expect("started");
        child.wait_with_output().expect("ended")
    }

    /// Returns the HTML page that `perturb report` makes of a run.
    fn page(&self, name: &str) -> String {
        let path = self.out("page.html");
        let mut command = perturb(&["report"]);
        succeeded(&command.arg(self.out(name)).arg("--html").arg(&path).output().expect("ended"));
        std::fs::read_to_string(path).expect("a page")
    }

    /// Makes small heatmaps of a run.
    fn heatmap(&self, name: &str, arguments: &[&str]) -> Output {
        let mut command = perturb(&["heatmap", "--grid", "2", "--episodes", "1"]);
        command.arg(self.out(name)).args(arguments).output().expect("ended")
    }

    /// Returns the bytes of all results.
    fn results(&self, name: &str) -> BTreeMap<String, Vec<u8>> {
        let folder = ExperimentFolder::new(&self.out(name));
        let read = |id: &str| std::fs::read(folder.cell(id).path().join("result.json")).ok();
        self.plan.cells.iter().filter_map(|cell| Some((cell.id.clone(), read(&cell.id)?))).collect()
    }

    fn cell_result(&self, name: &str, index: usize) -> Box<CellResult> {
        match ExperimentFolder::new(&self.out(name)).state(&self.plan.cells[index]) {
            Ok(CellState::Done(result)) => result,
            other => panic!("cell {index} is {other:?}"),
        }
    }

    /// Returns how often each cell's training was begun or resumed. The log of a group is in the folder of its first
    /// cell.
    fn attempts(&self, name: &str) -> Vec<usize> {
        let folder = ExperimentFolder::new(&self.out(name));
        let log = |cell: &Cell| std::fs::read_to_string(folder.cell(&cell.id).log()).unwrap_or_default();
        let logs: String = self.plan.cells.iter().map(log).collect();
        // The warning about a missing checkpoint also contains the folder's name, and does not count.
        let begins =
            |line: &&str| ["begins", "goes on"].iter().any(|how| line.contains(&format!("training {how} directory=")));
        let lines: Vec<&str> = logs.lines().filter(begins).collect();
        let of = |cell: &Cell| lines.iter().filter(|line| line.contains(&format!("/{}/", cell.id))).count();
        self.plan.cells.iter().map(of).collect()
    }
}

#[track_caller]
fn succeeded(output: &Output) {
    assert!(output.status.success(), "{}: {}", output.status, stderr(output));
}

/// Returns the processes that `parent` started.
fn children(parent: u32) -> Vec<u32> {
    let list = std::fs::read_to_string(format!("/proc/{parent}/task/{parent}/children")).unwrap_or_default();
    list.split_whitespace().filter_map(|id| id.parse().ok()).collect()
}

/// Kills a run with SIGKILL, and waits until all its processes have ended.
fn kill_all(mut child: Child) {
    // The list may be empty, because the run may be between two worker processes.
    let started = children(child.id());
    kill("-KILL", child.id());
    assert_eq!(child.wait().expect("ended").signal(), Some(9), "killed before its end");
    wait_for("the end of what the run started", || !started.iter().any(|&id| is_running(id)));
}
