//! The title of a report, and the plan's own description of the experiment.

use super::Report;
use super::finding::listed;

/// Maximum number of methods that a title lists by name. If there are more, the title has only their number.
const MAX_NAMED: usize = 3;

impl Report<'_> {
    /// Returns the plan's title or, if it has none, a title that names methods and environments.
    pub(super) fn title(&self) -> String {
        if !self.plan.title.is_empty() {
            return self.plan.title.clone();
        }
        let methods: Vec<String> = self.scope.methods.iter().map(ToString::to_string).collect();
        let methods = if methods.len() > MAX_NAMED { format!("{} methods", methods.len()) } else { listed(&methods) };
        if self.scope.environments.is_empty() {
            return "Results".into();
        }
        format!("Generalisation of {methods} on {}", listed(&self.scope.environments))
    }

    /// Returns the paragraphs of the comment at the start of the experiment file.
    pub(super) fn abstract_paragraphs(&self) -> Vec<String> {
        opening_comment(&self.plan.text)
    }
}

/// Returns the paragraphs of the comment at the start of a file. Leaves out paragraphs whose lines are all indented,
/// because they contain commands.
fn opening_comment(text: &str) -> Vec<String> {
    let comment = text.lines().skip_while(|line| line.trim().is_empty());
    let lines: Vec<&str> = comment.map_while(|line| line.trim().strip_prefix('#')).collect();
    let is_command = |line: &&str| line.starts_with("  ") || line.starts_with('\t');
    let paragraphs = lines.split(|line| line.trim().is_empty()).filter(|lines| !lines.iter().all(is_command));
    paragraphs.map(|lines| lines.iter().map(|line| line.trim()).collect::<Vec<_>>().join(" ")).collect()
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
