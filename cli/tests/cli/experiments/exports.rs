//! Exports of an experiment to a results table, and uses of the table.

use std::path::Path;

use perturb_experiment::{CellStates, Results, StudyResults};
use perturb_records::{ResultsTable, StudyEpisodes};

use super::{Experiment, PLAN, succeeded};
use crate::common::{perturb, stderr};

/// Runs `perturb` with `arguments`, and returns its exit status and both outputs.
fn run(arguments: &[&Path]) -> (Option<i32>, String) {
    let output = perturb(&[]).args(arguments).output().expect("ended");
    (output.status.code(), format!("{}{}", String::from_utf8_lossy(&output.stdout), stderr(&output)))
}

#[test]
fn a_run_is_exported_audited_and_continued_from_its_table() {
    // The learning rates differ so much that two short trainings give policies that act differently.
    let experiment = Experiment::new(&PLAN.replace("7e-3", "0.1"));
    succeeded(&experiment.run("part", &["--cell", "0,2"]));
    let (part, file) = (experiment.out("part"), experiment.out("table/results.parquet"));
    std::fs::create_dir(experiment.out("table")).expect("a folder");
    let path = Path::new;
    let export = |folder: &Path| run(&[path("export"), folder, path("--into"), &file, path("--policies")]);
    let (status, told) = export(&part);
    assert!(status == Some(0) && told.contains("part: 2 new cells, 0 replaced, 0 unchanged"), "{told}");
    let first = std::fs::read(&file).expect("a table");
    let (_, told) = export(&part);
    assert!(told.contains("part: 0 new cells, 0 replaced, 2 unchanged"), "{told}");
    assert!(std::fs::read(&file).expect("a table") == first, "the second export changes nothing");

    // The table is enough for a report.
    let table = ResultsTable::read(&file).expect("a table");
    let results = StudyResults::new(&table, "part");
    let done = Results::read(&experiment.plan, &results).expect("results").done().count();
    assert_eq!(done, 2);
    let report = experiment.out("report");
    let (status, told) = run(&[path("report"), &file.join("part"), path("--out"), &report]);
    assert!(status == Some(0) && told.contains("2 of 8 cells are done"), "{told}");
    let (status, told) = run(&[path("report"), &file.join("other"), path("--out"), &report]);
    assert!(status == Some(2) && told.contains("has no study `other`: give one of them as"), "{told}");

    // The audit finds equal checksums, until one policy file is replaced by another.
    let audit = || run(&[path("audit"), &experiment.out("table")]);
    let (status, told) = audit();
    assert!(status == Some(0) && told.contains("48 of 48 episodes of 2 policies have the same bytes"), "{told}");
    let policy =
        |cell: usize| experiment.out("table/policies").join(format!("{}.safetensors", experiment.plan.cells[cell].id));
    std::fs::copy(policy(2), policy(0)).expect("copied");
    let (status, told) = audit();
    assert!(status == Some(1) && told.contains("the first episode that differs is D, environment"), "{told}");
    std::fs::remove_file(StudyEpisodes::path(&experiment.out("table"), "part")).expect("removed");
    let (status, told) = run(&[path("audit"), &policy(0)]);
    assert!(status == Some(1) && told.contains("the episodes have the checksum"), "{told}");

    // Another run with --done runs only the cells that the table does not have. The two runs together have all cells.
    let done = file.to_str().expect("a path");
    let rest = experiment.run("rest", &["--done", done]);
    succeeded(&rest);
    assert!(stderr(&rest).contains("2 of 8 cells are done in"), "{}", stderr(&rest));
    assert_eq!(experiment.results("rest").len(), 6);
    let (_, told) =
        run(&[path("export"), &experiment.out("rest"), path("--into"), &file, path("--study"), path("part")]);
    assert!(told.contains("part: 6 new cells") && told.contains("has 16 rows of 1 study"), "{told}");
    let table = ResultsTable::read(&file).expect("a table");
    let results = StudyResults::new(&table, "part");
    let all = experiment
        .plan
        .cells
        .iter()
        .filter(|cell| matches!(results.state(cell), Ok(perturb_experiment::CellState::Done(_))));
    assert_eq!(all.count(), 8);
}
