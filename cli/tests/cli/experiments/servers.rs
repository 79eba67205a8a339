//! Experiments whose servers are restarted, and experiments with private servers.

use std::fs::File;

use perturb_experiment::ExperimentFolder;

use super::{Experiment, kill_all, succeeded};
use crate::common::{ended, wait_for};
use crate::guarded::weights;
use crate::patience::Named;

/// A plan with two cells of some seconds.
const PLAN: &str = "
environments = ['CartPole', 'Pendulum']
versions = ['E']
test_versions = ['D', 'E']
test_episodes = 12
settings = { episodes = 4000, num_envs = 8, checkpoint_interval = 20 }

[[algorithm]]
name = 'a2c'
architectures = ['ff']
";

#[test]
fn a_run_gives_same_results_after_its_server_restarts() {
    let experiment = Experiment::new(PLAN);
    let mut server = Named::new(experiment.directory.path(), "socket");
    let address = server.address();
    let arguments = ["--jobs", "1", "--server", &address];
    succeeded(&experiment.run("undisturbed", &arguments));

    let said = experiment.out("said");
    let mut command = experiment.command("out", &arguments);
    let child = command.stderr(File::create(&said).expect("a file")).spawn().expect("started");
    let losses =
        || std::fs::read_to_string(&said).expect("words").matches("; waiting for a server for at most").count();
    let training = |name: &str, cell: usize| {
        ExperimentFolder::new(&experiment.out(name)).cell(&experiment.plan.cells[cell].id).training()
    };
    for cell in 0..2 {
        wait_for("a checkpoint", || training("out", cell).join("checkpoint/checkpoint.json").exists());
        let before = losses();
        server.kill();
        assert_eq!(experiment.results("out").len(), cell, "killed in the middle of a training");
        wait_for("a run that waits", || losses() > before);
        server.restart();
    }
    let status = ended(child).status;
    assert!(status.success(), "{status}: {}", std::fs::read_to_string(&said).expect("words"));
    assert!(experiment.attempts("out").iter().all(|&attempts| attempts > 1), "{:?}", experiment.attempts("out"));
    assert_eq!(experiment.results("out"), experiment.results("undisturbed"));
    for cell in 0..2 {
        assert!(weights(&training("out", cell)) == weights(&training("undisturbed", cell)), "cell {cell}");
    }
}

#[test]
fn a_run_that_is_killed_leaves_no_folder_of_a_server() {
    let experiment = Experiment::new(&PLAN.replace("episodes = 4000,", "episodes = 1000000,"));
    let own = experiment.out("tmp");
    std::fs::create_dir(&own).expect("a folder");
    let mut command = experiment.command("out", &["--jobs", "2"]);
    let child = command.env("TMPDIR", &own).spawn().expect("started");
    wait_for("two trainings", || experiment.attempts("out") == [1, 1]);
    let folders = || own.read_dir().expect("a list").count();
    assert_eq!(folders(), 2, "each process has a server");
    kill_all(child);
    assert_eq!(folders(), 0, "each server removes its own before it ends");
}
