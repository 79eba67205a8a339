//! Faults of the machine, which are the run's errors and no cell's.

use super::{Experiment, PLAN, succeeded};
use crate::common::stderr;
use perturb_faults::disk;

/// Where no file may get larger than 16 KiB a checkpoint's weights do not fit.
const BLOCKS: u32 = 32;
/// A disk on which a cell begins, and does not end.
const KILOBYTES: u32 = 120;

#[test]
fn a_disk_that_refuses_ends_the_run_and_what_was_done_is_kept() {
    let experiment = Experiment::new(PLAN);
    let arguments = ["--cell", "0,1", "--jobs", "1"];
    succeeded(&experiment.run("undisturbed", &arguments));

    let output = disk::small_files(&experiment.command("out", &arguments), BLOCKS).output().expect("ended");
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

#[test]
fn a_disk_that_is_full_ends_the_run_and_the_same_command_goes_on_once_there_is_room() {
    let experiment = Experiment::new(PLAN);
    let arguments = ["--cell", "0,1", "--jobs", "1"];
    succeeded(&experiment.run("undisturbed", &arguments));

    let [disk, kept] = ["disk", "kept"].map(|name| experiment.out(name));
    for folder in [&disk, &kept] {
        std::fs::create_dir(folder).expect("a folder");
    }
    let command = experiment.command("disk/run", &arguments);
    let Some(mut twice) = disk::full_at_first(&command, &disk, KILOBYTES, &kept) else {
        return eprintln!("skipped: nobody may mount a disk here");
    };
    let output = twice.output().expect("ended");
    let said = stderr(&output);
    assert!(output.status.success(), "{}: {said}", output.status);
    let (first, _) = said.split_once("first status 1").expect(&said);
    assert!(first.contains("the run cannot go on: CartPole-a2c-ff-"), "{said}");
    assert!(first.contains("No space left on device"), "{said}");
    assert_eq!(experiment.results("kept/run"), experiment.results("undisturbed"));
}
