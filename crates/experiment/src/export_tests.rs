use std::collections::BTreeMap;

use perturb_checkpoint::Counters;
use perturb_protocol::Version;
use perturb_records::{FILE, ParameterCheck, RecordedTest, RecordsMetadata, ResultsTable};

use super::*;
use crate::fixture;
use crate::folder::{FailureRecord, IntermediateEvaluation, Timing};
use crate::selection::Results;
use crate::states::{CellStates, DoneCells, LayeredStates, StudyResults};

const PLAN: &str = "environments = ['CartPole']\nversions = ['D', 'R']\ntest_versions = ['D', 'R', 'E']\nruns = 2
    evaluate_at = [300]\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

fn plan() -> Plan {
    Plan::parse("test", PLAN.into()).unwrap()
}

/// Returns records of tests on D, R and E with ten episodes each. The first episodes of a test are successes;
/// `successes` gives their numbers.
fn records(successes: [u32; 3]) -> Records {
    let about = RecordsMetadata::new(&Default::default(), "policy".into(), 1);
    let mut records = Records::new(about);
    for (version, successes) in Version::ALL.into_iter().zip(successes) {
        let name = version.to_string();
        let one = |index: u32| {
            let episode = fixture::episode(&name, index, 1.0, 100 + index, index < successes);
            perturb_records::EpisodeRecord { requested: Vec::new(), applied: Vec::new(), ..episode }
        };
        records.add(RecordedTest { set: version.into(), seed: 7, axes: None }, (0..10).map(one).collect());
    }
    records
}

/// Writes three of the plan's four cells: a result with marks and recorded episodes, a result without them, and a
/// failure. The fourth cell is missing.
fn write(plan: &Plan, folder: &ExperimentFolder) {
    let [first, second, third, _] = &plan.cells[..] else { panic!("{} cells", plan.cells.len()) };
    let of = |records: &Records| {
        let tests = records.about.tests.iter().map(|test| test.set.name.clone());
        tests.map(|name| (name.clone(), records.result(&name, None))).collect::<BTreeMap<_, _>>()
    };
    let mut result = fixture::result(first, [0.0; 3], 0.0);
    let (marked, last) = (records([1, 2, 3]), records([10, 9, 3]));
    let counters = Counters { episodes: 301, timesteps: 2000, ..Counters::default() };
    result.marks.insert(300, IntermediateEvaluation { counters, results: of(&marked), agreement: marked.agreement() });
    result.results = of(&last);
    result.agreement = Some(last.agreement());
    result.training.counters = Counters { episodes: 15_000, timesteps: 70_000, ..Counters::default() };
    result.earlier_commits = vec!["0.0.9 (b)".into()];
    let place = folder.cell(&first.id);
    marked.write(&place.mark(300).join(FILE)).unwrap();
    last.write(&place.path().join(FILE)).unwrap();
    place.write_timing(&Timing { seconds: 1.5 }).unwrap();
    place.write_result(&result).unwrap();
    let mut result = fixture::result(second, [33.3, 66.7, 0.1], -1.0 / 3.0);
    result.training.counters = Counters { episodes: 15_000, timesteps: 9, ..Counters::default() };
    folder.cell(&second.id).write_result(&result).unwrap();
    let failure =
        FailureRecord { id: third.id.clone(), reason: "NaN".into(), commit: "x".into(), requires_restart: true };
    folder.cell(&third.id).write_failure(&failure).unwrap();
}

/// Writes the cells and exports them to a table. Returns the table after writing it to a file and reading it again.
fn exported(plan: &Plan, folder: &ExperimentFolder) -> ResultsTable {
    write(plan, folder);
    let mut table = ResultsTable::default();
    let mut recorded = Vec::new();
    let rows = export(plan, folder, "study", |id, records| recorded.push((id.to_owned(), records))).unwrap();
    assert_eq!(recorded, [(plan.cells[0].id.clone(), records([10, 9, 3]))]);
    table.merge("study", plan.for_table(), rows);
    let path = folder.path().join("results.parquet");
    table.write(&path).unwrap();
    ResultsTable::read(&path).unwrap()
}

#[test]
fn a_row_has_every_number_of_a_test() {
    let directory = tempfile::tempdir().unwrap();
    let (plan, folder) = (plan(), ExperimentFolder::new(directory.path()));
    let table = exported(&plan, &folder);
    let rows = table.rows();
    assert_eq!(rows.len(), 6 + 3 + 1);
    let row = &rows[5];
    let (last, returns) = (records([10, 9, 3]), 109.0);
    assert_eq!((row.tested_on.as_deref(), row.after_episodes, row.timesteps), (Some("R"), Some(15_000), Some(70_000)));
    assert_eq!((row.episodes, row.successes, row.seconds), (Some(10), Some(9), Some(1.5)));
    assert_eq!((row.cvar_10, row.mean_return), (Some(100.0), Some((100.0 + returns) / 2.0)));
    assert_eq!((row.checksum.clone(), row.commit.as_str()), (last.checksum("R"), "0.0.9 (b); 0.1.0 (0123456789ab)"));
    assert_eq!(row.settings, serde_json::to_string(&plan.cells[0].config.table()).unwrap());
    assert_eq!((rows[0].after_episodes, rows[0].timesteps, rows[0].successes), (Some(300), Some(2000), Some(1)));
    assert_eq!((rows[6].cvar_10, rows[6].checksum.clone(), rows[6].successes), (None, None, Some(333)));
    assert_eq!((rows[9].failure.as_deref(), rows[9].tested_on.as_deref()), (Some("NaN"), None));
}

#[test]
fn a_table_has_the_results_of_its_folder() {
    let directory = tempfile::tempdir().unwrap();
    let (plan, folder) = (plan(), ExperimentFolder::new(directory.path()));
    let table = exported(&plan, &folder);
    let again = Plan::of_study("study", &table.studies["study"]).unwrap();
    assert_eq!(again.cells, plan.cells);
    let results = StudyResults::new(&table, "study");
    let figures = |states: &dyn CellStates| {
        let results = Results::read(&plan, states).unwrap();
        let failures: Vec<_> = results.failures().map(|failure| failure.reason.clone()).collect();
        let of_marks =
            |result: &CellResult| result.marks.iter().map(|(mark, of)| (*mark, of.results.clone())).collect::<Vec<_>>();
        let done = results.done().map(|result| {
            let Counters { episodes, timesteps, .. } = result.training.counters;
            (result.results.clone(), of_marks(result), episodes, timesteps, result.training.settings.clone())
        });
        (done.collect::<Vec<_>>(), failures)
    };
    let (mut of_folder, of_table) = (figures(&folder), figures(&results));
    // The interval in the fixture is not a Wilson interval, so it is replaced.
    for (name, result) in &mut of_folder.0[1].0 {
        result.success_percent_95 = of_table.0[1].0[name].success_percent_95;
    }
    assert_eq!(of_table, of_folder);
    assert_eq!(StudyResults::new(&table, "other").state(&plan.cells[0]).unwrap(), CellState::Missing);
}

#[test]
fn the_last_rows_are_the_final_policy_also_after_an_early_end() {
    let directory = tempfile::tempdir().unwrap();
    let (plan, folder) = (plan(), ExperimentFolder::new(directory.path()));
    let cell = &plan.cells[0];
    let mut result = fixture::result(cell, [1.0, 2.0, 3.0], 0.0);
    result.training.counters = Counters { episodes: 300, timesteps: 2000, ..Counters::default() };
    let agreement = ParameterCheck { episodes: 0, largest: None };
    let marks = result.results.clone();
    result.marks.insert(300, IntermediateEvaluation { counters: result.training.counters, results: marks, agreement });
    folder.cell(&cell.id).write_result(&result).unwrap();
    let mut table = ResultsTable::default();
    table.merge("study", plan.for_table(), export(&plan, &folder, "study", |_, _| {}).unwrap());
    let CellState::Done(read) = StudyResults::new(&table, "study").state(cell).unwrap() else { panic!("a result") };
    let keys = |results: &BTreeMap<String, TestResult>| results.keys().cloned().collect::<Vec<_>>();
    assert_eq!((keys(&read.results), keys(&read.marks[&300].results)), (keys(&result.results), keys(&result.results)));
}

#[test]
fn a_selected_cell_is_exported_once() {
    let directory = tempfile::tempdir().unwrap();
    let text = "environments = ['CartPole']\nversions = ['D']\nselection = 'clean'\ntuning_runs = 1\nruns = 1
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\ngrid = { n_steps = [64, 128] }";
    let (plan, folder) = (Plan::parse("test", text.into()).unwrap(), ExperimentFolder::new(directory.path()));
    for cell in plan.cells.iter().chain(&plan.candidates) {
        let mut result = fixture::result(cell, [50.0; 3], 0.0);
        result.results.insert(crate::SELECTION_TEST.into(), result.results["D"].clone());
        folder.cell(&cell.id).write_result(&result).unwrap();
    }
    let known = plan.with_selected_cells(&folder).unwrap();
    assert_eq!((known.cells.len(), known.candidates.len()), (3, 2));
    let rows = export(&known, &folder, "study", |_, _| {}).unwrap();
    assert_eq!(rows.len(), 4 * 4, "two tuning cells and two candidates, each with four tests");
}

#[test]
fn results_of_another_plan_come_last() {
    let directory = tempfile::tempdir().unwrap();
    let (plan, folder) = (plan(), ExperimentFolder::new(directory.path()));
    write(&plan, &folder);
    let mut result = fixture::result(&plan.cells[3], [1.0, 2.0, 3.0], 0.0);
    result.id = "A-of-another-plan".into();
    folder.cell(&result.id).write_result(&result).unwrap();
    let rows = export(&plan, &folder, "study", |_, _| {}).unwrap();
    let last: Vec<_> = rows.iter().rev().take(4).map(|row| (row.cell.as_str(), row.trained_on.as_str())).collect();
    let other = ("A-of-another-plan", "R");
    assert_eq!(last, [other, other, other, (plan.cells[2].id.as_str(), "R")]);
}

#[test]
fn done_cells_have_the_same_settings_and_tests() {
    let directory = tempfile::tempdir().unwrap();
    let (plan, folder) = (plan(), ExperimentFolder::new(directory.path()));
    let table = exported(&plan, &folder);
    let done = DoneCells::new(&table).unwrap();
    let is_done = |cell: &Cell| matches!(done.state(cell).unwrap(), CellState::Done(_));
    assert_eq!(plan.cells.iter().map(is_done).collect::<Vec<_>>(), [true, true, false, false]);
    let mut other_tests = plan.cells[0].clone();
    other_tests.tests.episodes += 1;
    assert!(!is_done(&other_tests), "tested with another number of episodes");
    let empty = tempfile::tempdir().unwrap();
    let empty = ExperimentFolder::new(empty.path());
    let both = LayeredStates { first: &empty, then: Some(&done) };
    assert!(matches!(both.state(&plan.cells[0]).unwrap(), CellState::Done(_)));
    let both = LayeredStates { first: &folder, then: Some(&done) };
    assert!(matches!(both.state(&plan.cells[2]).unwrap(), CellState::Failed(_)), "the folder has it");
}

#[test]
fn a_result_that_its_episodes_do_not_give_is_not_exported() {
    let directory = tempfile::tempdir().unwrap();
    let (plan, folder) = (plan(), ExperimentFolder::new(directory.path()));
    write(&plan, &folder);
    records([9, 9, 3]).write(&folder.cell(&plan.cells[0].id).path().join(FILE)).unwrap();
    let message = export(&plan, &folder, "study", |_, _| {}).unwrap_err().to_string();
    assert!(message.contains("does not match its recorded episodes"), "{message}");
}
