//! Doc comments that open without a subject.
//!
//! A comment such as "What became of the request" must be read to its end to find out what it describes. A doc comment
//! should open with its subject, or with a verb whose subject is the documented item: "Returns the result of the
//! request".

use crate::source::{SourceTree, folder_of, is_generated, is_test};

/// First words of comments that do not name a subject.
pub const OPENINGS: [&str; 22] = [
    "What", "Whatever", "Who", "Whoever", "Whose", "Which", "Of", "That", "Those", "The same", "So many", "As many",
    "Where", "When", "How", "Its", "None", "It", "One", "As", "So", "Likewise",
];

/// The first line of a doc comment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DocComment {
    /// The folder to which the comment is counted, see [`folder_of`].
    pub folder: String,
    /// The file with the comment.
    pub file: String,
    /// The line in the file, from 1.
    pub line: usize,
    /// The text of the first line.
    pub text: String,
    /// Whether the comment opens without a subject.
    pub lacks_subject: bool,
}

/// Reads the first line of every doc comment in Rust files and of every comment in `.proto` files. Skips tests and
/// generated code.
pub fn read(tree: &SourceTree) -> Vec<DocComment> {
    let mut comments = Vec::new();
    let files = tree.with_extension(".rs").chain(tree.with_extension(".proto"));
    for (file, source) in files.filter(|(path, _)| !is_test(path) && !is_generated(path)) {
        let marks: &[&str] = if file.ends_with(".proto") { &["//"] } else { &["///", "//!"] };
        let mut lines = source.lines().map(str::trim_start).enumerate().peekable();
        let mut is_continued = false;
        while let Some((index, line)) = lines.next() {
            if line == "#[cfg(test)]"
                && lines.peek().is_some_and(|(_, next)| next.starts_with("mod ") && next.ends_with('{'))
            {
                break;
            }
            let comment = marks.iter().find_map(|mark| line.strip_prefix(mark));
            let text = comment.map(|text| text.strip_prefix(' ').unwrap_or(text));
            if let Some(text) = text.filter(|text| !is_continued && !text.is_empty()) {
                comments.push(DocComment {
                    folder: folder_of(file).to_owned(),
                    file: file.to_owned(),
                    line: index + 1,
                    text: text.to_owned(),
                    lacks_subject: lacks_subject(text),
                });
            }
            is_continued = comment.is_some();
        }
    }
    comments
}

/// Returns whether a comment opens with one of [`OPENINGS`] as a whole word.
pub fn lacks_subject(text: &str) -> bool {
    OPENINGS.into_iter().any(|opening| {
        text.strip_prefix(opening).is_some_and(|rest| !rest.starts_with(|c: char| c.is_alphanumeric() || c == '_'))
    })
}
