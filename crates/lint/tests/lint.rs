//! Runs each check on small source trees that pass and that fail.

use perturb_lint::cycles::{self, Cycle};
use perturb_lint::doc_comments;
use perturb_lint::imports;
use perturb_lint::limits::{self, Check, Exemptions, Finding, LimitTable};
use perturb_lint::names;
use perturb_lint::source::{SourceTree, folder_of, is_test};

const MANIFEST: (&str, &str) = ("a/Cargo.toml", "[package]\nname = \"a\"\n");

fn rust(files: &[(&str, &str)]) -> SourceTree {
    SourceTree::from_files([MANIFEST].iter().chain(files).copied())
}

fn cycles(tree: &SourceTree) -> Vec<Cycle> {
    imports::read(tree).iter().flat_map(cycles::find).collect()
}

/// Returns the modules of each cycle, joined by commas.
fn cycle_modules(tree: &SourceTree) -> Vec<String> {
    cycles(tree).iter().map(|cycle| cycle.modules.join(",")).collect()
}

fn count(tree: &SourceTree, check: Check, folder: &str) -> f64 {
    let findings = limits::check(tree, &Exemptions::default());
    findings
        .iter()
        .find(|finding| finding.check == check && finding.folder == folder)
        .map_or(0.0, |finding| finding.count)
}

#[test]
fn a_cycle_is_a_path_with_the_line_of_each_edge() {
    let tree = rust(&[
        ("a/src/lib.rs", "mod one;\nmod two;\nmod three;\n"),
        ("a/src/one.rs", "\nuse crate::two::Two;\n"),
        ("a/src/two.rs", "pub struct Two;\nfn f() { crate::three::g() }\n"),
        ("a/src/three.rs", "// crate::one in a comment\n\n\nuse super::one as first;\n"),
    ]);
    let cycles = cycles(&tree);
    assert_eq!(cycles.len(), 1);
    assert_eq!(
        cycles[0].to_string(),
        "a: 3 of 3 modules of the root import each other: one, three, two; for example
    one -> two  a/src/one.rs:2
    two -> three  a/src/two.rs:2
    three -> one  a/src/three.rs:4"
    );
}

#[test]
fn imports_in_one_direction_are_no_cycle() {
    let tree = rust(&[
        ("a/src/lib.rs", "mod one;\nmod two;\n"),
        ("a/src/one.rs", "use crate::two::{self, Two};\nfn f() -> two::Two { \"crate::one::x\"; 'c'; Two }\n"),
        ("a/src/two.rs", "pub struct Two;\n"),
    ]);
    assert_eq!(cycle_modules(&tree), Vec::<String>::new());
}

#[test]
fn a_parent_and_its_child_count_as_one() {
    let tree = rust(&[
        ("a/src/lib.rs", "pub mod one;\npub use one::One;\nstruct Root;\n"),
        ("a/src/one/mod.rs", "mod inner;\npub use inner::One;\npub struct Outer;\nuse crate::Root;\n"),
        ("a/src/one/inner.rs", "use super::Outer;\nuse crate::Root;\npub struct One;\n"),
    ]);
    assert_eq!(cycle_modules(&tree), Vec::<String>::new());
}

#[test]
fn folders_are_compared_where_their_paths_part() {
    let tree = rust(&[
        ("a/src/lib.rs", "mod net;\nmod pool;\n"),
        ("a/src/net/mod.rs", "mod peers;\n"),
        ("a/src/net/peers.rs", "use crate::pool::batch::Batch;\n"),
        ("a/src/pool/mod.rs", "pub mod batch;\nmod shard;\n"),
        ("a/src/pool/batch.rs", "use super::shard;\npub struct Batch;\n"),
        ("a/src/pool/shard.rs", "use super::super::net;\nuse super::{batch::{Batch as B}};\n"),
    ]);
    assert_eq!(cycle_modules(&tree), ["net,pool", "batch,shard"]);
}

#[test]
fn groups_globs_and_nested_uses_are_read() {
    let tree = rust(&[
        ("a/src/lib.rs", "mod one;\nmod two;\nmod three;\nmod four;\n"),
        ("a/src/one.rs", "use crate::{two::{Two, deep::Deep}, four};\n"),
        ("a/src/two.rs", "pub mod deep { use crate::three::*; pub struct Deep; }\npub struct Two;\n"),
        ("a/src/three.rs", "use super::*;\nfn f() { four::f() }\n"),
        ("a/src/four.rs", "pub(in crate::one) fn f(x: &crate::one::X) {}\n"),
    ]);
    assert_eq!(cycle_modules(&tree), ["four,one,three,two"]);
}

#[test]
fn re_exports_are_followed_to_the_defining_module() {
    let tree = rust(&[
        ("a/src/lib.rs", "mod one;\nmod two;\npub use two::Two;\npub use other::proto;\n"),
        ("a/src/one.rs", "use crate::Two;\nuse crate::proto;\nfn f() { proto::two::f() }\npub struct One;\n"),
        ("a/src/two.rs", "use crate::one::One;\npub struct Two;\n"),
    ]);
    assert_eq!(cycle_modules(&tree), ["one,two"]);
    let names_of_another_crate = rust(&[
        ("a/src/lib.rs", "mod one;\nmod two;\npub use other::proto;\n"),
        ("a/src/one.rs", "use crate::proto;\nfn f() { proto::two::f() }\npub struct One;\n"),
        ("a/src/two.rs", "use crate::one::One;\n"),
    ]);
    assert_eq!(cycle_modules(&names_of_another_crate), Vec::<String>::new());
}

#[test]
fn visibility_is_no_import() {
    let tree = rust(&[
        ("a/src/lib.rs", "mod one;\nmod two;\n"),
        ("a/src/one.rs", "pub(in crate::two) struct One;\npub(crate) struct B;\n"),
        ("a/src/two.rs", "use crate::one::One;\n"),
    ]);
    assert_eq!(cycle_modules(&tree), Vec::<String>::new());
}

#[test]
fn tests_are_left_out() {
    let one = "use crate::two::Two;\npub struct One;\n";
    for test in [
        "#[cfg(test)]\nmod tests { use crate::one::One; }\n",
        "#[cfg(test)]\nmod tests;\n",
        "#[cfg(all(test, unix))]\nuse crate::one::{One, Other};\n",
        "#[test]\nfn f<A, B>() { crate::one::f() }\n",
        "#[tokio::test]\nasync fn f() { crate::one::f() }\n",
        "struct T { #[cfg(test)] pub one: crate::one::One, two: u8 }\n",
        "fn f(x: u8) { match x { #[cfg(test)] 1 => crate::one::f(), _ => {} } }\n",
    ] {
        let two = format!("{test}pub struct Two;\n");
        let files = [("a/src/lib.rs", "mod one;\nmod two;\n"), ("a/src/one.rs", one), ("a/src/two.rs", &two)];
        let inner = ("a/src/two/tests.rs", "use crate::one::One;\n");
        assert_eq!(cycle_modules(&rust(&[&files[..], &[inner]].concat())), Vec::<String>::new(), "{test}");
    }
    let not_a_test = "#[cfg(not(test))]\nuse crate::one::One;\n#[cfg(test)]\nuse std::fs;\npub struct Two;\n";
    let files = [("a/src/lib.rs", "mod one;\nmod two;\n"), ("a/src/one.rs", one), ("a/src/two.rs", not_a_test)];
    assert_eq!(cycle_modules(&rust(&files)), ["one,two"]);
}

#[test]
fn programs_and_files_at_given_paths_are_read() {
    let cycle = [
        ("a/src/bin/program.rs", "#[path = \"../one.rs\"]\nmod one;\nmod two { use super::one::One; }\n"),
        ("a/src/one.rs", "use crate::two;\n"),
    ];
    assert_eq!(cycle_modules(&rust(&cycle)), ["one,two"]);
    let named = SourceTree::from_files([
        ("a/Cargo.toml", "[package]\nname = \"a\"\n[[bin]]\npath = \"code/main.rs\" # here\n"),
        ("a/code/main.rs", "mod one { use crate::two; } mod two { use crate::one; }\n"),
    ]);
    assert_eq!(cycle_modules(&named), ["one,two"]);
}

#[test]
fn python_modules_are_read_too() {
    let tree = SourceTree::from_files([
        ("p/src/a/__init__.py", "from .one import f\n"),
        (
            "p/src/a/one.py",
            "\"\"\"import a.three\"\"\"\nfrom a.two import (\n    g,  # import a.three\n    h as i,\n)\n",
        ),
        ("p/src/a/two.py", "def g():\n    import a.three as t\n"),
        ("p/src/a/three.py", "import numpy as np\nfrom a import f\nimport about\n"),
        ("p/src/a/four.py", "from . import one\n"),
        ("p/tests/test_a.py", "from a import one\n"),
    ]);
    let cycles = cycles(&tree);
    assert_eq!(
        cycles[0].to_string(),
        "p/src/a: 3 of 4 modules of the root import each other: one, three, two; for example
    one -> two  p/src/a/one.py:2
    two -> three  p/src/a/two.py:2
    three -> one  p/src/a/three.py:2"
    );
}

#[test]
fn comments_without_subject_are_counted_by_folder() {
    let tree = rust(&[
        (
            "a/src/lib.rs",
            "//! Whatever happens.\n//! It is not the first line.\n\n/// Returns it.\nfn f() {}\n/// Whatsoever.\nfn g() {}\n",
        ),
        ("a/src/x.rs", "/// The name.\nfn f() {}\n#[cfg(test)]\nmod tests {\n/// What is tested.\nfn t() {}\n}\n"),
        ("a/tests/x.rs", "//! What is tested.\n"),
    ]);
    let comments = doc_comments::read(&tree);
    assert_eq!(comments.len(), 4);
    assert_eq!(
        comments.iter().filter(|comment| comment.lacks_subject).map(|comment| comment.line).collect::<Vec<_>>(),
        [1]
    );
    assert_eq!(count(&tree, Check::DocComments, "a"), 25.0);
    for text in ["The same as before.", "Of a run.", "So many steps.", "None; or one."] {
        assert!(doc_comments::lacks_subject(text), "{text}");
    }
    for text in ["Ofen", "Items", "The samples", "Asks.", "Somebody."] {
        assert!(!doc_comments::lacks_subject(text), "{text}");
    }
}

#[test]
fn proto_comments_are_counted_but_not_generated_code() {
    let tree = SourceTree::from_files([
        ("proto/a.proto", "// What it is.\n// Whatever.\nmessage A {\n  // The number.\n  int32 b = 1;\n}\n"),
        ("a/src/generated/a.rs", "/// What it is.\npub struct A;\nconst MOST: u8 = 1;\n"),
        ("a/src/lib.rs", "/// The type.\npub struct A;\n"),
    ]);
    assert_eq!(count(&tree, Check::DocComments, "proto"), 50.0);
    assert_eq!(count(&tree, Check::DocComments, "a"), 0.0);
    assert_eq!(count(&tree, Check::TypesDefinedTwice, "all"), 0.0);
    assert_eq!(count(&tree, Check::SuperlativeConstants, "a"), 0.0);
}

#[test]
fn types_of_two_files_with_one_name_are_found() {
    let tree = rust(&[
        ("a/src/one.rs", "pub struct State;\nimpl Iterator for State { type Item = u8; }\nmod x { enum Line {} }\n"),
        (
            "a/src/two.rs",
            "enum State {}\nimpl Iterator for B { type Item = u8; }\nfn f() { struct Line; }\nstruct B;\n",
        ),
        ("a/src/three.rs", "#[cfg(test)]\nmod tests { struct B; }\npub trait Line {}\n"),
        ("a/tests/t.rs", "struct B;\n"),
        ("a/benches/t.rs", "struct B;\n"),
        ("p/a.py", "class B:\n    pass\n"),
    ]);
    let names = names::read(&tree);
    assert_eq!(names::defined_twice(&names.types).into_keys().collect::<Vec<_>>(), ["Line", "State"]);
    assert_eq!(count(&tree, Check::TypesDefinedTwice, "all"), 2.0);
    let exemptions = Exemptions::parse("# A comment.\nState = \"two state machines\"\n").unwrap();
    let findings = limits::check(&tree, &exemptions);
    let finding = findings.iter().find(|finding| finding.check == Check::TypesDefinedTwice).unwrap();
    assert_eq!(finding.places, ["Line: a/src/one.rs:3, a/src/three.rs:3"]);
}

#[test]
fn superlative_constants_and_functions_called_of_are_found() {
    let tree = rust(&[
        (
            "a/src/one.rs",
            "const MOST_STEPS: u8 = 1;\npub static LEAST: u8 = 1;\nconst RESTART: u8 = 1;\nimpl A { pub fn of() {} }\nfn off() {}\n",
        ),
        ("a/src/two.rs", "#[cfg(test)]\nmod tests { const MOST: u8 = 1; fn of() {} }\nconst FEW: u8 = 1;\n"),
        ("a/tests/two.rs", "const MOST: u8 = 1; fn of() {}\n"),
        ("p/a.py", "LONGEST: int = 1\nMOST_x = 2\ndef of(x):\n    pass\n"),
    ]);
    let names = names::read(&tree);
    assert_eq!(
        names.superlatives.iter().map(|place| place.name.as_str()).collect::<Vec<_>>(),
        ["MOST_STEPS", "LEAST", "FEW", "LONGEST"]
    );
    assert_eq!(
        names.called_of.iter().map(|place| (place.file.as_str(), place.line)).collect::<Vec<_>>(),
        [("a/src/one.rs", 4), ("p/a.py", 3)]
    );
    assert_eq!(count(&tree, Check::SuperlativeConstants, "a"), 3.0);
    assert_eq!(count(&tree, Check::FunctionsCalledOf, "p"), 1.0);
}

#[test]
fn test_names_of_more_than_60_characters_are_found() {
    let (fits, long) = ("x".repeat(60), "x".repeat(61));
    let tree = SourceTree::from_files([
        (
            "a/tests/one.rs",
            format!("#[test]\nfn {fits}() {{}}\n#[rstest]\n#[case(1)]\nfn {long}() {{}}\nfn {long}() {{}}\n"),
        ),
        ("p/tests/test_a.py", format!("def test_{}():\n    pass\ndef test_{long}():\n    pass\n", "x".repeat(55))),
    ]);
    let names = names::read(&tree);
    let places: Vec<_> = names.long_tests.iter().map(|place| (place.file.as_str(), place.line)).collect();
    assert_eq!(places, [("a/tests/one.rs", 5), ("p/tests/test_a.py", 3)]);
}

fn finding(check: Check, folder: &str, count: f64) -> Finding {
    Finding { check, folder: folder.to_owned(), count, places: vec!["here".to_owned(); count as usize] }
}

#[test]
fn findings_above_their_limit_are_errors() {
    let tree = SourceTree::default();
    let limits = LimitTable::parse("[long-test-names]\n\"a\" = 3\n\"b\" = 3\n\"gone\" = 1\n").unwrap();
    let findings = [
        finding(Check::LongTestNames, "a", 4.0),
        finding(Check::LongTestNames, "b", 2.0),
        finding(Check::FunctionsCalledOf, "a", 12.0),
        finding(Check::DocComments, "a", 2.0),
        finding(Check::DocComments, "b", 2.1),
    ];
    let verdict = limits::judge(&tree, &findings, &limits, &Exemptions::default());
    let starts = ["a: 4 test names of more than 60", "a: 12 functions called `of`", "b: 2.1 % of the doc comments"];
    assert_eq!(verdict.errors.len(), starts.len(), "{verdict:?}");
    for (error, start) in verdict.errors.iter().zip(starts) {
        assert!(error.starts_with(start), "{error}");
    }
    assert!(verdict.errors[1].ends_with("and 2 more: perturb-lint --list a"), "{}", verdict.errors[1]);
    assert_eq!(
        verdict.warnings,
        [
            "crates/lint/limits.toml: [long-test-names] \"b\" = 3 can fall to 2",
            "crates/lint/limits.toml: [long-test-names] \"gone\" = 1 can fall to 0"
        ]
    );
}

#[test]
fn limits_fall_to_the_present_numbers_and_never_rise() {
    let findings = [
        finding(Check::ImportCycles, "a", 4.0),
        finding(Check::ImportCycles, "new", 7.0),
        finding(Check::DocComments, "b", 2.0),
        finding(Check::DocComments, "c", 2.5),
        finding(Check::LongTestNames, "d", 9.0),
    ];
    let text = "[import-cycles]\n\"a\" = 5\n[doc-comments-without-subject]\n\"b\" = 9\n\"c\" = 9\n\"gone\" = 3\n\
                [long-test-names]\n\"d\" = 8\n";
    let lowered = LimitTable::parse(text).unwrap().lowered_to(&findings);
    let expected =
        "\n[import-cycles]\n\"a\" = 4\n\n[doc-comments-without-subject]\n\"c\" = 2.5\n\n[long-test-names]\n\"d\" = 8\n";
    assert!(lowered.to_string().ends_with(expected), "{lowered}");
    assert_eq!(LimitTable::parse(&lowered.to_string()), Ok(lowered), "limits are read as they are written");
}

#[test]
fn wrong_limits_and_exemptions_are_refused_with_their_line() {
    assert_eq!(LimitTable::parse("\n[cycles]\na = 1\n"), Err("line 3: no check is called [cycles]".to_owned()));
    assert_eq!(LimitTable::parse("[import-cycles]\na = x\n"), Err("line 2: expected a number, found x".to_owned()));
    assert_eq!(LimitTable::parse("[import-cycles]\na\n"), Err("line 2: expected key = value, found a".to_owned()));
    assert_eq!(Exemptions::parse("State = \"\"\n"), Err("line 1: State has no reason".to_owned()));
}

#[test]
fn exemptions_that_nothing_needs_are_warned_of() {
    let exemptions = Exemptions::parse("State = \"a reason\"\n").unwrap();
    let verdict = limits::judge(&SourceTree::default(), &[], &LimitTable::default(), &exemptions);
    assert_eq!(verdict.warnings, ["crates/lint/duplicate-names.toml: State is not defined twice; remove the entry"]);
}

#[test]
fn files_are_counted_for_their_folder() {
    for (path, folder) in [
        ("src/server/a/b.rs", "src/server"),
        ("src/a.rs", "src"),
        ("build.rs", "."),
        ("crates/records/src/a.rs", "crates/records"),
    ] {
        assert_eq!(folder_of(path), folder, "{path}");
    }
    for (path, expected) in
        [("a/tests/b.rs", true), ("a/src/b_tests.rs", true), ("p/test_a.py", true), ("a/src/testing.rs", false)]
    {
        assert_eq!(is_test(path), expected, "{path}");
    }
}

#[test]
fn public_types_need_a_glossary_entry() {
    let glossary = "| type | meaning |\n|---|---|\n| `Pool`, `Shard` | Not `Fresh`. |\n| `DE` | No type. |\n";
    let pool = "pub struct Pool;\npub struct Fresh;\npub type Common = u8;\npub enum FreshError {}\n\
                pub(crate) struct Inner;\nstruct Own;\n#[cfg(test)]\nmod tests {\n    pub struct Tested;\n}\n";
    let files =
        [("docs/glossary.md", glossary), ("src/pool/pool.rs", pool), ("src/env/other.rs", "pub struct Other;\n")];
    let tree = SourceTree::from_files(files);
    let exemptions = Exemptions::default().with_commonplaces("Common = \"a number\"\nGone = \"was one\"\n").unwrap();
    let findings = limits::check(&tree, &exemptions);
    let found: Vec<_> = findings.iter().filter(|finding| finding.check == Check::TypesWithoutGlossaryEntry).collect();
    assert_eq!(found.len(), 1);
    assert_eq!(
        (found[0].folder.as_str(), &found[0].places[..]),
        ("src/pool", &["src/pool/pool.rs:2: Fresh".into()][..])
    );
    let verdict = limits::judge(&tree, &findings, &LimitTable::default(), &exemptions);
    assert_eq!(verdict.errors.len(), 1);
    assert_eq!(
        verdict.warnings,
        [
            "crates/lint/commonplace-types.toml: there is no type Gone; remove the entry",
            "docs/glossary.md: there is no type Shard; remove the entry",
        ]
    );
    assert!(Exemptions::default().with_commonplaces("Common = \"\"\n").is_err(), "a commonplace needs a reason");
}
