//! Faults of the machine, which are the run's errors and no cell's.

use std::process::{Command, Stdio};

use super::{Experiment, PLAN, succeeded};
use crate::common::stderr;

/// `command` where no file may get larger than 16 KiB: a checkpoint's weights do not fit.
fn without_room(command: &Command) -> Command {
    let mut limited = Command::new("sh");
    // In blocks of 512 bytes. Writing more is an error then, and no signal.
    limited.args(["-c", "trap '' XFSZ; ulimit -f 32; exec \"$@\"", "sh"]).arg(command.get_program());
    limited.args(command.get_args()).stdout(Stdio::piped()).stderr(Stdio::piped());
    limited.envs(command.get_envs().filter_map(|(name, value)| Some((name, value?))));
    limited
}

#[test]
fn a_disk_that_refuses_ends_the_run_and_what_was_done_is_kept() {
    let experiment = Experiment::new(PLAN);
    let arguments = ["--cell", "0,1", "--jobs", "1"];
    succeeded(&experiment.run("undisturbed", &arguments));

    let output = without_room(&experiment.command("out", &arguments)).output().expect("ended");
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("the run cannot go on: CartPole-a2c-ff-D-") && said.contains("File too large"), "{said}");
    assert!(said.contains("the same command goes on from what was trained"), "{said}");
    assert!(experiment.results("out").is_empty());
    let cells = experiment.out("out").join("cells");
    for cell in std::fs::read_dir(cells).expect("cells") {
        assert!(!cell.expect("a cell").path().join("failure.json").exists(), "no cell is blamed");
    }

    succeeded(&experiment.run("out", &arguments));
    assert_eq!(experiment.results("out"), experiment.results("undisturbed"), "without --retry-failed");
}
