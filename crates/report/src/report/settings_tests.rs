use perturb_experiment::{IntermediateEvaluation, Plan, Recorded};

use super::*;
use crate::fixture;

const PLAN: &str = "
environments = ['CartPole']
versions = ['D']
test_versions = ['D', 'E']
runs = 3
settings = { episodes = 50 }
[[algorithm]]
name = 'a2c'
architectures = ['ff']
grid = { n_steps = [5, 15], normalize_observations = [true, false] }
";

/// Ones of the run, tens of whether observations are normalised and of the steps.
fn rate(cell: &Cell) -> f64 {
    let settings = cell.config.table();
    let normalized = settings["normalize_observations"].as_bool() == Some(true);
    let long = settings["n_steps"].as_integer() == Some(15);
    10.0 + f64::from(cell.run) + 40.0 * f64::from(u8::from(normalized)) + 20.0 * f64::from(u8::from(long))
}

fn csv(table: &Table) -> Vec<String> {
    String::from_utf8(table.to_csv()).unwrap().lines().map(str::to_owned).collect()
}

#[test]
fn value_is_averaged_over_configurations_and_runs() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    // The last configuration, of 15 steps without normalisation, has no result in the third run.
    let results = fixture::results(&plan, |cell| {
        let known = cell.run < 3 || rate(cell) != 33.0;
        known.then(|| ([rate(cell), 0.0, rate(cell) / 2.0], 1.0))
    });
    let selections = results.select();
    let recorded = Recorded::default();
    let report = Report::new(&results, &selections, &recorded, &[]);
    insta::assert_snapshot!(report.settings_table().unwrap().to_text(), @r"
     environment  method  trained on  setting                 value  configurations               on D               on E  runs
     CartPole     a2c ff  D           n_steps                 5                   2  32.0 [29.5, 34.5]  16.0 [14.8, 17.2]     3
     CartPole     a2c ff  D           n_steps                 15                  2               51.5               25.8     2
     CartPole     a2c ff  D           normalize_observations  true                2  62.0 [59.5, 64.5]  31.0 [29.8, 32.2]     3
     CartPole     a2c ff  D           normalize_observations  false               2               21.5               10.8     2
    ");
    let lines = csv(&report.settings_file());
    assert!(lines[1].starts_with("CartPole,a2c,ff,,D,n_steps,5,50,D,3,32,"), "{lines:?}");
    assert!(lines[1].ends_with(",2"), "two configurations: {lines:?}");
    let configurations = csv(&report.configurations_file());
    assert_eq!(configurations.len(), 1 + 4 * 2);
    let last = &configurations[8];
    assert!(
        last.contains(",n_steps=15 normalize_observations=false,50,E,2,15.75,0.25,,"),
        "two runs have no interval: {last}"
    );
    assert!(report.settings_pictures().is_empty(), "a line needs two moments");
}

#[test]
fn constant_settings_and_final_cells_are_left_out() {
    let one = PLAN.replace("[5, 15]", "[5]").replace("[true, false]", "[true]");
    let plan = Plan::parse("test", one).unwrap();
    let results = fixture::results(&plan, |cell| Some(([rate(cell), 0.0, 0.0], 1.0)));
    let tests = grid_tests(&results);
    assert!(tests.settings.is_empty() && tests.configurations.is_empty());

    let plan = Plan::parse("test", format!("selection = 'clean'{PLAN}")).unwrap();
    let mut anew = plan.clone();
    anew.cells.extend(plan.candidates.iter().cloned());
    let results =
        fixture::results(&anew, |cell| Some(([if cell.tuned_as.is_some() { 99.0 } else { 7.0 }, 0.0, 0.0], 1.0)));
    let tests = grid_tests(&results);
    assert_eq!(tests.configurations.len(), 4 * 2);
    assert!(tests.configurations.iter().chain(&tests.settings).all(|test| test.success.mean < 99.0));
    assert!(
        tests.configurations.iter().all(|test| test.success.runs == 1 && test.interval.is_none()),
        "one tuning seed"
    );
}

#[test]
fn pictures_follow_a_setting_over_the_training() {
    let plan = Plan::parse("test", format!("evaluate_at = [20]{PLAN}")).unwrap();
    let mut results = fixture::results(&plan, |cell| Some(([rate(cell), 0.0, 60.0], 1.0)));
    for state in &mut results.states {
        let CellState::Done(result) = state else { unreachable!("all are done") };
        let agreement = perturb_records::ParameterCheck { episodes: 1, largest: None };
        let at_mark = [("E".to_owned(), TestResult { success_percent: 80.0, ..result.results["E"].clone() })].into();
        result.marks.insert(20, IntermediateEvaluation { counters: Default::default(), results: at_mark, agreement });
    }
    let selections = results.select();
    let recorded = Recorded::default();
    let report = Report::new(&results, &selections, &recorded, &[]);
    let pictures = report.settings_pictures();
    let files: Vec<&str> = pictures.iter().map(|picture| picture.file.as_str()).collect();
    assert_eq!(files, ["CartPole-a2c-ff-D-n_steps", "CartPole-a2c-ff-D-normalize_observations"]);
    let PictureDrawing::Panels(panels) = &pictures[0].drawing else { unreachable!("lines") };
    assert_eq!(panels.legend, ["n_steps = 5", "n_steps = 15"]);
    assert_eq!(panels.panels.len(), 2, "tested on D and E");
    let line: Vec<(f64, f64)> = panels.panels[1].lines[1].points.iter().map(|point| (point.x, point.y)).collect();
    assert_eq!(line, [(20.0, 80.0), (50.0, 60.0)]);
    let at_the_end: Vec<f64> = panels.panels[0].lines.iter().map(|line| line.points[0].y).collect();
    assert_eq!(at_the_end, [32.0, 52.0], "on D there are no marks");
    assert!(report.settings_table().unwrap().to_text().contains("60.0"), "the end, not the mark");
    assert_eq!(csv(&report.settings_file()).iter().filter(|line| line.contains(",20,E,3,80,0,80,80,")).count(), 4);
}

#[test]
fn the_end_is_each_trainings_own() {
    let grid = "grid = { episodes = [20, 50], n_steps = [5, 15] }";
    let plan = PLAN.replace("grid = { n_steps = [5, 15], normalize_observations = [true, false] }", grid);
    let plan = Plan::parse("test", format!("evaluate_at = [20]{}", plan.replace("settings = { episodes = 50 }\n", "")))
        .unwrap();
    let episodes = |cell: &Cell| cell.config.common.episodes;
    let mut results = fixture::results(&plan, |cell| Some(([episodes(cell) as f64, 0.0, 0.0], 1.0)));
    for state in &mut results.states {
        let CellState::Done(result) = state else { unreachable!("all are done") };
        let agreement = perturb_records::ParameterCheck { episodes: 1, largest: None };
        let results = result
            .results
            .iter()
            .map(|(name, test)| (name.clone(), TestResult { success_percent: 7.0, ..test.clone() }));
        let mark = IntermediateEvaluation { counters: Default::default(), results: results.collect(), agreement };
        result.marks.insert(20, mark);
    }
    let selections = results.select();
    let recorded = Recorded::default();
    let report = Report::new(&results, &selections, &recorded, &[]);
    let table = report.settings_table().unwrap().to_text();
    let row =
        |start: &str| table.lines().find(|line| line.contains(start)).unwrap_or_else(|| panic!("{start}: {table}"));
    assert!(row("episodes  20 ").contains(" 20.0"), "{table}");
    assert!(row("episodes  50 ").contains(" 50.0"), "{table}");
    assert!(row("n_steps   5 ").contains(" 35.0"), "the mean of both ends, not of a mark: {table}");
    let lines = csv(&report.settings_file());
    assert!(lines.iter().any(|line| line.contains(",n_steps,5,,D,3,35,")), "no one number of episodes: {lines:?}");
    assert!(lines.iter().any(|line| line.contains(",n_steps,5,20,D,3,13.5,")), "at 20 an end and a mark: {lines:?}");
}
