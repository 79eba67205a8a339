//! Everything as HTML. Whatever comes from a file or an address is escaped.
//!
//! A page consists of parts with names. When something changes, its parts come again as they would be in a new page, and the
//! script puts them in their places; curves come as numbers.

pub(crate) mod experiment;
pub(crate) mod index;
pub(crate) mod pictures;
pub(crate) mod training;

use std::path::{Path, PathBuf};

use axum::http::StatusCode;
use axum::response::{Html, IntoResponse, Response};
use chrono::DateTime;
use maud::{DOCTYPE, Markup, html};
use perturb_study::runs::Kind;
use perturb_study::words::shortened;
use serde_json::{Map, Value, json};

use crate::paced::Trouble;
use crate::paths::{Relative, Root};
use crate::watch::Missing;

/// What there is to see of something.
#[derive(Debug, Default)]
pub(crate) struct Update {
    /// Of the window.
    pub(crate) title: String,
    /// Of what; `None` for all runs.
    pub(crate) kind: Option<Kind>,
    /// The parts of the page, by their names.
    pub(crate) parts: Vec<(&'static str, Markup)>,
    /// What is drawn.
    pub(crate) charts: Value,
    /// The state of which a report would be sent.
    pub(crate) report: u64,
    /// Of an experiment: what a report is made from now.
    pub(crate) reported: Option<Reported>,
    /// The way to it.
    crumbs: Markup,
}

/// What a report is made from.
#[derive(Clone, Debug)]
pub(crate) struct Reported {
    /// The folder; in its place why there is no report.
    pub(crate) folder: Result<PathBuf, String>,
    /// Of its files.
    pub(crate) state: u64,
}

impl Update {
    /// As the script reads it.
    pub(crate) fn to_json(&self) -> String {
        let parts: Map<String, Value> =
            self.parts.iter().map(|(name, part)| ((*name).to_owned(), Value::from(part.0.clone()))).collect();
        // A number of 64 bits is none of a script's.
        let report = format!("{:016x}", self.report);
        json!({ "title": self.title, "parts": parts, "charts": self.charts, "report": report }).to_string()
    }

    /// A part of the page, in its place.
    fn part(&self, name: &str) -> Markup {
        let content = self.parts.iter().find(|(known, _)| *known == name).map(|(_, part)| part);
        html! { div id=(name) data-part { @if let Some(content) = content { (content) } } }
    }
}

/// What is sent when there is nothing to see.
pub(crate) fn gone(missing: &Missing) -> String {
    let words = match missing {
        Missing::NoRun => "There is no run here any more.".into(),
        missing => words_of(missing).1,
    };
    json!({ "gone": words }).to_string()
}

/// What is answered when there is nothing to see.
pub(crate) fn not_there(missing: &Missing) -> Response {
    let (status, words) = words_of(missing);
    refusal(status, &words)
}

fn words_of(missing: &Missing) -> (StatusCode, String) {
    match missing {
        Missing::NoRun => (StatusCode::NOT_FOUND, "There is no run here, or not any more.".into()),
        Missing::Gone(reason) => (StatusCode::NOT_FOUND, format!("The runs cannot be listed: {reason}.")),
        Missing::Not(Trouble::Panicked) => {
            let words = "The server cannot show this: a mistake of its own, which it has said on its console.";
            (StatusCode::INTERNAL_SERVER_ERROR, words.into())
        }
        Missing::Not(Trouble::Slow) => {
            let words = "Looking at these files takes too long; perhaps their disk or network does not answer.";
            (StatusCode::SERVICE_UNAVAILABLE, words.into())
        }
    }
}

/// The page of a run.
pub(crate) fn run_page(root: &Root, relative: &Relative, update: &Update) -> String {
    match update.kind {
        Some(Kind::Experiment) => experiment::page(root, relative, update),
        _ => training::page(root, relative, update),
    }
}

/// A whole page, which hears of changes at the address `events`.
fn document(title: &str, events: &str, crumbs: &Markup, main: &Markup) -> String {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                link rel="icon" href="/assets/icon.svg" type="image/svg+xml";
                link rel="stylesheet" href="/assets/uPlot.css";
                link rel="stylesheet" href="/assets/style.css";
                script src="/assets/uPlot.js" defer {}
                script src="/assets/app.js" defer {}
            }
            body data-events=(events) {
                header.top {
                    nav aria-label="Where this is" { (crumbs) }
                    p #live role="status" { noscript { "Without JavaScript this stays as it is now; load it again to see more." } }
                }
                main { (main) }
                footer { p { "perturb " (perturb_study::VERSION) ". This page only shows; it changes nothing." } }
            }
        }
    }
    .into_string()
}

/// The way to `relative`: the folder of all runs, the runs that it is in, and itself.
fn crumbs(root: &Root, relative: &Relative) -> Markup {
    let mut way = Relative::default();
    let mut links = Vec::new();
    let names: Vec<_> = relative.path().iter().collect();
    let mut shown = String::new();
    for (place, name) in names.iter().enumerate() {
        way = way.join(name);
        shown = if shown.is_empty() {
            name.to_string_lossy().into_owned()
        } else {
            format!("{shown}/{}", name.to_string_lossy())
        };
        let last = place + 1 == names.len();
        if last || root.resolve(&way).is_some_and(|path| Kind::of(&path).is_some()) {
            links.push((std::mem::take(&mut shown), way.clone(), last));
        }
    }
    html! {
        ol {
            li { a href="/" { (root.given().display()) } }
            @for (shown, way, last) in links {
                li { @if last { span aria-current="page" { (shown) } } @else { a href=(run_link(&way)) { (shown) } } }
            }
        }
    }
}

/// The address of a run's page.
fn run_link(relative: &Relative) -> String {
    format!("/run/{}", relative.encode())
}

/// A name for `relative`, which is `root` if it is empty.
fn name_of(root: &Root, relative: &Relative) -> String {
    let path: &Path = if relative.path().as_os_str().is_empty() { root.given() } else { relative.path() };
    path.display().to_string()
}

/// "in work", with a colour.
fn badge(state: &str) -> Markup {
    html! { span class={ "state " (state.replace(' ', "-")) } { (state) } }
}

/// A bar, which those who do not see it hear as `label`.
fn bar(done: u64, of: u64, label: &str) -> Markup {
    html! { progress max=(of.max(1)) value=(done.min(of)) aria-label=(label) {} }
}

/// A time of day, UTC; the script makes it that of the reader.
fn time(seconds: i64) -> Markup {
    let Some(time) = DateTime::from_timestamp(seconds, 0) else { return html! {} };
    html! { time datetime=(time.format("%Y-%m-%dT%H:%M:%SZ")) { (time.format("%Y-%m-%d %H:%M UTC")) } }
}

/// Names with their values.
fn facts<'a>(facts: impl IntoIterator<Item = (&'a str, Markup)>) -> Markup {
    html! { dl.facts { @for (name, value) in facts { div { dt { (name) } dd { (value) } } } } }
}

/// What is wrong.
fn troubles(sentences: &[String]) -> Markup {
    html! {
        @if !sentences.is_empty() {
            ul.trouble { @for sentence in sentences { li { (sentence) } } }
        }
    }
}

/// The place of a plot.
fn chart(name: &str, title: &str) -> Markup {
    html! {
        figure.chart data-chart=(name) {
            figcaption { (title) }
            div.plot role="img" aria-label=(title) {}
        }
    }
}

/// A page that says why there is nothing to see.
pub(crate) fn refusal(status: StatusCode, words: &str) -> Response {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { "perturb: " (status.as_u16()) }
                link rel="stylesheet" href="/assets/style.css";
            }
            body { main { h1 { (status) } p { (words) } p { a href="/" { "All runs" } } } }
        }
    };
    (status, Html(page.into_string())).into_response()
}

/// After so many seconds a report is asked for again that could not be made.
const AGAIN: u32 = 15;

/// What stands in the place of a report.
pub(crate) fn no_report(reason: &str) -> String {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="color-scheme" content="light dark";
                meta http-equiv="refresh" content=(AGAIN); // what was wrong may have been put right
                title { "perturb: no report" }
            }
            body { p { "There is no report now: " (shortened(reason)) } }
        }
    }
    .into_string()
}

/// A file of this program by its name, with its type.
pub(crate) fn asset(name: &str) -> Option<(&'static str, &'static str)> {
    const SCRIPT: &str = "text/javascript; charset=utf-8";
    const STYLE: &str = "text/css; charset=utf-8";
    Some(match name {
        "app.js" => (SCRIPT, include_str!("../../assets/app.js")),
        "style.css" => (STYLE, include_str!("../../assets/style.css")),
        "icon.svg" => ("image/svg+xml", include_str!("../../assets/icon.svg")),
        "uPlot.js" => (SCRIPT, include_str!("../../assets/uplot/uPlot.iife.js")),
        "uPlot.css" => (STYLE, include_str!("../../assets/uplot/uPlot.min.css")),
        _ => return None,
    })
}
