//! The page with the list of all runs.

use std::time::Duration;

use maud::{Markup, html};
use perturb_experiment::runs::RunKind;
use perturb_protocol::Address;
use perturb_text::{duration, grouped};

use super::{Update, badge, bar, curves, facts, pictures, run_link, shown_name, time};
use crate::index::{Index, MAX_FOLDERS, Row};
use crate::paths::Root;
use crate::server_status::ServerStatus;

/// Maximum number of symbolic links out of the served folder that the page names.
const MAX_SHOWN_LINKS: usize = 20;

/// The address of a polled perturb-server, and its status or the reason why the last poll failed. `None` before the
/// first poll.
type PolledServer<'a> = (&'a Address, Option<Result<ServerStatus, String>>);

pub(crate) fn update(root: &Root, index: &Index, server: Option<&PolledServer<'_>>) -> Update {
    let in_work = index.runs.iter().filter(|row| row.summary.state == "in work").count();
    Update {
        title: if in_work > 0 { format!("{in_work} in work · perturb") } else { "perturb".into() },
        kind: None,
        parts: vec![
            ("runs", runs(root, index)),
            ("server", server.map_or_else(Markup::default, server_section)),
            ("pictures", pictures::section(&index.pictures)),
        ],
        ..Update::default()
    }
}

pub(crate) fn page(root: &Root, update: &Update) -> String {
    let breadcrumbs = html! { ol { li { span aria-current="page" { (root.given().display()) } } } };
    let main = html! {
        h1 { "Trainings and experiments" }
        (update.part("runs"))
        (curves::chosen_link())
        (update.part("server"))
        (update.part("pictures"))
    };
    super::document(&update.title, "/events", &breadcrumbs, &main)
}

fn runs(root: &Root, index: &Index) -> Markup {
    html! {
        @if index.runs.is_empty() {
            p { "There is no training and no experiment yet in " code { (root.given().display()) } "." }
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
            p { "And " (grouped(index.more_runs)) " more, which changed earlier." }
        }
        @if !index.links_out.is_empty() {
            p {
                "Links that lead out of the folder are not followed: "
                @for (place, link) in index.links_out.iter().take(MAX_SHOWN_LINKS).enumerate() {
                    @if place > 0 { ", " }
                    code { (link.path().display()) }
                }
                @if index.links_out.len() > MAX_SHOWN_LINKS {
                    " and " (grouped(index.links_out.len() - MAX_SHOWN_LINKS)) " more"
                }
                "."
            }
        }
        @if index.has_more_folders {
            p { "There are more than " (grouped(MAX_FOLDERS)) " folders; the others were not searched." }
        }
    }
}

fn run(root: &Root, Row { relative, kind, summary, changed, remaining_seconds }: &Row) -> Markup {
    let name = shown_name(root, relative);
    let known = !summary.unit.is_empty();
    let number = |number: u64| grouped(number as usize);
    html! {
        tr role="row" {
            th scope="row" role="rowheader" {
                @if *kind == RunKind::Training { (curves::choice_box(&name, relative)) }
                a href=(run_link(relative)) { (name) }
            }
            td.what role="cell" {
                (match kind {
                    RunKind::Training => "training",
                    RunKind::Experiment => "experiment",
                    RunKind::Assessment => "assessment",
                })
                @if !summary.what.is_empty() { ": " (summary.what) }
            }
            td.amount role="cell" {
                @if known {
                    (bar(summary.done, summary.budget, &format!("{name}: done")))
                    span { (number(summary.done)) " of " (number(summary.budget)) " " (summary.unit) }
                    @if let Some(seconds) = remaining_seconds { span { ", about " (duration(*seconds)) " left" } }
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

/// Returns the section with the status of the perturb-server.
fn server_section((address, last): &PolledServer<'_>) -> Markup {
    let text = |text: String| html! { (text) };
    html! {
        h2 { "Environment server" }
        @match last {
            None => p { code { (address) } " has not been asked yet." },
            Some(Err(reason)) => { (super::faults(&[format!("{address} does not take sessions: {reason}")])) },
            Some(Ok(answer)) => { p { code { (address) } } (facts([
                ("state", html! { (badge("takes sessions")) }),
                ("median response time", text(milliseconds(answer.median_response))),
                ("slowest response lately", text(milliseconds(answer.max_response))),
                ("version", text(answer.version.clone())),
                ("environments in the catalogue", text(grouped(answer.environments))),
                ("maximum environments in a session", text(grouped(answer.max_batch_size as usize))),
            ])) }
        }
    }
}
