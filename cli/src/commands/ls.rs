//! `perturb ls`.

use std::io::Write;

use super::args::LsArgs;
use super::error::{CommandError, Result};
use perturb_study::runs::{RunSummary, no_folder, places};
use perturb_study::table::Table;
use perturb_study::words::grouped;

pub(super) fn run(args: &LsArgs) -> Result<()> {
    if !args.dir.is_dir() {
        return Err(CommandError::Usage(no_folder(&args.dir)));
    }
    let found: Vec<RunSummary> = places(&args.dir, usize::MAX)?.runs.iter().map(RunSummary::read).collect();
    let mut out = std::io::stdout();
    if args.json {
        return Ok(writeln!(out, "{:#}", serde_json::to_value(found).unwrap_or_default())?);
    }
    if found.is_empty() {
        return Ok(writeln!(out, "{} holds neither trainings nor experiments", args.dir.display())?);
    }
    let table = Table::of("", &found)
        .text("run", |found| found.path.display())
        .text("what", |found| &found.what)
        .number("done", |found| {
            let number = |number: u64| grouped(number as usize);
            format!("{} of {} {}", number(found.done), number(found.budget), found.unit)
        })
        .number("success, %", |found| found.success_percent.map_or_else(String::new, |percent| format!("{percent:.1}")))
        .text("state", |found| found.state);
    Ok(writeln!(out, "{}", table.build().to_text())?)
}
