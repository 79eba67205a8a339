//! Compares every two methods, by pairs of runs with the same seed in the same environment.

use perturb_experiment::{MethodResults, scores};
use perturb_records::Metric;
use perturb_records::statistics::{Bootstrapped, holm, mean_with_t_interval, probability_of_improvement, sign_flip_p};
use perturb_settings::Method;
use perturb_text::Table;

use super::columns::MethodColumns;
use super::index::ReportIndex;
use super::{MISSING, Report};

/// Number of bootstrap resamples for a comparison. It is smaller than for other numbers of a report, because a report
/// may have hundreds of comparisons.
const RESAMPLES: usize = 10_000;
/// Minimum number of runs in each environment for a comparison.
const MIN_RUNS: usize = 2;
/// The name that stands for all environments together.
const ALL: &str = "all";

/// A comparison of the methods x and y by one metric, over the runs that both methods have in every compared
/// environment.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct MethodComparison {
    /// The environment's name, or [`ALL`].
    environment: String,
    x: Method,
    y: Method,
    metric: Metric,
    /// The difference x − y in percentage points, averaged over environments and runs.
    difference: Bootstrapped,
    /// The probability that a random run of x has a higher score than a random run of y.
    improvement: Bootstrapped,
    pairs: usize,
    p: f64,
    /// The p-value after Holm's correction for all comparisons of the same environment.
    corrected: f64,
}

/// Compares all methods over all environments together and then, if there are several, in each environment.
pub(super) fn comparisons(scope: &ReportIndex<'_>, selections: &[MethodResults<'_>]) -> Vec<MethodComparison> {
    let environments = &scope.averaged;
    if let [environment] = environments[..] {
        return family(scope, selections, environment, &[environment]);
    }
    let each = environments.iter().flat_map(|environment| family(scope, selections, environment, &[environment]));
    family(scope, selections, ALL, environments).into_iter().chain(each).collect()
}

/// Compares all methods over `environments`, and corrects the p-values of these comparisons together. Leaves out
/// reference methods such as the random policy, because each of them would raise all corrected p-values. Also leaves
/// out agents that were trained outside of the experiment, because their runs share no seeds with other runs.
fn family(
    scope: &ReportIndex<'_>,
    selections: &[MethodResults<'_>],
    name: &str,
    environments: &[&str],
) -> Vec<MethodComparison> {
    let mut methods = scope.methods.clone();
    methods.retain(|method| !method.is_reference() && !method.external);
    let found = |method: &Method| -> Option<Vec<&MethodResults<'_>>> {
        let of = |environment| selections.iter().find(|of| of.environment == environment && of.method == *method);
        environments.iter().map(|environment| of(*environment)).collect()
    };
    let mut family = Vec::new();
    for (index, x) in methods.iter().enumerate() {
        for y in &methods[index + 1..] {
            let (Some(of_x), Some(of_y)) = (found(x), found(y)) else { continue };
            let both = [of_x, of_y].concat();
            let compared = |metric| compare(name, [x, y], metric, &scores(&both, metric));
            family.extend(Metric::ALL.into_iter().filter_map(compared));
        }
    }
    let corrected = holm(&family.iter().map(|comparison| comparison.p).collect::<Vec<_>>());
    family.iter_mut().zip(corrected).for_each(|(comparison, corrected)| comparison.corrected = corrected);
    family
}

/// Compares x with y. `scores` has x's scores by environment and run, then y's in the same order. Returns `None` if
/// there are fewer than [`MIN_RUNS`] runs. The corrected p-value is set later.
fn compare(environment: &str, [x, y]: [&Method; 2], metric: Metric, scores: &[Vec<f64>]) -> Option<MethodComparison> {
    let (of_x, of_y) = scores.split_at(scores.len() / 2);
    let difference = |(x, y): (&Vec<f64>, &Vec<f64>)| x.iter().zip(y).map(|(x, y)| x - y).collect();
    let differences: Vec<Vec<f64>> = of_x.iter().zip(of_y).map(difference).collect();
    let pairs = differences.concat();
    if differences.first()?.len() < MIN_RUNS {
        return None;
    }
    let improvement = |strata: &[Vec<f64>]| {
        let (x, y) = strata.split_at(strata.len() / 2);
        probability_of_improvement(x, y)
    };
    let p = sign_flip_p(&pairs, 1);
    Some(MethodComparison {
        environment: environment.into(),
        x: x.clone(),
        y: y.clone(),
        metric,
        difference: mean_with_t_interval(&differences)?,
        improvement: Bootstrapped::new(scores, RESAMPLES, 1, improvement)?,
        pairs: pairs.len(),
        p,
        corrected: p,
    })
}

impl Report<'_> {
    /// Returns the table of comparisons over all environments; `None` if there are no comparisons.
    pub(super) fn comparisons_table(&self) -> Option<Table> {
        let first = self.comparisons.first()?;
        let of_all = self.comparisons.chunk_by(|a, b| a.environment == b.environment).next()?;
        let title = format!(
            "Methods compared in pairs, {}: differences in percentage points with 95 % t intervals, probabilities of \
             improvement with 95 % stratified bootstrap intervals, p of sign flips, corrected after Holm for the {} comparisons",
            if first.environment == ALL { "all environments" } else { &first.environment },
            of_all.len()
        );
        let table = Table::builder(title, of_all)
            .text("X", |row| &row.x)
            .text("Y", |row| &row.y)
            .text("metric", |row| row.metric)
            .number("X − Y", |row| row.difference)
            .number("P(X > Y)", |row| format!("{:.2}", row.improvement))
            .number("pairs", |row| row.pairs)
            .number("p", |row| format_p(row.p))
            .number("corrected", |row| format_p(row.corrected))
            .build();
        Some(table)
    }

    /// Returns the file `comparisons.csv`.
    pub(super) fn comparisons_file(&self) -> Table {
        let end = |number: &Bootstrapped, end: usize| {
            number.interval_95.map(|interval| interval[end].to_string()).unwrap_or_default()
        };
        Table::builder("comparisons.csv", &self.comparisons)
            .text("environment", |row| &row.environment)
            .method_as("x_", |row| &row.x)
            .method_as("y_", |row| &row.y)
            .text("metric", |row| row.metric)
            .number("pairs", |row| row.pairs)
            .number("difference", |row| row.difference.point)
            .number("difference_low_95", move |row| end(&row.difference, 0))
            .number("difference_high_95", move |row| end(&row.difference, 1))
            .number("improvement", |row| row.improvement.point)
            .number("improvement_low_95", move |row| end(&row.improvement, 0))
            .number("improvement_high_95", move |row| end(&row.improvement, 1))
            .number("p", |row| row.p)
            .number("p_holm", |row| row.corrected)
            .build()
    }
}

/// Formats a p-value with three decimals. A p-value that would be rounded to 0.000 becomes "< 0.001".
pub(super) fn format_p(p: f64) -> String {
    if p < 0.0005 {
        "< 0.001".into()
    } else if p.is_nan() {
        MISSING.into()
    } else {
        format!("{p:.3}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_of_the_same_seed_are_pairs() {
        let plan = "environments = ['CartPole']\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff', 'rc']";
        let methods = perturb_experiment::Plan::parse("test", plan.into()).unwrap().methods();
        let compared = |scores: &[Vec<f64>]| compare(ALL, [&methods[0], &methods[1]], Metric::Default, scores);
        // In both environments, x is better by 1 in each run, although the scores differ widely between runs.
        let [x, y] = [0.0, 1.0].map(|less| [10.0, 50.0, 90.0].map(|score| score - less).to_vec());
        let comparison = compared(&[x.clone(), x.clone(), y.clone(), y]).unwrap();
        assert_eq!((comparison.difference.point, comparison.difference.interval_95), (1.0, Some([1.0, 1.0])));
        assert_eq!((comparison.pairs, comparison.p), (6, 2_f64.powi(-5)));
        // Each of x's three runs is compared with each of y's three runs. The runs of x with scores 10, 50 and 90 beat
        // one, two and three runs of y: 6 of 9 in total.
        assert!((comparison.improvement.point - 6.0 / 9.0).abs() < 1e-12);
        assert_eq!(compared(&[vec![1.0], vec![2.0]]), None, "one run says nothing of others");
    }

    #[test]
    fn a_reference_line_changes_no_comparison() {
        let learners =
            "environments = ['CartPole']\nruns = 3\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff', 'rc']";
        let of = |text: String| {
            let plan = perturb_experiment::Plan::parse("test", text).unwrap();
            let rate =
                |cell: &perturb_experiment::Cell| 10.0 * f64::from(cell.run) + cell.method().to_string().len() as f64;
            let results = crate::fixture::results(&plan, |cell| Some(([rate(cell); 3], 1.0)));
            let selections = results.select();
            comparisons(&ReportIndex::new(&plan, &selections), &selections)
        };
        let without = of(learners.into());
        assert_eq!(without.len(), Metric::ALL.len());
        assert_eq!(of(format!("{learners}\n[[algorithm]]\nname = 'random'\narchitectures = ['ff']")), without);
    }
}
