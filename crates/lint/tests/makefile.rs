//! Rules for the Makefile.

use perturb_lint::source::SourceTree;
use std::path::Path;

/// Returns the filters by which a command `cargo test` selects tests: names of modules, which end in `::`, and parts of
/// tests' names.
fn test_filters(command: &str) -> Vec<&str> {
    let arguments = command.split(&['&', '|', ';'][..]).next().unwrap_or_default();
    let is_filter = |word: &str| word.bytes().all(|byte| byte.is_ascii_lowercase() || b"_:".contains(&byte));
    let words: Vec<_> = arguments.split_whitespace().skip_while(|word| *word != "test").skip(1).collect();
    let takes_value =
        |option: &str| ["--package", "--test", "--features", "--test-threads", "--config"].contains(&option);
    let after_option = |place: usize| place > 0 && takes_value(words[place - 1]);
    (0..words.len())
        .filter(|&place| is_filter(words[place]) && !after_option(place))
        .map(|place| words[place])
        .collect()
}

#[test]
fn make_targets_select_tests_that_exist() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let tree = SourceTree::read(&root).unwrap();
    let makefile = std::fs::read_to_string(root.join("Makefile")).unwrap().replace("\\\n", " ");
    let mut n_filters = 0;
    for line in makefile.lines() {
        for command in line.match_indices("cargo test").map(|(start, _)| &line[start..]) {
            for filter in test_filters(command) {
                n_filters += 1;
                let name = filter.trim_end_matches("::").rsplit("::").next().unwrap_or_default();
                let definition = if filter.contains("::") { format!("mod {name};") } else { format!("fn {name}") };
                let is_there = tree.with_extension(".rs").any(|(_, text)| text.contains(&definition));
                assert!(
                    is_there,
                    "`{command}` selects `{filter}`, but there is no `{definition}`; correct the Makefile"
                );
            }
        }
    }
    assert!(n_filters >= 15, "only {n_filters} names were found in the Makefile");
}
