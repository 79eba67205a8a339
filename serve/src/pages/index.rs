//! The page of all runs.

use std::time::Duration;

use maud::{Markup, html};
use perturb_protocol::Address;
use perturb_study::runs::Kind;
use perturb_study::words::{duration, grouped};

use super::{Update, badge, bar, facts, name_of, pictures, run_link, time};
use crate::index::{Index, MOST_FOLDERS, Row};
use crate::load::Answer;
use crate::paths::Root;

/// An asked server with its last answer, if there is one yet.
type Server<'a> = (&'a Address, Option<Result<Answer, String>>);

pub(crate) fn update(root: &Root, index: &Index, server: Option<&Server<'_>>) -> Update {
    let in_work = index.runs.iter().filter(|row| row.summary.state == "in work").count();
    Update {
        title: if in_work > 0 { format!("{in_work} in work · perturb") } else { "perturb".into() },
        kind: None,
        parts: vec![
            ("runs", runs(root, index)),
            ("server", server.map_or_else(Markup::default, of_server)),
            ("pictures", pictures::shown(&index.pictures)),
        ],
        ..Update::default()
    }
}

pub(crate) fn page(root: &Root, update: &Update) -> String {
    let crumbs = html! { ol { li { span aria-current="page" { (root.given().display()) } } } };
    let main = html! {
        h1 { "Trainings and experiments" }
        (update.part("runs"))
        (update.part("server"))
        (update.part("pictures"))
    };
    super::document(&update.title, "/events", &crumbs, &main)
}

fn runs(root: &Root, index: &Index) -> Markup {
    html! {
        @if index.runs.is_empty() {
            p { "There is nothing yet: neither a training nor an experiment is in " code { (root.given().display()) } "." }
        } @else {
            table.runs role="table" {
                thead role="rowgroup" {
                    tr role="row" {
                        @for name in ["run", "what", "done", "success", "state", "changed"] {
                            th scope="col" role="columnheader" { (name) }
                        }
                    }
                }
                tbody role="rowgroup" { @for row in &index.runs { (run(root, row)) } }
            }
        }
        @if index.more_runs > 0 {
            p { "And " (grouped(index.more_runs)) " more, which changed before these." }
        }
        @if index.more {
            p { "There are more than " (grouped(MOST_FOLDERS)) " folders; the others were not looked at." }
        }
    }
}

fn run(root: &Root, Row { relative, kind, summary, changed, left }: &Row) -> Markup {
    let name = name_of(root, relative);
    let known = !summary.unit.is_empty();
    let number = |number: u64| grouped(number as usize);
    html! {
        tr role="row" {
            th scope="row" role="rowheader" { a href=(run_link(relative)) { (name) } }
            td.what role="cell" {
                (match kind { Kind::Training => "training", Kind::Experiment => "experiment" })
                @if !summary.what.is_empty() { ": " (summary.what) }
            }
            td.amount role="cell" {
                @if known {
                    (bar(summary.done, summary.budget, &format!("{name}: done")))
                    span { (number(summary.done)) " of " (number(summary.budget)) " " (summary.unit) }
                    @if let Some(left) = left { span { ", about " (duration(*left)) " left" } }
                }
            }
            td.number role="cell" data-name="success" { @if let Some(percent) = summary.success_percent { (format!("{percent:.1} %")) } }
            td role="cell" { (badge(summary.state)) }
            td role="cell" { (time(*changed)) }
        }
    }
}

fn milliseconds(time: Duration) -> String {
    format!("{:.1} ms", 1e3 * time.as_secs_f64())
}

/// What a server of environments says of itself.
fn of_server((address, last): &Server<'_>) -> Markup {
    let text = |text: String| html! { (text) };
    html! {
        h2 { "Server of environments" }
        @match last {
            None => p { code { (address) } " was not asked yet." },
            Some(Err(reason)) => { (super::troubles(&[format!("{address} does not take sessions: {reason}")])) },
            Some(Ok(answer)) => { p { code { (address) } } (facts([
                ("state", html! { (badge("takes sessions")) }),
                ("answers in", text(milliseconds(answer.usual))),
                ("slowest answer of late", text(milliseconds(answer.slowest))),
                ("version", text(answer.version.clone())),
                ("kinds of environments", text(grouped(answer.environments))),
                ("environments a session, at most", text(grouped(answer.most as usize))),
            ])) }
        }
    }
}
