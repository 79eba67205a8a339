//! `perturb-lint [--list FOLDER | --write-limits]`, run in the repository's root by `make lint`.

use std::io::Write as _;
use std::path::Path;
use std::process::ExitCode;

use perturb_lint::limits::{self, Exemptions, LimitTable};
use perturb_lint::source::SourceTree;

const LIMITS: &str = "crates/lint/limits.toml";
const EXEMPTIONS: &str = "crates/lint/duplicate-names.toml";
const USAGE: &str = "usage: perturb-lint [--list FOLDER | --write-limits]
  --list FOLDER   print every finding of a folder, such as src/server, or of `all`
  --write-limits  write the numbers of today to crates/lint/limits.toml";

fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args().skip(1).collect();
    let arguments: Vec<_> = arguments.iter().map(String::as_str).collect();
    let result = match arguments[..] {
        [] => check(),
        ["--list", folder] => list(folder).map(|()| true),
        ["--write-limits"] => write_limits().map(|()| true),
        _ => Err(USAGE.to_owned()),
    };
    match result {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(message) => {
            eprintln!("{message}");
            ExitCode::from(2)
        }
    }
}

fn read(path: &str) -> Result<String, String> {
    std::fs::read_to_string(path)
        .map_err(|error| format!("cannot read {path}: {error}; run perturb-lint in the repository's root"))
}

fn exemptions() -> Result<Exemptions, String> {
    Exemptions::parse(&read(EXEMPTIONS)?).map_err(|error| format!("{EXEMPTIONS}, {error}"))
}

/// Prints errors and warnings; returns whether there was no error.
fn check() -> Result<bool, String> {
    let limits = LimitTable::parse(&read(LIMITS)?).map_err(|error| format!("{LIMITS}, {error}"))?;
    let exemptions = exemptions()?;
    let tree = SourceTree::read(Path::new("."))?;
    let findings = limits::check(&tree, &exemptions);
    let verdict = limits::judge(&tree, &findings, &limits, &exemptions);
    for warning in &verdict.warnings {
        eprintln!("warning: {warning}");
    }
    for error in &verdict.errors {
        eprintln!("error: {error}");
    }
    Ok(verdict.errors.is_empty())
}

fn list(folder: &str) -> Result<(), String> {
    let findings = limits::check(&SourceTree::read(Path::new("."))?, &exemptions()?);
    let mut text = String::new();
    for finding in findings.iter().filter(|finding| finding.folder == folder) {
        text += &format!("{}: {}\n", finding.check.section(), finding.count);
        for place in &finding.places {
            text += &format!("  {place}\n");
        }
    }
    // Whoever closes the pipe early has read enough.
    let _ = std::io::stdout().write_all(text.as_bytes());
    Ok(())
}

fn write_limits() -> Result<(), String> {
    let findings = limits::check(&SourceTree::read(Path::new("."))?, &exemptions()?);
    std::fs::write(LIMITS, LimitTable::needed_for(&findings).to_string())
        .map_err(|error| format!("cannot write {LIMITS}: {error}"))
}
