//! The page of an experiment.

use std::collections::BTreeSet;
use std::path::Path;

use maud::{Markup, html};
use perturb_experiment::Cell;
use perturb_experiment::runs::{CellStatus, ExperimentStatus, RunKind};
use perturb_text::{duration, grouped};
use serde_json::json;

use super::{
    ReportSource, Update, badge, bar, breadcrumbs, chart, faults, pictures, report_frame, run_link, shown_name, time,
};
use crate::experiment::{LiveExperiment, MAX_CURVES as MAX_LISTED};
use crate::paths::{RelativePath, Root};
use crate::pictures::scan_run;

/// Maximum number of cells in the map of all cells. For more cells no map is drawn.
const MAX_MAPPED: usize = 1000;

pub(crate) fn update(
    root: &Root,
    relative: &RelativePath,
    path: &Path,
    experiment: &LiveExperiment,
    report: u64,
) -> Update {
    let name = shown_name(root, relative);
    let (title, parts) = match experiment.status() {
        Err(reason) => (name, vec![("head", faults(&[format!("This experiment is not understood: {reason}")]))]),
        Ok(status) => {
            let parts = vec![
                ("head", head(status, experiment)),
                ("rates", rates_table(status)),
                ("working", working(status, experiment, relative)),
                ("map", map(status, experiment, relative)),
                ("failures", failures(status, experiment, relative)),
                ("lag", lag(report != experiment.report_fingerprint())),
                ("pictures", pictures::section(&scan_run(relative, path))),
            ];
            (title(&name, status, experiment), parts)
        }
    };
    let charts = json!({ "cells": experiment.curves() });
    let source = ReportSource { folder: experiment.report_folder(), fingerprint: experiment.report_fingerprint() };
    Update {
        title,
        kind: Some(RunKind::Experiment),
        parts,
        charts,
        report,
        report_source: Some(source),
        breadcrumbs: breadcrumbs(root, relative),
    }
}

pub(crate) fn page(root: &Root, relative: &RelativePath, update: &Update) -> String {
    let main = html! {
        h1 { (shown_name(root, relative)) }
        (update.part("head"))
        (update.part("failures"))
        (update.part("rates"))
        (update.part("working"))
        div.charts data-needs="cells" { (chart("cells", "Training success of the running cells, %, over episodes")) }
        details open { summary { "All cells" } (update.part("map")) }
        (update.part("pictures"))
        h2 { "Current report" }
        (report_frame(relative, update))
        p.note {
            "Files: " a href={ "/file/" (relative.join("plan.toml").encode()) } { "plan.toml" }
        }
    };
    super::document(&update.title, &format!("/events/{}", relative.encode()), &update.breadcrumbs, &main)
}

fn title(name: &str, status: &ExperimentStatus, experiment: &LiveExperiment) -> String {
    let settled = status.count(CellStatus::is_settled);
    let all = status.cells.len();
    if experiment.state() == "in work" { format!("{settled}/{all} · {name}") } else { format!("{name} · perturb") }
}

fn head(status: &ExperimentStatus, experiment: &LiveExperiment) -> Markup {
    let all = status.cells.len() as u64;
    let done = status.done().count();
    let settled = status.count(CellStatus::is_settled) as u64;
    let count = |is: fn(&CellStatus) -> bool| status.count(is);
    let failed = count(|cell| matches!(cell, CellStatus::Failed(_)));
    let working = count(|cell| *cell == CellStatus::InWork);
    let waiting = count(|cell| matches!(cell, CellStatus::Waiting { .. }));
    let wrong: Vec<String> = status
        .cells
        .iter()
        .filter_map(|cell| match cell {
            CellStatus::NotUnderstood(reason) => Some(reason.clone()),
            _ => None,
        })
        .take(MAX_LISTED)
        .collect();
    html! {
        p.head { (status.plan.environments().join(", ")) " " (badge(experiment.state())) }
        (bar(settled, all, "Cells that are done or have failed"))
        p {
            (grouped(done)) " of " (grouped(all as usize)) " cells done"
            @for (number, what) in [(failed, "failed"), (working, "in work"), (waiting, "to do")] {
                @if number > 0 { ", " (grouped(number)) " " (what) }
            }
            @if let Some(left) = experiment.remaining_seconds() { "; about " (duration(left)) " left" }
            "; changed " (time(experiment.changed())) "."
        }
        (faults(&wrong))
    }
}

/// Returns a table with a row for each combination of environment, method and training distribution. A row has the
/// number of finished cells, and their mean success rate in each test.
fn rates_table(status: &ExperimentStatus) -> Markup {
    let rates = status.rates();
    // The rows in the order of the plan: a description, the number of finished cells, and the number of all cells.
    let mut rows: Vec<(String, usize, usize)> = Vec::new();
    for (cell, known) in status.plan.cells.iter().zip(&status.cells) {
        let description = cell.described();
        let index = rows.iter().position(|(name, ..)| *name == description).unwrap_or_else(|| {
            rows.push((description, 0, 0));
            rows.len() - 1
        });
        rows[index].1 += usize::from(matches!(known, CellStatus::Done(_)));
        rows[index].2 += 1;
    }
    let mut seen = BTreeSet::new();
    let sets: Vec<&str> = (status.plan.cells.iter().flat_map(|cell| &cell.tests.sets))
        .map(|set| set.name.as_str())
        .filter(|name| seen.insert(*name))
        .collect();
    html! {
        h2 { "Success of the finished cells, %" }
        div.wide {
            table.rates {
                thead {
                    tr {
                        th scope="col" { "environment, method, trained on" }
                        th scope="col" { "cells" }
                        @for set in &sets { th.number scope="col" { "on " (set) } }
                    }
                }
                tbody {
                    @for (description, done, all) in &rows {
                        @let rate = rates.iter().find(|rate| rate.kind == *description);
                        tr {
                            th scope="row" { (description) }
                            td.number { (done) " of " (all) }
                            @for set in &sets {
                                td.number {
                                    @if let Some((_, percent)) = rate.and_then(|rate| rate.success.iter().find(|(name, _)| name == set)) {
                                        (format!("{percent:.1}"))
                                    }
                                }
                            }
                        }
                    }
                }
            }
        }
        p.note { "Means over configurations and runs. The report below has the selected configurations." }
    }
}

fn working(status: &ExperimentStatus, experiment: &LiveExperiment, relative: &RelativePath) -> Markup {
    let cells = || {
        let all = status.plan.cells.iter().zip(&status.cells);
        all.filter(|(_, known)| **known == CellStatus::InWork).map(|(cell, _)| cell)
    };
    let more = cells().count().saturating_sub(MAX_LISTED);
    html! {
        @if cells().next().is_some() {
            h2 { "In work" }
            div.wide {
                table.working {
                    thead { tr { @for name in ["cell", "training", "success, last 100", "doing"] { th scope="col" { (name) } } } }
                    tbody { @for cell in cells().take(MAX_LISTED) { (working_row(cell, experiment, relative)) } }
                }
            }
            @if more > 0 { p { "And " (more) " more." } }
        }
    }
}

/// Returns the row of a running cell.
fn working_row(cell: &Cell, experiment: &LiveExperiment, relative: &RelativePath) -> Markup {
    let training = experiment.training(&cell.id).and_then(|training| training.status().ok());
    let episodes = training.map_or(0, |status| status.episodes);
    let budget = cell.config.common.episodes;
    let success = training.and_then(|status| status.progress.as_ref()?.success_percent());
    let doing = match () {
        () if training.is_none() => "beginning",
        () if episodes >= budget || training.is_some_and(|status| status.over) => "tests",
        () => "training",
    };
    html! {
        tr {
            th scope="row" { (cell_link(experiment, relative, cell, &html! { (cell.id) })) }
            td.amount {
                (bar(episodes, budget, &format!("{}: episodes", cell.id)))
                span { (grouped(episodes as usize)) " of " (grouped(budget as usize)) }
            }
            td.number data-name="success" { @if let Some(percent) = success { (format!("{percent:.0} %")) } }
            td { (doing) }
        }
    }
}

/// Returns a note if the report is older than the results. Reports are built rarely, to leave the processor to
/// trainings.
fn lag(lags: bool) -> Markup {
    html! { @if lags { p.note { "Some results are newer than this report. It will be built again soon and shown without a reload." } } }
}

/// Returns the map of all cells, which shows each cell as a square in the colour of its state.
fn map(status: &ExperimentStatus, experiment: &LiveExperiment, relative: &RelativePath) -> Markup {
    if status.cells.len() > MAX_MAPPED {
        return html! { p { (grouped(status.cells.len())) " cells are too many for the map of cells." } };
    }
    let word = |known: &CellStatus| match known {
        CellStatus::Done(_) => "done",
        CellStatus::Failed(_) => "failed",
        CellStatus::NotUnderstood(_) => "not understood",
        CellStatus::InWork => "in work",
        CellStatus::Waiting { begun: true } => "broken off",
        CellStatus::Waiting { begun: false } => "to do",
    };
    html! {
        ul.map {
            @for (cell, known) in status.plan.cells.iter().zip(&status.cells) {
                @let word = word(known);
                @let label = format!("{}: {word}", cell.id);
                li class={ "state " (word.replace(' ', "-")) } title=(label) {
                    (cell_link(experiment, relative, cell, &html! { span.hidden { (label) } }))
                }
            }
        }
        ul.legend {
            @for word in ["done", "failed", "in work", "broken off", "to do"] {
                li { span class={ "swatch state " (word.replace(' ', "-")) } {} (word) }
            }
        }
    }
}

fn failures(status: &ExperimentStatus, experiment: &LiveExperiment, relative: &RelativePath) -> Markup {
    let failed: Vec<(&Cell, &str)> = status
        .plan
        .cells
        .iter()
        .zip(&status.cells)
        .filter_map(|(cell, known)| match known {
            CellStatus::Failed(reason) => Some((cell, reason.as_str())),
            _ => None,
        })
        .collect();
    html! {
        @if !failed.is_empty() {
            ul.trouble {
                @for (cell, reason) in failed.iter().take(MAX_LISTED) {
                    li { (cell_link(experiment, relative, cell, &html! { (cell.id) })) " failed: " (reason) }
                }
                @if failed.len() > MAX_LISTED { li { "and " (failed.len() - MAX_LISTED) " more" } }
            }
        }
    }
}

/// Returns `words`, as a link to the page of the cell's training if the training has begun.
fn cell_link(experiment: &LiveExperiment, relative: &RelativePath, cell: &Cell, words: &Markup) -> Markup {
    let address = || run_link(&relative.join("cells").join(&cell.id).join("training"));
    html! { @if experiment.has_page(&cell.id) { a href=(address()) { (words) } } @else { (words) } }
}
