//! Paired differences in success on E: trained on R minus trained on D, same seed.

use std::collections::BTreeMap;

use perturb_experiment::{MethodResults, SelectedRun, distinct};
use perturb_protocol::Version;
use perturb_records::Scenario;
use perturb_records::statistics::{Bootstrapped, holm, mean_with_t_interval, sign_flip_p};
use perturb_settings::Method;
use perturb_text::Table;

use super::Report;
use super::columns::MethodColumns;
use super::comparisons::shown as shown_p;
use super::index::ReportIndex;
use super::numbers::or_empty;
use super::pictures::{Picture, PictureDrawing};
use crate::plot::intervals::{Group, IntervalRow};
use crate::plot::{IntervalPlot, panels};

/// Minimum number of pairs for an interval.
const MIN_PAIRS: usize = 2;
/// The name of all environments together in files. Readers see "all environments".
const ALL: &str = "all";
/// Step to which the axis is rounded, percentage points.
const STEP: f64 = 10.0;

const TITLE: &str = "Success on E of policies trained on R, less that of those trained on D";

/// The paired difference of a method in an environment, or over all.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct PairedDifference<'a> {
    /// The environment's name, or [`ALL`].
    environment: &'a str,
    method: Method,
    /// The number of pairs of runs, over all environments.
    pairs: usize,
    /// Percentage points, mean over environments and runs, with its t interval.
    points: Bootstrapped,
    /// The p-value of a sign-flip test over all pairs.
    p: f64,
    /// The p-value after Holm's correction for all methods of the same environment.
    corrected: f64,
}

/// Over all environments, if there are several, then those in each of them; of reference lines none, as in comparisons.
pub(super) fn gains<'a>(scope: &ReportIndex<'a>, selections: &[MethodResults<'a>]) -> Vec<PairedDifference<'a>> {
    let learners: Vec<_> = scope.methods.iter().filter(|method| !method.is_reference() && !method.external).collect();
    let of = |environments: &[&'a str], name: &'a str| -> Vec<PairedDifference<'a>> {
        let gain = |method: &&Method| gain(selections, method, environments, name);
        let mut gains: Vec<PairedDifference<'a>> =
            learners.iter().copied().filter_map(|method| gain(&method)).collect();
        let corrected = holm(&gains.iter().map(|gain| gain.p).collect::<Vec<_>>());
        gains.iter_mut().zip(corrected).for_each(|(gain, corrected)| gain.corrected = corrected);
        gains
    };
    let together = if scope.averaged.len() > 1 { of(&scope.averaged, ALL) } else { Vec::new() };
    together.into_iter().chain(scope.averaged.iter().flat_map(|name| of(&[*name], name))).collect()
}

/// Over the runs that all `environments` have.
fn gain<'a>(
    selections: &[MethodResults<'a>],
    method: &Method,
    environments: &[&'a str],
    name: &'a str,
) -> Option<PairedDifference<'a>> {
    let row = |environment: &&str| selections.iter().find(|it| it.environment == *environment && it.method == *method);
    let of_each: Vec<_> =
        environments.iter().map(|environment| row(environment).map(differences)).collect::<Option<_>>()?;
    let is_everywhere = |run: &&u32| of_each.iter().all(|runs| runs.contains_key(*run));
    let runs: Vec<u32> = of_each.first()?.keys().filter(is_everywhere).copied().collect();
    if runs.len() < MIN_PAIRS {
        return None;
    }
    let strata: Vec<Vec<f64>> = of_each.iter().map(|of| runs.iter().map(|run| of[run]).collect()).collect();
    let points = mean_with_t_interval(&strata)?;
    let (pairs, p) = (strata.iter().map(Vec::len).sum(), sign_flip_p(&strata.concat(), 1));
    Some(PairedDifference { environment: name, method: method.clone(), pairs, points, p, corrected: p })
}

/// By the numbers of the runs in which both policies were tested on E.
fn differences(row: &MethodResults<'_>) -> BTreeMap<u32, f64> {
    use Version::{D, E, R};
    let difference = |(number, run): (&u32, &SelectedRun<'_>)| {
        let rate = |train| run.rate(Scenario { train, test: E });
        Some((*number, rate(R)? - rate(D)?))
    };
    row.runs.iter().filter_map(difference).collect()
}

impl<'a> Report<'a> {
    /// `None` if there is nothing to compare.
    pub(super) fn gains_table(&self) -> Option<Table> {
        self.gains.first()?;
        let title = format!(
            "{TITLE}: percentage points with 95 % t intervals, pairs of the same seed, p of sign flips, \
             corrected after Holm for the methods of an environment"
        );
        let table = Table::builder(title, &self.gains)
            .text("environment", |row| shown(row.environment))
            .text("method", |row| &row.method)
            .number("R − D", |row| row.points)
            .number("pairs", |row| row.pairs)
            .number("p", |row| shown_p(row.p))
            .number("corrected", |row| shown_p(row.corrected))
            .build();
        Some(table)
    }

    pub(super) fn gains_file(&self) -> Table {
        let end =
            |row: &PairedDifference<'_>, end: usize| or_empty(row.points.interval_95.map(|interval| interval[end]));
        Table::builder("train_r_vs_d.csv", &self.gains)
            .text("environment", |row| row.environment)
            .method(|row| &row.method)
            .number("pairs", |row| row.pairs)
            .number("gain", |row| row.points.point)
            .number("low_95", move |row| end(row, 0))
            .number("high_95", move |row| end(row, 1))
            .number("p", |row| row.p)
            .number("corrected_p", |row| row.corrected)
            .build()
    }

    /// `None` if there is nothing to compare.
    pub(super) fn gains_picture(&self) -> Option<Picture> {
        self.gains.first()?;
        let ends = self.gains.iter().flat_map(|row| row.points.interval_95.unwrap_or([row.points.point; 2]));
        let most = ends.fold(0.0_f64, |most, end| most.max(end.abs()));
        let reach = STEP * (most / STEP).ceil().max(1.0);
        let row = |gain: &PairedDifference<'_>| IntervalRow {
            name: gain.method.to_string(),
            index: panels::index_of(&self.scope.methods, &gain.method),
            point: Some(gain.points.point),
            interval: gain.points.interval_95,
            other: None,
        };
        let group = |environment: &str| Group {
            name: shown(environment).into(),
            rows: self.gains.iter().filter(|gain| gain.environment == environment).map(row).collect(),
        };
        let drawing = IntervalPlot {
            title: TITLE.into(),
            x_name: "percentage points".into(),
            x: -reach..reach,
            groups: distinct(self.gains.iter().map(|gain| gain.environment)).into_iter().map(group).collect(),
            legend: ["mean over pairs of the same seed".into(), "95 % t interval of it".into(), String::new()],
            note: "Right of 0: training on R helped.".into(),
        };
        Some(Picture {
            environment: String::new(),
            file: "gains".into(),
            name: TITLE.into(),
            caption: format!(
                "{TITLE}: means over pairs of the same seed with 95 % t intervals. Right of 0 training on R \
                 helped."
            ),
            data: self.gains_file(),
            drawing: PictureDrawing::Intervals(drawing),
        })
    }
}

fn shown(environment: &str) -> &str {
    if environment == ALL { "all environments" } else { environment }
}

#[cfg(test)]
mod tests {
    use super::*;
    use perturb_experiment::{Cell, Plan};
    use perturb_records::TrainedOn;

    const A2C: &str = "[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

    /// Environment, method, pairs, points and their interval.
    type Row = (String, String, usize, f64, Option<[f64; 2]>);

    fn gains_of(file: &str, known: impl Fn(&Cell) -> Option<[f64; 3]>) -> Vec<Row> {
        let plan = Plan::parse("test", file.into()).unwrap();
        let results = crate::fixture::results(&plan, |cell| known(cell).map(|rates| (rates, 1.0)));
        let selections = results.select();
        let shown = |it: PairedDifference<'_>| {
            (it.environment.to_owned(), it.method.to_string(), it.pairs, it.points.point, it.points.interval_95)
        };
        gains(&ReportIndex::new(&plan, &selections), &selections).into_iter().map(shown).collect()
    }

    fn is_r(cell: &Cell) -> bool {
        cell.trained_on() == TrainedOn::Version(Version::R)
    }

    /// On E a policy of R has 10 points more than that of D with the same seed, in Pendulum 30, however far seeds lie apart.
    #[test]
    fn policies_of_a_seed_are_compared_where_neither_was_trained() {
        let random = "[[algorithm]]\nname = 'random'\narchitectures = ['ff']";
        let seeing = "[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\nsettings = { observe = 'parameters' }";
        let file = format!("environments = ['CartPole', 'Pendulum']\nruns = 3\n{A2C}\n{random}\n{seeing}");
        let rates = |cell: &Cell| {
            let more = if cell.config.common.environment == "Pendulum" { 30.0 } else { 10.0 };
            Some([50.0, 50.0, 20.0 * f64::from(cell.run) + if is_r(cell) { more } else { 0.0 }])
        };
        let row = |name: &str, pairs, points, interval| (name.to_owned(), "a2c ff".to_owned(), pairs, points, interval);
        let expected = [
            row(ALL, 6, 20.0, Some([20.0; 2])),
            row("CartPole", 3, 10.0, Some([10.0; 2])),
            row("Pendulum", 3, 30.0, Some([30.0; 2])),
        ];
        assert_eq!(gains_of(&file, rates), expected, "the points of each environment");
    }

    /// Run 1 of Pendulum has no policy of R: over all, the others count.
    #[test]
    fn all_environments_have_the_same_runs() {
        let file = format!("environments = ['CartPole', 'Pendulum']\nruns = 3\n{A2C}");
        let known = |cell: &Cell| {
            let is_missing = cell.config.common.environment == "Pendulum" && cell.run == 1 && is_r(cell);
            let points = if is_r(cell) { 10.0 * f64::from(cell.run) } else { 0.0 };
            (!is_missing).then_some([0.0, 0.0, points])
        };
        let pairs: Vec<_> = gains_of(&file, known).into_iter().map(|(.., pairs, points, _)| (pairs, points)).collect();
        assert_eq!(pairs, [(4, 25.0), (3, 20.0), (2, 25.0)]);
    }

    #[test]
    fn an_interval_holds_what_other_seeds_might_have_given() {
        let file = format!("environments = ['CartPole']\nruns = 5\n{A2C}");
        let rates = |cell: &Cell| Some([0.0, 0.0, if is_r(cell) { 10.0 * f64::from(cell.run) } else { 0.0 }]);
        let found = gains_of(&file, rates);
        let (.., points, interval) = &found[0];
        let [low, high] = interval.unwrap();
        assert_eq!(*points, 30.0);
        assert!((10.0..30.0).contains(&low) && (30.0..=50.0).contains(&high) && high - low > 15.0, "{low} to {high}");
    }

    #[test]
    fn one_pair_says_nothing() {
        let file = format!("environments = ['CartPole']\n{A2C}");
        assert_eq!(gains_of(&file, |_| Some([1.0; 3])), []);
    }
}
