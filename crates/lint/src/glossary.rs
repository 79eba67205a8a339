//! Check of the glossary: it must explain every public type of the server, the pool and the learner, except those that
//! are listed as commonplace.

use std::collections::BTreeSet;

use crate::names::Definition;

/// Folders whose public types the glossary must explain.
pub const FOLDERS: [&str; 3] = ["src/server/", "src/pool/", "learner/src/"];

/// Returns the types that the glossary's tables explain: names in backquotes in the first column, such as `Pool`.
pub fn explained_types(glossary: &str) -> BTreeSet<&str> {
    let first_columns = glossary.lines().filter_map(|line| line.strip_prefix('|')?.split('|').next());
    first_columns.flat_map(|column| column.split('`').skip(1).step_by(2)).filter(|name| is_type_name(name)).collect()
}

/// Returns the public types that lack an explanation: types in [`FOLDERS`] that are neither in the glossary nor
/// commonplace. Types whose names end in `Error` need none.
pub fn unexplained<'a>(
    public_types: &'a [Definition],
    glossary: &str,
    is_commonplace: impl Fn(&str) -> bool,
) -> Vec<&'a Definition> {
    let explained = explained_types(glossary);
    let needs_entry = |definition: &&Definition| {
        let name = definition.name.as_str();
        FOLDERS.iter().any(|folder| definition.file.starts_with(folder))
            && !name.ends_with("Error")
            && !explained.contains(name)
            && !is_commonplace(name)
    };
    public_types.iter().filter(needs_entry).collect()
}

/// Returns whether a text looks like the name of a type: `ReplayBuffer`, but not `n_steps` or `DE`.
fn is_type_name(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_uppercase())
        && text.contains(|c: char| c.is_ascii_lowercase())
        && text.chars().all(|c| c.is_ascii_alphanumeric())
}
