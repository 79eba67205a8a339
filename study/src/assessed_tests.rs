use std::fs;

use rstest::rstest;

use super::*;
use crate::Version::{D, E, R, RE};
use crate::fixture;

const PLAN: &str = "environments = ['CartPole', 'Pendulum']\nversions = ['D']\nruns = 2
    [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

#[test]
fn what_is_written_is_read_and_replaced_only_on_request() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("mine");
    let assessed = fixture::assessed("PPO", "CartPole", &[Some(D), Some(R), None], [200, 190, 100]);
    assessed.write(&path, false).unwrap();
    assert_eq!(Assessed::read(&path).unwrap(), assessed);
    let refused = assessed.write(&path, false).unwrap_err().to_string();
    assert!(refused.contains("overwrite=True replaces it"), "{refused}");
    fs::write(path.join("episodes-mine.parquet"), "not the assessment's").unwrap();
    fixture::assessed("PPO", "CartPole", &[Some(R), Some(RE)], [200; 3]).write(&path, true).unwrap();
    let there = ["assessment.json", "episodes-R-or-E.parquet", "episodes-R.parquet", "episodes-mine.parquet"];
    assert_eq!(files::list(&path).unwrap(), there.map(|file| path.join(file)), "only the former's records are gone");
    fs::remove_file(path.join(ASSESSMENT)).unwrap();
    let refused = assessed.write(&path, true).unwrap_err().to_string();
    assert!(refused.contains("name another folder"), "{refused}");
    let refused = Assessed::read(&path).unwrap_err().to_string();
    assert!(refused.contains("holds no assessment"), "{refused}");
}

#[test]
fn an_assessment_is_there_until_another_one_is_written() {
    let directory = tempfile::tempdir().unwrap();
    let former = fixture::assessed("PPO", "CartPole", &[Some(D), Some(R)], [200; 3]);
    former.write(directory.path(), false).unwrap();
    fs::create_dir(directory.path().join("episodes-E.parquet")).unwrap(); // so that this one cannot be written
    fixture::assessed("PPO", "CartPole", &[Some(E)], [100; 3]).write(directory.path(), true).unwrap_err();
    assert_eq!(Assessed::read(directory.path()).unwrap().policies(), former.policies());
}

#[test]
fn what_is_damaged_can_be_overwritten() {
    let directory = tempfile::tempdir().unwrap();
    fs::write(directory.path().join(ASSESSMENT), "{").unwrap();
    let assessed = fixture::assessed("PPO", "CartPole", &[Some(D)], [200; 3]);
    assessed.write(directory.path(), true).unwrap();
    assert_eq!(Assessed::read(directory.path()).unwrap().policies(), assessed.policies());
}

#[test]
fn what_was_changed_is_refused_and_can_be_overwritten() {
    let directory = tempfile::tempdir().unwrap();
    let assessed = fixture::assessed("PPO", "CartPole", &[Some(D), Some(R)], [200; 3]);
    assessed.write(directory.path(), false).unwrap();
    let json = directory.path().join(ASSESSMENT);
    let written = fs::read_to_string(&json).unwrap();
    fs::write(&json, written.replace("\"PPO\"", "\"A2C\"")).unwrap();
    let refused = Assessed::read(directory.path()).unwrap_err().to_string();
    assert!(refused.contains("its checksum is another"), "{refused}");
    let less = fixture::assessed("PPO", "CartPole", &[Some(D)], [200; 3]);
    less.write(directory.path(), true).unwrap();
    assert_eq!(files::list(directory.path()).unwrap().len(), 2, "the former's records are gone");
}

#[rstest]
#[case("{", "is damaged")]
#[case(r#"{"format_version": 2, "policies": 1}"#, "has format 2; this program reads 1")]
#[case(r#"{"format_version": 1, "environment": "CartPole", "agent": "PPO", "policies": []}"#, "there is none")]
#[case(
    r#"{"format_version": 1, "environment": "CartPole", "agent": "PPO", "policies": [{"file": "episodes-D.parquet"}]}"#,
    "missing field"
)]
fn what_is_no_assessment_is_refused(#[case] document: &str, #[case] words: &str) {
    let directory = tempfile::tempdir().unwrap();
    fixture::assessed("PPO", "CartPole", &[Some(D)], [200; 3]).write(directory.path(), false).unwrap();
    fs::write(directory.path().join(ASSESSMENT), document).unwrap();
    let refused = Assessed::read(directory.path()).unwrap_err().to_string();
    assert!(refused.contains(words), "{refused}");
}

#[test]
fn policies_of_one_agent_are_told_apart_by_what_they_were_trained_on() {
    let one = |name: &str, trained_on| fixture::assessed("PPO", name, &[trained_on], [200; 3]).policies;
    for (policies, words) in [
        ([one("CartPole", Some(D)), one("Pendulum", Some(R))].concat(), "they are of CartPole and Pendulum"),
        ([one("CartPole", None), one("CartPole", None)].concat(), "trained on the same"),
    ] {
        let refused = Assessed::new(String::new(), "PPO".into(), policies).unwrap_err().to_string();
        assert!(refused.contains(words), "{refused}");
    }
}

#[test]
fn agents_are_rows_behind_those_of_their_environment_and_their_assessments_are_runs() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let results = fixture::results(&plan, |_| Some(([90.0; 3], 1.0)));
    let mut selections = results.select();
    let assessed = [
        fixture::assessed("PPO", "CartPole", &[Some(D)], [200; 3]),
        fixture::assessed("PPO", "CartPole", &[Some(R)], [200; 3]), // the same run: nothing else has R
        fixture::assessed("PPO", "CartPole", &[Some(D), Some(R)], [190; 3]),
        fixture::assessed("SAC", "Acrobot", &[None], [200; 3]),
    ];
    add_assessed(&mut selections, &assessed);
    let rows: Vec<String> = selections.iter().map(|row| format!("{} {}", row.environment, row.method)).collect();
    assert_eq!(
        rows,
        ["CartPole a2c ff", "CartPole PPO (trained elsewhere)", "Pendulum a2c ff", "Acrobot SAC (trained elsewhere)"]
    );
    let trained = |row: &MethodResults<'_>| {
        let runs = row.runs.iter().map(|(run, of)| (*run, of.0.keys().map(ToString::to_string).collect::<String>()));
        runs.collect::<Vec<_>>()
    };
    assert_eq!(trained(&selections[1]), [(1, "DR".to_owned()), (2, "DR".to_owned())]);
    assert_eq!(trained(&selections[3]), [(1, "unknown".to_owned())]);
    // Of ten episodes with 190 steps and one more each, five have 195.
    assert_eq!(selections[1].metric(crate::Metric::Default), [(1, 100.0), (2, 50.0)].into());
}

/// Each letter is what a policy was trained on.
#[rstest]
#[case("D,DRE", "D,DRE")]
#[case("DR,RE", "DR,RE")]
#[case("D,R", "DR")]
#[case("D,DRE,R", "DR,DRE")]
fn no_run_has_a_part_of_an_assessment(#[case] assessments: &str, #[case] expected: &str) {
    let assessed = |letters: &str| {
        let trained_on = letters.chars().map(|letter| Some(letter.to_string().parse().unwrap()));
        fixture::assessed("PPO", "CartPole", &trained_on.collect::<Vec<Option<Version>>>(), [200; 3])
    };
    let assessed: Vec<_> = assessments.split(',').map(assessed).collect();
    let mut selections = Vec::new();
    add_assessed(&mut selections, &assessed);
    let runs = selections[0].runs.values().map(|run| run.0.keys().map(ToString::to_string).collect::<String>());
    assert_eq!(runs.collect::<Vec<_>>().join(","), expected);
    let reported = elsewhere(&selections);
    for one in &assessed {
        let of_one = reported.iter().filter(|(agent, ..)| std::ptr::eq(*agent, one));
        let runs: Vec<u32> = of_one.map(|(.., run)| *run).collect();
        assert_eq!(runs, vec![runs[0]; one.policies().len()]);
    }
}

#[test]
fn success_is_judged_by_the_plans_rule() {
    let rate = |text: &str, steps| {
        let plan = Plan::parse("test", text.into()).unwrap();
        let assessed = fixture::assessed("PPO", "CartPole", &[Some(D)], [steps; 3]).judged_as_in(&plan).unwrap();
        let policy = &assessed.policies()[0];
        let shown = policy.records.about.success.as_ref().unwrap().to_string();
        (policy.test("D").unwrap().success_percent, shown)
    };
    assert_eq!(rate(PLAN, 192), (70.0, "steps at least 195".into()));
    let other = PLAN.replace("runs = 2", "runs = 2\nsuccess = 'code'");
    assert_eq!(rate(&other, 192), (100.0, "steps at least 100".into()));
    assert_eq!(rate(&other, 95), (50.0, "steps at least 100".into()));
    let elsewhere = "environments = ['Pendulum']\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";
    assert_eq!(rate(elsewhere, 192), (70.0, "steps at least 195".into()), "the plan has nothing to say");
}
