//! How far an experiment is.

use std::fs::Metadata;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::RunSummary;
use crate::files::is_locked;
use crate::plan::{Cell, Plan};
use crate::scheduler::{Rate, Rates};
use crate::{AnyError, CellResult, CellState, Folder, Taken, mean};

/// An experiment, as its folder has it.
#[derive(Clone, Debug)]
pub struct ExperimentStatus {
    /// Where it is.
    pub folder: Folder,
    /// With all cells that are known by now.
    pub plan: Plan,
    /// Of each cell of the plan, in its order.
    pub cells: Vec<CellStatus>,
    /// Of plan.toml, as it was read.
    stamp: Option<Stamp>,
}

/// How far a cell is.
#[derive(Clone, Debug, PartialEq)]
pub enum CellStatus {
    /// There is a result.
    Done(Box<CellResult>),
    /// It failed, for this reason.
    Failed(String),
    /// Its files cannot be read.
    NotUnderstood(String),
    /// Somebody works on it.
    InWork,
    /// None of these; whether it was begun.
    Waiting {
        /// Whether it has a folder.
        begun: bool,
    },
}

/// Tells a file from what it was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stamp(u64, i64, i64, u64);

impl Stamp {
    fn of(path: &Path) -> Option<Self> {
        let of = |file: Metadata| Self(file.ino(), file.mtime(), file.mtime_nsec(), file.len());
        std::fs::metadata(path).ok().map(of)
    }
}

impl ExperimentStatus {
    /// Of the experiment in `path`.
    ///
    /// # Errors
    /// If the plan cannot be read.
    pub fn read(path: &Path) -> Result<Self, AnyError> {
        let folder = Folder::new(path);
        let stamp = Stamp::of(&folder.plan_path());
        let plan = Plan::load(&folder.require_plan()?)?.in_folder(&folder)?;
        let cells = plan.cells.iter().map(|cell| status(&folder, cell)).collect();
        Ok(Self { folder, plan, cells, stamp })
    }

    /// Looks again, at what may have changed: cells that were not settled, and the plan. A cell that is done stays so.
    ///
    /// # Errors
    /// If the plan cannot be read.
    pub fn refresh(&mut self) -> Result<(), AnyError> {
        let settled = |cells: &[CellStatus]| cells.iter().filter(|cell| cell.is_settled()).count();
        let before = settled(&self.cells);
        if Stamp::of(&self.folder.plan_path()) != self.stamp {
            *self = Self::read(self.folder.path())?;
            return Ok(());
        }
        for (cell, known) in self.plan.cells.iter().zip(&mut self.cells) {
            if !matches!(known, CellStatus::Done(_)) || !self.folder.cell(&cell.id).is_settled(false) {
                *known = status(&self.folder, cell);
            }
        }
        // What is selected may have become known.
        if !self.plan.candidates.is_empty() && settled(&self.cells) != before {
            *self = Self::read(self.folder.path())?;
        }
        Ok(())
    }

    /// How many cells are as `is` says.
    pub fn count(&self, is: impl Fn(&CellStatus) -> bool) -> usize {
        self.cells.iter().filter(|cell| is(cell)).count()
    }

    /// The cells that are done, with their results.
    pub fn done(&self) -> impl Iterator<Item = (&Cell, &CellResult)> {
        self.plan.cells.iter().zip(&self.cells).filter_map(|(cell, status)| match status {
            CellStatus::Done(result) => Some((cell, &**result)),
            _ => None,
        })
    }

    /// Success of the cells that are done, by their kinds.
    pub fn rates(&self) -> Vec<Rate> {
        let mut rates = Rates::default();
        self.done().for_each(|(cell, result)| rates.add(cell, result));
        rates.list()
    }

    /// What cells took that are done.
    pub fn taken(&self) -> Taken<'_> {
        Taken::read(&self.plan, &self.folder)
    }

    /// "in work", "finished", "with failures" or "broken off".
    pub fn state(&self) -> &'static str {
        let any = |is: fn(&CellStatus) -> bool| self.cells.iter().any(is);
        match () {
            () if any(|cell| *cell == CellStatus::InWork) => "in work",
            () if any(|cell| matches!(cell, CellStatus::Failed(_))) => "with failures",
            () if self.cells.iter().all(|cell| matches!(cell, CellStatus::Done(_))) => "finished",
            () => "broken off",
        }
    }

    /// In a few figures.
    pub fn summary(&self) -> RunSummary {
        let rates: Vec<f64> =
            self.done().flat_map(|(_, result)| result.results.values().map(|test| test.success_percent)).collect();
        RunSummary {
            path: self.folder.path().to_owned(),
            what: self.plan.environments().join(", "),
            done: self.done().count() as u64,
            budget: self.cells.len() as u64,
            unit: "cells",
            success_percent: (!rates.is_empty()).then(|| mean(rates.iter().copied())),
            state: self.state(),
        }
    }
}

impl CellStatus {
    /// Whether it is done or has failed.
    pub fn is_settled(&self) -> bool {
        matches!(self, Self::Done(_) | Self::Failed(_))
    }
}

fn status(folder: &Folder, cell: &Cell) -> CellStatus {
    let place = folder.cell(&cell.id);
    match place.state() {
        Ok(CellState::Done(result)) => CellStatus::Done(result),
        Ok(CellState::Failed(failure)) => CellStatus::Failed(failure.reason),
        Ok(CellState::Missing) if is_locked(&place.path().join("lock")) => CellStatus::InWork,
        Ok(CellState::Missing) => CellStatus::Waiting { begun: place.path().is_dir() },
        Err(error) => CellStatus::NotUnderstood(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Failure, fixture};

    const PLAN: &str = "environments = ['Pendulum']\nversions = ['D']\nruns = 3
        [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

    #[test]
    fn cells_are_followed_from_their_beginning_to_their_result() {
        let directory = tempfile::tempdir().unwrap();
        let folder = Folder::new(directory.path());
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        assert!(ExperimentStatus::read(directory.path()).is_err());
        folder.keep_plan(&plan).unwrap();
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
        let failure =
            Failure { id: plan.cells[1].id.clone(), reason: "NaN".into(), commit: "x".into(), begins_anew: true };
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
        assert_eq!(status.cells[0], CellStatus::Waiting { begun: false }, "results may go, too");
        std::fs::write(folder.plan_path(), PLAN.replace("runs = 3", "runs = 2")).unwrap();
        status.refresh().unwrap();
        assert_eq!(status.cells.len(), 2, "another plan");
    }
}
