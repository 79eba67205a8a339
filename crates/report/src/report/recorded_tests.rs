//! What a report makes of recorded episodes, of several methods with several runs.

use std::collections::BTreeMap;

use perturb_checkpoint::Counters;
use perturb_experiment::{CellFolder, CellState, Folder, read_curves};
use perturb_protocol::{Version, proto};
use perturb_records::{EpisodeRecord, RecordedTest, Records, RecordsMetadata};

use super::*;
use crate::fixture;
use crate::plot::svg;

/// Two methods that are trained on D and R, in two runs.
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
/// In each test: ten parts of forty, of one parameter.
const EPISODES: u32 = 400;

/// R's lengths are 0.25 … 0.75; E's are on either side.
fn length(version: Version, index: u32) -> f64 {
    let place = (f64::from(index) + 0.5) / f64::from(EPISODES);
    match version {
        Version::D => 0.5,
        Version::R => 0.25 + 0.5 * place,
        Version::E if place < 0.5 => 0.05 + 0.4 * place,
        Version::E | Version::RE => 0.75 + 0.5 * (place - 0.5),
    }
}

/// A2C balances a pole of length l for 200 l steps, PPO for 45 more in the first run and 40 less in the second; 100 are a
/// success.
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

/// Rates, %, of the recorded episodes.
fn results(plan: &Plan) -> Results<'_> {
    let mut results = fixture::results(plan, |cell| {
        let records = records(cell);
        Some((Version::ALL.map(|version| records.result(&version.to_string(), None).success_percent), 1.0))
    });
    for state in &mut results.states {
        let CellState::Done(result) = state else { unreachable!("all are done") };
        let (count, length) = trained(&result.training.method.algorithm);
        result.training.counters = Counters {
            iterations: 4,
            timesteps: count * length,
            episodes: count / 2,
            generated_episodes: count,
            learned_timesteps: count * length / 2,
        };
    }
    results
}

fn with_report(check: impl Fn(&Report<'_>)) {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let results = results(&plan);
    let selections = results.select();
    let mut recorded = Recorded::new(&selections);
    for (cell, result) in plan.cells.iter().zip(results.done()) {
        recorded.add(result, &records(cell));
    }
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    for cell in &plan.cells {
        monitor(cell, &folder.cell(&cell.id));
    }
    let curves = read_curves(&selections, &folder).unwrap();
    check(&Report::new(&results, &selections, &recorded, &curves));
}

/// Episodes of a training, which learned from every other one, and steps of each.
fn trained(algorithm: &str) -> (u64, u64) {
    if algorithm == "ppo" { (80, 10) } else { (40, 40) }
}

/// The second half of the episodes are successes.
fn monitor(cell: &Cell, folder: &CellFolder) {
    let (count, length) = trained(cell.config.settings.name());
    let line = |index: u64| format!("1,{length},{}\n", u8::from(2 * index >= count));
    std::fs::create_dir_all(folder.training()).unwrap();
    let lines: String = (0..count).map(line).collect();
    std::fs::write(folder.training().join("monitor.csv"), format!("r,l,success\n{lines}")).unwrap();
}

fn file(report: &Report<'_>, name: &str) -> Vec<String> {
    let files: BTreeMap<String, Table> = report.files().into_iter().map(|table| (table.title.clone(), table)).collect();
    String::from_utf8(files[name].to_csv()).unwrap().lines().map(str::to_owned).collect()
}

#[test]
fn the_worst_tenth_is_of_each_test_and_over_runs() {
    with_report(|report| {
        // On R the worst 40 of 400 have lengths from 0.25 to 0.3: 50 to 59 steps of A2C, 45 more or 40 less of PPO, whose
        // first run succeeds with half of them.
        insta::assert_snapshot!(report.worst_tables()[0].to_text(), @r"
         method  trained on   return on D  return on R  return on E  contexts of R  contexts of E
         a2c ff  D            100.0 ± 0.0   54.5 ± 0.0   13.5 ± 0.0      0.0 ± 0.0      0.0 ± 0.0
         a2c ff  R            100.0 ± 0.0   54.5 ± 0.0   13.5 ± 0.0      0.0 ± 0.0      0.0 ± 0.0
         ppo ff  D           102.5 ± 42.5  57.0 ± 42.5  29.2 ± 29.2    25.0 ± 25.0      0.0 ± 0.0
         ppo ff  R           102.5 ± 42.5  57.0 ± 42.5  29.2 ± 29.2    25.0 ± 25.0      0.0 ± 0.0
        ");
        assert_eq!(file(report, "cvar.csv").len(), 1 + 2 * 2 * 3);
    });
}

#[test]
fn success_over_parameter_has_a_row_for_each_bin() {
    with_report(|report| {
        let lines = file(report, "parameters.csv");
        let of = |start: &str| lines.iter().filter(|line| line.starts_with(start)).cloned().collect::<Vec<_>>();
        assert!(of("CartPole,ppo,ff,,D,D").is_empty(), "it does not vary there");
        let on_r = of("CartPole,ppo,ff,,D,R");
        assert_eq!((on_r.len(), of("CartPole,ppo,ff,,D,E").len()), (10, 5), "nothing between E's two intervals");
        // From 0.55 to 0.6, in the first run 155 to 164 steps, in the second 70 to 79: half of 80 are successes.
        assert!(
            on_r[6].contains(",2,80,40,50,39.") && on_r[6].starts_with("CartPole,ppo,ff,,D,R,length,m,0.5"),
            "{on_r:?}"
        );
    });
}

#[test]
fn success_over_the_threshold_is_judged_anew() {
    with_report(|report| {
        let lines = file(report, "thresholds.csv");
        let of = |threshold: &str| {
            let start = format!("CartPole,a2c,ff,,D,R,steps,1,at least,{threshold},");
            let line = lines.iter().find(|line| line.starts_with(&start)).cloned();
            line.map(|line| line.split(',').nth(13).unwrap().to_owned())
        };
        let [own, tables] = [of("100"), of("0")];
        assert_eq!((own.as_deref(), tables.as_deref()), (Some("50"), Some("100")), "{lines:?}");
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
fn trainings_are_compared_after_as_many_steps_and_episodes() {
    with_report(|report| {
        // All have 40 episodes and 800 steps. There PPO is at half of its episodes, and A2C at half of its steps.
        insta::assert_snapshot!(report.footing_tables()[0].to_text(), @r"
         method  trained on  steps  episodes  iterations  episodes that all have   success, %  steps that all have   success, %
         a2c ff  D            1600        40           4                      40  100.0 ± 0.0                  800    0.0 ± 0.0
         a2c ff  R            1600        40           4                      40  100.0 ± 0.0                  800    0.0 ± 0.0
         ppo ff  D             800        80           4                      40    0.0 ± 0.0                  800  100.0 ± 0.0
         ppo ff  R             800        80           4                      40    0.0 ± 0.0                  800  100.0 ± 0.0
        ");
    });
}

#[test]
fn pictures_have_their_files() {
    with_report(|report| {
        let pictures = report.pictures();
        let files: Vec<&str> = pictures.iter().map(|picture| picture.file.as_str()).collect();
        let of_environment = ["CartPole-D-parameters", "CartPole-R-parameters", "CartPole-thresholds"];
        assert_eq!(files, [&["CartPole-finding", "profiles", "gains"], &of_environment[..]].concat());
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
