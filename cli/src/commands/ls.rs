//! `perturb ls`: lists trainings, experiments and assessments.

use std::io::Write;

use perturb_experiment::runs::{RunSummary, no_folder, places};
use perturb_system::escape_terminal;
use perturb_text::{Table, grouped};

use super::args::LsArgs;
use super::display::{note, output, terminal_width};
use super::error::{CommandError, Result};

/// Explanation of the column `success`, printed below the list.
const SUCCESS_NOTE: &str = "\nsuccess: a training's last 100 episodes, or all tests of cells or assessments";

pub(super) fn run(args: &LsArgs) -> Result<()> {
    args.json.check()?;
    if !args.dir.is_dir() {
        return Err(CommandError::Usage(no_folder(&args.dir)));
    }
    let search = places(&args.dir, usize::MAX, None)?;
    if search.more {
        note("there are more folders behind symbolic links than are searched; name the folder that a link leads to");
    }
    let found: Vec<RunSummary> = search.runs.iter().map(RunSummary::read).collect();
    args.json.write(&found)?;
    if args.json.is_printed() {
        return Ok(());
    }
    let mut out = output();
    if found.is_empty() {
        return Ok(writeln!(out, "{} has no trainings, experiments or assessments", args.dir.display())?);
    }
    // Escape line breaks in a path, which would divide its row in two.
    let path = |found: &RunSummary| escape_terminal(&found.path.display().to_string()).into_owned();
    let done = |found: &RunSummary| {
        if found.unit.is_empty() {
            // The unit is empty if the run's files are damaged. Its progress is then unknown.
            return String::new();
        }
        let number = |number: u64| grouped(number as usize);
        format!("{} of {} {}", number(found.done), number(found.budget), found.unit)
    };
    // Print a table if it fits into the terminal, and otherwise two lines for each run.
    let table = Table::builder("", &found)
        .text("run", path)
        .text("what", |found| &found.what)
        .number("done", done)
        .number("success, %", |found| found.success_percent.map_or_else(String::new, |percent| format!("{percent:.1}")))
        .text("state", |found| found.state);
    let table = table.build().to_text();
    if terminal_width().is_none_or(|width| table.lines().all(|line| line.chars().count() <= width)) {
        return Ok(writeln!(out, "{table}\n{SUCCESS_NOTE}")?);
    }
    // The table is too wide: the terminal would wrap its lines.
    for found in &found {
        let success = found.success_percent.map(|percent| format!("success {percent:.1} %"));
        let words = [found.what.clone(), done(found), success.unwrap_or_default(), found.state.to_owned()];
        let words: Vec<String> = words.into_iter().filter(|words| !words.is_empty()).collect();
        writeln!(out, "{}\n  {}", path(found), words.join(", "))?;
    }
    Ok(writeln!(out, "{SUCCESS_NOTE}")?)
}
