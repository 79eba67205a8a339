//! Runs the cells of a plan in rounds, with a backend for local processes or Slurm.

use std::collections::HashMap;
use std::io::Write;
use std::process::ExitCode;

use perturb_experiment::scheduler::{Backend, ProgressEvent, Rate, RunEnd, RunError, run as run_plan, write_line};
use perturb_experiment::{CellState, CellStates, DoneCells, ExperimentFolder, FailureId, LayeredStates, Plan};
use perturb_files::interrupt::StopFlag;
use perturb_report::ReportInputs;
use perturb_text::{count, quoted};

use super::args::RunArgs;
use super::display::{Display, note};
use super::error::{CommandError, Result};
use super::resume_hint::this_command;
use super::signal_code;
use super::{json, report};

/// Maximum number of success rates that are printed at the end.
const MAX_RATES: usize = 24;

/// Runs a plan's cells in a first round, and the cells that its tuning selects in a second round.
pub(super) struct PlanRunner<'a> {
    args: &'a RunArgs,
    folder: &'a ExperimentFolder,
    /// Finished cells in the table of --done.
    done: Option<&'a DoneCells<'a>>,
    stop: &'a StopFlag,
    /// The plan with all cells that are known so far.
    plan: Plan,
    /// Failed cells of an earlier run, by id. --retry-failed runs them again.
    retryable: HashMap<String, FailureId>,
    /// Outcome of the previous round; `None` before the first round.
    last_outcome: Option<RunEnd>,
    /// Success rates of the finished cells, by kind of cell (environment, method and training set).
    rates: Vec<Rate>,
    /// Output for the cells' events as JSON lines.
    events: Option<Box<dyn Write>>,
}

impl<'a> PlanRunner<'a> {
    /// Makes the runner, and copies the plan into the folder.
    pub(super) fn begin(
        args: &'a RunArgs,
        plan: Plan,
        folder: &'a ExperimentFolder,
        done: Option<&'a DoneCells<'a>>,
        stop: &'a StopFlag,
    ) -> Result<Self> {
        let events = args.json.as_deref().map(json::event_writer).transpose()?;
        store_plan(args, &plan, folder)?;
        let retryable = if args.retry_failed { folder.failures()? } else { HashMap::new() };
        Ok(Self { args, folder, done, stop, plan, retryable, last_outcome: None, rates: Vec::new(), events })
    }

    /// Returns the plan of the next round. In the first round it is the given plan. In the second round it also has the
    /// cells that tuning selected. Cells that are finished in the table of --done are left out. Returns `None` when no
    /// round is left.
    pub(super) fn next_round(&mut self) -> Result<Option<Plan>> {
        match self.last_outcome {
            None => {}
            Some(RunEnd::Stopped { .. }) => return Ok(None),
            Some(RunEnd::Finished { .. }) => {
                let plan = self.plan.with_selected_cells(&layered(self.folder, self.done))?;
                let new = plan.cells.len() - self.plan.cells.len();
                if new == 0 {
                    return Ok(None);
                }
                note(format_args!("tuning is finished; {} with the selected configurations", count(new, "cell")));
                self.plan = Plan { candidates: Vec::new(), ..plan };
            }
        }
        let left = without_done(self.plan.clone(), self.done)?;
        if let Some(file) = self.args.done.as_deref().filter(|_| self.done.is_some()) {
            let (all, done) = (self.plan.cells.len(), self.plan.cells.len() - left.cells.len());
            note(format_args!("{done} of {} are done in {}", count(all, "cell"), file.display()));
        }
        Ok(Some(left))
    }

    /// Runs all cells of `plan` with `backend`, and shows the progress.
    pub(super) fn run(&mut self, plan: &Plan, backend: &mut dyn Backend) -> Result<()> {
        let mut display = Display::for_cells(plan.cells.len());
        let mut rates = Vec::new();
        let mut report = |report: ProgressEvent<'_>| match report {
            ProgressEvent::Status(status) => {
                display.cells(status);
                rates.clone_from(&status.rates);
            }
            ProgressEvent::Note(sentence) => note(sentence),
            ProgressEvent::Line(line) => self.events.iter_mut().for_each(|out| write_line(out, line)),
        };
        let last_outcome =
            run_plan(plan, self.folder, backend, &self.retryable, self.args.wait.time(), self.stop, &mut report);
        drop(display);
        self.rates = rates;
        self.last_outcome = Some(last_outcome.map_err(|error| match error {
            RunError::NoServer(_) => CommandError::Failed(format!("{error}; resume with: {}", this_command())),
            error => error.into(),
        })?);
        Ok(())
    }

    /// Prints the result and returns the exit status.
    pub(super) fn finish(self) -> Result<ExitCode> {
        let Self { args, folder, plan, last_outcome, rates, .. } = self;
        rates.iter().take(MAX_RATES).for_each(note);
        if rates.len() > MAX_RATES {
            note(format_args!("and {} more: perturb report {}", rates.len() - MAX_RATES, quoted(folder.path())));
        }
        // After a signal, print how to resume. Otherwise find the failed cells.
        let failed = match last_outcome {
            Some(RunEnd::Stopped { signal, left }) => {
                let jobs = left.join(" ");
                note(format_args!("stopped by signal {signal}; resume with: {}", this_command()));
                if !left.is_empty() {
                    note(format_args!(
                        "Slurm job {jobs} continues to run, and the resumed command watches it again; to cancel it: scancel {jobs}"
                    ));
                }
                return Ok(signal_code(signal));
            }
            Some(RunEnd::Finished { failed }) => failed,
            None => Vec::new(),
        };
        if let Some(page) = &args.html {
            let sources = ReportInputs { folder: Some(folder.clone()), ..ReportInputs::default() };
            report::write(sources, None, Some(page))?;
            let tables = folder.path().join("report");
            note(format_args!("the report is in {} and {}", page.display(), tables.display()));
        }
        let Some(first) = failed.first() else {
            let result = match plan.cells.len() {
                1 => "the only cell is done".to_owned(),
                cells => format!("all {cells} cells are done"),
            };
            note(format_args!("{result}; perturb report {}", quoted(folder.path())));
            return Ok(ExitCode::SUCCESS);
        };
        Err(CommandError::Failed(format!(
            "{} of {} failed, the first is {first}: see {} for the reason, and use --retry-failed to run them again",
            failed.len(),
            count(plan.cells.len(), "cell"),
            folder.path().join("cells").join(first).join("failure.json").display()
        )))
    }
}

/// Returns the states of cells. A cell's state is read from `folder`, or from `done` if the cell is not in `folder`.
pub(super) fn layered<'a>(folder: &'a ExperimentFolder, done: Option<&'a DoneCells<'a>>) -> LayeredStates<'a> {
    LayeredStates { first: folder, then: done.map(|done| done as &dyn CellStates) }
}

/// Returns `plan` without the cells that are finished in `done`.
pub(super) fn without_done(mut plan: Plan, done: Option<&DoneCells<'_>>) -> Result<Plan> {
    let Some(done) = done else { return Ok(plan) };
    let mut left = Vec::new();
    for cell in std::mem::take(&mut plan.cells) {
        if !matches!(done.state(&cell)?, CellState::Done(_)) {
            left.push(cell);
        }
    }
    plan.cells = left;
    Ok(plan)
}

/// Copies the plan into its folder, and prints a note if it replaces another plan. With --cell an existing plan is not
/// replaced: the command may be a queued job, whose plan is older than the plan in the folder.
fn store_plan(args: &RunArgs, plan: &Plan, folder: &ExperimentFolder) -> Result<()> {
    let path = folder.plan_path();
    if !args.cell.is_empty() && path.exists() {
        return Ok(());
    }
    if folder.store_plan(plan)? {
        note(format_args!("{} was another plan and is replaced; the cells of both plans are kept", path.display()));
    }
    Ok(())
}
