//! The status of an experiment: its plan, and the state of each cell.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use perturb_files::{AnyError, Stamp, escapes_root, is_locked, list, read_toml};
use perturb_records::statistics::mean;
use perturb_text::{grouped, shortened};

use super::RunSummary;
use crate::eta::CellDurations;
use crate::folder::{CellResult, CellState, ExperimentFolder, FolderError};
use crate::plan::{Cell, Plan};
use crate::scheduler::{Rate, Rates};

/// Maximum number of cells in a plan that [`ExperimentStatus::read_within`] accepts.
const MAX_FOLLOWED_CELLS: usize = 50_000;
/// The error text for a symbolic link to a file outside the shown folder.
pub const LEADS_OUT: &str = "a link that leads out of the folder";

/// The status of an experiment, as read from its folder.
#[derive(Clone, Debug)]
pub struct ExperimentStatus {
    /// The folder of the experiment.
    pub folder: ExperimentFolder,
    /// The plan, including the cells that its selection has added so far.
    pub plan: Plan,
    /// The status of each cell, in the plan's order.
    pub cells: Vec<CellStatus>,
    /// The stamp of `plan.toml` when it was read, for noticing changes.
    stamp: Option<Stamp>,
    /// The stamps of each cell's result and failure files when they were read, in the plan's order.
    records: Vec<RecordStamps>,
    /// The folder that symbolic links must not lead out of; `None` if links may lead anywhere.
    within: Option<PathBuf>,
}

/// The status of a cell.
#[derive(Clone, Debug, PartialEq)]
pub enum CellStatus {
    /// The cell has a result.
    Done(Box<CellResult>),
    /// The cell failed with this reason.
    Failed(String),
    /// The cell's files cannot be read, for this reason.
    NotUnderstood(String),
    /// A process is working on the cell: its folder is locked.
    InWork,
    /// No process is working on the cell, and it has neither a result nor a failure.
    Waiting {
        /// Whether the cell has a folder, which means that it was started before.
        begun: bool,
    },
}

/// The stamps of `result.json` and `failure.json`; `None` for a missing file.
type RecordStamps = [Option<Stamp>; 2];
/// The names of the files with a cell's result and failure.
const RECORDS: [&str; 2] = ["result.json", "failure.json"];

impl ExperimentStatus {
    /// Reads the status of the experiment in `path`.
    ///
    /// # Errors
    /// An error if the plan cannot be read.
    pub fn read(path: &Path) -> Result<Self, AnyError> {
        Self::with(path, None)
    }

    /// Reads the status of an experiment that is shown to other users. Does not follow symbolic links to files outside
    /// `root` or to hidden files in `root`. `path` must be in `root` and contain no links.
    ///
    /// # Errors
    /// An error if the plan cannot be read, is behind a link that leads out of `root`, or has too many cells.
    pub fn read_within(path: &Path, root: &Path) -> Result<Self, AnyError> {
        Self::with(path, Some(root.to_owned()))
    }

    /// Reads the status of an experiment. `within` is the folder that links must not lead out of.
    fn with(path: &Path, within: Option<PathBuf>) -> Result<Self, AnyError> {
        let folder = ExperimentFolder::new(path);
        let stamp = Stamp::read(&folder.plan_path());
        let plan = read_plan(&folder, within.as_deref())?;
        let (records, cells) = plan.cells.iter().map(|cell| known(&folder, cell, within.as_deref())).unzip();
        Ok(Self { folder, plan, cells, stamp, records, within })
    }

    /// Reads the plan, results and failures again if their files have changed.
    ///
    /// # Errors
    /// An error if the plan cannot be read.
    pub fn refresh(&mut self) -> Result<(), AnyError> {
        if Stamp::read(&self.folder.plan_path()) != self.stamp {
            *self = Self::with(self.folder.path(), self.within.clone())?;
            return Ok(());
        }
        let before = self.count(CellStatus::is_settled);
        for (place, cell) in self.plan.cells.iter().enumerate() {
            let records = records(&self.folder, cell);
            if records != self.records[place] || !self.cells[place].is_settled() {
                self.cells[place] = status(&self.folder, cell, records, self.within.as_deref());
                self.records[place] = records;
            }
        }
        // The tuning cells may have selected a configuration since the last call.
        if !self.plan.candidates.is_empty() && self.count(CellStatus::is_settled) != before {
            self.replan()?;
        }
        Ok(())
    }

    /// Reads the plan again. Cells that were already in the plan keep their status.
    fn replan(&mut self) -> Result<(), AnyError> {
        let within = self.within.as_deref();
        let plan = read_plan(&self.folder, within)?;
        let had = self.plan.cells.iter().map(|cell| cell.id.clone());
        let had = had.zip(self.records.drain(..).zip(self.cells.drain(..)));
        let mut had: HashMap<String, (RecordStamps, CellStatus)> = had.collect();
        let all =
            plan.cells.iter().map(|cell| had.remove(&cell.id).unwrap_or_else(|| known(&self.folder, cell, within)));
        (self.records, self.cells) = all.unzip();
        self.plan = plan;
        Ok(())
    }

    /// Returns the time of the last change of the plan, a result or a failure, in seconds since 1970.
    pub fn changed(&self) -> i64 {
        let stamps = self.records.iter().flatten().chain([&self.stamp]).flatten();
        stamps.map(Stamp::seconds).max().unwrap_or_default()
    }

    /// Returns the number of cells whose status satisfies `is`.
    pub fn count(&self, is: impl Fn(&CellStatus) -> bool) -> usize {
        self.cells.iter().filter(|cell| is(cell)).count()
    }

    /// Returns the finished cells with their results.
    pub fn done(&self) -> impl Iterator<Item = (&Cell, &CellResult)> {
        self.plan.cells.iter().zip(&self.cells).filter_map(|(cell, status)| match status {
            CellStatus::Done(result) => Some((cell, &**result)),
            _ => None,
        })
    }

    /// Returns the mean success rates of finished cells by environment, method and training distribution.
    pub fn rates(&self) -> Vec<Rate> {
        let mut rates = Rates::default();
        self.done().for_each(|(cell, result)| rates.add(cell, result));
        rates.list()
    }

    /// Returns the durations of finished cells.
    pub fn durations(&self) -> CellDurations<'_> {
        CellDurations::read(&self.plan, &self.folder)
    }

    /// Returns the state of the experiment: "in work" if a cell is running, otherwise "with failures" if a cell has
    /// failed, "finished" if all cells are done, or else "broken off".
    pub fn state(&self) -> &'static str {
        let any = |is: fn(&CellStatus) -> bool| self.cells.iter().any(is);
        match () {
            () if any(|cell| *cell == CellStatus::InWork) => "in work",
            () if any(|cell| matches!(cell, CellStatus::Failed(_))) => "with failures",
            () if self.cells.iter().all(|cell| matches!(cell, CellStatus::Done(_))) => "finished",
            () => "broken off",
        }
    }

    /// Returns the summary of the experiment.
    pub fn summary(&self) -> RunSummary {
        let rates: Vec<f64> =
            self.done().flat_map(|(_, result)| result.results.values().map(|test| test.success_percent)).collect();
        RunSummary {
            path: self.folder.path().to_owned(),
            what: match &self.plan.environments()[..] {
                few @ ([_] | [_, _]) => few.join(", "),
                many => format!("{} environments", many.len()), // all names would not fit in a line
            },
            done: self.done().count() as u64,
            budget: self.cells.len() as u64,
            unit: "cells",
            success_percent: (!rates.is_empty()).then(|| mean(rates.iter().copied())),
            state: self.state(),
        }
    }
}

impl CellStatus {
    /// Returns whether the cell is done or has failed.
    pub fn is_settled(&self) -> bool {
        matches!(self, Self::Done(_) | Self::Failed(_))
    }
}

/// Reads the plan, with the cells that its selection has added so far. With `within`, refuses links that lead out of
/// this folder, and plans with too many cells.
fn read_plan(folder: &ExperimentFolder, within: Option<&Path>) -> Result<Plan, AnyError> {
    let path = folder.require_plan()?;
    if let Some(root) = within {
        let out = |name: &Path| escapes_root(root, folder.path(), name);
        let tables =
            list(folder.path())?.into_iter().filter(|path| path.extension().is_some_and(|ending| ending == "csv"));
        let names =
            tables.filter_map(|path| Some(path.file_name()?.into())).chain(["plan.toml", "cells"].map(PathBuf::from));
        for name in names {
            if out(&name) {
                return Err(format!("{} is {LEADS_OUT}", name.display()).into());
            }
        }
    }
    let plan = Plan::parse(&path.display().to_string(), read_toml(&path)?)?;
    if within.is_some() && plan.cells.len() > MAX_FOLLOWED_CELLS {
        let (cells, most) = (grouped(plan.cells.len()), grouped(MAX_FOLLOWED_CELLS));
        return Err(
            format!("the plan has {cells} cells, but at most {most} can be shown here; use `perturb ls`").into()
        );
    }
    if let Some(root) = within.filter(|_| !plan.candidates.is_empty()) {
        for cell in &plan.cells {
            require_within(folder, cell, root)?; // results determine which candidates become cells
        }
    }
    Ok(plan.with_selected_cells(folder)?)
}

/// Returns an error if the result or failure of a cell is behind a link that leads out of `root`.
fn require_within(folder: &ExperimentFolder, cell: &Cell, root: &Path) -> Result<(), String> {
    let place = Path::new("cells").join(&cell.id);
    let out = RECORDS.into_iter().find(|name| escapes_root(root, folder.path(), place.join(name)));
    out.map_or(Ok(()), |name| Err(format!("{} is {LEADS_OUT}", place.join(name).display())))
}

/// Returns the current stamps of a cell's result and failure files.
fn records(folder: &ExperimentFolder, cell: &Cell) -> RecordStamps {
    let place = folder.cell(&cell.id);
    RECORDS.map(|name| Stamp::read(&place.path().join(name)))
}

/// Reads the stamps and the status of a cell.
fn known(folder: &ExperimentFolder, cell: &Cell, within: Option<&Path>) -> (RecordStamps, CellStatus) {
    let records = records(folder, cell);
    (records, status(folder, cell, records, within))
}

/// Reads the status of a cell. `records` are the current stamps of its files.
fn status(folder: &ExperimentFolder, cell: &Cell, records: RecordStamps, within: Option<&Path>) -> CellStatus {
    let place = folder.cell(&cell.id);
    if records == [None; 2] {
        let begun = place.path().is_dir();
        return match begun && is_locked(place.path()) {
            true => CellStatus::InWork,
            false => CellStatus::Waiting { begun },
        };
    }
    if let Some(Err(reason)) = within.map(|root| require_within(folder, cell, root)) {
        return CellStatus::NotUnderstood(reason);
    }
    match place.state() {
        Ok(CellState::Done(result)) => CellStatus::Done(result),
        Ok(CellState::Failed(failure)) => CellStatus::Failed(shortened(failure.reason)),
        Ok(CellState::Missing) => CellStatus::Waiting { begun: true }, // deleted since the stamp was read
        Err(FolderError::Damaged { path, reason }) => {
            let reason = shortened(reason);
            CellStatus::NotUnderstood(FolderError::Damaged { path, reason }.to_string())
        }
        Err(error) => CellStatus::NotUnderstood(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture;
    use crate::folder::FailureRecord;

    const PLAN: &str = "environments = ['Pendulum']\nversions = ['D']\nruns = 3
        [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

    #[test]
    fn cells_are_followed_from_their_beginning_to_their_result() {
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(directory.path());
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        assert!(ExperimentStatus::read(directory.path()).is_err());
        folder.store_plan(&plan).unwrap();
        let mut status = ExperimentStatus::read(directory.path()).unwrap();
        assert_eq!((status.state(), &status.cells[0]), ("broken off", &CellStatus::Waiting { begun: false }));

        let places: Vec<_> = plan.cells.iter().map(|cell| folder.cell(&cell.id)).collect();
        let lock = places[0].try_lock().unwrap();
        status.refresh().unwrap();
        assert_eq!((status.state(), &status.cells[0]), ("in work", &CellStatus::InWork));
        drop(lock);
        status.refresh().unwrap();
        assert_eq!(status.cells[0], CellStatus::Waiting { begun: true });
        places[0].write_result(&fixture::result(&plan.cells[0], [90.0, 60.0, 30.0], 1.0)).unwrap();
        let failure = FailureRecord {
            id: plan.cells[1].id.clone(),
            reason: "NaN".into(),
            commit: "x".into(),
            requires_restart: true,
        };
        places[1].write_failure(&failure).unwrap();
        std::fs::create_dir_all(places[2].path()).unwrap();
        std::fs::write(places[2].path().join("result.json"), "{").unwrap();
        status.refresh().unwrap();
        let summary = status.summary();
        assert_eq!((summary.state, summary.done, summary.budget), ("with failures", 1, 3));
        assert_eq!(summary.success_percent, Some(60.0));
        assert_eq!(status.cells[1], CellStatus::Failed("NaN".into()));
        assert!(matches!(&status.cells[2], CellStatus::NotUnderstood(why) if why.contains("result.json")));
        assert_eq!(status.rates()[0].success[0], ("D".to_owned(), 90.0));

        for (cell, place) in plan.cells.iter().zip(&places) {
            place.write_result(&fixture::result(cell, [90.0, 60.0, 30.0], 1.0)).unwrap();
        }
        status.refresh().unwrap();
        assert_eq!(status.state(), "finished");
        std::fs::remove_dir_all(places[0].path()).unwrap();
        status.refresh().unwrap();
        assert_eq!(status.cells[0], CellStatus::Waiting { begun: false }, "results may be deleted");
        places[1].write_result(&fixture::result(&plan.cells[1], [10.0, 20.0, 30.0], 1.0)).unwrap();
        status.refresh().unwrap();
        let again = |known: &CellStatus| matches!(known, CellStatus::Done(result) if result.results["D"].success_percent == 10.0);
        assert!(again(&status.cells[1]), "results may be replaced");
        std::fs::write(folder.plan_path(), PLAN.replace("runs = 3", "runs = 2")).unwrap();
        status.refresh().unwrap();
        assert_eq!(status.cells.len(), 2, "another plan");
    }

    #[test]
    fn links_out_of_the_root_are_not_shown_to_others() {
        let directory = tempfile::tempdir().unwrap();
        let outside = directory.path().join("outside.json");
        std::fs::write(&outside, "{\"secret\": 7}").unwrap();
        let root = directory.path().canonicalize().unwrap().join("root");
        let folder = ExperimentFolder::new(&root.join("study"));
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        folder.store_plan(&plan).unwrap();
        let cell = folder.cell(&plan.cells[0].id);
        std::fs::create_dir_all(cell.path()).unwrap();
        std::os::unix::fs::symlink(&outside, cell.path().join("result.json")).unwrap();
        let read = |within: bool| match within {
            true => ExperimentStatus::read_within(folder.path(), &root).unwrap(),
            false => ExperimentStatus::read(folder.path()).unwrap(),
        };
        let reason = |status: &ExperimentStatus| match &status.cells[0] {
            CellStatus::NotUnderstood(reason) => reason.clone(),
            known => panic!("{known:?}"),
        };
        let shown = read(true);
        assert!(reason(&shown).ends_with("result.json is a link that leads out of the folder"));
        assert!(reason(&read(false)).contains("secret"), "only `read_within` refuses links");
        std::fs::rename(folder.plan_path(), directory.path().join("plan")).unwrap();
        std::os::unix::fs::symlink(directory.path().join("plan"), folder.plan_path()).unwrap();
        let error = ExperimentStatus::read_within(folder.path(), &root).unwrap_err().to_string();
        assert_eq!(error, "plan.toml is a link that leads out of the folder");
    }

    #[test]
    fn long_reasons_and_large_plans_are_limited() {
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(directory.path());
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        folder.store_plan(&plan).unwrap();
        let (id, commit) = (plan.cells[0].id.clone(), "x".into());
        let failure = FailureRecord { id, reason: "long ".repeat(1000), commit, requires_restart: true };
        folder.cell(&failure.id).write_failure(&failure).unwrap();
        let status = ExperimentStatus::read(directory.path()).unwrap();
        assert!(matches!(&status.cells[0], CellStatus::Failed(reason) if reason.len() < 400));
        std::fs::write(folder.plan_path(), PLAN.replace("runs = 3", "runs = 50001")).unwrap();
        let error = ExperimentStatus::read_within(directory.path(), directory.path()).unwrap_err().to_string();
        assert!(error.contains("the plan has 50 001 cells"), "{error}");
    }
}
