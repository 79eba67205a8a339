//! `perturb report` and `perturb curves`: tables and pictures of an experiment's results.

use std::io::Write;
use std::path::{Path, PathBuf};

use perturb_experiment::{BudgetAxis, ExperimentFolder, Results, read_curves};
use perturb_files::{require_writable, write_atomically};
use perturb_report::curves_table;
use perturb_report::plot::{CurveQuantity, draw_curves, save};
use perturb_report::{ReportInputs, save_heatmaps};

use super::args::{CurvesArgs, ReportArgs};
use super::display::{note, output, terminal_width};
use super::error::{CommandError, Result};
use super::{plan_in, refuse_file, require_default_out};

pub(super) fn run(args: &ReportArgs) -> Result<()> {
    let mut sources = ReportInputs { rule: args.selection, ..ReportInputs::default() };
    for dir in &args.dirs {
        sources.add(dir)?;
    }
    let (text, out) = write(sources, args.out.clone(), args.html.as_deref())?;
    write!(output(), "{text}")?;
    note(format_args!("\nthe tables are also in {}", out.display()));
    Ok(())
}

/// Writes tables and pictures to the folder `out`, and the whole report as HTML to the file `page`. Returns the tables
/// as text, and their folder.
pub(super) fn write(sources: ReportInputs, out: Option<PathBuf>, page: Option<&Path>) -> Result<(String, PathBuf)> {
    let out = match out {
        Some(out) => out,
        None => {
            let folder = default_folder(&sources)?;
            require_default_out(&folder)?;
            folder
        }
    };
    refuse_file(&out)?;
    // A page in the folder of the tables needs no check, because that folder will be created.
    let is_inside = |page: &Path| page.parent().is_some_and(|folder| folder.starts_with(&out));
    page.filter(|page| !is_inside(page)).map_or(Ok(()), require_writable)?;
    sources.read(|whole| {
        let report = &whole.report;
        write_atomically(&out.join("report.md"), report.markdown().as_bytes())?;
        for table in report.files() {
            write_atomically(&out.join(&table.title), &table.to_csv())?;
        }
        report.pictures().iter().try_for_each(|picture| picture.save(&out))?;
        save_heatmaps(whole.heatmaps, &out)?;
        if let Some(path) = page {
            write_atomically(path, whole.page()?.as_bytes())?;
        }
        Ok((report.text(terminal_width().unwrap_or(usize::MAX)), out.clone()))
    })
}

/// Returns the default folder of a report: report/ in the experiment's folder, or report/RULE/ for another selection
/// rule than the plan's. Refuses reports with assessments or of a results table, because they belong to no experiment's
/// folder; --out is then required.
fn default_folder(sources: &ReportInputs) -> Result<PathBuf> {
    let Some(folder) = sources.folder.as_ref().filter(|_| sources.assessed.is_empty()) else {
        let message = "give --out: a report with assessments or of a results table has no default folder";
        return Err(CommandError::Usage(message.into()));
    };
    let mut out = folder.path().join("report");
    if let Some(rule) = sources.another_rule()? {
        // Use a folder for each other selection rule, so that the report by the plan's own rule is not replaced.
        out = out.join(rule.to_string());
    }
    Ok(out)
}

pub(super) fn curves(args: &CurvesArgs) -> Result<()> {
    let folder = ExperimentFolder::new(&args.dir);
    let plan = plan_in(&folder)?;
    let out = args.out.clone().unwrap_or_else(|| args.dir.join("report"));
    refuse_file(&out)?;
    if args.out.is_none() {
        require_default_out(&out)?;
    }
    let results = Results::read(&plan, &folder)?;
    let all = read_curves(&results.select(), &folder)?;
    write_atomically(&out.join("curves.csv"), &curves_table(&all).to_csv())?;
    let mut stdout = output();
    for curves in &all {
        if curves.curves.is_empty() {
            note(format_args!("{}: no finished training with a monitor.csv", curves.environment));
            continue;
        }
        for (axis, suffix) in [(BudgetAxis::Episodes, ""), (BudgetAxis::Steps, "-steps")] {
            for quantity in CurveQuantity::ALL {
                let path = out.join(format!("{}-{quantity}{suffix}", curves.environment));
                save(&draw_curves(curves, quantity, axis), &path)?;
                writeln!(stdout, "{}.svg and .png", path.display())?;
            }
        }
    }
    Ok(writeln!(stdout, "{}", out.join("curves.csv").display())?)
}
