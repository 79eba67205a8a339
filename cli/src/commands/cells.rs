//! Doing a plan's cells, whatever does them.

use super::args::RunArgs;
use super::display::Display;
use super::error::{CommandError, Result};
use super::report;
use super::signal_code;
use perturb_study::interrupt::StopFlag;
use perturb_study::scheduler::{Announcement, Backend, RunEnd, run as run_plan, write_line};
use perturb_study::{Folder, Plan};
use std::process::ExitCode;

/// Has `backend` do all cells, shows how far that is, and says how it ended.
pub(super) fn do_cells(
    args: &RunArgs,
    plan: &Plan,
    folder: &Folder,
    backend: &mut dyn Backend,
    stop: &StopFlag,
) -> Result<ExitCode> {
    keep_plan(args, plan, folder)?;
    let mut display = Display::of_cells(plan.cells.len());
    let mut report = |report: Announcement<'_>| match report {
        Announcement::Status(status) => display.cells(status),
        Announcement::Note(sentence) => display.say(sentence),
        Announcement::Line(line) if args.json => write_line(&mut std::io::stdout(), line),
        Announcement::Line(_) => {}
    };
    let end = run_plan(plan, folder, backend, args.retry_failed, stop, &mut report);
    drop(display);
    let failed = match end? {
        RunEnd::Finished { failed } => failed,
        RunEnd::Stopped { signal, left } => {
            let jobs = left.join(" ");
            eprintln!("stopped by signal {signal}; the same command goes on");
            if !left.is_empty() {
                eprintln!("Slurm job {jobs} runs meanwhile, and is watched again then; to end it: scancel {jobs}");
            }
            return Ok(signal_code(signal));
        }
    };
    if let Some(page) = &args.html {
        report::write(folder, Some(page))?;
        eprintln!("the report is in {} and {}", page.display(), folder.path().join("report").display());
    }
    let Some(first) = failed.first() else {
        eprintln!("all {} cells are done; perturb report {}", plan.cells.len(), folder.path().display());
        return Ok(ExitCode::SUCCESS);
    };
    Err(CommandError::Failed(format!(
        "{} of {} cells failed, the first is {first}: see {} for the reason, and use --retry-failed to try again",
        failed.len(),
        plan.cells.len(),
        folder.path().join("cells").join(first).join("failure.json").display()
    )))
}

/// Copies the plan into its folder, and says so if another one was there. Single cells leave that one: their plan may be
/// older, that of a job which had to wait for instance.
fn keep_plan(args: &RunArgs, plan: &Plan, folder: &Folder) -> Result<()> {
    let kept = folder.plan_path();
    if !args.cell.is_empty() && kept.exists() {
        return Ok(());
    }
    if folder.keep_plan(plan)? {
        eprintln!("{} was another plan; it is replaced, and cells that both have are kept", kept.display());
    }
    Ok(())
}
