//! The head of a report: title, date, plan, and the settings that all cells share.

use std::collections::BTreeSet;

use perturb_experiment::distinct;
use perturb_records::success::Rule;

use super::finding::listed;
use super::{Cell, PAPER_EPISODES, PAPER_TEST_EPISODES, Plan, Report, Selection, range, seeds};

/// Maximum number of methods in a title.
const NAMED: usize = 3;

impl Report<'_> {
    /// The plan's, or what it is of.
    pub(super) fn title(&self) -> String {
        if !self.plan.title.is_empty() {
            return self.plan.title.clone();
        }
        let methods: Vec<String> = self.scope.methods.iter().map(ToString::to_string).collect();
        let methods = if methods.len() > NAMED { format!("{} methods", methods.len()) } else { listed(&methods) };
        if self.scope.environments.is_empty() {
            return "Results".into();
        }
        format!("Generalisation of {methods} on {}", listed(&self.scope.environments))
    }

    /// The paragraphs in which the plan says what it is.
    pub(super) fn abstract_paragraphs(&self) -> Vec<String> {
        opening_comment(&self.plan.text)
    }

    /// Returns names and values of the metadata, without empty ones.
    pub(super) fn facts(&self) -> Vec<(&'static str, String)> {
        let cells = &self.plan.cells;
        let mut facts = vec![("date", self.plan.date.clone())];
        if !cells.is_empty() {
            let all = || cells.iter().chain(&self.plan.candidates);
            let trained_on: Vec<String> =
                distinct(all().map(Cell::trained_on)).iter().map(ToString::to_string).collect();
            let sets = distinct(all().flat_map(|cell| &cell.tests.sets).map(|set| set.name.as_str()));
            let budget = with_papers(range(cells, |cell| cell.config.common.episodes), PAPER_EPISODES);
            let tests = with_papers(range(cells, |cell| cell.tests.episodes), PAPER_TEST_EPISODES);
            facts.extend([
                ("training", format!("{budget} on {}", listed(&trained_on))),
                ("tests", format!("{tests} each, on {}", listed(&sets))),
                ("seeds", self.seeds()),
                ("preset", listed(&distinct(all().map(|cell| cell.method().preset.to_string())))),
                ("selection", self.selection_rule().to_owned()),
                ("success", success(all())),
            ]);
        }
        let done = self.selected();
        let commits: BTreeSet<&str> = done.iter().flat_map(|selected| selected.result.commits()).collect();
        facts
            .push(("program", commits.iter().map(|commit| format!("perturb {commit}")).collect::<Vec<_>>().join(", ")));
        facts.into_iter().filter(|(_, said)| !said.is_empty()).collect()
    }

    fn seeds(&self) -> String {
        let Plan { cells, candidates, .. } = self.plan;
        let runs = |of: &[&Cell]| of.iter().map(|cell| cell.run).collect::<BTreeSet<_>>().len();
        match self.plan.selection {
            Selection::Clean => {
                let tuning: Vec<&Cell> = cells.iter().filter(|cell| cell.tuned_as.is_none()).collect();
                let reported: Vec<&Cell> = candidates.iter().collect();
                format!(
                    "{} selected ({}), {} are reported ({})",
                    seeds(tuning.iter().copied()),
                    perturb_text::count(runs(&tuning), "run"),
                    seeds(reported.iter().copied()),
                    perturb_text::count(runs(&reported), "run")
                )
            }
            Selection::Paper => {
                let all: Vec<&Cell> = cells.iter().collect();
                format!("{} ({})", seeds(all.iter().copied()), perturb_text::count(runs(&all), "run"))
            }
        }
    }

    fn selection_rule(&self) -> &'static str {
        match self.plan.selection {
            Selection::Clean => "clean: by episodes and seeds of its own",
            Selection::Paper if self.plan.selects() => "paper: by the tests that are reported",
            Selection::Paper => "none: each method has one configuration in each environment",
        }
    }
}

/// The paragraphs of the comment that a file begins with. One whose lines are all indented has commands.
fn opening_comment(text: &str) -> Vec<String> {
    let comment = text.lines().skip_while(|line| line.trim().is_empty());
    let lines: Vec<&str> = comment.map_while(|line| line.trim().strip_prefix('#')).collect();
    let is_command = |line: &&str| line.starts_with("  ") || line.starts_with('\t');
    let paragraphs = lines.split(|line| line.trim().is_empty()).filter(|lines| !lines.iter().all(is_command));
    paragraphs.map(|lines| lines.iter().map(|line| line.trim()).collect::<Vec<_>>().join(" ")).collect()
}

/// Marks a budget that is the paper's.
fn with_papers(budget: String, papers: u64) -> String {
    let said = if budget == papers.to_string() { "as the paper".to_owned() } else { format!("the paper: {papers}") };
    format!("{budget} episodes ({said})")
}

/// By which rules.
fn success<'a>(cells: impl Iterator<Item = &'a Cell>) -> String {
    let said = |rule: &Option<Rule>| match rule {
        None => "as the paper's text says".to_owned(),
        Some(Rule::Text) => "as the paper's text says".to_owned(),
        Some(Rule::Code) => "as the paper's published code judges".to_owned(),
        Some(rule) => format!("by `{rule}`"),
    };
    listed(&distinct(cells.map(|cell| said(&cell.tests.success))))
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::opening_comment;

    #[rstest]
    #[case::nothing("runs = 3\n# later", &[])]
    #[case::lines("# One\n# paragraph.\nruns = 3", &["One paragraph."])]
    #[case::paragraphs("#\n# One.\n#\n#\n#Two.\n\n# later", &["One.", "Two."])]
    #[case::commands("\n# One.\n#\n#   perturb run\n#\tperturb report\n#\n# Two.", &["One.", "Two."])]
    #[case::a_list("# One:\n# - two\n#   lines", &["One: - two lines"])]
    fn abstract_is_the_comment_before_the_first_key(#[case] text: &str, #[case] paragraphs: &[&str]) {
        assert_eq!(opening_comment(text), paragraphs);
    }
}
