//! The main result of an experiment: a picture of Default, Interpolation and Extrapolation with their intervals and the
//! paper's numbers, and a sentence about it.

use perturb_experiment::{Selection, distinct};
use perturb_records::statistics::Bootstrapped;
use perturb_records::{Metric, Scenario};
use perturb_text::count;

use super::csv::metrics_file;
use super::numbers::{AVERAGE, MethodMetrics};
use super::pictures::{Picture, PictureDrawing};
use super::{MISSING, Report};
use crate::plot::intervals::{Group, IntervalRow};
use crate::plot::{IntervalPlot, panels};

impl<'a> Report<'a> {
    /// Returns the first pictures of the page: a picture of the average over environments or, if there is no average, a
    /// picture for each environment.
    pub(super) fn finding_pictures(&self) -> Vec<Picture> {
        self.opening_rows().into_iter().map(|rows| self.finding_picture(rows)).collect()
    }

    /// Returns a text of one to three sentences for each of the [`finding_pictures`](Self::finding_pictures) in which
    /// some method has Extrapolation.
    pub(super) fn finding_sentences(&self) -> Vec<String> {
        let rows = self.opening_rows().into_iter();
        rows.filter_map(|rows| Some(format!("{}: {}", self.finding_of(rows), finding_sentence(rows)?))).collect()
    }

    /// Returns a picture for each environment if the page begins with a picture of the average. Otherwise the page
    /// already begins with a picture of each environment, so returns an empty list.
    pub(super) fn environment_pictures(&self) -> Vec<Picture> {
        if !self.has_average() {
            return Vec::new();
        }
        self.each_environment().map(|rows| self.finding_picture(rows)).collect()
    }

    /// Returns the rows of each picture at the start of the page.
    fn opening_rows(&self) -> Vec<&[MethodMetrics<'a>]> {
        if self.has_average() { vec![&self.averages] } else { self.each_environment().collect() }
    }

    /// Returns whether there is an average over several environments.
    fn has_average(&self) -> bool {
        self.scope.averaged.len() > 1 && self.averages.iter().any(|row| !row.ours.is_empty())
    }

    /// Returns the rows of each environment.
    fn each_environment(&self) -> impl Iterator<Item = &[MethodMetrics<'a>]> {
        self.metrics.chunk_by(|a, b| a.environment == b.environment)
    }

    /// Returns the name of the environment of `rows`, or "Average over …" if `rows` are averages over environments.
    fn finding_of(&self, rows: &[MethodMetrics<'_>]) -> String {
        if rows[0].environment != AVERAGE {
            return rows[0].environment.to_owned();
        }
        let environments = match self.scope.averaged.len() {
            2 => listed(&self.scope.averaged),
            several => count(several, "environment"),
        };
        format!("Average over {environments}")
    }

    /// Returns the picture of the methods in `rows`, which are all in one environment or all averages. It has a group
    /// of rows for each metric.
    fn finding_picture(&self, rows: &[MethodMetrics<'_>]) -> Picture {
        let is_average = rows[0].environment == AVERAGE;
        let of = self.finding_of(rows);
        let file = if is_average { "finding".to_owned() } else { format!("{of}-finding") };
        let over = if is_average { "environments and runs" } else { "runs" };
        let of_rows = |has: &dyn Fn(&MethodMetrics<'_>) -> bool| rows.iter().any(has);
        let has_intervals = of_rows(&|row| row.means.values().any(|mean| mean.interval_95.is_some()));
        let intervals = if has_intervals { " with 95 % t intervals" } else { "" };
        let papers = if of_rows(&|row| !row.papers.is_empty()) { ", beside the paper's means" } else { "" };
        let conditional = match self.plan.selection {
            Selection::Paper if !intervals.is_empty() && self.plan.selects() => {
                " The intervals apply to the selected configurations, and ignore that others might have been selected."
            }
            _ => "",
        };
        let group = |metric: Metric| Group {
            name: metric.to_string(),
            rows: rows.iter().map(|row| self.finding_row(row, metric)).collect(),
        };
        let drawing = IntervalPlot {
            title: format!("{of}: where policies were trained, and elsewhere"),
            x_name: "success rate, %".into(),
            x: panels::RATES,
            groups: Metric::ALL.map(group).into(),
            legend: [
                format!("mean over {over}"),
                "its 95 % t interval".into(),
                "the paper's mean, of five runs".into(),
            ],
            note: too_few(rows).unwrap_or_default(),
        };
        let said = too_few(rows).map(|few| format!(" {few}")).unwrap_or_default();
        Picture {
            environment: if is_average { String::new() } else { rows[0].environment.to_owned() },
            name: format!("{of}: Default, Interpolation and Extrapolation of each method"),
            caption: format!(
                "{of}: Default, Interpolation and Extrapolation; means over {over}{intervals}{papers}.{said}{conditional}"
            ),
            data: metrics_file(&format!("{file}.csv"), &rows.iter().collect::<Vec<_>>()),
            file,
            drawing: PictureDrawing::Intervals(drawing),
        }
    }

    /// Returns a method's row in the group of `metric`.
    fn finding_row(&self, row: &MethodMetrics<'_>, metric: Metric) -> IntervalRow {
        IntervalRow {
            name: row.method.to_string(),
            index: panels::index_of(&self.scope.methods, &row.method),
            point: row.means.get(&metric).map(|mean| mean.point),
            interval: row.means.get(&metric).and_then(|mean| mean.interval_95),
            other: row.papers.get(&metric).map(|paper| paper.mean),
        }
    }
}

/// Returns sentences that name the method with the best Extrapolation and the next one, and compare Extrapolation with
/// Default. Returns `None` if no method has Extrapolation. If several methods have the highest rounded number, they
/// share the first place and none is called best. If a method has a single run, no method is called best either, and
/// the method's numbers are marked. Policies that learn nothing are left out.
fn finding_sentence(rows: &[MethodMetrics<'_>]) -> Option<String> {
    // Ranks the methods by Extrapolation.
    let learned: Vec<_> = rows.iter().filter(|row| row.method.learns()).collect();
    let mean = |row: &MethodMetrics<'_>, metric| row.means.get(&metric).copied();
    let both = |row: &MethodMetrics<'_>| Some((mean(row, Metric::Default)?, mean(row, Metric::Extrapolation)?));
    let mut ranked: Vec<_> =
        learned.iter().filter_map(|row| both(row).map(|(default, mean)| (*row, default, mean))).collect();
    ranked.sort_by(|(.., a), (.., b)| b.point.total_cmp(&a.point));
    let &(best, default, extrapolation) = ranked.first()?;
    let numbers = format!("Extrapolation of {} and Default of {}", format_mean(extrapolation), format_mean(default));
    let zeros = zero_sentence(ranked.iter().filter(|(.., mean)| mean.point == 0.0).map(|(row, ..)| *row));
    if ranked.len() == 1 {
        return Some(format!("{} has {numbers}.{zeros}", best.method));
    }
    let written = |mean: &Bootstrapped| format!("{:.1}", mean.point);
    let number = written(&extrapolation);
    // `first` are the methods with the highest rounded number.
    let (first, others) = ranked.split_at(ranked.partition_point(|(.., mean)| written(mean) == number));
    let some_of_one_run = ranked.iter().any(|(.., mean)| mean.runs == 1);
    let claimed = if some_of_one_run { "comes out first" } else { "generalises best" };
    let found = match first {
        _ if number == "0.0" => "none extrapolates: each has Extrapolation of 0.0 %".to_owned(),
        [_] => format!("{} {claimed}, with {numbers}", best.method),
        _ => format!(
            "none {claimed}: {} have the same Extrapolation, {}",
            listed(&first.iter().map(|(row, ..)| row.method.to_string()).collect::<Vec<_>>()),
            listed(&distinct(first.iter().map(|(.., mean)| format_mean(*mean)))),
        ),
    };
    // Compares the intervals of the best methods and of the next method, if all of these have one.
    let next = others.first().map(|(row, _, extrapolation)| {
        let lowest = first.iter().map(|(.., mean)| Some(mean.interval_95?[0])).reduce(|a, b| Some(a?.min(b?)));
        let intervals = match (lowest.flatten(), extrapolation.interval_95) {
            (Some(low), Some([_, high])) if high < low => ", and their intervals are apart",
            (Some(_), Some(_)) => ", and their intervals overlap",
            _ => "",
        };
        format!("; next is {}, with Extrapolation of {}{intervals}", row.method, format_mean(*extrapolation))
    });
    let of = if ranked.len() < learned.len() { format!(" of {}", learned.len()) } else { String::new() };
    let differences: Vec<f64> = ranked.iter().map(|(_, default, mean)| rounded(mean.point - default.point)).collect();
    let [least, most] =
        [f64::min, f64::max].map(|of| format!("{:+.1}", differences.iter().copied().reduce(of).unwrap_or_default()));
    let range = if least == most {
        format!("is {least} points for each")
    } else {
        format!("ranges from {least} to {most} points")
    };
    Some(format!(
        "of {}{of} methods {found}{}. Extrapolation minus Default {range}.{zeros}",
        ranked.len(),
        next.unwrap_or_default(),
    ))
}

/// Returns a sentence that names the methods whose Extrapolation is 0 only because some scenarios have no success. It
/// also names these scenarios. Returns an empty text if there are no such methods.
fn zero_sentence<'a, 'm: 'a>(rows: impl Iterator<Item = &'a MethodMetrics<'m>>) -> String {
    let by = |row: &MethodMetrics<'_>| {
        let zeros: Vec<String> = row.zeros.iter().map(Scenario::to_string).collect();
        format!("for {}, {}", row.method, listed(&zeros))
    };
    let methods: Vec<String> = rows.filter(|row| !row.zeros.is_empty()).map(by).collect();
    if methods.is_empty() {
        return String::new();
    }
    format!(
        " Extrapolation is a geometric mean, and is 0 in a run in which any of its three success rates is 0: {}.",
        methods.join("; ")
    )
}

/// Formats a mean with its interval, e.g. "8.0 % [6.5, 9.0]". Adds "(1 run)" to the mean of a single run.
fn format_mean(mean: Bootstrapped) -> String {
    match mean.interval_95 {
        Some([low, high]) => format!("{:.1} % [{:.1}, {:.1}]", mean.point, low + 0.0, high + 0.0), // no negative zero
        None if mean.runs == 1 => format!("{:.1} % (1 run)", mean.point),
        None => format!("{:.1} %", mean.point),
    }
}

/// Rounds to one decimal, as shown. Turns a negative zero into a positive one.
fn rounded(points: f64) -> f64 {
    (10.0 * points).round() / 10.0 + 0.0
}

/// Returns a sentence that says which numbers have no interval, and why. Returns `None` if all numbers have an
/// interval.
fn too_few(rows: &[MethodMetrics<'_>]) -> Option<String> {
    let all: Vec<&Bootstrapped> = rows.iter().flat_map(|row| row.means.values()).collect();
    let without: Vec<_> = all.iter().filter(|mean| mean.interval_95.is_none()).collect();
    let runs = distinct(without.iter().map(|mean| mean.runs)).into_iter().map(|runs| count(runs, "run"));
    let runs = listed(&runs.collect::<Vec<_>>());
    match without.len() {
        0 => None,
        some if some == all.len() => Some(format!("No intervals: too few seeds ({runs}).")),
        _ => Some(format!("Some numbers have no interval: too few seeds ({runs}).")),
    }
}

/// Joins names for a sentence, e.g. "a, b and c". Without names returns [`MISSING`].
pub(super) fn listed(names: &[impl AsRef<str>]) -> String {
    match names {
        [] => MISSING.to_owned(),
        [one] => one.as_ref().to_owned(),
        [before @ .., last] => {
            let before: Vec<&str> = before.iter().map(AsRef::as_ref).collect();
            format!("{} and {}", before.join(", "), last.as_ref())
        }
    }
}

#[cfg(test)]
#[path = "finding_tests.rs"]
mod tests;
