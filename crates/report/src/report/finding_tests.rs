use std::collections::{BTreeMap, BTreeSet};

use perturb_experiment::{Cell, Plan, Recorded};
use perturb_protocol::Version;
use perturb_settings::Method;
use perturb_text::Table;
use rstest::rstest;

use super::*;
use crate::fixture;
use crate::report::{HeatmapPictures, ReportBundle};

/// Returns a plan with two methods.
fn plan(environments: &str, runs: u32) -> Plan {
    let text = format!(
        "# Does it help?\n# We asked.\n\nenvironments = [{environments}]\nruns = {runs}\npreset = 'paper'\n[[algorithm]]\nname = 'a2c'\n\
         architectures = ['ff']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']"
    );
    Plan::parse("test", text).unwrap()
}

fn rates(cell: &Cell) -> Option<([f64; 3], f64)> {
    let common = &cell.config.common;
    let of_run = f64::from(cell.run * cell.run) + if common.environment == "CartPole" { 40.0 } else { 10.0 };
    let is_missing = cell.config.settings.name() == "ppo" && common.environment == "Pendulum";
    (!is_missing).then_some(([of_run + 10.0, of_run, of_run / 2.0], 1.0))
}

fn with_report<T>(plan: &Plan, make: impl FnOnce(&Report<'_>) -> T) -> T {
    let results = fixture::results(plan, rates);
    let selections = results.select();
    make(&Report::new(&results, &selections, &Recorded::default(), &[]))
}

/// Returns the texts of each row of a table, sorted: environment, algorithm and metric, then `columns`.
fn written(table: &Table, columns: &[&str]) -> Vec<Vec<String>> {
    let place = |name: &&str| table.columns.iter().position(|column| column.name == *name).unwrap();
    let names = ["environment", "algorithm", "metric"].iter().chain(columns);
    let places: Vec<usize> = names.map(place).collect();
    let mut rows: Vec<Vec<String>> =
        table.rows.iter().map(|row| places.iter().map(|&place| row[place].text.clone()).collect()).collect();
    rows.sort();
    rows
}

fn intervals(picture: &Picture) -> &IntervalPlot {
    let PictureDrawing::Intervals(intervals) = &picture.drawing else { unreachable!("numbers with intervals") };
    intervals
}

#[test]
fn finding_numbers_match_tables_and_pictures() {
    with_report(&plan("'CartPole', 'Pendulum'", 5), |report| {
        let files = report.files();
        let rows = written(&files[0], &["runs", "mean", "low_95", "paper_mean"]);
        assert_eq!(rows.len(), 3 * 3 * 2, "two environments and their average, three metrics, two methods");
        let finding = report.finding_pictures();
        let pictured = written(&finding[0].data, &["runs", "mean", "low_95", "paper_mean"]);
        assert!(pictured.len() == 6 && pictured.iter().all(|row| rows.contains(row)), "{pictured:?} {rows:?}");

        let pictures = report.finding_pictures();
        assert_eq!(pictures.len(), 1);
        let drawn = intervals(&pictures[0]);
        assert_eq!(
            drawn.groups.iter().map(|group| group.name.as_str()).collect::<Vec<_>>(),
            Metric::ALL.map(|it| it.to_string())
        );
        for (group, metric) in drawn.groups.iter().zip(Metric::ALL) {
            for (row, of) in group.rows.iter().zip(&report.averages) {
                assert_eq!(row.name, of.method.to_string());
                assert_eq!(row.other, of.papers.get(&metric).map(|paper| paper.mean));
                let (ours, point) = (of.ours.get(&metric).map(|ours| ours.mean), row.point);
                assert!(ours.is_some() == point.is_some() && (ours.unwrap_or(0.0) - point.unwrap_or(0.0)).abs() < 1e-9);
                assert!(row.point.is_none() == row.interval.is_none(), "five runs have an interval");
                assert!(row.interval.is_none_or(|[low, high]| low < row.point.unwrap() && row.point.unwrap() < high));
            }
        }
        assert!(drawn.groups.iter().all(|group| group.rows[1].point.is_none()), "PPO has nothing on Pendulum");
        let each: Vec<_> = report.environment_pictures().into_iter().map(|picture| picture.file).collect();
        assert_eq!(each, ["CartPole-finding", "Pendulum-finding"]);
    });
}

#[rstest]
#[case(1, Some("No intervals: too few seeds (1 run)."))]
#[case(2, Some("No intervals: too few seeds (2 runs)."))]
#[case(3, None)]
fn too_few_seeds_have_no_interval_and_it_says_so(#[case] runs: u32, #[case] said: Option<&str>) {
    with_report(&plan("'CartPole'", runs), |report| {
        let pictures = report.finding_pictures();
        let drawn = intervals(&pictures[0]);
        assert_eq!(drawn.note, said.unwrap_or_default());
        assert_eq!(pictures[0].caption.contains(said.unwrap_or("too few")), said.is_some());
        assert_eq!(pictures[0].caption.contains("with 95 %"), said.is_none());
        let rows = drawn.groups.iter().flat_map(|group| &group.rows);
        assert!(rows.into_iter().all(|row| row.interval.is_some() == said.is_none()));
    });
}

/// Returns the finding's sentence for methods with five runs each. A row has a method's name, Default, Extrapolation
/// and the interval of Extrapolation. `missing` is the number of further methods without numbers.
fn said_of(rows: &[(&str, f64, f64, Option<[f64; 2]>)], missing: usize) -> Option<String> {
    said_of_runs(rows, &vec![5; rows.len()], missing)
}

fn said_of_runs(rows: &[(&str, f64, f64, Option<[f64; 2]>)], runs: &[usize], missing: usize) -> Option<String> {
    let plan = plan("'CartPole'", 1);
    let method = |name: &str| Method { algorithm: name.into(), ..plan.cells[0].method() };
    let of = |method: Method, means: BTreeMap<Metric, Bootstrapped>| MethodMetrics {
        environment: "CartPole",
        method,
        ours: BTreeMap::new(),
        ties: BTreeMap::new(),
        papers: BTreeMap::new(),
        comparable: true,
        means,
        zeros: BTreeSet::new(),
        iqms: BTreeMap::new(),
        gaps: BTreeMap::new(),
        reselected: BTreeMap::new(),
        done: 5,
        cells: 5,
    };
    let known = rows.iter().zip(runs).map(|(&(name, default, extrapolation, interval_95), &runs)| {
        let means = [
            (Metric::Default, Bootstrapped { point: default, interval_95: None, runs }),
            (Metric::Extrapolation, Bootstrapped { point: extrapolation, interval_95, runs }),
        ];
        of(method(name), means.into())
    });
    let rows: Vec<_> = known.chain((0..missing).map(|_| of(method("late"), BTreeMap::new()))).collect();
    finding_sentence(&rows)
}

#[rstest]
#[case::nothing(&[], 1, None)]
#[case::one(&[("a2c", 90.0, 30.25, None)], 0, Some(
    "a2c ff (paper) has Extrapolation of 30.2 % and Default of 90.0 %."))]
#[case::without_intervals_and_some_missing(&[("a2c", 0.0, 0.9, None), ("ppo", 90.0, 0.5, None)], 1, Some(
    "of 2 of 3 methods a2c ff (paper) generalises best, with Extrapolation of 0.9 % and Default of 0.0 %; next is ppo ff (paper), \
     with Extrapolation of 0.5 %. Extrapolation minus Default ranges from -89.5 to +0.9 points."))]
#[case::apart(&[("ppo", 9.0, 5.0, Some([3.0, 6.0])), ("a2c", 9.0, 8.0, Some([6.5, 9.0]))], 0, Some(
    "of 2 methods a2c ff (paper) generalises best, with Extrapolation of 8.0 % [6.5, 9.0] and Default of 9.0 %; next is ppo ff \
     (paper), with Extrapolation of 5.0 % [3.0, 6.0], and their intervals are apart. Extrapolation minus Default \
     ranges from -4.0 to -1.0 points."))]
#[case::alike_and_random(&[("ppo", 9.0, 8.0, Some([6.0, 9.0])), ("a2c", 8.0, 8.0, Some([6.5, 9.0])), ("random", 1.0, 99.0, None)], 0,
    Some("of 2 methods none generalises best: ppo ff (paper) and a2c ff (paper) have the same Extrapolation, 8.0 % [6.0, 9.0] \
     and 8.0 % [6.5, 9.0]. Extrapolation minus Default ranges from -1.0 to +0.0 points."))]
#[case::overlapping(&[("ppo", 9.0, 8.0, Some([6.0, 9.0])), ("a2c", 8.0, 7.9, Some([6.5, 9.0]))], 0,
    Some("of 2 methods ppo ff (paper) generalises best, with Extrapolation of 8.0 % [6.0, 9.0] and Default of 9.0 %; next is a2c ff \
     (paper), with Extrapolation of 7.9 % [6.5, 9.0], and their intervals overlap. Extrapolation minus Default \
     ranges from -1.0 to -0.1 points."))]
#[case::written_alike_before_another(&[("ppo", 9.0, 8.04, None), ("a2c", 8.0, 7.96, None), ("late", 9.0, 1.0, None)], 0,
    Some("of 3 methods none generalises best: ppo ff (paper) and a2c ff (paper) have the same Extrapolation, 8.0 %; next is late \
     ff (paper), with Extrapolation of 1.0 %. Extrapolation minus Default ranges from -8.0 to +0.0 points."))]
#[case::none_extrapolates(&[("ppo", 95.3, 0.0, None), ("a2c", 0.0, 0.04, None)], 1,
    Some("of 2 of 3 methods none extrapolates: each has Extrapolation of 0.0 %. Extrapolation minus \
     Default ranges from -95.3 to +0.0 points."))]
fn the_finding_in_words(
    #[case] rows: &[(&str, f64, f64, Option<[f64; 2]>)],
    #[case] missing: usize,
    #[case] said: Option<&str>,
) {
    assert_eq!(said_of(rows, missing).as_deref(), said);
}

#[rstest]
#[case::one(&[("ppo", 90.0, 8.0)], &[1], "ppo ff (paper) has Extrapolation of 8.0 % (1 run) and \
    Default of 90.0 % (1 run).")]
#[case::the_first(&[("ppo", 9.0, 8.0), ("a2c", 9.0, 5.0)], &[1, 3], "of 2 methods ppo ff (paper) comes out first, with \
    Extrapolation of 8.0 % (1 run) and Default of 9.0 % (1 run); next is a2c ff (paper), with Extrapolation of 5.0 %. \
    Extrapolation minus Default ranges from -4.0 to -1.0 points.")]
#[case::the_last(&[("ppo", 9.0, 8.0), ("a2c", 9.0, 5.04), ("late", 9.0, 4.96)], &[3, 3, 1], "of 3 methods ppo ff (paper) comes \
    out first, with Extrapolation of 8.0 % and Default of 9.0 %; next is a2c ff (paper), with Extrapolation of 5.0 %. \
    Extrapolation minus Default ranges from -4.0 to -1.0 points.")]
#[case::none(&[("ppo", 9.0, 8.0), ("a2c", 9.0, 5.0)], &[2, 2], "of 2 methods ppo ff (paper) generalises best, with \
    Extrapolation of 8.0 % and Default of 9.0 %; next is a2c ff (paper), with Extrapolation of 5.0 %. Extrapolation \
    minus Default ranges from -4.0 to -1.0 points.")]
#[case::alike(&[("ppo", 9.0, 8.0), ("a2c", 9.0, 8.0)], &[3, 1], "of 2 methods none comes out first: ppo ff (paper) and a2c ff \
    (paper) have the same Extrapolation, 8.0 % and 8.0 % (1 run). Extrapolation minus Default is -1.0 points for \
    each.")]
fn with_a_single_run_none_is_best(#[case] rows: &[(&str, f64, f64)], #[case] runs: &[usize], #[case] said: &str) {
    let rows: Vec<_> =
        rows.iter().map(|&(name, default, extrapolation)| (name, default, extrapolation, None)).collect();
    assert_eq!(said_of_runs(&rows, runs, 0).as_deref(), Some(said));
}

/// Each case has PPO's rates on D, R and E in two rows: trained on D, and trained on R or E. All rates of A2C are 0.
#[rstest]
#[case::by_one([[90.0, 20.0, 0.0], [90.0, 60.0, 2.0]], "CartPole: of 2 methods none extrapolates: each has Extrapolation of 0.0 %. \
    Extrapolation minus Default ranges from -90.0 to +0.0 points. Extrapolation is a geometric mean, and is 0 in a run \
    in which any of its three success rates is 0: for ppo ff (paper), DE.")]
#[case::by_two([[90.0, 20.0, 0.0], [90.0, 60.0, 0.0]], "CartPole: of 2 methods none extrapolates: each has Extrapolation of 0.0 %. \
    Extrapolation minus Default ranges from -90.0 to +0.0 points. Extrapolation is a geometric mean, and is 0 in a run \
    in which any of its three success rates is 0: for ppo ff (paper), DE and RE.")]
#[case::by_all([[90.0, 0.0, 0.0], [90.0, 60.0, 0.0]], "CartPole: of 2 methods none extrapolates: each has Extrapolation of 0.0 %. \
    Extrapolation minus Default ranges from -90.0 to +0.0 points.")]
fn zero_geometric_mean_is_explained(#[case] rates: [[f64; 3]; 2], #[case] said: &str) {
    let [on_d, on_r] = rates;
    let plan = plan("'CartPole'", 2);
    let results = fixture::results(&plan, |cell| {
        let of_ppo = if cell.config.common.version == Version::D { on_d } else { on_r };
        Some((if cell.config.settings.name() == "ppo" { of_ppo } else { [0.0; 3] }, 1.0))
    });
    let (selections, recorded) = (results.select(), Recorded::default());
    assert_eq!(Report::new(&results, &selections, &recorded, &[]).finding_sentences(), [said]);
}

fn page(plan: &Plan) -> String {
    let results = fixture::results(plan, rates);
    let selections = results.select();
    let recorded = Recorded::default();
    let report = Report::new(&results, &selections, &recorded, &[]);
    ReportBundle { report, curves: &[], comparisons: Vec::new(), heatmaps: &HeatmapPictures::default() }.page().unwrap()
}

#[test]
fn page_has_results_first_and_provenance_last() {
    let of_plan = plan("'CartPole'", 4);
    let opened = page(&of_plan);
    let order = [
        "<nav",
        "<h1>Generalisation of a2c ff (paper) and ppo ff (paper) on CartPole</h1>",
        "Does it help? We asked.",
        "aria-label=\"CartPole: Default, Interpolation and Extrapolation of each method\"><svg",
        "<section id=\"metrics\">",
        "<section id=\"scenarios\">",
        "<section id=\"statistics\">",
        "<h2>Provenance</h2>",
        "Plan: <a download=\"plan.toml\" href=\"data:text/plain;charset=utf-8,%23%20Does",
        "cells are done",
        "success as the paper's published code judges",
        "Done by perturb 0.1.0 (0123456789ab).",
    ];
    let mut rest = opened.as_str();
    for part in order {
        rest = rest.split_once(part).unwrap_or_else(|| panic!("{part} is not there, or earlier")).1;
    }
    assert_eq!(opened.matches("<section").count(), 5, "without curves and heatmaps");
    let text = format!("title = 'Wind & wires'\ndate = 2026-11-23\n{}", of_plan.text);
    let named = page(&Plan::parse("test", text).unwrap());
    assert!(named.contains("<h1>Wind &amp; wires</h1>") && named.contains("2026-11-23. Plan: "));
}

#[test]
fn every_figure_has_its_svg_and_its_csv_within_the_page() {
    let page = page(&plan("'CartPole', 'Pendulum'", 2));
    let figures: Vec<&str> =
        page.split("<figure>").skip(1).map(|rest| rest.split_once("</figure>").unwrap().0).collect();
    assert_eq!(figures.len(), 4, "the average, two environments, profiles");
    let decoded = |figure: &str, ending: &str| {
        let (_, rest) = figure.split_once(&format!(".{ending}\" href=\"data:")).unwrap();
        let content = rest.split_once(',').unwrap().1.split_once('"').unwrap().0;
        percent_encoding::percent_decode_str(content).decode_utf8().unwrap().into_owned()
    };
    for figure in figures {
        let shown = figure.split_once("<svg").unwrap().1.split_once("</svg>").unwrap().0;
        assert_eq!(decoded(figure, "svg").trim_end(), format!("<svg{shown}</svg>"), "what is shown");
        assert!(decoded(figure, "csv").lines().count() > 3);
    }
}
