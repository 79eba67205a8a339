use perturb_protocol::Version;
use perturb_protocol::Version::{D, R};
use rstest::rstest;

use super::*;
use crate::fixture;

const PLAN: &str = "environments = ['CartPole', 'Pendulum']\nversions = ['D']\nruns = 2
    [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

#[test]
fn external_agents_follow_their_environment_as_rows() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let results = fixture::results(&plan, |_| Some(([90.0; 3], 1.0)));
    let mut selections = results.select();
    let assessed = [
        fixture::assessed("PPO", "CartPole", &[Some(D)], [200; 3]),
        fixture::assessed("PPO", "CartPole", &[Some(R)], [200; 3]), // the same run, because no assessment in it has R
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
        let runs =
            row.runs.iter().map(|(run, of)| (*run, of.selected.keys().map(ToString::to_string).collect::<String>()));
        runs.collect::<Vec<_>>()
    };
    assert_eq!(trained(&selections[1]), [(1, "DR".to_owned()), (2, "DR".to_owned())]);
    assert_eq!(trained(&selections[3]), [(1, "unknown".to_owned())]);
    // Ten episodes have 190, 191 … 199 steps, so five have at least 195.
    assert_eq!(selections[1].metric(perturb_records::Metric::Default), [(1, 100.0), (2, 50.0)].into());
}

/// The first argument lists assessments, and the second one lists the expected runs, both separated by commas. Each
/// letter is the training distribution of a policy.
#[rstest]
#[case("D,DRE", "D,DRE")]
#[case("DR,RE", "DR,RE")]
#[case("D,R", "DR")]
#[case("D,DRE,R", "DR,DRE")]
fn all_policies_of_an_assessment_are_in_one_run(#[case] assessments: &str, #[case] expected: &str) {
    let assessed = |letters: &str| {
        let trained_on = letters.chars().map(|letter| Some(letter.to_string().parse().unwrap()));
        fixture::assessed("PPO", "CartPole", &trained_on.collect::<Vec<Option<Version>>>(), [200; 3])
    };
    let assessed: Vec<_> = assessments.split(',').map(assessed).collect();
    let mut selections = Vec::new();
    add_assessed(&mut selections, &assessed);
    let runs = selections[0].runs.values().map(|run| run.selected.keys().map(ToString::to_string).collect::<String>());
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
        let assessed = judged_as_in(&plan, fixture::assessed("PPO", "CartPole", &[Some(D)], [steps; 3])).unwrap();
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
