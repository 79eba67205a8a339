//! The page with the learning curves of several trainings in the same charts.

use maud::{Markup, html};
use serde::Serialize;
use serde_json::json;

use super::{Update, badge, budget_choice, chart, faults, run_link, shown_name};
use crate::curve::LearningCurve;
use crate::paths::{RelativePath, Root};
use crate::training::LiveTraining;

/// Maximum number of trainings in a chart: the number of colours.
pub(crate) const MAX_TRAININGS: usize = 8;

/// A training in the charts.
#[derive(Debug, Serialize)]
pub(crate) struct ChartedTraining {
    #[serde(skip)]
    relative: RelativePath,
    /// The shown name. `kind` has the same value: the script chooses colours by `kind`, so each training has its own
    /// colour.
    id: String,
    kind: String,
    #[serde(skip)]
    what: String,
    #[serde(skip)]
    state: &'static str,
    #[serde(flatten)]
    curve: LearningCurve,
}

impl ChartedTraining {
    pub(crate) fn new(root: &Root, relative: &RelativePath, training: &LiveTraining) -> Self {
        let name = shown_name(root, relative);
        let summary = training.summary();
        Self {
            relative: relative.clone(),
            id: name.clone(),
            kind: name,
            what: summary.what,
            state: summary.state,
            curve: training.curve(),
        }
    }
}

/// Returns the content for the `chosen` trainings, of which `found` exist.
pub(crate) fn update(root: &Root, chosen: &[RelativePath], found: &[ChartedTraining]) -> Update {
    let missing = chosen.iter().filter(|relative| found.iter().all(|one| one.relative != **relative));
    let missing: Vec<String> =
        missing.map(|relative| format!("There is no training {}.", shown_name(root, relative))).collect();
    let head = html! {
        ul {
            @for one in found {
                li { a href=(run_link(&one.relative)) { (one.id) } ": " (one.what) " " (badge(one.state)) }
            }
        }
        (faults(&missing))
    };
    Update {
        title: format!("{} trainings · perturb", found.len()),
        parts: vec![("head", head)],
        charts: json!({ "runs": found }),
        ..Update::default()
    }
}

/// Returns the page. Its parts and curves are empty until the first event.
pub(crate) fn page(root: &Root, chosen: &[RelativePath]) -> String {
    let title = "Learning curves of several trainings";
    let breadcrumbs = html! {
        ol { li { a href="/" { (root.given().display()) } } li { span aria-current="page" { (title) } } }
    };
    let main = html! {
        h1 { (title) }
        (Update::default().part("head"))
        (budget_choice())
        div.charts {
            (chart("return", "Return"))
            (chart("success", "Success, %"))
            (chart("length", "Episode length, steps"))
        }
    };
    let names: Vec<String> = chosen.iter().map(RelativePath::encode).collect();
    super::document(title, &format!("/events?runs={}", names.join(",")), &breadcrumbs, &main)
}

/// Returns the checkbox by which a user chooses a training in the list of all runs.
pub(super) fn choice_box(name: &str, relative: &RelativePath) -> Markup {
    html! { input type="checkbox" name="charted" value=(relative.encode()) aria-label={ "Compare " (name) } title="Compare with other trainings"; " " }
}

/// Returns the link to the curves of the chosen trainings. It is hidden until the script adds the trainings to it.
pub(super) fn chosen_link() -> Markup {
    html! { p hidden { a #charted href="/curves" data-most=(MAX_TRAININGS) {} } }
}
