//! What an experiment found, as one figure: Default, Interpolation and Extrapolation with intervals, beside the paper's.

use super::numbers::{AVERAGE, MethodMetrics, or_empty};
use super::pictures::{Drawing, Picture};
use super::{MISSING, Report};
use crate::plan::{Selection, distinct};
use crate::plot::intervals::{Group, IntervalRow};
use crate::plot::{Intervals, panels};
use crate::statistics::Bootstrapped;
use crate::table::Table;
use crate::{Metric, scheduler::count};

impl Report<'_> {
    /// What the page opens with: all environments together; where nothing can be said of these, or there is one alone, each.
    pub(super) fn finding_pictures(&self) -> Vec<Picture> {
        if self.has_average() { vec![self.finding_picture(&self.averages)] } else { self.each_environment() }
    }

    /// Of each environment, where the page opens with all together.
    pub(super) fn environment_pictures(&self) -> Vec<Picture> {
        if self.has_average() { self.each_environment() } else { Vec::new() }
    }

    fn has_average(&self) -> bool {
        self.scope.averaged.len() > 1 && self.averages.iter().any(|row| !row.ours.is_empty())
    }

    fn each_environment(&self) -> Vec<Picture> {
        let of_environments = self.metrics.chunk_by(|a, b| a.environment == b.environment);
        of_environments.map(|rows| self.finding_picture(rows)).collect()
    }

    /// What the opening figures show, in words: a sentence or two for each.
    pub(super) fn finding_sentences(&self) -> Vec<String> {
        let rows: Vec<&[MethodMetrics<'_>]> = match self.has_average() {
            true => vec![&self.averages],
            false => self.metrics.chunk_by(|a, b| a.environment == b.environment).collect(),
        };
        rows.into_iter().filter_map(|rows| self.finding_sentence(rows)).collect()
    }

    fn finding_sentence(&self, rows: &[MethodMetrics<'_>]) -> Option<String> {
        let mean = |row: &MethodMetrics<'_>, metric| row.means.get(&metric).copied();
        let mut ranked: Vec<_> = rows.iter().filter_map(|row| Some((row, mean(row, Metric::Extrapolation)?))).collect();
        ranked.sort_by(|(_, a), (_, b)| b.point.total_cmp(&a.point));
        let shown = |mean: Bootstrapped| match mean.interval_95 {
            Some([low, high]) => format!("{:.1} % ({low:.1} to {high:.1})", mean.point),
            None => format!("{:.1} %", mean.point),
        };
        let (best, extrapolation) = *ranked.first()?;
        let of = self.finding_of(rows);
        let mut said = format!("{of}: {} has the highest Extrapolation, {}", best.method, shown(extrapolation));
        if let Some(default) = mean(best, Metric::Default) {
            said += &format!(", and {} as Default", shown(default));
        }
        if let Some((next, its)) = ranked.get(1) {
            said += &format!("; {} has the next, {}", next.method, shown(*its));
            if let (Some([low, _]), Some([_, high])) = (extrapolation.interval_95, its.interval_95) {
                said += if high < low { ", and the intervals are apart" } else { ", and the intervals overlap" };
            }
        }
        said += ".";
        let losses = ranked.iter().filter_map(|(row, its)| Some(mean(row, Metric::Default)?.point - its.point));
        let losses: Vec<f64> = losses.collect();
        if losses.len() > 1 {
            let [least, most] = [f64::min, f64::max].map(|of| losses.iter().copied().reduce(of).unwrap_or_default());
            said += &format!(
                " From Default to Extrapolation the {} methods lose {least:.1} to {most:.1} points.",
                losses.len()
            );
        }
        Some(said)
    }

    /// What rows are of: an environment, or the average of several.
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

    /// Numbers of all environments together and of each, with their intervals.
    pub(super) fn finding_file(&self) -> Table {
        let averages = self.averages.iter().filter(|_| self.has_average());
        finding_table("finding.csv", &averages.chain(&self.metrics).collect::<Vec<_>>())
    }

    fn finding_picture(&self, rows: &[MethodMetrics<'_>]) -> Picture {
        let is_average = rows[0].environment == AVERAGE;
        let of = self.finding_of(rows);
        let file = if is_average { "finding".to_owned() } else { format!("{of}-finding") };
        let over = if is_average { "environments and runs" } else { "runs" };
        let of_rows = |has: &dyn Fn(&MethodMetrics<'_>) -> bool| rows.iter().any(has);
        let intervals = match of_rows(&|row| row.means.values().any(|mean| mean.interval_95.is_some())) {
            true if is_average => " with 95 % stratified bootstrap intervals",
            true => " with 95 % bootstrap intervals",
            false => "",
        };
        let papers = if of_rows(&|row| !row.papers.is_empty()) { ", beside the paper's means" } else { "" };
        let conditional = match self.plan.selection {
            Selection::Paper if !intervals.is_empty() && self.plan.selects() => {
                " The intervals are those of the configurations that were selected, whatever else might have been."
            }
            _ => "",
        };
        let group = |metric: Metric| Group {
            name: metric.to_string(),
            rows: rows.iter().map(|row| self.finding_row(row, metric)).collect(),
        };
        let drawing = Intervals {
            title: format!("{of}: where policies were trained, and elsewhere"),
            x_name: "success rate, %".into(),
            x: panels::RATES,
            groups: Metric::ALL.map(group).into(),
            legend: [
                format!("mean over {over}"),
                "95 % bootstrap interval of it".into(),
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
            data: finding_table(&format!("{file}.csv"), &rows.iter().collect::<Vec<_>>()),
            file,
            drawing: Drawing::Intervals(drawing),
        }
    }

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

fn finding_table(name: &str, rows: &[&MethodMetrics<'_>]) -> Table {
    let lines: Vec<_> = rows.iter().flat_map(|row| Metric::ALL.map(|metric| (*row, metric))).collect();
    let mean = |(row, metric): &(&MethodMetrics<'_>, Metric)| row.means.get(metric).copied();
    let end = move |line: &(&MethodMetrics<'_>, Metric), which: usize| {
        or_empty(mean(line).and_then(|mean| Some(mean.interval_95?[which])))
    };
    Table::of(name, &lines)
        .text("environment", |(row, _)| row.environment)
        .method(|(row, _)| &row.method)
        .text("metric", |(_, metric)| metric)
        .number("runs", move |line| mean(line).map_or(0, |mean| mean.runs))
        .number("mean", move |line| or_empty(mean(line).map(|mean| mean.point)))
        .number("low_95", move |line| end(line, 0))
        .number("high_95", move |line| end(line, 1))
        .number("paper_mean", |(row, metric)| or_empty(row.papers.get(metric).map(|paper| paper.mean)))
        .build()
}

/// Which numbers have no interval; `None` if all have.
fn too_few(rows: &[MethodMetrics<'_>]) -> Option<String> {
    let all: Vec<&Bootstrapped> = rows.iter().flat_map(|row| row.means.values()).collect();
    let without: Vec<_> = all.iter().filter(|mean| mean.interval_95.is_none()).collect();
    let runs = distinct(without.iter().map(|mean| mean.runs)).into_iter().map(|runs| count(runs, "run"));
    let runs = listed(&runs.collect::<Vec<_>>());
    match without.len() {
        0 => None,
        some if some == all.len() => Some(format!("No intervals: too few seeds ({runs}).")),
        _ => Some(format!("Where there is no interval: too few seeds ({runs}).")),
    }
}

/// As a sentence has them.
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
