//! The page of a saved assessment.

use maud::{Markup, html};
use perturb_experiment::runs::{AssessmentStatus, RunKind};

use super::{ReportSource, Update, breadcrumbs, facts, faults, report_frame, shown_name};
use crate::assessment::LiveAssessment;
use crate::paths::{RelativePath, Root};

pub(crate) fn update(root: &Root, relative: &RelativePath, assessment: &LiveAssessment, report: u64) -> Update {
    let head = match assessment.status() {
        Ok(status) => head(status),
        Err(reason) => faults(&[format!("This assessment is not understood: {reason}")]),
    };
    let source = ReportSource { folder: assessment.report_folder(), fingerprint: assessment.report_fingerprint() };
    Update {
        title: shown_name(root, relative),
        kind: Some(RunKind::Assessment),
        parts: vec![("head", head)],
        report,
        report_source: Some(source),
        breadcrumbs: breadcrumbs(root, relative),
        ..Update::default()
    }
}

pub(crate) fn page(root: &Root, relative: &RelativePath, update: &Update) -> String {
    let main = html! {
        h1 { (shown_name(root, relative)) }
        (update.part("head"))
        h2 { "Report" }
        (report_frame(relative, update))
    };
    super::document(&update.title, &format!("/events/{}", relative.encode()), &update.breadcrumbs, &main)
}

fn head(status: &AssessmentStatus) -> Markup {
    facts([("agent", html! { (status.agent) }), ("environment", html! { (status.environment) })])
}
