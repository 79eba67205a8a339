//! Doing a plan's cells, whatever does them.

use std::collections::HashMap;
use std::io::Write;
use std::process::ExitCode;

use perturb_experiment::scheduler::{Announcement, Backend, Rate, RunEnd, RunError, run as run_plan, write_line};
use perturb_experiment::{FailureMark, Folder, Plan};
use perturb_files::interrupt::StopFlag;
use perturb_report::Sources;
use perturb_text::{count, quoted};

use super::again::this_command;
use super::args::RunArgs;
use super::display::{Display, note};
use super::error::{CommandError, Result};
use super::signal_code;
use super::{json, report};

/// So many kinds of cells are told of at the end.
const MOST_RATES: usize = 24;

/// A run, which does a plan's cells and, when these select others, those too.
pub(super) struct Doing<'a> {
    args: &'a RunArgs,
    folder: &'a Folder,
    stop: &'a StopFlag,
    /// What is done, or is to be done next.
    plan: Plan,
    /// Failures that were there when the run began.
    forgiven: HashMap<String, FailureMark>,
    /// `None` before anything is done.
    end: Option<RunEnd>,
    /// Success of what is done.
    rates: Vec<Rate>,
    /// Where what happens is told as JSON.
    lines: Option<Box<dyn Write>>,
}

impl<'a> Doing<'a> {
    /// Keeps the plan in its folder.
    pub(super) fn begin(args: &'a RunArgs, plan: Plan, folder: &'a Folder, stop: &'a StopFlag) -> Result<Self> {
        let lines = args.json.as_deref().map(json::lines).transpose()?;
        keep_plan(args, &plan, folder)?;
        let forgiven = if args.retry_failed { folder.failures()? } else { HashMap::new() };
        Ok(Self { args, folder, stop, plan, forgiven, end: None, rates: Vec::new(), lines })
    }

    /// The cells to do next: the plan's, then those that it has beside them when these are done; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<Plan>> {
        match self.end {
            None => {}
            Some(RunEnd::Stopped { .. }) => return Ok(None),
            Some(RunEnd::Finished { .. }) => {
                let plan = self.plan.in_folder(self.folder)?;
                let new = plan.cells.len() - self.plan.cells.len();
                if new == 0 {
                    return Ok(None);
                }
                note(format_args!("tuning is done; {} with what is selected", count(new, "cell")));
                self.plan = Plan { candidates: Vec::new(), ..plan };
            }
        }
        Ok(Some(self.plan.clone()))
    }

    /// Has `backend` do all cells of `plan`, and shows how far that is.
    pub(super) fn run(&mut self, plan: &Plan, backend: &mut dyn Backend) -> Result<()> {
        let mut display = Display::of_cells(plan.cells.len());
        let mut rates = Vec::new();
        let mut report = |report: Announcement<'_>| match report {
            Announcement::Status(status) => {
                display.cells(status);
                rates.clone_from(&status.rates);
            }
            Announcement::Note(sentence) => note(sentence),
            Announcement::Line(line) => self.lines.iter_mut().for_each(|out| write_line(out, line)),
        };
        let end = run_plan(plan, self.folder, backend, &self.forgiven, self.args.wait.time(), self.stop, &mut report);
        drop(display);
        self.rates = rates;
        self.end = Some(end.map_err(|error| match error {
            RunError::NoServer(_) => CommandError::Failed(format!("{error}; go on with: {}", this_command())),
            error => error.into(),
        })?);
        Ok(())
    }

    /// Says how everything ended.
    pub(super) fn end(self) -> Result<ExitCode> {
        let Self { args, folder, plan, end, rates, .. } = self;
        rates.iter().take(MOST_RATES).for_each(note);
        if rates.len() > MOST_RATES {
            note(format_args!("and {} more: perturb report {}", rates.len() - MOST_RATES, quoted(folder.path())));
        }
        let failed = match end {
            Some(RunEnd::Stopped { signal, left }) => {
                let jobs = left.join(" ");
                note(format_args!("stopped by signal {signal}; the same command goes on: {}", this_command()));
                if !left.is_empty() {
                    note(format_args!(
                        "Slurm job {jobs} runs meanwhile, and is watched again then; to end it: scancel {jobs}"
                    ));
                }
                return Ok(signal_code(signal));
            }
            Some(RunEnd::Finished { failed }) => failed,
            None => Vec::new(),
        };
        if let Some(page) = &args.html {
            let sources = Sources { folder: Some(folder.clone()), ..Sources::default() };
            report::write(sources, None, Some(page))?;
            let tables = folder.path().join("report");
            note(format_args!("the report is in {} and {}", page.display(), tables.display()));
        }
        let Some(first) = failed.first() else {
            let done = match plan.cells.len() {
                1 => "the only cell is done".to_owned(),
                cells => format!("all {cells} cells are done"),
            };
            note(format_args!("{done}; perturb report {}", quoted(folder.path())));
            return Ok(ExitCode::SUCCESS);
        };
        Err(CommandError::Failed(format!(
            "{} of {} failed, the first is {first}: see {} for the reason, and use --retry-failed to try again",
            failed.len(),
            count(plan.cells.len(), "cell"),
            folder.path().join("cells").join(first).join("failure.json").display()
        )))
    }
}

/// Copies the plan into its folder, and says so if another one was there. Single cells leave that one: their plan may be
/// older, that of a job which had to wait for instance.
fn keep_plan(args: &RunArgs, plan: &Plan, folder: &Folder) -> Result<()> {
    let kept = folder.plan_path();
    if !args.cell.is_empty() && kept.exists() {
        return Ok(());
    }
    if folder.keep_plan(plan)? {
        note(format_args!("{} was another plan; it is replaced, and cells that both have are kept", kept.display()));
    }
    Ok(())
}
