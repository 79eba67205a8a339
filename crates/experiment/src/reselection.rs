//! Selection inside the bootstrap: how a number varies because chance influences the selected configuration.
//!
//! Each resample draws runs within each environment, like a bootstrap without selection. It also repeats every selection by
//! the plan's rule: it draws tuning seeds, and the number of successes of each selecting test from a binomial distribution
//! with the measured rate. The measured results of the configuration with the highest rank are reported, not its redrawn
//! rate, because the maximum of several redrawn rates is biased upwards. So the numbers that select are not the reported
//! ones, as in Tsamardinos, Greasidou and Borboudakis (2018, <https://doi.org/10.1007/s10994-018-5714-4>).
//!
//! With the paper's rule every configuration has been tested in every run. With the clean rule a configuration that was not
//! selected has no reported runs. Each of them is replaced by the tests of a drawn tuning cell of this configuration.

use std::collections::HashMap;

use perturb_policy::random::{Purpose, stream, uniform};
use perturb_protocol::Version;
use perturb_records::statistics::{Bootstrapped, MIN_RUNS_FOR_INTERVAL, mean, percentile_interval, resample};
use perturb_records::{Metric, TestResult, TrainedOn};
use perturb_settings::Method;

use crate::folder::{CellResult, CellState};
use crate::plan::{Cell, SELECTION_TEST, Selection};
use crate::selection::{MethodResults, Results, Selected, common_runs};

/// The seed for drawing runs, which is that of the interval without selection.
const RUNS_SEED: u64 = 1;
/// The seed for drawing selections. It is a separate stream, so the same runs are drawn with and without selection.
const SELECTION_SEED: u64 = 2;

/// All selections of a plan, with their candidates.
pub struct SelectionBootstrap<'a> {
    contests: HashMap<(&'a str, Method, TrainedOn<'a>, Option<u32>), Candidates<'a>>,
    rule: Selection,
}

/// A selection, whose candidates are in the plan's order.
#[derive(Default)]
struct Candidates<'a> {
    seeds: Vec<u64>,
    candidates: Vec<SelectableCell<'a>>,
}

struct SelectableCell<'a> {
    configuration: &'a str,
    tests: Vec<SelectionTest>,
}

/// A cell's selecting test.
struct SelectionTest {
    seed: u64,
    successes: Binomial,
    mean_return: f64,
    /// Success rates on D, R and E, %, that may be reported.
    rates: [Option<f64>; 3],
}

/// A reported run, with the indices of the selections of its policies by training distribution.
struct DrawnPolicy<'a> {
    score: f64,
    selected: [Option<(usize, Selected<'a>)>; 3],
}

impl<'a> SelectionBootstrap<'a> {
    /// Returns the bootstrap over all results.
    pub fn new(results: &'a Results<'a>) -> Self {
        let rule = results.plan.selection;
        let mut contests = HashMap::new();
        for (cell, state) in results.plan.cells.iter().zip(&results.states) {
            let CellState::Done(result) = state else { continue };
            let name = match rule {
                Selection::Paper => cell.trained_on().to_string(),
                Selection::Clean => SELECTION_TEST.into(), // which cells that are trained anew do not have
            };
            if let Some(test) = result.results.get(&name) {
                let contest: &mut Candidates<'a> = contests.entry(key(cell, rule, cell.run)).or_default();
                contest.add(cell, SelectionTest::new(cell, result, test));
            }
        }
        Self { contests, rule }
    }

    /// Returns `statistic` of a metric's scores, %, for each of the `resamples`. Scores are ordered by `selections`, then by
    /// the runs that all of them have. It works like [`bootstrap`](perturb_records::statistics::bootstrap), but repeats
    /// every selection in each resample.
    pub fn bootstrap(
        &self,
        selections: &[&MethodResults<'a>],
        metric: Metric,
        resamples: usize,
        statistic: impl Fn(&[Vec<f64>]) -> Vec<f64>,
    ) -> Option<Vec<Bootstrapped>> {
        let (contests, reported) = self.reported(selections, metric);
        let runs = reported.iter().map(Vec::len).min().filter(|runs| *runs > 0)?;
        let mut drawn: Vec<Vec<f64>> = reported.iter().map(|runs| runs.iter().map(|run| run.score).collect()).collect();
        let points = statistic(&drawn);
        let mut estimates = vec![Vec::with_capacity(resamples); points.len()];
        let sizes: Vec<usize> = reported.iter().map(Vec::len).collect();
        let mut rng = stream(SELECTION_SEED, Purpose::Bootstrap);
        let mut uniform = || uniform(&mut rng);
        let resamples = if runs < MIN_RUNS_FOR_INTERVAL { 0 } else { resamples };
        resample(&sizes, resamples, RUNS_SEED, |draws| {
            let winners: Vec<_> = contests.iter().map(|contest| contest.decide(&mut uniform)).collect();
            for ((drawn, runs), draws) in drawn.iter_mut().zip(&reported).zip(draws) {
                for (drawn, &run) in drawn.iter_mut().zip(draws) {
                    *drawn = runs[run].score_of(metric, &winners, &mut uniform);
                }
            }
            estimates.iter_mut().zip(statistic(&drawn)).for_each(|(estimates, number)| estimates.push(number));
        });
        let with_interval = |(point, estimates): (f64, Vec<f64>)| {
            let interval_95 = (resamples > 0).then(|| percentile_interval(estimates));
            Bootstrapped { point, interval_95, runs }
        };
        Some(points.into_iter().zip(estimates).map(with_interval).collect())
    }

    /// Returns the reported policies by `selections`, then by run, and the tests that selected them.
    fn reported(
        &self,
        selections: &[&MethodResults<'a>],
        metric: Metric,
    ) -> (Vec<&Candidates<'a>>, Vec<Vec<DrawnPolicy<'a>>>) {
        let (mut contests, mut places) = (Vec::new(), HashMap::new());
        let needs = |version| metric.value(|scenario| (scenario.train != version).then_some(0.0)).is_none();
        let mut reported: Vec<Vec<DrawnPolicy<'a>>> = selections.iter().map(|_| Vec::new()).collect();
        for (number, scores) in common_runs(selections, metric) {
            for ((runs, selection), score) in reported.iter_mut().zip(selections).zip(scores) {
                let selected = Version::ALL.map(|version| {
                    let selected = selection.runs[&number].cell_trained_on(TrainedOn::Version(version));
                    let selected = selected.filter(|_| needs(version))?;
                    let key = key(selected.cell, self.rule, number);
                    let contest = self.contests.get(&key)?;
                    let place = *places.entry(key).or_insert_with(|| {
                        contests.push(contest);
                        contests.len() - 1
                    });
                    Some((place, selected))
                });
                runs.push(DrawnPolicy { score, selected });
            }
        }
        (contests, reported)
    }
}

/// With the paper's rule each run has its own selection. With the clean rule all tuning cells select for all runs.
fn key(cell: &Cell, rule: Selection, run: u32) -> (&str, Method, TrainedOn<'_>, Option<u32>) {
    let run = (rule == Selection::Paper).then_some(run);
    (&cell.config.common.environment, cell.method(), cell.trained_on(), run)
}

impl<'a> Candidates<'a> {
    fn add(&mut self, cell: &'a Cell, test: SelectionTest) {
        if !self.seeds.contains(&test.seed) {
            self.seeds.push(test.seed);
        }
        match self.candidates.iter_mut().find(|known| known.configuration == cell.configuration) {
            Some(known) => known.tests.push(test),
            None => self.candidates.push(SelectableCell { configuration: &cell.configuration, tests: vec![test] }),
        }
    }

    /// Draws episodes and seeds, and returns the candidate with the highest rank. Ties are broken at random. Returns `None`
    /// if no candidate has a drawn seed.
    fn decide(&self, uniform: &mut impl FnMut() -> f64) -> Option<&SelectableCell<'a>> {
        if let [only] = &self.candidates[..] {
            return Some(only);
        }
        let seeds: Vec<u64> = match self.seeds[..] {
            [only] => vec![only],
            _ => self.seeds.iter().map(|_| *draw(&self.seeds, uniform)).collect(),
        };
        let (mut highest, mut best) = (None, Vec::new());
        for candidate in &self.candidates {
            let rank = candidate.rank(&seeds, uniform);
            if rank.is_none() || rank < highest {
                continue;
            }
            if rank > highest {
                highest = rank;
                best.clear();
            }
            best.push(candidate);
        }
        match best[..] {
            [] => None,
            [only] => Some(only),
            _ => Some(*draw(&best, uniform)),
        }
    }
}

impl SelectableCell<'_> {
    /// Returns the redrawn success rate and the mean return over those of `seeds` for which it has a test.
    fn rank(&self, seeds: &[u64], uniform: &mut impl FnMut() -> f64) -> Option<(f64, f64)> {
        let found = seeds.iter().filter_map(|seed| self.tests.iter().find(|test| test.seed == *seed));
        let tests: Vec<(f64, f64)> =
            found.map(|test| (test.successes.draw_percent(uniform()), test.mean_return)).collect();
        (!tests.is_empty()).then(|| (mean(tests.iter().map(|test| test.0)), mean(tests.iter().map(|test| test.1))))
    }
}

impl SelectionTest {
    fn new(cell: &Cell, result: &CellResult, test: &TestResult) -> Self {
        Self {
            seed: cell.config.common.seed,
            successes: Binomial::new(test),
            mean_return: test.mean_return,
            rates: Version::ALL.map(|on| result.results.get(&on.to_string()).map(|test| test.success_percent)),
        }
    }
}

impl DrawnPolicy<'_> {
    /// Returns the metric of this run as if `winners` had been selected. Returns the reported score if a test is missing.
    fn score_of(
        &self,
        metric: Metric,
        winners: &[Option<&SelectableCell<'_>>],
        uniform: &mut impl FnMut() -> f64,
    ) -> f64 {
        let others = self.selected.map(|selected| {
            let (place, selected) = selected?;
            let of_tuning = selected.cell.tuned_as.as_ref().unwrap_or(&selected.cell.configuration);
            let winner = winners[place].filter(|winner| winner.configuration != of_tuning)?;
            Some(if let [only] = &winner.tests[..] { only } else { draw(&winner.tests, uniform) })
        });
        let score = metric.value(|scenario| match others[scenario.train as usize] {
            Some(other) => other.rates[scenario.test as usize],
            None => self.selected[scenario.train as usize]?.1.rate(scenario.test),
        });
        score.unwrap_or(self.score)
    }
}

fn draw<'t, T>(all: &'t [T], uniform: &mut impl FnMut() -> f64) -> &'t T {
    &all[(uniform() * all.len() as f64) as usize]
}

/// Distribution of the number of successes among n episodes that are drawn with replacement from n episodes with k
/// successes.
struct Binomial {
    /// Cumulative weights of 0, 1 … n successes, not normalised.
    cumulative: Vec<f64>,
}

impl Binomial {
    fn new(test: &TestResult) -> Self {
        let n = test.episodes as usize;
        let k = ((test.success_percent * n as f64 / 100.0).round() as usize).min(n);
        let odds = k as f64 / (n - k) as f64;
        let mut weights = vec![0.0; n + 1];
        weights[k] = 1.0; // the most likely number, from which the others follow
        for i in k..n {
            weights[i + 1] = weights[i] * (n - i) as f64 / (i + 1) as f64 * odds;
        }
        for i in (0..k).rev() {
            weights[i] = weights[i + 1] * (i + 1) as f64 / (n - i) as f64 / odds;
        }
        let sum = |sum: &mut f64, weight: f64| {
            *sum += weight;
            Some(*sum)
        };
        Self { cumulative: weights.into_iter().scan(0.0, sum).collect() }
    }

    /// Returns the share of successes, %, at the quantile `place` of the distribution, 0 … 1.
    fn draw_percent(&self, place: f64) -> f64 {
        let n = self.cumulative.len() - 1;
        let successes = self.cumulative.partition_point(|below| *below <= place * self.cumulative[n]).min(n);
        100.0 * successes as f64 / n as f64
    }
}

#[cfg(test)]
#[path = "reselection_tests.rs"]
mod tests;
