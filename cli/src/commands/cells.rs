//! Doing a plan's cells, whatever does them.

use super::Ending;
use super::args::RunArgs;
use super::display::Display;
use super::error::{CommandError, Result};
use super::report;
use perturb_study::interrupt::StopFlag;
use perturb_study::scheduler::{Backend, Report, RunEnd, RunError, run as run_cells, write_line};
use perturb_study::{Folder, Plan};

/// Has `backend` do all cells, shows how far that is, and says how it ended.
pub(super) fn do_cells<B: Backend>(
    args: &RunArgs,
    plan: &Plan,
    folder: &Folder,
    backend: &mut B,
    stop: &StopFlag,
) -> Result<Ending>
where
    CommandError: From<RunError<B::Error>>,
{
    keep_plan(args, plan, folder)?;
    let mut display = Display::of_cells(plan.cells.len());
    let mut report = |report: Report<'_>| match report {
        Report::Status(status) => display.cells(status),
        Report::Note(sentence) => display.say(sentence),
        Report::Line(line) if args.json => write_line(&mut std::io::stdout(), line),
        Report::Line(_) => {}
    };
    let end = run_cells(plan, folder, backend, args.retry_failed, stop, &mut report);
    drop(display);
    let failed = match end? {
        RunEnd::Finished { failed } => failed,
        RunEnd::Stopped { signal, left } => {
            let jobs = left.join(" ");
            eprintln!("stopped by signal {signal}; the same command goes on");
            if !left.is_empty() {
                eprintln!("Slurm job {jobs} runs meanwhile, and is watched again then; to end it: scancel {jobs}");
            }
            return Ok(Ending::Signal(signal));
        }
    };
    if let Some(page) = &args.html {
        report::write(folder, Some(page))?;
        eprintln!("the report is in {} and {}", page.display(), folder.path().join("report").display());
    }
    let Some(first) = failed.first() else {
        eprintln!("all {} cells are done; perturb report {}", plan.cells.len(), folder.path().display());
        return Ok(Ending::Done);
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
