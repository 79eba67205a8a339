use perturb_experiment::Plan;
use perturb_protocol::Version;
use perturb_records::{ExternalEvaluation, RecordedTest};
use perturb_settings::sets::TestSet;

use super::*;
use crate::fixture;
use crate::report::{Report, ReportError, ReportInputs};

const PLAN: &str = "environments = ['CartPole', 'Pendulum']\nruns = 2
    [[algorithm]]\nname = 'ppo'\narchitectures = ['ff', 'rc']";

/// Makes a report of made-up results of `plan` and of `assessed`, passes the report to `of`, and returns the result of
/// `of`.
fn report<T>(plan: &Plan, assessed: &[ExternalEvaluation], of: impl Fn(&Report<'_>) -> T) -> T {
    let results = fixture::results(plan, |cell| Some(([f64::from(cell.run) + 90.0, 70.0, 50.0], 1.0)));
    let mut selections = results.select();
    let recorded = perturb_experiment::Recorded::new(&selections);
    perturb_experiment::add_assessed(&mut selections, assessed);
    of(&Report::new(&results, &selections, &recorded, &[]))
}

fn lines_of<'t>(text: &'t str, part: &str) -> Vec<&'t str> {
    text.lines().filter(|line| line.contains(part)).collect()
}

#[test]
fn an_agent_stands_in_the_tables_and_changes_no_other_row() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let agent = fixture::assessed("PPO", "CartPole", &[Some(Version::D), Some(Version::R)], [200, 190, 100]);
    let without = report(&plan, &[], |report| report.markdown());
    let with = report(&plan, &[agent], |report| report.markdown());
    let cells = |text: &str| -> Vec<Vec<String>> {
        let rows = text.lines().filter(|line| line.starts_with("| ppo"));
        rows.map(|line| line.split('|').map(|cell| cell.trim().to_owned()).collect()).collect()
    };
    assert!(!cells(&without).is_empty());
    assert_eq!(cells(&with), cells(&without));
    let rows = lines_of(&with, "| PPO (trained elsewhere)");
    // There is one row of metrics, and a row for each of two training distributions.
    assert_eq!(rows.len(), 1 + 2, "{rows:#?}");
    let metrics: Vec<&str> = rows[0].split('|').map(str::trim).collect();
    assert_eq!(metrics[2..5], ["100.0", "–", "–"], "the paper has no such method: {}", rows[0]);
    assert_eq!(metrics[5], "50.0");
    assert_eq!(metrics[11..13], ["1", "–"], "runs and cells: {}", rows[0]);
    assert!(with.contains("1 agent was trained elsewhere"), "{with}");
    let known = lines_of(&with, "PPO on CartPole, run 1: trained on");
    assert_eq!(known.len(), 2);
    for part in ["trained on D", "100000", "01234567", "steps at least 195", "saved as `mine`"] {
        assert!(known[0].contains(part), "{part}: {known:?}");
    }
}

#[test]
fn agent_of_unknown_training_has_no_scenario() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let agent = fixture::assessed("PPO", "Pendulum", &[None], [200, 190, 100]);
    let text = report(&plan, &[agent], |report| report.markdown());
    let rows = lines_of(&text, "PPO (trained elsewhere)");
    assert_eq!(rows.len(), 1, "tests on D, R and E: {rows:#?}");
    assert!(rows.iter().all(|row| row.contains("unknown")), "{rows:#?}");
}

#[test]
fn training_distribution_of_only_a_later_run_has_its_row() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let agents = [&[Some(Version::D)][..], &[Some(Version::D), None]]
        .map(|trained_on| fixture::assessed("PPO", "Pendulum", trained_on, [200, 190, 100]));
    let text = report(&plan, &agents, |report| report.markdown());
    let rows = lines_of(&text, "PPO (trained elsewhere)").into_iter().filter(|row| row.contains("unknown"));
    assert_eq!(rows.count(), 1, "tests on D, R and E: {text}");
}

#[test]
fn agents_with_all_environments_are_averaged() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let everywhere = ["CartPole", "Pendulum"]
        .map(|name| fixture::assessed("PPO", name, &[Some(Version::D), Some(Version::R)], [200, 190, 100]));
    let lines = |assessed: &[ExternalEvaluation], file: &str| {
        report(&plan, assessed, |report| {
            let table = report.files().into_iter().find(|table| table.title == file).unwrap();
            String::from_utf8(table.to_csv()).unwrap()
        })
    };
    assert_eq!(lines_of(&lines(&everywhere[..1], "iqm.csv"), "PPO").len(), 0);
    assert_eq!(lines_of(&lines(&everywhere, "iqm.csv"), "PPO,,,true,").len(), 3);
    let further = [fixture::assessed("PPO", "Acrobot", &[Some(Version::D), Some(Version::R)], [100; 3])];
    let more = [&everywhere[..], &further].concat();
    assert_eq!(lines(&more, "iqm.csv"), lines(&everywhere, "iqm.csv"), "averages are over the plan's environments");
    let two_runs = [everywhere.clone(), everywhere].concat();
    assert_eq!(lines_of(&lines(&two_runs, "iqm.csv"), "PPO,,,true,Default,2").len(), 1);
    assert_eq!(lines_of(&lines(&two_runs, "comparisons.csv"), "PPO").len(), 0, "its runs have no seed in common");
    let scenarios = lines(&two_runs[..1], "scenarios.csv");
    assert_eq!(lines_of(&scenarios, "PPO,,,true,").len(), 6, "{scenarios}");
    assert!(!lines(&[], "scenarios.csv").contains("elsewhere"), "files of experiments alone are as they were");
}

#[test]
fn evaluations_alone_have_a_page_without_cells() {
    let assessed = vec![fixture::assessed("P<PO", "CartPole", &[Some(Version::D)], [200, 190, 100])];
    let page = ReportInputs { assessed, ..ReportInputs::default() }
        .read(|whole| whole.page().map_err(ReportError::from))
        .unwrap();
    for there in ["P&lt;PO (trained elsewhere)", "id=\"scenarios\"", "training steps: ", "<svg", "id=\"heatmaps\""] {
        assert!(page.contains(there), "{there}");
    }
    for not_there in ["cells are done", "Selection:", "id=\"curves\"", "Plan:", "P<PO"] {
        assert!(!page.contains(not_there), "{not_there}");
    }
}

#[test]
fn several_agents_have_a_section_that_compares_them() {
    let assessed =
        ["PPO", "SAC"].map(|agent| fixture::assessed(agent, "CartPole", &[Some(Version::D)], [200, 190, 100]));
    let page = ReportInputs { assessed: assessed.into(), ..ReportInputs::default() }
        .read(|whole| whole.page().map_err(ReportError::from))
        .unwrap();
    assert!(page.contains("id=\"comparison\"") && page.contains("SAC − PPO"), "{page}");
}

#[test]
fn own_sets_of_agents_alone_come_first() {
    let tested = fixture::assessed("PPO", "CartPole", &[Some(Version::D)], [200, 190, 100]);
    let ExternalPolicy { known, records, .. } = &tested.policies()[0];
    let mut records = records.clone();
    let set = TestSet { name: "mine".into(), ..Version::D.into() };
    let episodes = (0..4).map(|index| fixture::episode("mine", index, 0.5, 200, true)).collect();
    records.add(RecordedTest { set, seed: 1, axes: None }, episodes);
    let policies = vec![ExternalPolicy::new(known.clone(), records)];
    let assessed = ExternalEvaluation::new(String::new(), "PPO".into(), policies).unwrap();
    let page = ReportInputs { assessed: vec![assessed], ..ReportInputs::default() }
        .read(|whole| whole.page().map_err(ReportError::from))
        .unwrap();
    let place = |text: &str| page.find(text).unwrap_or_else(|| panic!("{text}: {page}"));
    assert!(place(">on mine<") < place(">on D<") && place(">on D<") < place(">on E<"));
}

#[test]
fn a_folder_is_an_experiment_or_an_assessment() {
    let directory = tempfile::tempdir().unwrap();
    let mut sources = ReportInputs::default();
    let refused = sources.add(directory.path()).unwrap_err().to_string();
    assert!(refused.contains("neither an experiment"), "{refused}");
    let agent = fixture::assessed("PPO", "CartPole", &[None], [200; 3]);
    agent.write(&directory.path().join("agent"), false).unwrap();
    sources.add(&directory.path().join("agent")).unwrap();
    for name in ["one", "two"] {
        let folder = perturb_experiment::ExperimentFolder::new(&directory.path().join(name));
        folder.store_plan(&Plan::parse("test", PLAN.into()).unwrap()).unwrap();
    }
    sources.add(&directory.path().join("one")).unwrap();
    assert_eq!((sources.assessed.len(), sources.folder.is_some()), (1, true));
    let refused = sources.add(&directory.path().join("two")).unwrap_err().to_string();
    assert!(refused.contains("are both experiments"), "{refused}");
}

#[test]
fn another_revision_is_told() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let agent = fixture::assessed("PPO", "CartPole", &[None], [200; 3]);
    assert!(!report(&plan, std::slice::from_ref(&agent), |report| report.text(usize::MAX)).contains("revision"));
    let mut results = fixture::results(&plan, |_| Some(([90.0; 3], 1.0)));
    for state in &mut results.states {
        let perturb_experiment::CellState::Done(result) = state else { unreachable!("all are done") };
        result.training.environment_revision = 2;
    }
    let assessed = [agent];
    let mut selections = results.select();
    perturb_experiment::add_assessed(&mut selections, &assessed);
    let lines = sentences(&results, &selections);
    assert!(lines[2].contains("tested in revision 1 of CartPole, others in revision 2"), "{lines:?}");
}
