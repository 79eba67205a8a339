//! Folders whose names are not UTF-8 or contain a line break, and links to runs.

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;

use serde_json::Value;

use crate::common::{perturb, stderr};

#[test]
fn runs_with_odd_paths_are_trained_and_listed() {
    let folder = tempfile::tempdir().expect("a directory");
    let runs = folder.path().join("runs");
    for name in [OsStr::from_bytes(b"latin\xfc"), OsStr::new("new\nline")] {
        let mut command = perturb(&["-q", "train", "--env", "CartPole", "--algorithm", "a2c", "--episodes", "6"]);
        command.args(["--json", "-", "--out"]).arg(runs.join(name));
        let output = command.output().expect("perturb runs");
        assert!(output.status.success(), "{}", stderr(&output));
        let document: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        assert_eq!(document["finished"], true);
    }
    std::os::unix::fs::symlink(runs.join("new\nline"), folder.path().join("link")).expect("a link");
    let output = perturb(&["ls", "--json", "-"]).arg(folder.path()).output().expect("perturb runs");
    let listed: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let paths: Vec<&str> = listed.as_array().expect("a list").iter().filter_map(|run| run["path"].as_str()).collect();
    let ends = |end: &str| paths.iter().any(|path| path.ends_with(end));
    assert!(paths.len() == 2 && ends("/latin\u{fffd}") && ends("/new\nline"), "{paths:?}");
    let output = perturb(&["ls"]).arg(folder.path()).output().expect("perturb runs");
    let table = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(table.lines().any(|line| line.contains("new\\nline") && line.contains("CartPole")), "{table}");
    let output = perturb(&["ls"]).arg(folder.path().join("link")).output().expect("perturb runs");
    assert!(String::from_utf8_lossy(&output.stdout).contains("CartPole"), "{}", stderr(&output));
}

#[test]
fn a_temporary_folder_that_is_not_utf8_is_refused() {
    let folder = tempfile::tempdir().expect("a directory");
    let temporary = folder.path().join(OsStr::from_bytes(b"latin\xfc"));
    std::fs::create_dir(&temporary).expect("a folder");
    let mut command = perturb(&["train", "--env", "CartPole", "--episodes", "6", "--out"]);
    let output = command.arg(folder.path().join("run")).env("TMPDIR", &temporary).output().expect("perturb runs");
    assert!(!output.status.success());
    let said = stderr(&output);
    assert!(
        said.contains("is not UTF-8") && said.contains("set TMPDIR to a folder") && !said.contains("--listen"),
        "{said}"
    );
}
