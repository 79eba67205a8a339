//! The page of a training.

use std::path::Path;

use maud::{Markup, html};
use perturb_study::runs::{Kind, TrainingStatus};
use perturb_study::words::{duration, grouped, shortened};
use perturb_study::{CellResult, TestResult};
use serde_json::json;

use super::{Update, badge, bar, chart, crumbs, facts, name_of, pictures, time, troubles};
use crate::curve::Curve;
use crate::paths::{Relative, Root};
use crate::training::Training;

/// Where time goes, and its colour's class.
const SHARES: [(&str, &str); 4] =
    [("choosing actions", "a"), ("waiting for servers", "b"), ("updating the policy", "c"), ("anything else", "d")];

pub(crate) fn update(root: &Root, relative: &Relative, path: &Path, training: &Training) -> Update {
    let curve = training.curve();
    let name = name_of(root, relative);
    let (title, head) = match training.status() {
        Ok(status) => (title(&name, status), head(status, training)),
        Err(reason) => (name, troubles(&[format!("This training is not understood: {reason}")])),
    };
    let (result, failure) = match training.result() {
        Some(Ok(result)) => (Some(result), None),
        Some(Err(reason)) => (None, Some(reason)),
        None => (None, None),
    };
    let wrong: Vec<String> = failure.into_iter().chain(training.troubles()).collect();
    let parts = vec![
        ("head", head),
        ("troubles", troubles(&wrong)),
        ("figures", figures(training, &curve)),
        ("note", note(training, &curve)),
        ("shares", shares(training)),
        ("tests", result.map_or_else(Markup::default, |result| tests(&result))),
        ("pictures", pictures::of_run(relative, path)),
        ("settings", settings(training)),
        ("files", files(training, relative)),
    ];
    let charts = json!({ "curve": curve });
    Update { title, kind: Some(Kind::Training), parts, charts, crumbs: crumbs(root, relative), ..Update::default() }
}

pub(crate) fn page(root: &Root, relative: &Relative, update: &Update) -> String {
    let main = html! {
        h1 { (name_of(root, relative)) }
        (update.part("head"))
        (update.part("troubles"))
        (update.part("figures"))
        h2 { "Learning curve" }
        fieldset.choice {
            legend { "Over" }
            label { input type="radio" name="over" value="episodes" checked; " episodes" }
            label { input type="radio" name="over" value="steps"; " environment steps" }
        }
        div.charts {
            (chart("return", "Return"))
            (chart("success", "Success, %"))
            (chart("length", "Steps of an episode"))
            (chart("speed", "Steps in a second"))
        }
        (update.part("note"))
        (update.part("shares"))
        (update.part("tests"))
        (update.part("pictures"))
        (update.part("settings"))
        (update.part("files"))
    };
    super::document(&update.title, &format!("/events/{}", relative.encode()), &update.crumbs, &main)
}

fn title(name: &str, status: &TrainingStatus) -> String {
    let (done, budget) = (status.episodes as f64, status.config.common.episodes.max(1) as f64);
    let percent = (100.0 * done / budget).min(100.0).floor();
    if status.state == "in work" { format!("{percent} % · {name}") } else { format!("{name} · perturb") }
}

fn head(status: &TrainingStatus, training: &Training) -> Markup {
    let (done, budget) = (status.episodes, status.config.common.episodes);
    let number = |number: u64| grouped(number as usize);
    html! {
        p.head { (status.what()) " " (badge(status.state)) }
        (bar(done, budget, "Episodes that are done"))
        p {
            (number(done)) " of " (number(budget)) " episodes"
            @if let Some(left) = training.left() { ", about " (duration(left)) " left" }
            "; changed " (time(training.changed())) ". "
            @match status.saved {
                Some(saved) => { "The last checkpoint has " (number(saved)) " episodes." },
                None => "There is no checkpoint yet.",
            }
        }
    }
}

/// The last episodes, the last update.
fn figures(training: &Training, curve: &Curve) -> Markup {
    let Some(progress) = training.progress() else { return Markup::default() };
    let text = |text: String| html! { (text) };
    let of = |name: &'static str, column: &str, show: &dyn Fn(f64) -> String| {
        progress.get(column).map(|value| (name, text(show(value))))
    };
    let whole = |number: f64| grouped(number.max(0.0) as usize);
    let plain = |number: f64| format!("{number:.2}");
    let speed = curve.speed.last().copied().flatten().map(|speed| ("steps/s", text(whole(speed))));
    let known = [
        of("return, last 100", "rollout/ep_rew_mean", &plain),
        of("success, last 100", "rollout/success_rate", &|rate| format!("{:.1} %", 100.0 * rate)),
        of("length, last 100", "rollout/ep_len_mean", &plain),
        of("environment steps", "time/total_timesteps", &whole),
        speed,
        of("time", "time/time_elapsed", &duration),
        of("updates", "train/n_updates", &whole),
        of("explained variance", "train/explained_variance", &plain),
    ];
    facts(known.into_iter().flatten())
}

/// What a point is.
fn note(training: &Training, curve: &Curve) -> Markup {
    let count = curve.episodes.len();
    html! {
        @if count == 0 {
            p.note { "No episode has ended yet." }
        } @else {
            p.note {
                "A point is the mean of " (grouped(curve.each.min(training.count()))) " episodes, the last one of some more or fewer. Return is not normalised."
            }
        }
    }
}

/// Where the time went, as a bar with its numbers.
fn shares(training: &Training) -> Markup {
    let Some(shares) = training.shares() else { return Markup::default() };
    let all: f64 = shares.iter().sum::<f64>().max(1e-9);
    let mut before = 0.0;
    let parts: Vec<(&str, &str, f64, f64)> = SHARES
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

/// What a cell's tests came to.
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
        p.note { "Again: " code { (result.command) } }
    }
}

fn settings(training: &Training) -> Markup {
    let Ok(status) = training.status() else { return Markup::default() };
    let table = status.config.table();
    html! {
        h2 { "Settings" }
        dl.settings { @for (name, value) in &table { div { dt { (name) } dd { (shown(value)) } } } }
    }
}

fn shown(value: &toml::Value) -> String {
    shortened(value.as_str().map_or_else(|| value.to_string(), str::to_owned))
}

fn files(training: &Training, relative: &Relative) -> Markup {
    html! {
        p.note {
            @for (place, name) in training.files().enumerate() {
                @if place > 0 { ", " } @else { "Files: " }
                a href={ "/file/" (relative.join(name).encode()) } { (name) }
            }
        }
    }
}
