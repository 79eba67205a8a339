//! The page of a training.

use std::path::Path;

use maud::{Markup, html};
use perturb_experiment::CellResult;
use perturb_experiment::runs::{RunKind, TrainingStatus};
use perturb_records::TestResult;
use perturb_text::{duration, grouped, shortened};
use serde_json::json;

use super::{Update, badge, bar, breadcrumbs, budget_choice, chart, facts, faults, pictures, shown_name, time};
use crate::curve::LearningCurve;
use crate::paths::{RelativePath, Root};
use crate::pictures::scan_run;
use crate::training::LiveTraining;

/// The activities on which a training spends its time, in the order of [`LiveTraining::time_shares`]. Each has its name
/// on the page, and the suffix of its CSS class.
const TIME_SHARES: [(&str, &str); 4] =
    [("choosing actions", "a"), ("waiting for servers", "b"), ("updating the policy", "c"), ("anything else", "d")];

pub(crate) fn update(root: &Root, relative: &RelativePath, path: &Path, training: &LiveTraining) -> Update {
    let curve = training.curve();
    let name = shown_name(root, relative);
    let (title, head) = match training.status() {
        Ok(status) => (title(&name, status), head(status, training)),
        Err(reason) => (name, faults(&[format!("This training is not understood: {reason}")])),
    };
    let (result, failure) = match training.result() {
        Some(Ok(result)) => (Some(result), None),
        Some(Err(reason)) => (None, Some(reason)),
        None => (None, None),
    };
    let all_faults: Vec<String> = failure.into_iter().chain(training.faults()).collect();
    let parts = vec![
        ("head", head),
        ("troubles", faults(&all_faults)),
        ("figures", figures(training, &curve)),
        ("note", note(training, &curve)),
        ("shares", shares(training)),
        ("tests", result.map_or_else(Markup::default, |result| tests(&result))),
        ("pictures", pictures::section(&scan_run(relative, path))),
        ("settings", settings(training)),
        ("files", files(training, relative)),
    ];
    let charts = json!({ "curve": curve });
    let breadcrumbs = breadcrumbs(root, relative);
    Update { title, kind: Some(RunKind::Training), parts, charts, breadcrumbs, ..Update::default() }
}

pub(crate) fn page(root: &Root, relative: &RelativePath, update: &Update) -> String {
    let main = html! {
        h1 { (shown_name(root, relative)) }
        (update.part("head"))
        (update.part("troubles"))
        (update.part("figures"))
        h2 { "Learning curve" }
        (budget_choice())
        div.charts {
            (chart("return", "Return"))
            (chart("success", "Success, %"))
            (chart("length", "Episode length, steps"))
            (chart("speed", "Steps per second"))
        }
        (update.part("note"))
        (update.part("shares"))
        (update.part("tests"))
        (update.part("pictures"))
        (update.part("settings"))
        (update.part("files"))
    };
    super::document(&update.title, &format!("/events/{}", relative.encode()), &update.breadcrumbs, &main)
}

fn title(name: &str, status: &TrainingStatus) -> String {
    let done = status.episodes as f64;
    let budget = status.config.common.episodes.max(1) as f64;
    let percent = (100.0 * done / budget).min(100.0).floor();
    if status.state == "in work" { format!("{percent} % · {name}") } else { format!("{name} · perturb") }
}

fn head(status: &TrainingStatus, training: &LiveTraining) -> Markup {
    let done = status.episodes;
    let budget = status.config.common.episodes;
    let number = |number: u64| grouped(number as usize);
    html! {
        p.head { (status.what()) " " (badge(status.state)) }
        (bar(done, budget, "Episodes that are done"))
        p {
            (number(done)) " of " (number(budget)) " episodes"
            @if let Some(left) = training.remaining_seconds() { ", about " (duration(left)) " left" }
            "; changed " (time(training.changed())) ". "
            @match status.saved {
                Some(saved) => { "The last checkpoint was written after " (number(saved)) " episodes." },
                None => "There is no checkpoint yet.",
            }
        }
    }
}

/// Returns a list of figures: means over the last 100 episodes, the speed, totals of the training so far, and a
/// statistic of the last update.
fn figures(training: &LiveTraining, curve: &LearningCurve) -> Markup {
    let Some(progress) = training.progress() else { return Markup::default() };
    let text = |text: String| html! { (text) };
    let figure = |name: &'static str, column: &str, show: &dyn Fn(f64) -> String| {
        progress.get(column).map(|value| (name, text(show(value))))
    };
    let whole = |number: f64| grouped(number.max(0.0) as usize);
    let plain = |number: f64| format!("{number:.2}");
    let speed = curve.speed.last().copied().flatten().map(|speed| ("steps/s", text(whole(speed))));
    let known = [
        figure("return, last 100", "rollout/ep_rew_mean", &plain),
        figure("success, last 100", "rollout/success_rate", &|rate| format!("{:.1} %", 100.0 * rate)),
        figure("length, last 100", "rollout/ep_len_mean", &plain),
        figure("environment steps", "time/total_timesteps", &whole),
        speed,
        figure("time", "time/time_elapsed", &duration),
        figure("updates", "train/n_updates", &whole),
        figure("explained variance", "train/explained_variance", &plain),
    ];
    facts(known.into_iter().flatten())
}

/// Returns a note that explains the points of the learning curve.
fn note(training: &LiveTraining, curve: &LearningCurve) -> Markup {
    let count = curve.episodes.len();
    html! {
        @if count == 0 {
            p.note { "No episode has ended yet." }
        } @else {
            p.note {
                "A point is the mean of " (grouped(curve.episodes_per_point.min(training.episode_count()))) " episodes; the last point may have a few more or fewer. Returns are not normalised."
            }
        }
    }
}

/// Returns a bar that shows the share of time that the training spends on each activity, and a list of the percentages.
fn shares(training: &LiveTraining) -> Markup {
    let Some(shares) = training.time_shares() else { return Markup::default() };
    let all: f64 = shares.iter().sum::<f64>().max(1e-9);
    let mut before = 0.0;
    let parts: Vec<(&str, &str, f64, f64)> = TIME_SHARES
        .iter()
        .zip(shares)
        .map(|((name, class), seconds)| {
            let percent = 100.0 * seconds / all;
            before += percent;
            (*name, *class, before - percent, percent)
        })
        .collect();
    html! {
        h2 { "Where the time goes" }
        svg.shares viewBox="0 0 100 4" preserveAspectRatio="none" role="img" aria-label="Shares of the time, as listed below" {
            @for (_, class, begin, percent) in &parts {
                rect class={ "share-" (class) } x=(format!("{begin:.3}")) y="0" width=(format!("{percent:.3}")) height="4" {}
            }
        }
        ul.legend {
            @for (name, class, _, percent) in &parts {
                li { span class={ "swatch share-" (class) } {} (name) " " b { (format!("{percent:.1} %")) } }
            }
        }
    }
}

/// Returns a table with the results of a cell's tests.
fn tests(result: &CellResult) -> Markup {
    let row = |name: &str, TestResult { episodes, success_percent, success_percent_95: [low, high], mean_return, mean_length }: &TestResult| {
        html! {
            tr {
                th scope="row" { (name) }
                td.number { (grouped(*episodes as usize)) }
                td.number { (format!("{success_percent:.1}")) }
                td.number { (format!("{low:.1} … {high:.1}")) }
                td.number { (format!("{mean_return:.2}")) }
                td.number { (format!("{mean_length:.1}")) }
            }
        }
    };
    html! {
        h2 { "Tests" }
        div.wide {
            table {
                thead {
                    tr {
                        @for name in ["tested on", "episodes", "success, %", "95 % interval", "return", "length"] {
                            th scope="col" { (name) }
                        }
                    }
                }
                tbody { @for (name, test) in &result.results { (row(name, test)) } }
            }
        }
        p.note { "Command to repeat this: " code { (result.command) } }
    }
}

fn settings(training: &LiveTraining) -> Markup {
    let Ok(status) = training.status() else { return Markup::default() };
    let table = status.config.table();
    html! {
        h2 { "Settings" }
        dl.settings { @for (name, value) in &table { div { dt { (name) } dd { (format_value(value)) } } } }
    }
}

fn format_value(value: &toml::Value) -> String {
    shortened(value.as_str().map_or_else(|| value.to_string(), str::to_owned))
}

fn files(training: &LiveTraining, relative: &RelativePath) -> Markup {
    html! {
        p.note {
            @for (index, name) in training.files().enumerate() {
                @if index > 0 { ", " } @else { "Files: " }
                a href={ "/file/" (relative.join(name).encode()) } { (name) }
            }
        }
    }
}
