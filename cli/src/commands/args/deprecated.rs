//! Deprecated names of commands and options. They still work, and a line on standard error states the new name.

use std::ffi::{OsStr, OsString};
use std::os::unix::ffi::{OsStrExt, OsStringExt};

/// Old and new names of commands.
const COMMANDS: [(&str, &str); 1] = [("rates", "rescore")];

/// The command, the old name and the new name of each renamed option.
const OPTIONS: [(&str, &str, &str); 5] = [
    ("plan", "--missing", "--unfinished-in"),
    ("plan", "--from", "--timings-from"),
    ("evaluate", "--base", "--base-version"),
    ("evaluate", "--selection", "--selection-episodes"),
    ("heatmap", "--base", "--base-version"),
];

/// Replaces deprecated names in a process's arguments. The first argument is the program's name. Calls `warn` with a
/// sentence for each replacement.
pub(super) fn renamed(mut arguments: Vec<OsString>, mut warn: impl FnMut(String)) -> Vec<OsString> {
    let is_name = |argument: &OsString| !argument.as_bytes().starts_with(b"-");
    let Some(mut position) = arguments.iter().skip(1).position(is_name).map(|position| position + 1) else {
        return arguments;
    };
    if arguments[position] == "help" && arguments.get(position + 1).is_some_and(is_name) {
        position += 1;
    }
    if let Some((old, new)) = COMMANDS.into_iter().find(|(old, _)| arguments[position] == *old) {
        warn(format!("`perturb {old}` is called `perturb {new}` now; the old name works until version 0.3"));
        arguments[position] = new.into();
    }
    let command = arguments[position].clone();
    for argument in arguments[position + 1..].iter_mut().take_while(|argument| *argument != "--") {
        for (_, old, new) in OPTIONS.into_iter().filter(|(name, ..)| command == *name) {
            if let Some(renamed) = renamed_option(argument, old, new) {
                warn(format!("{old} is called {new} now; the old name works until version 0.3"));
                *argument = renamed;
            }
        }
    }
    arguments
}

/// If `argument` is the option `old`, with or without `=VALUE`, returns it with the name `new`.
fn renamed_option(argument: &OsStr, old: &str, new: &str) -> Option<OsString> {
    let value = argument.as_bytes().strip_prefix(old.as_bytes())?;
    (value.is_empty() || value[0] == b'=').then(|| OsString::from_vec([new.as_bytes(), value].concat()))
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case("plan a --missing b --from=c", "plan a --unfinished-in b --timings-from=c", 2)]
    #[case("-q plan --missing b", "-q plan --unfinished-in b", 1)]
    #[case("evaluate --base R --selection", "evaluate --base-version R --selection-episodes", 2)]
    #[case("heatmap --base=R", "heatmap --base-version=R", 1)]
    #[case("rates a --success text", "rescore a --success text", 1)]
    #[case("help rates", "help rescore", 1)]
    #[case("report --selection paper", "report --selection paper", 0)]
    #[case("plan --missing-cells b --fromage", "plan --missing-cells b --fromage", 0)]
    #[case("plan -- --missing", "plan -- --missing", 0)]
    #[case("run --missing b", "run --missing b", 0)]
    #[case("help", "help", 0)]
    #[case("", "", 0)]
    fn old_names_are_replaced_and_named(#[case] given: &str, #[case] expected: &str, #[case] warnings: usize) {
        let words = |text: &str| ["perturb"].into_iter().chain(text.split_whitespace()).map(OsString::from).collect();
        let mut warned = Vec::new();
        let arguments: Vec<OsString> = renamed(words(given), |warning| warned.push(warning));
        assert_eq!(arguments, words(expected));
        assert_eq!(warned.len(), warnings, "{warned:?}");
    }
}
