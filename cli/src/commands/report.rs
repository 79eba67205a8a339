//! `perturb report` and `perturb curves`.

use std::io::Write;
use std::path::Path;

use super::args::{CurvesArgs, ReportArgs};
use super::error::Result;
use perturb_study::files::write_atomically;
use perturb_study::plot::{Quantity, draw_curves, save};
use perturb_study::report::{Figures, Report, html};
use perturb_study::{Folder, Plan, Results, curves_table, read_curves, verify};

pub(super) fn run(args: &ReportArgs) -> Result<()> {
    let folder = Folder::new(&args.dir);
    let text = write(&folder, args.html.as_deref())?;
    write!(std::io::stdout(), "{text}")?;
    eprintln!("\nthe tables are also in {}", args.dir.join("report").display());
    Ok(())
}

/// Writes the tables of an experiment and, with `page`, everything as HTML; returns the tables as text.
pub(super) fn write(folder: &Folder, page: Option<&Path>) -> Result<String> {
    let plan = Plan::load(&folder.require_plan()?)?;
    let results = Results::read(&plan, folder)?;
    verify(&results, folder)?;
    let selections = results.select();
    let report = Report::new(&results, &selections);

    let out = folder.path().join("report");
    write_atomically(&out.join("report.md"), report.markdown().as_bytes())?;
    for table in report.files() {
        write_atomically(&out.join(&table.title), &table.to_csv())?;
    }
    if let Some(path) = page {
        let figures = Figures::read(&selections, folder)?;
        write_atomically(path, html(&report, &figures).as_bytes())?;
    }
    Ok(report.text())
}

pub(super) fn curves(args: &CurvesArgs) -> Result<()> {
    let folder = Folder::new(&args.dir);
    let plan = Plan::load(&folder.require_plan()?)?;
    let results = Results::read(&plan, &folder)?;
    let all = read_curves(&results.select(), &folder)?;
    let out = args.out.clone().unwrap_or_else(|| args.dir.join("report"));
    write_atomically(&out.join("curves.csv"), &curves_table(&all).to_csv())?;
    let mut stdout = std::io::stdout();
    for curves in &all {
        if curves.curves.is_empty() {
            eprintln!("{}: no finished training with a monitor.csv", curves.environment);
            continue;
        }
        for quantity in Quantity::ALL {
            let path = out.join(format!("{}-{quantity}.svg", curves.environment));
            save(&draw_curves(curves, quantity), &path)?;
            writeln!(stdout, "{} and .png", path.display())?;
        }
    }
    Ok(writeln!(stdout, "{}", out.join("curves.csv").display())?)
}
