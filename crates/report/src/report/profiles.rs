//! Performance profiles: the share of runs whose score is above a threshold, for each threshold.

use perturb_experiment::{MethodResults, scores};
use perturb_records::Metric;
use perturb_records::statistics::{Bootstrapped, bootstrap, profile};
use perturb_settings::Method;
use perturb_text::Table;

use super::Report;
use super::columns::MethodColumns;
use super::index::ReportIndex;
use super::numbers::MethodMetrics;
use super::pictures::{Picture, PictureDrawing};
use crate::plot::panels::{PanelLine, PanelPoint, Panels, PlotPanel, RATES, index_of};

/// Number of bootstrap resamples for the intervals of a profile.
const RESAMPLES: usize = 10_000;
/// The highest threshold, %. Thresholds are 0, 1 … 100 %.
const THRESHOLDS: u32 = 100;

/// The performance profile of a method by one metric, over all averaged environments.
pub(super) struct Profile {
    method: Method,
    metric: Metric,
    /// The share of runs (0 … 1) whose score is above each threshold.
    shares: Vec<Bootstrapped>,
}

/// Computes the performance profiles: one for each method in `averages` and each of its metrics that has an
/// interquartile mean.
pub(super) fn profiles(
    scope: &ReportIndex<'_>,
    selections: &[MethodResults<'_>],
    averages: &[MethodMetrics<'_>],
) -> Vec<Profile> {
    let thresholds: Vec<f64> = (0..=THRESHOLDS).map(f64::from).collect();
    let mut profiles = Vec::new();
    for MethodMetrics { method, iqms, .. } in averages {
        let is_averaged = |row: &&MethodResults<'_>| scope.averaged.contains(&row.environment);
        let found: Vec<_> = selections.iter().filter(|row| row.method == *method).filter(is_averaged).collect();
        for &metric in iqms.keys() {
            let shares = bootstrap(&scores(&found, metric), RESAMPLES, 1, |strata| profile(strata, &thresholds));
            profiles.extend(shares.map(|shares| Profile { method: method.clone(), metric, shares }));
        }
    }
    profiles
}

impl Report<'_> {
    /// Returns the file `profiles.csv`: the share of runs above each threshold.
    pub(super) fn profiles_file(&self) -> Table {
        let of = |profile| (0..=THRESHOLDS as usize).map(move |threshold| (profile, threshold));
        let lines: Vec<(&Profile, usize)> = self.profiles.iter().flat_map(of).collect();
        let number = |(profile, threshold): &(&Profile, usize)| profile.shares[*threshold];
        let end = move |line: &(&Profile, usize), end: usize| {
            number(line).interval_95.map(|interval| interval[end].to_string()).unwrap_or_default()
        };
        Table::builder("profiles.csv", &lines)
            .method(|(profile, _)| &profile.method)
            .text("metric", |(profile, _)| profile.metric)
            .number("runs", move |line| number(line).runs)
            .number("threshold", |(_, threshold)| threshold)
            .number("share_above", move |line| number(line).point)
            .number("low_95", move |line| end(line, 0))
            .number("high_95", move |line| end(line, 1))
            .build()
    }

    /// Returns the picture of all profiles; `None` if there are none.
    pub(super) fn profiles_picture(&self) -> Option<Picture> {
        self.profiles.first()?;
        let methods = &self.scope.methods;
        let line = |profile: &Profile| {
            let point = |(threshold, share): (usize, &Bootstrapped)| {
                let [low, high] = share.interval_95.unwrap_or([share.point; 2]).map(|end| 100.0 * end);
                PanelPoint { x: threshold as f64, y: 100.0 * share.point, low, high }
            };
            let index = index_of(methods, &profile.method);
            PanelLine { index, points: profile.shares.iter().enumerate().map(point).collect() }
        };
        let panel = |metric: Metric| PlotPanel {
            caption: metric.to_string(),
            x_name: "success rate, %".into(),
            x: 0.0..100.0,
            y_name: "share of runs, %".into(),
            y: RATES,
            lines: self.profiles.iter().filter(|profile| profile.metric == metric).map(line).collect(),
        };
        Some(Picture {
            environment: String::new(),
            file: "profiles".into(),
            name: "performance profiles".into(),
            caption: "Performance profiles: the share of runs, over all environments, with a success rate above the value \
                      on the x axis. Bands are 95 % stratified bootstrap intervals at each point; a single run has none."
                .into(),
            drawing: PictureDrawing::Panels(Panels {
                title: "All environments: share of runs above a success rate".into(),
                panels: Metric::ALL.map(panel).into_iter().filter(|panel| !panel.lines.is_empty()).collect(),
                legend: methods.iter().map(ToString::to_string).collect(),
                note: "Bands: 95 % bootstrap intervals.".into(),
            }),
            data: self.profiles_file(),
        })
    }
}
