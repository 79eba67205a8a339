//! Tests of the numbers that a report computes from recorded episodes, with several methods and runs.

use std::collections::BTreeMap;

use perturb_experiment::Cell;
use perturb_protocol::{Version, proto};
use perturb_records::{EpisodeRecord, RecordedTest, Records, RecordsMetadata};

use super::*;
use crate::fixture;
use crate::plot::svg;

/// A plan with two methods, trained on D and R in two runs.
const PLAN: &str = "
environments = ['CartPole']
versions = ['D', 'R']
runs = 2
[[algorithm]]
name = 'a2c'
architectures = ['ff']
[[algorithm]]
name = 'ppo'
architectures = ['ff']
";
/// Number of episodes in each test. The test on R has ten bins with 40 episodes each.
const EPISODES: u32 = 400;

/// Returns the pole length of an episode. Lengths on R are 0.25 … 0.75. Lengths on E are below and above this range.
fn length(version: Version, index: u32) -> f64 {
    let place = (f64::from(index) + 0.5) / f64::from(EPISODES);
    match version {
        Version::D => 0.5,
        Version::R => 0.25 + 0.5 * place,
        Version::E if place < 0.5 => 0.05 + 0.4 * place,
        Version::E | Version::RE => 0.75 + 0.5 * (place - 0.5),
    }
}

/// Returns an episode. A2C balances a pole of length l for 200 l steps. PPO balances it for 45 more steps in the first
/// run, and for 40 fewer steps in the second. An episode of at least 100 steps is a success.
fn episode(cell: &Cell, version: Version, index: u32) -> EpisodeRecord {
    let length = length(version, index);
    let more = match (cell.config.settings.name(), cell.run) {
        ("ppo", 1) => 45.0,
        ("ppo", _) => -40.0,
        _ => 0.0,
    };
    let steps = (200.0 * length + more).max(0.0) as u32;
    fixture::episode(&version.to_string(), index, length, steps, steps >= 100)
}

fn records(cell: &Cell) -> Records {
    let environment = proto::Environment {
        name: "CartPole".into(),
        parameters: vec![proto::Parameter { name: "length".into(), unit: "m".into(), ..Default::default() }],
        success: Some(proto::Success {
            quantity: "steps".into(),
            unit: "1".into(),
            comparison: proto::Comparison::AtLeast.into(),
            threshold: 100.0,
            ..Default::default()
        }),
        step_limit: 500,
        ..Default::default()
    };
    let mut records = Records::new(RecordsMetadata::new(&environment, String::new(), 1));
    for version in Version::ALL {
        let episodes = (0..EPISODES).map(|index| episode(cell, version, index)).collect();
        records.add(RecordedTest { set: version.into(), seed: 7, axes: None }, episodes);
    }
    records
}

/// Returns results whose success rates agree with the recorded episodes.
fn results(plan: &Plan) -> Results<'_> {
    fixture::results(plan, |cell| {
        let records = records(cell);
        Some((Version::ALL.map(|version| records.result(&version.to_string(), None).success_percent), 1.0))
    })
}

fn with_report(check: impl Fn(&Report<'_>)) {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let results = results(&plan);
    let selections = results.select();
    let mut recorded = Recorded::new(&selections);
    for (cell, result) in plan.cells.iter().zip(results.done()) {
        recorded.add(result, &records(cell));
    }
    check(&Report::new(&results, &selections, &recorded, &[]));
}

fn file(report: &Report<'_>, name: &str) -> Vec<String> {
    let files: BTreeMap<String, Table> = report.files().into_iter().map(|table| (table.title.clone(), table)).collect();
    String::from_utf8(files[name].to_csv()).unwrap().lines().map(str::to_owned).collect()
}

#[test]
fn success_over_parameter_has_a_row_for_each_bin() {
    with_report(|report| {
        let lines = file(report, "parameters.csv");
        let of = |start: &str| lines.iter().filter(|line| line.starts_with(start)).cloned().collect::<Vec<_>>();
        assert!(of("CartPole,ppo,ff,,D,D").is_empty(), "it does not vary there");
        let on_r = of("CartPole,ppo,ff,,D,R");
        assert_eq!((on_r.len(), of("CartPole,ppo,ff,,D,E").len()), (10, 5), "nothing between E's two intervals");
        // Lengths from 0.55 to 0.6 give 155 to 164 steps in the first run and 70 to 79 in the second, so 40 of 80
        // episodes are successes.
        assert!(
            on_r[6].contains(",2,80,40,50,39.") && on_r[6].starts_with("CartPole,ppo,ff,,D,R,length,m,0.5"),
            "{on_r:?}"
        );
    });
}

#[test]
fn methods_are_compared_over_runs_of_the_same_seed() {
    with_report(|report| {
        insta::assert_snapshot!(report.comparisons_table().unwrap().to_text(), @r"
         X       Y       metric         X − Y  P(X > Y)  pairs      p  corrected
         a2c ff  ppo ff  Default         50.0      0.75      2  1.000      1.000
         a2c ff  ppo ff  Interpolation   -2.5      0.50      2  1.000      1.000
         a2c ff  ppo ff  Extrapolation    4.4      0.50      2  1.000      1.000
        ");
        assert_eq!(file(report, "comparisons.csv").len(), 1 + 3);
    });
}

#[test]
fn pictures_have_their_files() {
    with_report(|report| {
        let pictures = report.pictures();
        let files: Vec<&str> = pictures.iter().map(|picture| picture.file.as_str()).collect();
        assert_eq!(files, ["CartPole-finding", "profiles", "CartPole-D-parameters", "CartPole-R-parameters"]);
        for picture in &pictures {
            let drawn = svg(&picture.drawing).unwrap();
            assert!(drawn.contains("a2c ff") && drawn.contains("ppo ff"), "{}", picture.file);
            let out = tempfile::tempdir().unwrap();
            picture.save(out.path()).unwrap();
            let read = |ending: &str| std::fs::read(out.path().join(format!("{}.{ending}", picture.file))).unwrap();
            assert_eq!((read("svg"), read("csv")), (drawn.into_bytes(), picture.data.to_csv()));
            assert!(picture.data.rows.len() >= 2, "numbers: {}", picture.file);
        }
    });
}
