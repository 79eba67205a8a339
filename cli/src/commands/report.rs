//! `perturb report` and `perturb curves`.

use std::io::Write;
use std::path::{Path, PathBuf};

use super::args::{CurvesArgs, ReportArgs};
use super::error::Result;
use super::plan_in;
use perturb_study::files::write_atomically;
use perturb_study::outcomes::Recorded;
use perturb_study::plot::{Quantity, draw_curves, save};
use perturb_study::report::{Figures, Picture, Report, heatmap_pictures, html, save_heatmaps};
use perturb_study::{Folder, Footing, Plan, Results, Selection, curves_table, read_curves, verify};

pub(super) fn run(args: &ReportArgs) -> Result<()> {
    let folder = Folder::new(&args.dir);
    let (text, out) = write(&folder, args.selection, args.html.as_deref())?;
    write!(std::io::stdout(), "{text}")?;
    eprintln!("\nthe tables are also in {}", out.display());
    Ok(())
}

/// Writes the tables of an experiment and, with `page`, everything as HTML; returns the tables as text, and where they are.
pub(super) fn write(folder: &Folder, rule: Option<Selection>, page: Option<&Path>) -> Result<(String, PathBuf)> {
    let plan = Plan::load(&folder.require_plan()?)?;
    let mut out = folder.path().join("report");
    if let Some(rule) = rule.filter(|rule| *rule != plan.selection) {
        out = out.join(rule.to_string()); // beside what the plan asks for
    }
    let rule = rule.unwrap_or(plan.selection);
    let plan = plan.by(rule)?.in_folder(folder)?;
    let results = Results::read(&plan, folder)?;
    let selections = results.select();
    let mut recorded = Recorded::of(&selections);
    verify(&results, folder, |result, records| recorded.add(result, records))?;
    let curves = read_curves(&selections, folder)?;
    let report = Report::new(&results, &selections, &recorded, &curves);

    write_atomically(&out.join("report.md"), report.markdown().as_bytes())?;
    for table in report.files() {
        write_atomically(&out.join(&table.title), &table.to_csv())?;
    }
    for Picture { file, panels, .. } in report.pictures() {
        save(&panels, &out.join(file))?;
    }
    let heatmaps = heatmap_pictures(&selections, folder)?;
    save_heatmaps(&heatmaps, &out)?;
    if let Some(path) = page {
        let figures = Figures::draw(&report, &curves, &heatmaps)?;
        write_atomically(path, html(&report, &figures).as_bytes())?;
    }
    Ok((report.text(), out))
}

pub(super) fn curves(args: &CurvesArgs) -> Result<()> {
    let folder = Folder::new(&args.dir);
    let plan = plan_in(&folder)?;
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
        for (by, ending) in [(Footing::Episodes, ""), (Footing::Steps, "-steps")] {
            for quantity in Quantity::ALL {
                let path = out.join(format!("{}-{quantity}{ending}.svg", curves.environment));
                save(&draw_curves(curves, quantity, by), &path)?;
                writeln!(stdout, "{} and .png", path.display())?;
            }
        }
    }
    Ok(writeln!(stdout, "{}", out.join("curves.csv").display())?)
}
