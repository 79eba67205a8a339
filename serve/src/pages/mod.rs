//! Makes the pages as HTML. Texts from files and addresses are escaped.
//!
//! A page consists of named parts. When something changes, an event with all parts of the page is sent, and the page's
//! script replaces the parts that differ. Curves are sent as numbers.

pub(crate) mod assessment;
pub(crate) mod curves;
pub(crate) mod experiment;
pub(crate) mod index;
pub(crate) mod pictures;
pub(crate) mod training;

use std::path::{Path, PathBuf};

use axum::Extension;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use chrono::DateTime;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use perturb_experiment::runs::RunKind;
use perturb_text::shortened;
use serde_json::{Map, Value, json};

use crate::cached_loader::CachedLoadError;
use crate::error::ViewError;
use crate::links::RelativeRoot;
use crate::paths::{RelativePath, Root};

/// The changing content of a page.
#[derive(Debug, Default)]
pub(crate) struct Update {
    /// Title of the browser window.
    pub(crate) title: String,
    /// Kind of the run; `None` for pages that are not about a single run.
    pub(crate) kind: Option<RunKind>,
    /// The parts of the page, by their names.
    pub(crate) parts: Vec<(&'static str, Markup)>,
    /// The numbers that the page's charts show.
    pub(crate) charts: Value,
    /// Fingerprint (hash of the source files) of the report that a request would get now.
    pub(crate) report: u64,
    /// Files of the report of an experiment or an assessment; `None` for other pages.
    pub(crate) report_source: Option<ReportSource>,
    /// Links to the served folder, and to the runs whose folders contain the folder of this page's run.
    breadcrumbs: Markup,
}

/// The files from which a report is built.
#[derive(Clone, Debug)]
pub(crate) struct ReportSource {
    /// The folder of the experiment or assessment, or the reason why there is no report.
    pub(crate) folder: Result<PathBuf, String>,
    /// A number that changes with the files.
    pub(crate) fingerprint: u64,
}

impl Update {
    /// Makes the links of the page's parts relative.
    pub(crate) fn with_relative_links(mut self, relative_root: &RelativeRoot) -> Self {
        let relative = |part: &Markup| PreEscaped(relative_root.relative_links(&part.0));
        self.parts.iter_mut().for_each(|(_, part)| *part = relative(part));
        self
    }

    /// Returns the content as JSON for the page's script.
    pub(crate) fn to_json(&self) -> String {
        let parts: Map<String, Value> =
            self.parts.iter().map(|(name, part)| ((*name).to_owned(), Value::from(part.0.clone()))).collect();
        // The fingerprint is sent as text, because numbers in JavaScript have only 53 bits.
        let report = format!("{:016x}", self.report);
        json!({ "title": self.title, "parts": parts, "charts": self.charts, "report": report }).to_string()
    }

    /// Returns a part of the page, in an element whose content the page's script can replace.
    fn part(&self, name: &str) -> Markup {
        let content = self.parts.iter().find(|(known, _)| *known == name).map(|(_, part)| part);
        html! { div id=(name) data-part { @if let Some(content) = content { (content) } } }
    }
}

/// Returns the event that tells open pages why their content cannot be shown any more.
pub(crate) fn error_event(error: &ViewError) -> String {
    let message = match error {
        ViewError::RunNotFound => "There is no run here any more.".into(),
        error => describe(error).1,
    };
    json!({ "gone": message }).to_string()
}

/// Returns the response for a page that cannot be shown.
pub(crate) fn error_page(error: &ViewError) -> Response {
    let (status, message) = describe(error);
    message_page(status, &message)
}

fn describe(error: &ViewError) -> (StatusCode, String) {
    match error {
        ViewError::RunNotFound => (StatusCode::NOT_FOUND, "There is no run here, or not any more.".into()),
        ViewError::Unlisted(reason) => (StatusCode::NOT_FOUND, format!("The runs cannot be listed: {reason}.")),
        ViewError::Load(CachedLoadError::Panicked) => {
            let message = "The server cannot show this because of a bug in it. Its console has the details.";
            (StatusCode::INTERNAL_SERVER_ERROR, message.into())
        }
        ViewError::Load(CachedLoadError::TimedOut) => {
            let message = "Reading these files takes too long; perhaps their disk or network does not answer.";
            (StatusCode::SERVICE_UNAVAILABLE, message.into())
        }
    }
}

/// Returns the page of a run.
pub(crate) fn run_page(root: &Root, relative: &RelativePath, update: &Update) -> String {
    match update.kind {
        Some(RunKind::Experiment) => experiment::page(root, relative, update),
        Some(RunKind::Assessment) => assessment::page(root, relative, update),
        _ => training::page(root, relative, update),
    }
}

/// Returns a whole HTML page. Its script gets changes from the address `events`.
fn document(title: &str, events: &str, breadcrumbs: &Markup, main: &Markup) -> String {
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
                    nav aria-label="Breadcrumbs" { (breadcrumbs) }
                    p #live role="status" { noscript { "Without JavaScript this page does not update itself; reload it to see changes." } }
                }
                main { (main) }
                footer { p { "perturb " (perturb_experiment::VERSION) ". This page changes no file." } }
            }
        }
    }
    .into_string()
}

/// Returns links to the served folder, to the runs whose folders contain `relative`, and the name of `relative` itself.
fn breadcrumbs(root: &Root, relative: &RelativePath) -> Markup {
    let mut way = RelativePath::default();
    let mut links = Vec::new();
    let names: Vec<_> = relative.path().iter().collect();
    let mut shown = String::new();
    for (index, name) in names.iter().enumerate() {
        way = way.join(name);
        shown = if shown.is_empty() {
            name.to_string_lossy().into_owned()
        } else {
            format!("{shown}/{}", name.to_string_lossy())
        };
        let last = index + 1 == names.len();
        if last || root.resolve(&way).is_some_and(|path| RunKind::detect(&path).is_some()) {
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

/// Returns the address of a run's page.
fn run_link(relative: &RelativePath) -> String {
    format!("/run/{}", relative.encode())
}

/// Returns the name of `relative` for display. An empty path means the served folder.
fn shown_name(root: &Root, relative: &RelativePath) -> String {
    let path: &Path = if relative.path().as_os_str().is_empty() { root.given() } else { relative.path() };
    path.display().to_string()
}

/// Returns the element of a state, such as "in work", in the colour of the state.
fn badge(state: &str) -> Markup {
    html! { span class={ "state " (state.replace(' ', "-")) } { (state) } }
}

/// Returns a progress bar. Screen readers read `label`.
fn bar(done: u64, total: u64, label: &str) -> Markup {
    html! { progress max=(total.max(1)) value=(done.min(total)) aria-label=(label) {} }
}

/// Returns a time in UTC, given in seconds since 1970. The script changes it to the reader's time zone.
fn time(seconds: i64) -> Markup {
    let Some(time) = DateTime::from_timestamp(seconds, 0) else { return html! {} };
    html! { time datetime=(time.format("%Y-%m-%dT%H:%M:%SZ")) { (time.format("%Y-%m-%d %H:%M UTC")) } }
}

/// Returns a list of names and their values.
fn facts<'a>(facts: impl IntoIterator<Item = (&'a str, Markup)>) -> Markup {
    html! { dl.facts { @for (name, value) in facts { div { dt { (name) } dd { (value) } } } } }
}

/// Returns a list of error messages. It is empty if there are none.
fn faults(sentences: &[String]) -> Markup {
    html! {
        @if !sentences.is_empty() {
            ul.trouble { @for sentence in sentences { li { (sentence) } } }
        }
    }
}

/// Returns the element in which the script draws a chart.
fn chart(name: &str, title: &str) -> Markup {
    html! {
        figure.chart data-chart=(name) {
            figcaption { (title) }
            div.plot role="img" aria-label=(title) {}
        }
    }
}

/// Returns the report of a run in a frame. Above it is the part `lag`, a note that is shown while the report is out of
/// date.
fn report_frame(relative: &RelativePath, update: &Update) -> Markup {
    let report = format!("/report/{}", relative.encode());
    html! {
        p.note { a href=(report) { "The report on its own page" } ", as " code { "perturb report --html" } " writes it." }
        (update.part("lag"))
        iframe.report src=(report) title="Report" loading="lazy" data-report=(format!("{:016x}", update.report)) {}
    }
}

/// Returns the choice of the horizontal axis of learning curves.
fn budget_choice() -> Markup {
    html! {
        fieldset.choice {
            legend { "Over" }
            label { input type="radio" name="over" value="episodes" checked; " episodes" }
            label { input type="radio" name="over" value="steps"; " environment steps" }
        }
    }
}

/// The HTML of a page with a message. It is attached to a response as an extension until its links are made relative.
#[derive(Clone, Debug)]
pub(crate) struct MessagePage(pub(crate) String);

/// Returns a response with a page that only has a message. Its HTML is in the extension [`MessagePage`].
pub(crate) fn message_page(status: StatusCode, message: &str) -> Response {
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
            body { main { h1 { (status) } p { (message) } p { a href="/" { "All runs" } } } }
        }
    };
    (status, Extension(MessagePage(page.into_string()))).into_response()
}

/// Time after which browsers repeat the request for a report that could not be built, in seconds.
const REPORT_RETRY_SECONDS: u32 = 15;

/// Returns the page that is shown in place of a report.
pub(crate) fn no_report(reason: &str) -> String {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="color-scheme" content="light dark";
                meta http-equiv="refresh" content=(REPORT_RETRY_SECONDS); // the next attempt may succeed
                title { "perturb: no report" }
            }
            body { p { "There is no report now: " (shortened(reason)) } }
        }
    }
    .into_string()
}

/// Returns the media type and the content of a script, style or icon of the pages, by its name.
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
