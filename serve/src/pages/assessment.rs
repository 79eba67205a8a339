//! The page of a saved assessment.

use maud::{Markup, html};
use perturb_experiment::runs::{AssessedTest, AssessmentStatus, RunKind};
use perturb_text::grouped;

use super::{Update, breadcrumbs, facts, faults, shown_name};
use crate::assessment::LiveAssessment;
use crate::paths::{RelativePath, Root};

pub(crate) fn update(root: &Root, relative: &RelativePath, assessment: &LiveAssessment) -> Update {
    let parts = match assessment.status() {
        Ok(status) => vec![("head", head(status)), ("tests", tests(&status.tests))],
        Err(reason) => vec![("head", faults(&[format!("This assessment is not understood: {reason}")]))],
    };
    let title = shown_name(root, relative);
    let breadcrumbs = breadcrumbs(root, relative);
    Update { title, kind: Some(RunKind::Assessment), parts, breadcrumbs, ..Update::default() }
}

pub(crate) fn page(root: &Root, relative: &RelativePath, update: &Update) -> String {
    let main = html! {
        h1 { (shown_name(root, relative)) }
        (update.part("head"))
        (update.part("tests"))
    };
    super::document(&update.title, &format!("/events/{}", relative.encode()), &update.breadcrumbs, &main)
}

fn head(status: &AssessmentStatus) -> Markup {
    facts([("agent", html! { (status.agent) }), ("environment", html! { (status.environment) })])
}

fn tests(tests: &[AssessedTest]) -> Markup {
    html! {
        h2 { "Tests" }
        div.wide {
            table {
                thead {
                    tr {
                        @for name in ["trained on", "tested on", "episodes", "success, %", "95 % interval", "return", "length"] {
                            th scope="col" { (name) }
                        }
                    }
                }
                tbody { @for test in tests { (row(test)) } }
            }
        }
    }
}

fn row(AssessedTest { trained_on, tested_on, result }: &AssessedTest) -> Markup {
    let [low, high] = result.success_percent_95;
    html! {
        tr {
            th scope="row" { (trained_on) }
            td { (tested_on) }
            td.number { (grouped(result.episodes as usize)) }
            td.number { (format!("{:.1}", result.success_percent)) }
            td.number { (format!("{low:.1} … {high:.1}")) }
            td.number { (format!("{:.2}", result.mean_return)) }
            td.number { (format!("{:.1}", result.mean_length)) }
        }
    }
}
