//! The program `perturb-lint [--list FOLDER | --lower-limits]`. `make lint` runs it in the repository's root.

use std::io::Write as _;
use std::path::Path;
use std::process::ExitCode;

use perturb_lint::limits::{self, Exemptions, LimitTable};
use perturb_lint::source::SourceTree;

const LIMITS: &str = "crates/lint/limits.toml";
const EXEMPTIONS: &str = "crates/lint/duplicate-names.toml";
const COMMONPLACES: &str = "crates/lint/commonplace-types.toml";
const USAGE: &str = "usage: perturb-lint [--list FOLDER | --lower-limits]
  --list FOLDER   print every finding of a folder, such as src/server, or of `all`
  --lower-limits  lower the limits in crates/lint/limits.toml to the present numbers; no limit rises";

fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args().skip(1).collect();
    let arguments: Vec<_> = arguments.iter().map(String::as_str).collect();
    let result = match arguments[..] {
        [] => check(),
        ["--list", folder] => list(folder).map(|()| true),
        ["--lower-limits"] => lower_limits().map(|()| true),
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

fn limits() -> Result<LimitTable, String> {
    LimitTable::parse(&read(LIMITS)?).map_err(|error| format!("{LIMITS}, {error}"))
}

fn exemptions() -> Result<Exemptions, String> {
    let exemptions = Exemptions::parse(&read(EXEMPTIONS)?).map_err(|error| format!("{EXEMPTIONS}, {error}"))?;
    exemptions.with_commonplaces(&read(COMMONPLACES)?).map_err(|error| format!("{COMMONPLACES}, {error}"))
}

/// Runs all checks and prints errors and warnings. Returns whether there were no errors.
fn check() -> Result<bool, String> {
    let limits = limits()?;
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
    // Ignores errors: the program that reads the output has closed the pipe and needs no more output.
    let _ = std::io::stdout().write_all(text.as_bytes());
    Ok(())
}

fn lower_limits() -> Result<(), String> {
    let limits = limits()?;
    let findings = limits::check(&SourceTree::read(Path::new("."))?, &exemptions()?);
    let lowered = limits.lowered_to(&findings).to_string();
    std::fs::write(LIMITS, lowered).map_err(|error| format!("cannot write {LIMITS}: {error}"))
}
