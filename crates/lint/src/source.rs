//! The source files that are checked: all files that git tracks, and new files that git does not ignore.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

/// The path of the glossary.
pub const GLOSSARY: &str = "docs/glossary.md";

/// The source files, by their path relative to the repository's root, with `/` as separator.
#[derive(Clone, Debug, Default)]
pub struct SourceTree {
    files: BTreeMap<String, String>,
}

impl SourceTree {
    /// Creates a tree from pairs of path and text.
    pub fn from_files<P: Into<String>, T: Into<String>>(files: impl IntoIterator<Item = (P, T)>) -> Self {
        Self { files: files.into_iter().map(|(path, text)| (path.into(), text.into())).collect() }
    }

    /// Reads the Rust, Python, `.proto` and `Cargo.toml` files of a git checkout, and the glossary. Skips files that
    /// git ignores.
    ///
    /// # Errors
    ///
    /// An error message if `root` is not a git checkout, or if a file cannot be read.
    pub fn read(root: &Path) -> Result<Self, String> {
        let output = Command::new("git")
            .args(["ls-files", "-z", "--cached", "--others", "--exclude-standard"])
            .current_dir(root)
            .output()
            .map_err(|error| format!("cannot run git, which lists the files to check: {error}"))?;
        if !output.status.success() {
            let message = String::from_utf8_lossy(&output.stderr);
            return Err(format!("git cannot list the files of {}: {}", root.display(), message.trim()));
        }
        let mut files = BTreeMap::new();
        for path in String::from_utf8_lossy(&output.stdout).split('\0') {
            if ![".rs", ".py", ".proto", "Cargo.toml", GLOSSARY].iter().any(|end| path.ends_with(end)) {
                continue;
            }
            // A file that was deleted but is still in the index is not part of the tree.
            let file = root.join(path);
            if file.is_file() {
                let text = std::fs::read_to_string(&file).map_err(|error| format!("cannot read {path}: {error}"))?;
                files.insert(path.to_owned(), text);
            }
        }
        Ok(Self { files })
    }

    /// Returns the text of the file at `path`, or `None` if there is no such file.
    pub fn get(&self, path: &str) -> Option<&str> {
        self.files.get(path).map(String::as_str)
    }

    /// Returns all files in the order of their paths.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        self.files.iter().map(|(path, text)| (path.as_str(), text.as_str()))
    }

    /// Returns all files whose names end in `extension`, such as `.rs`.
    pub fn with_extension<'a>(&'a self, extension: &'a str) -> impl Iterator<Item = (&'a str, &'a str)> {
        self.iter().filter(move |(path, _)| path.ends_with(extension))
    }
}

/// Returns whether a file contains tests or fixtures.
///
/// These are the files in folders called `tests`, `test` or `fixtures`, and files called `tests.rs`, `*_test.rs`,
/// `*_tests.rs` or `test_*.py`.
pub fn is_test(path: &str) -> bool {
    let (folders, name) = path.rsplit_once('/').unwrap_or(("", path));
    folders.split('/').any(|folder| matches!(folder, "tests" | "test" | "fixtures"))
        || name == "tests.rs"
        || name.ends_with("_test.rs")
        || name.ends_with("_tests.rs")
        || (name.starts_with("test_") && name.ends_with(".py"))
}

/// Returns whether a file was generated from other files of the repository, such as `.proto` files.
///
/// These are the files in folders called `generated`, and the bindings of MuJoCo.
pub fn is_generated(path: &str) -> bool {
    path.contains("/generated/") || path.ends_with("/bindings.rs")
}

/// Returns whether a file belongs to a benchmark or an example, which are separate programs.
pub fn is_benchmark_or_example(path: &str) -> bool {
    path.split('/').any(|folder| matches!(folder, "benches" | "benchmarks" | "examples"))
}

/// Returns the folder to which the findings in a file are counted. This is a folder of the second level in `src`,
/// `crates` and `python`, and otherwise a folder of the top level.
///
/// Files in the repository's root are counted for `.`.
pub fn folder_of(path: &str) -> &str {
    let mut ends = path.match_indices('/').map(|(index, _)| index);
    let first = ends.next().unwrap_or(0);
    match (&path[..first], ends.next()) {
        ("", _) => ".",
        ("src" | "crates" | "python", Some(second)) => &path[..second],
        (folder, _) => folder,
    }
}
