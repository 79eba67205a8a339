use perturb_records::statistics::{bootstrap, interquartile_mean};

use super::*;
use crate::fixture;
use crate::plan::Plan;
use crate::selection::scores;

const RESAMPLES: usize = 2000;

/// A plan with two configurations: learning rates 7e-3 (A) and 7e-4 (B).
const PLAN: &str = "
environments = ['CartPole', 'Pendulum']
versions = ['D', 'R']
runs = 3
[[algorithm]]
name = 'a2c'
architectures = ['ff']
grid = { learning_rate = [7e-3, 7e-4] }
";

fn plan(rule: &str) -> Plan {
    Plan::parse("test", format!("{rule}{PLAN}")).unwrap()
}

fn is_a(cell: &Cell) -> bool {
    cell.config.table()["learning_rate"].as_float() == Some(7e-3)
}

/// Returns two confidence intervals of a metric's interquartile mean. The first is from an ordinary bootstrap, the
/// second from a bootstrap that repeats the selection of configurations in each resample.
fn intervals(results: &Results<'_>, metric: Metric) -> [[f64; 2]; 2] {
    let selections = results.select();
    let both: Vec<_> = selections.iter().collect();
    let iqm = |strata: &[Vec<f64>]| vec![interquartile_mean(strata)];
    let without = bootstrap(&scores(&both, metric), RESAMPLES, RUNS_SEED, iqm).unwrap()[0];
    let with = SelectionBootstrap::new(results).bootstrap(&both, metric, RESAMPLES, iqm).unwrap()[0];
    assert_eq!((without.point, without.runs), (with.point, with.runs));
    [without, with].map(|number| number.interval_95.unwrap())
}

/// Returns [`intervals`] for two configurations with the paper's rule. On D and R, A has a success rate above 60 %, and
/// the rate of B is lower by `behind`. On E, A has 50 % and B has 0 %.
fn by_paper(behind: f64, metric: Metric) -> [[f64; 2]; 2] {
    let plan = plan("");
    let results = fixture::results(&plan, |cell| {
        let best = 60.0 + f64::from(cell.run);
        Some((if is_a(cell) { [best, best, 50.0] } else { [best - behind, best - behind, 0.0] }, 0.0))
    });
    intervals(&results, metric)
}

#[test]
fn a_selection_without_doubt_leaves_the_interval_as_it_is() {
    for metric in Metric::ALL {
        let [without, with] = by_paper(40.0, metric);
        assert_eq!(without, with, "{metric}: the same runs are drawn");
    }
}

#[test]
fn doubtful_selection_widens_the_interval() {
    // Rates of A and B are 0.1 percentage points apart, and a redrawn rate has a standard deviation of some 1.5. So
    // resamples select B almost as often as A, and the Extrapolation of B is 0.
    let [without, with] = by_paper(0.1, Metric::Extrapolation);
    assert!(without[0] > 50.0 && with[0] == 0.0 && with[1] <= without[1], "{without:?} {with:?}");
    // Redrawn rates are not reported, so no number is better than the best measured one.
    let [without, with] = by_paper(1.0, Metric::Default);
    assert!(with[0] < without[0] && with[1] <= without[1] && with[0] > without[0] - 1.01, "{without:?} {with:?}");
}

const CLEAN: &str = "selection = 'clean'\ntuning_runs = 2\nselection_episodes = 1000\n";

/// Returns [`intervals`] with the clean rule. `selecting` returns the success rate in a selection test; its arguments
/// are whether the configuration is A, and the tuning run. In reported tests, tuning cells of A have 90 %, tuning cells
/// of B 10 %, and cells trained after the selection some 80 %.
fn by_clean(selecting: fn(bool, u32) -> f64) -> [[f64; 2]; 2] {
    let mut plan = plan(CLEAN);
    let tuning = plan.cells.len();
    let anew: Vec<Cell> = plan.candidates.iter().filter(|cell| is_a(cell)).cloned().collect();
    plan.cells.extend(anew);
    let mut results = fixture::results(&plan, |cell| {
        Some((
            [if cell.tuned_as.is_some() {
                80.0 + f64::from(cell.run)
            } else if is_a(cell) {
                90.0
            } else {
                10.0
            }; 3],
            0.0,
        ))
    });
    for (cell, state) in plan.cells.iter().zip(&mut results.states).take(tuning) {
        let CellState::Done(result) = state else { unreachable!("all are done") };
        let success_percent = selecting(is_a(cell), cell.run);
        let test = TestResult { success_percent, ..result.results["D"].clone() };
        result.results.insert(SELECTION_TEST.into(), test);
    }
    intervals(&results, Metric::Default)
}

#[test]
fn tuning_cells_replace_missing_final_cells() {
    // A is better with both seeds, so every resample selects A and reports only cells that were trained after the
    // selection.
    let [without, with] = by_clean(|is_a, _| if is_a { 70.0 } else { 30.0 });
    assert_eq!(without, with);
    // A is better with the first seed and in the mean over both seeds, and B is better with the second seed. If a
    // resample draws the second seed twice, it selects B, which has 10 %.
    let [without, with] = by_clean(|is_a, run| {
        if is_a == (run == 1) {
            70.0
        } else if run == 1 {
            20.0
        } else {
            30.0
        }
    });
    assert!(without[0] > 80.0 && with[0] == 10.0 && with[1] == without[1], "{without:?} {with:?}");
}

#[test]
fn a_run_alone_has_no_interval() {
    let plan = Plan::parse("test", PLAN.replace("runs = 3", "runs = 1")).unwrap();
    let results = fixture::results(&plan, |_| Some(([50.0; 3], 0.0)));
    let selections = results.select();
    let both: Vec<_> = selections.iter().collect();
    let mean = |strata: &[Vec<f64>]| vec![interquartile_mean(strata)];
    let alone = SelectionBootstrap::new(&results).bootstrap(&both, Metric::Default, RESAMPLES, mean).unwrap();
    assert_eq!(alone, [Bootstrapped { point: 50.0, interval_95: None, runs: 1 }]);
}

#[test]
fn redrawn_successes_are_binomial() {
    let test = |success_percent, episodes| TestResult {
        episodes,
        success_percent,
        success_percent_95: [0.0; 2],
        mean_return: 0.0,
        mean_length: 0.0,
    };
    let quarter = Binomial::new(&test(25.0, 4));
    // The probability of no success is (3/4)⁴ = 0.3164, and of one success 0.4219.
    for (place, percent) in [(0.0, 0.0), (0.316, 0.0), (0.317, 25.0), (0.738, 25.0), (0.739, 50.0), (0.9999, 100.0)] {
        assert_eq!(quarter.draw_percent(place), percent, "{place}");
    }
    for sure in [0.0, 100.0] {
        let sure_of = Binomial::new(&test(sure, 1000));
        assert!([0.0, 0.5, 0.999_999].into_iter().all(|place| sure_of.draw_percent(place) == sure));
    }
    let many = Binomial::new(&test(40.0, 1000));
    // The 2.5th percentile is 40 - 1.96 · √(0.4 · 0.6 / 1000) · 100 = 37.0.
    assert!((many.draw_percent(0.025) - 37.0).abs() < 0.11, "{}", many.draw_percent(0.025));
}
