//! A bootstrap that repeats the selection of configurations in each resample. Its intervals therefore include the
//! effect of chance on which configuration was selected.
//!
//! Each resample draws runs within each environment, as a bootstrap without selection does. It also repeats every
//! selection by the plan's rule. With the clean rule, it draws tuning seeds with replacement. With both rules, it draws
//! the number of successes of each selection test from a binomial distribution with the measured rate. The
//! configuration with the highest redrawn rate wins. The statistic then uses the winner's measured results, not its
//! redrawn rate, because the maximum of several redrawn rates is biased upwards. Using different numbers for the
//! selection and the estimate follows Tsamardinos, Greasidou and Borboudakis (2018,
//! <https://doi.org/10.1007/s10994-018-5714-4>).
//!
//! With the paper's rule, every configuration was tested in every run. With the clean rule, a configuration that was
//! not selected has no reported runs. If such a configuration wins in a resample, each run uses the tests of a tuning
//! cell of this configuration, drawn at random.

use std::collections::HashMap;

use perturb_policy::random::{Purpose, stream, uniform};
use perturb_protocol::Version;
use perturb_records::statistics::{Bootstrapped, MIN_RUNS_FOR_INTERVAL, mean, percentile_interval, resample};
use perturb_records::{Metric, TestResult, TrainedOn};
use perturb_settings::Method;

use crate::folder::{CellResult, CellState};
use crate::plan::{Cell, SELECTION_TEST, Selection};
use crate::selection::{MethodResults, Results, Selected, common_runs};

/// The seed for drawing runs. The ordinary bootstrap, which does not repeat selections, has the same seed.
const RUNS_SEED: u64 = 1;
/// The seed for repeating selections. It is separate from `RUNS_SEED`, so that this bootstrap draws the same runs as
/// the ordinary one.
const SELECTION_SEED: u64 = 2;

/// A bootstrap over the results of a plan that repeats all selections in each resample.
pub struct SelectionBootstrap<'a> {
    candidates_by_selection: HashMap<(&'a str, Method, TrainedOn<'a>, Option<u32>), Candidates<'a>>,
    rule: Selection,
}

/// The candidates of one selection, in the plan's order.
#[derive(Default)]
struct Candidates<'a> {
    seeds: Vec<u64>,
    candidates: Vec<CandidateConfiguration<'a>>,
}

/// A configuration that can be selected, with the selection tests of its cells.
struct CandidateConfiguration<'a> {
    configuration: &'a str,
    tests: Vec<SelectionTest>,
}

/// The result of the test by which a cell takes part in a selection.
struct SelectionTest {
    seed: u64,
    successes: Binomial,
    mean_return: f64,
    /// The cell's success rates on D, R and E, %; `None` for a version that it was not tested on.
    rates: [Option<f64>; 3],
}

/// A reported run of a method. `score` is its metric, %. For the training versions D, R and E, `selected` has the index
/// of the selection and the selected cell.
struct DrawnPolicy<'a> {
    score: f64,
    selected: [Option<(usize, Selected<'a>)>; 3],
}

impl<'a> SelectionBootstrap<'a> {
    /// Collects the selection tests of all finished cells.
    pub fn new(results: &'a Results<'a>) -> Self {
        let rule = results.plan.selection;
        let mut candidates_by_selection = HashMap::new();
        for (cell, state) in results.plan.cells.iter().zip(&results.states) {
            let CellState::Done(result) = state else { continue };
            let name = match rule {
                Selection::Paper => cell.trained_on().to_string(),
                Selection::Clean => SELECTION_TEST.into(), // only tuning cells have this test
            };
            if let Some(test) = result.results.get(&name) {
                let contest: &mut Candidates<'a> =
                    candidates_by_selection.entry(key(cell, rule, cell.run)).or_default();
                contest.add(cell, SelectionTest::new(cell, result, test));
            }
        }
        Self { candidates_by_selection, rule }
    }

    /// Computes the numbers that `statistic` returns, each with its 95 % bootstrap interval from `resamples` resamples.
    /// Repeats every selection in each resample; otherwise works like
    /// [`bootstrap`](perturb_records::statistics::bootstrap).
    ///
    /// `statistic` gets a list of scores of `metric`, %, for each of `selections`. A list has one score for each run
    /// that all of `selections` have. Returns `None` if there is no such run. There are no intervals if there are too
    /// few runs.
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

    /// Returns the candidates of each selection that chose a reported policy, and a list of reported runs for each of
    /// `selections`. Includes only runs that all of `selections` have.
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
                    let contest = self.candidates_by_selection.get(&key)?;
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

/// Returns the key of the selection that a cell takes part in. With the paper's rule, each run has its own selection.
/// With the clean rule, all tuning cells together select for all runs.
fn key(cell: &Cell, rule: Selection, run: u32) -> (&str, Method, TrainedOn<'_>, Option<u32>) {
    let run = (rule == Selection::Paper).then_some(run);
    (&cell.config.common.environment, cell.method(), cell.trained_on(), run)
}

impl<'a> Candidates<'a> {
    /// Adds the test of a cell to the candidate with the cell's configuration.
    fn add(&mut self, cell: &'a Cell, test: SelectionTest) {
        if !self.seeds.contains(&test.seed) {
            self.seeds.push(test.seed);
        }
        match self.candidates.iter_mut().find(|known| known.configuration == cell.configuration) {
            Some(known) => known.tests.push(test),
            None => {
                self.candidates.push(CandidateConfiguration { configuration: &cell.configuration, tests: vec![test] })
            }
        }
    }

    /// Repeats the selection with redrawn seeds and numbers of successes, and returns the winner. Ties of both
    /// rate and return are broken at random. Returns `None` if no candidate was tested with a drawn seed.
    fn decide(&self, uniform: &mut impl FnMut() -> f64) -> Option<&CandidateConfiguration<'a>> {
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

impl CandidateConfiguration<'_> {
    /// Returns the redrawn success rate, %, and the mean return, averaged over the tests with these `seeds`. Returns
    /// `None` if there is no such test.
    fn rank(&self, seeds: &[u64], uniform: &mut impl FnMut() -> f64) -> Option<(f64, f64)> {
        let found = seeds.iter().filter_map(|seed| self.tests.iter().find(|test| test.seed == *seed));
        let tests: Vec<(f64, f64)> =
            found.map(|test| (test.successes.draw_percent(uniform()), test.mean_return)).collect();
        (!tests.is_empty()).then(|| (mean(tests.iter().map(|test| test.0)), mean(tests.iter().map(|test| test.1))))
    }
}

impl SelectionTest {
    /// Returns the selection test of a finished cell.
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
    /// Returns the metric of this run, %, as if `winners` had been selected. `winners` has one element for each
    /// selection; `selected` contains indices of this list. Returns the reported score if a needed test is missing.
    fn score_of(
        &self,
        metric: Metric,
        winners: &[Option<&CandidateConfiguration<'_>>],
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

/// Returns a random element of `all`.
fn draw<'t, T>(all: &'t [T], uniform: &mut impl FnMut() -> f64) -> &'t T {
    &all[(uniform() * all.len() as f64) as usize]
}

/// Binomial distribution of the number of successes in n new episodes, if each succeeds with the measured rate of a
/// test of n episodes.
struct Binomial {
    /// Cumulative, unnormalised probabilities of 0, 1 … n successes.
    cumulative: Vec<f64>,
}

impl Binomial {
    /// Returns the distribution for the measured rate of `test`.
    fn new(test: &TestResult) -> Self {
        let n = test.episodes as usize;
        let k = ((test.success_percent * n as f64 / 100.0).round() as usize).min(n);
        let odds = k as f64 / (n - k) as f64;
        let mut weights = vec![0.0; n + 1];
        weights[k] = 1.0; // the most likely number; the loops compute the other weights from it
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

    /// Returns the success rate, %, at the quantile `place` (0 … 1) of the distribution. A uniformly random `place`
    /// gives a random draw.
    fn draw_percent(&self, place: f64) -> f64 {
        let n = self.cumulative.len() - 1;
        let successes = self.cumulative.partition_point(|below| *below <= place * self.cumulative[n]).min(n);
        100.0 * successes as f64 / n as f64
    }
}

#[cfg(test)]
#[path = "reselection_tests.rs"]
mod tests;
