//! Faults of the machine. They are errors of the run, not of its cells.

use super::{Experiment, PLAN, succeeded};
use crate::common::stderr;
use perturb_faults::disk;

/// Limit of file sizes, in blocks of 512 bytes. 16 KiB are too few for a checkpoint's weights.
const BLOCKS: u32 = 32;
/// Size of a disk on which a cell can begin but not finish, in kilobytes.
const KILOBYTES: u32 = 120;

#[test]
fn a_failing_disk_ends_the_run_and_keeps_results() {
    let experiment = Experiment::new(PLAN);
    let arguments = ["--cell", "0,1", "--jobs", "1"];
    succeeded(&experiment.run("undisturbed", &arguments));

    let output = disk::with_file_limit(&experiment.command("out", &arguments), BLOCKS).output().expect("ended");
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("the run cannot continue: CartPole-a2c-ff-D-") && said.contains("File too large"), "{said}");
    assert!(said.contains("resume with the same command"), "{said}");
    assert!(experiment.results("out").is_empty());
    let cells = experiment.out("out").join("cells");
    for cell in std::fs::read_dir(cells).expect("cells") {
        assert!(!cell.expect("a cell").path().join("failure.json").exists(), "no cell is blamed");
    }

    succeeded(&experiment.run("out", &arguments));
    assert_eq!(experiment.results("out"), experiment.results("undisturbed"), "without --retry-failed");
}

#[test]
fn a_run_resumes_after_a_full_disk() {
    let experiment = Experiment::new(PLAN);
    let arguments = ["--cell", "0,1", "--jobs", "1"];
    succeeded(&experiment.run("undisturbed", &arguments));

    let [disk, kept] = ["disk", "kept"].map(|name| experiment.out(name));
    for folder in [&disk, &kept] {
        std::fs::create_dir(folder).expect("a folder");
    }
    let command = experiment.command("disk/run", &arguments);
    let Some(mut twice) = disk::on_full_then_free_disk(&command, &disk, KILOBYTES, &kept) else {
        return eprintln!("skipped: nobody may mount a disk here");
    };
    let output = twice.output().expect("ended");
    let said = stderr(&output);
    assert!(output.status.success(), "{}: {said}", output.status);
    let (first, _) = said.split_once("first status 1").expect(&said);
    assert!(first.contains("the run cannot continue: CartPole-a2c-ff-"), "{said}");
    assert!(first.contains("No space left on device"), "{said}");
    assert_eq!(experiment.results("kept/run"), experiment.results("undisturbed"));
}
