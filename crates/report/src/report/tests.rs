use perturb_experiment::{Cell, CellState, ExperimentFolder, FailureRecord, SELECTION_TEST};
use perturb_protocol::Version;
use perturb_records::{Difference, Metric, ParameterCheck, TestResult};
use rstest::rstest;

use super::*;
use crate::fixture;

const PLAN: &str = "
environments = ['CartPole', 'Pendulum']
runs = 2
test_episodes = 50
settings = { episodes = 300 }
[[algorithm]]
name = 'a2c'
architectures = ['ff']
[[algorithm]]
name = 'rl2-ppo'
architectures = ['rc']
versions = ['D', 'R']
";

/// A plan with one method. It is trained on D and on a parameter set, and tested on D, R, E and two parameter sets.
const SETS: &str = "
environments = ['CartPole']
versions = ['D', 'long']
test_versions = ['D', 'R', 'E', 'long', 'corners']
[sets.long]
length = '0.7..0.8'
[sets.corners]
length = '0.1..1.0/2'
[[algorithm]]
name = 'ppo'
architectures = ['ff']
";

/// Returns results in which the first run of A2C on D failed. RL²-PPO has results only on CartPole and in the first
/// run.
fn results(plan: &Plan) -> Results<'_> {
    let mut results = fixture::results(plan, |cell| {
        let common = &cell.config.common;
        let known = cell.config.settings.name() == "a2c" || (common.environment == "CartPole" && cell.run == 1);
        let easier = match common.version {
            Version::D => [90.0, 40.0, 20.0],
            Version::R => [80.0, 70.0, 30.0],
            Version::E | Version::RE => [33.3, 50.0, 60.0],
        };
        known.then(|| (easier.map(|rate| rate + f64::from(cell.run)), 1.0))
    });
    let (id, commit) = (plan.cells[0].id.clone(), String::new());
    results.states[0] = CellState::Failed(FailureRecord {
        id,
        reason: "NaN in <loss> | after\n9 updates".into(),
        commit,
        requires_restart: true,
    });
    results
}

/// Snapshot names contain no module path, so that the files can move with the module.
#[rstest]
#[case("text", |report: &Report<'_>| report.text(usize::MAX))]
#[case("csv", |report: &Report<'_>| {
    let lines = |table: Table| format!("{}\n{}", table.title, String::from_utf8(table.to_csv()).unwrap());
    report.files().into_iter().map(lines).collect::<Vec<_>>().join("\n")
})]
fn a_report_has_all_its_numbers(#[case] name: &str, #[case] document: fn(&Report<'_>) -> String) {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let results = results(&plan);
    let selections = results.select();
    let recorded = Recorded::default();
    let report = Report::new(&results, &selections, &recorded, &[]);
    insta::with_settings!({ prepend_module_to_snapshot => false, omit_expression => true }, {
        insta::assert_snapshot!(name, document(&report));
    });
}

#[test]
fn custom_sets_stand_beside_the_scenarios() {
    let plan = Plan::parse("test", SETS.into()).unwrap();
    let mut results = fixture::results(&plan, |_| Some(([90.0, 40.0, 20.0], 1.0)));
    for state in &mut results.states {
        let CellState::Done(result) = state else { unreachable!("all are done") };
        let test = result.results["D"].clone();
        for (name, success_percent) in [("long", 75.0), ("corners", 55.0)] {
            result.results.insert(name.into(), TestResult { success_percent, ..test.clone() });
        }
    }
    let selections = results.select();
    let recorded = Recorded::default();
    let checks = [(4000, 0.0), (4000, 2e-16)].map(|(episodes, relative)| {
        let largest = Difference { parameter: "length".into(), requested: 0.7, applied: 0.7, relative };
        ParameterCheck { episodes, largest: Some(largest) }
    });
    let report = Report::new(&results, &selections, &recorded, &checks);
    insta::assert_snapshot!(report.scenario_tables()[0].to_text());
    assert_eq!((selections.len(), selections[0].cells), (1, 1), "selected among those that are trained on versions");
    let sentence = "compared in 8000 of 10000 test episodes; the largest relative difference is 2.0e-16, of length.";
    assert!(report.provenance.iter().any(|line| line.contains(sentence)), "{:?}", report.provenance);
}

/// The plan has two configurations and two tuning seeds. On D, a tuning cell of the selected configuration failed. On
/// R, all tuning cells failed. On E, a tuning cell has no result yet.
#[test]
fn clean_report_names_rule_seeds_and_selection() {
    let text = "environments = ['CartPole']\nselection = 'clean'\ntuning_runs = 2\nruns = 2\nselection_episodes = 70
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\ngrid = { n_steps = [64, 128] }";
    let plan = Plan::parse("test", text.into()).unwrap();
    let directory = tempfile::tempdir().unwrap();
    let folder = ExperimentFolder::new(directory.path());
    let n_steps = |cell: &Cell| cell.config.table()["n_steps"].as_integer();
    for cell in plan.cells.iter().chain(&plan.candidates) {
        let (version, seed) = (cell.config.common.version, cell.config.common.seed);
        let place = folder.cell(&cell.id);
        let selected = n_steps(cell) == Some(128);
        if version == Version::R || (version, selected, seed) == (Version::D, true, 2) {
            place
                .write_failure(&FailureRecord {
                    id: cell.id.clone(),
                    reason: "NaN".into(),
                    commit: "x".into(),
                    requires_restart: true,
                })
                .unwrap();
        } else if (version, selected, seed) != (Version::E, true, 2) {
            let mut result = fixture::result(cell, [if selected { 10.0 } else { 90.0 } + seed as f64, 5.0, 0.0], 1.0);
            let test =
                TestResult { success_percent: if selected { 75.0 } else { 25.0 }, ..result.results["D"].clone() };
            result.results.insert(SELECTION_TEST.into(), test);
            place.write_result(&result).unwrap();
        }
    }
    let plan = plan.with_selected_cells(&folder).unwrap();
    let results = Results::read(&plan, &folder).unwrap();
    let selections = results.select();
    let recorded = Recorded::default();
    let report = Report::new(&results, &selections, &recorded, &[]);
    let sentences = report.provenance.join("\n");
    for part in [
        "Selection: `clean`. Configurations were selected by 70 selection episodes of every training on seeds 1 to 2; \
         the reported configurations were trained anew on seeds 3 to 4, and tested on other episodes.",
        "1 of 3 selections wait for tuning cells: CartPole ppo ff on E.",
        "1 of 3 selections have nothing to select, since all their tuning cells failed: CartPole ppo ff on R.",
        "1 of 3 selections chose a configuration with failed tuning cells: CartPole ppo ff on D (1 of 2 tuning seeds).",
    ] {
        assert!(sentences.contains(part), "{sentences}");
    }
    let table = |title: &str| report.files().into_iter().find(|table| table.title == title).unwrap();
    let metrics = String::from_utf8(table("metrics.csv").to_csv()).unwrap();
    // 13.5 is the mean of 13 and 14, the results of the selected configuration with seeds 3 and 4.
    assert!(metrics.contains("CartPole,ppo,ff,,Default,2,13.5,0.5"), "{metrics}");
    let selected = String::from_utf8(table("selected.csv").to_csv()).unwrap();
    assert_eq!(selected.matches("\nCartPole,ppo,ff,,D,").count(), 2, "{selected}");
}

#[rstest]
#[case(
    "",
    "Trainings of 15000 episodes (as in the paper) on D, R and E with the preset `perturb`; tests of 1000 episodes (as \
     in the paper)"
)]
#[case(
    "settings = { episodes = 300 }\ntest_episodes = 50",
    "Trainings of 300 episodes (the paper's: 15000) on D, R and E"
)]
#[case(
    "test_episodes = 999",
    "tests of 999 episodes (the paper's: 1000) each on D, R and E; success as the paper's text says."
)]
fn budgets_and_rules_are_told(#[case] given: &str, #[case] expected: &str) {
    let text = format!("environments = ['CartPole']\n{given}\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']");
    let plan = Plan::parse("test", text).unwrap();
    let sentences = with_no_result(&plan, |report| report.provenance.join("\n"));
    assert!(sentences.contains(expected), "{sentences}");
}

fn with_no_result<T>(plan: &Plan, of: impl FnOnce(&Report<'_>) -> T) -> T {
    let results = fixture::results(plan, |_| None);
    let selections = results.select();
    of(&Report::new(&results, &selections, &Recorded::default(), &[]))
}

#[test]
fn a_single_row_lacks_cells_and_several_lack_them() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let sentences = |missing: &[&str]| {
        let results = fixture::results(&plan, |cell| {
            let Cell { config, .. } = cell;
            let is_missing = config.settings.name() == "a2c" && missing.contains(&config.common.environment.as_str());
            (!is_missing).then_some(([50.0; 3], 1.0))
        });
        let selections = results.select();
        Report::new(&results, &selections, &Recorded::default(), &[]).provenance.join("\n")
    };
    assert!(sentences(&["Pendulum"]).contains("1 of 4 rows lacks cells; the column"));
    assert!(sentences(&["Pendulum", "CartPole"]).contains("2 of 4 rows lack cells; the column"));
}

#[test]
fn what_is_not_done_is_missing_and_has_no_colour() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let entries: Vec<_> =
        with_no_result(&plan, |report| report.tables().flat_map(|table| table.rows.into_iter().flatten()).collect());
    assert!(entries.iter().all(|entry| entry.heat.is_none()));
    // The first summand is for three tables of metrics, each with two methods and three metrics. The second is for the
    // tables of scenarios: three tests of each training distribution (three of A2C and two of RL²-PPO) in two
    // environments. There is no table of interquartile means, because all of it would be missing.
    let expected = 3 * 2 * 3 + 3 * (3 + 2) * 2;
    assert_eq!(entries.iter().filter(|entry| entry.text == MISSING).count(), expected);
}

/// Policies that are trained on R+E have a row among the scenarios, but no metrics.
#[test]
fn training_on_r_plus_e_is_a_scenario_row_only() {
    let plan = |versions: &str| {
        let text = format!(
            "environments = ['CartPole']\nversions = ['D', 'R', 'E'{versions}]\ntest_versions = ['D', 'R', 'E']\n\
             runs = 2\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']"
        );
        Plan::parse("test", text).unwrap()
    };
    let (with, without) = (plan(", 'R+E'"), plan(""));
    let [with, without] = [&with, &without].map(|plan| {
        let rates = |cell: &Cell| {
            [90.0, 40.0, f64::from(cell.run)].map(|rate| rate / (1.0 + f64::from(cell.config.common.version as u8)))
        };
        let results = fixture::results(plan, |cell| Some((rates(cell), 1.0)));
        let selections = results.select();
        let recorded = Recorded::default();
        let report = Report::new(&results, &selections, &recorded, &[]);
        let lines = |table: &Table| table.to_markdown().lines().map(ToOwned::to_owned).collect::<Vec<String>>();
        let scenarios = report.scenario_tables().iter().flat_map(&lines).collect::<Vec<_>>();
        let file = report.files().into_iter().find(|file| file.title == "scenarios.csv").unwrap();
        let metrics = report.metrics.iter().map(|row| format!("{:?} {:?} {:?}", row.ours, row.iqms, row.gaps));
        (scenarios, lines(&file), metrics.collect::<Vec<_>>())
    });
    assert_eq!(with.2, without.2, "Default, Interpolation and Extrapolation come from D, R and E");
    for (with, without, more) in [(with.0, without.0, 1), (with.1, without.1, 3)] {
        let (of_both, others): (Vec<_>, Vec<_>) = with.into_iter().partition(|line| line.contains("R+E"));
        assert_eq!((of_both.len(), others), (more, without));
        assert!(of_both[0].contains("22.5"), "a quarter of 90: {}", of_both[0]);
    }
}

#[test]
fn files_tell_two_presets_of_a_method_apart() {
    let plan = |preset: &str| {
        let text = format!(
            "environments = ['CartPole']\nversions = ['D']\nruns = 2\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\n\
             [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\n{preset}"
        );
        Plan::parse("test", text).unwrap()
    };
    let (both, one) = (plan("preset = 'paper'"), plan("settings = { learning_rate = 1e-3 }"));
    let seeing = plan("settings = { observe = 'parameters' }");
    for (plan, name, expected) in
        [(&both, "preset", true), (&one, "preset", false), (&seeing, "observe", true), (&both, "observe", false)]
    {
        let results = fixture::results(plan, |cell| Some(([90.0, 40.0, f64::from(cell.run)], 1.0)));
        let selections = results.select();
        let recorded = Recorded::default();
        for file in Report::new(&results, &selections, &recorded, &[]).files() {
            // In a comparison of two methods, only one has a non-default preset, so only one has the column.
            let columns = file.columns.iter().filter(|column| column.name.ends_with(name)).count();
            // A method that sees the parameters is a reference method, and reference methods are not compared in pairs.
            let compared = file.columns.iter().any(|column| column.name.starts_with("x_"));
            assert_eq!(columns, usize::from(expected && !(name == "observe" && compared)), "{}", file.title);
        }
    }
}

/// A browser would read everything after an unclosed CSS rule as a part of this rule, without a warning.
#[test]
fn every_rule_of_the_style_is_closed() {
    let depths: Vec<i32> = super::html::STYLE
        .chars()
        .scan(0, |depth, char| {
            *depth += i32::from(char == '{') - i32::from(char == '}');
            Some(*depth)
        })
        .collect();
    assert_eq!(depths.last(), Some(&0));
    assert!(depths.iter().all(|depth| (0..=2).contains(depth)), "only a medium has rules inside");
}

#[test]
fn other_engines_have_no_difference_to_the_paper() {
    let plan = |environments: &str| {
        let rest = "runs = 2\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\n";
        Plan::parse("test", format!("environments = {environments}\n{rest}")).unwrap()
    };
    for (environments, expected) in [
        ("['CartPole', 'Pendulum']", [true, true, true]),
        ("['CartPole', 'Hopper']", [true, false, false]),
        ("['HalfCheetah', 'Hopper']", [false, false, false]),
    ] {
        let plan = plan(environments);
        let results = fixture::results(&plan, |_| Some(([90.0, 70.0, 50.0], 1.0)));
        let selections = results.select();
        let recorded = perturb_experiment::Recorded::new(&selections);
        let report = Report::new(&results, &selections, &recorded, &[]);
        let rows: Vec<_> = report.metrics.iter().chain(&report.averages).collect();
        assert!(rows.iter().all(|row| row.papers.contains_key(&Metric::Default)));
        let has_difference: Vec<bool> = rows.iter().map(|row| row.difference(Metric::Default).is_some()).collect();
        assert_eq!(has_difference, expected, "{environments}");
    }
}
