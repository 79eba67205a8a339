//! What is known of an experiment.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use perturb_study::generated_episodes;
use perturb_study::runs::{CellStatus, ExperimentStatus, RunSummary};
use serde::Serialize;

use crate::curve::Curve;
use crate::remaining::Pace;
use crate::stamp::Stamp;
use crate::training::{LOCK_INTERVAL, Training};

/// Of at most so many cells in work the curves are followed.
const MOST_FOLLOWED: usize = 48;
/// A test episode takes about so much of the time of a training's.
const TEST_SHARE: f64 = 0.25;
/// From one cell to the next it may take so long.
const BETWEEN: Duration = Duration::from_secs(15);

/// An experiment that is looked at now and then.
#[derive(Debug)]
pub(crate) struct Experiment {
    path: PathBuf,
    looked: Option<Instant>,
    /// Of `cells/`, and of the folder itself.
    stamps: [Option<Stamp>; 2],
    status: Result<ExperimentStatus, String>,
    /// When it last changed, s since 1970.
    changed: i64,
    /// When somebody was last seen to work on it.
    worked: Option<Instant>,
    /// Trainings of cells in work, by the cells' ids.
    in_work: HashMap<String, Training>,
    pace: Pace,
    /// What cells take in terms of others, for so many that are done.
    weights: (usize, Vec<f64>),
    /// Of all that its report is made from.
    files: u64,
}

/// The curve of a cell in work.
#[derive(Debug, Serialize)]
pub(crate) struct CellCurve {
    pub(crate) id: String,
    /// Environment, learner and what it is trained on.
    pub(crate) kind: String,
    #[serde(flatten)]
    pub(crate) curve: Curve,
}

impl Experiment {
    pub(crate) fn of(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            looked: None,
            stamps: [None; 2],
            status: Err("it was not looked at".into()),
            changed: 0,
            worked: None,
            in_work: HashMap::new(),
            pace: Pace::default(),
            weights: Default::default(),
            files: 0,
        }
    }

    /// Reads what has changed of its state.
    pub(crate) fn look(&mut self) {
        // A cell's first file makes its folder; what follows is in there.
        let stamps = [Stamp::of(&self.path.join("cells")), Stamp::of(&self.path.join("plan.toml"))];
        let idle = self.state() != "in work";
        let rested = self.looked.is_none_or(|looked| looked.elapsed() >= LOCK_INTERVAL);
        if stamps == self.stamps && idle && !rested {
            return;
        }
        self.stamps = stamps;
        self.looked = Some(Instant::now());
        let read = match &mut self.status {
            Ok(status) => status.refresh(),
            Err(_) => ExperimentStatus::read(&self.path).map(|status| self.status = Ok(status)),
        };
        if let Err(error) = read {
            self.status = Err(error.to_string());
        }
        if self.status.as_ref().is_ok_and(|status| status.state() == "in work") {
            self.worked = Some(Instant::now());
        }
        // A cell's folder changes when its result appears there.
        let cells = self.status.as_ref().map(|status| status.plan.cells.as_slice()).unwrap_or_default();
        let cells = cells.iter().filter_map(|cell| Stamp::of(&self.path.join("cells").join(&cell.id)));
        self.changed =
            self.stamps.iter().copied().flatten().chain(cells).map(|stamp| stamp.seconds()).max().unwrap_or_default();
    }

    /// The same, and how far the cells in work are.
    pub(crate) fn follow(&mut self) {
        self.look();
        let Ok(status) = &self.status else { return };
        let cells = || status.plan.cells.iter().zip(&status.cells);
        let working: Vec<&str> =
            cells().filter(|(_, cell)| **cell == CellStatus::InWork).map(|(cell, _)| cell.id.as_str()).collect();
        self.in_work.retain(|id, _| working.contains(&id.as_str()));
        for id in working.iter().take(MOST_FOLLOWED) {
            let training = || Training::of(&status.folder.cell(id).training());
            self.in_work.entry((*id).to_owned()).or_insert_with(training).follow();
        }
        if self.weights.0 != status.count(CellStatus::is_settled) || self.weights.1.len() != status.cells.len() {
            self.weights = (status.count(CellStatus::is_settled), weights(status));
        }
        let shares = self.shares(status);
        if self.state() != "in work" {
            self.pace.forget();
        } else {
            self.pace.hear(Instant::now(), &shares);
        }
        self.files = state_of_files(status);
    }

    /// How far it is, or why that is not known.
    pub(crate) fn status(&self) -> Result<&ExperimentStatus, &str> {
        self.status.as_ref().map_err(String::as_str)
    }

    /// What [`ExperimentStatus::state`] says, but between two cells it is still in work.
    pub(crate) fn state(&self) -> &'static str {
        let Ok(status) = &self.status else { return "not understood" };
        let left = status.cells.iter().any(|cell| !cell.is_settled());
        let lately = self.worked.is_some_and(|worked| worked.elapsed() < BETWEEN);
        if left && lately { "in work" } else { status.state() }
    }

    pub(crate) fn summary(&self) -> RunSummary {
        match &self.status {
            Ok(status) => RunSummary { state: self.state(), ..status.summary() },
            Err(_) => RunSummary::not_understood(&self.path),
        }
    }

    /// When it last changed, s since 1970.
    pub(crate) fn changed(&self) -> i64 {
        self.changed
    }

    /// Another number when its report would be another one.
    pub(crate) fn files(&self) -> u64 {
        self.files
    }

    /// The training of a cell in work, unless there are too many.
    pub(crate) fn training(&self, id: &str) -> Option<&Training> {
        self.in_work.get(id)
    }

    /// How long it may still take, s.
    pub(crate) fn left(&self) -> Option<f64> {
        let status = self.status.as_ref().ok()?;
        self.pace.left(Instant::now(), &self.shares(status), &self.weights.1)
    }

    /// The curves of cells in work, in the order of the plan.
    pub(crate) fn curves(&self) -> Vec<CellCurve> {
        let Ok(status) = &self.status else { return Vec::new() };
        let of = |cell: &perturb_study::Cell| {
            let curve = self.in_work.get(&cell.id)?.curve();
            let kind = format!("{} {}, {}", cell.config.common.environment, cell.method(), cell.trained_on());
            (curve.success.len() > 1).then(|| CellCurve { id: cell.id.clone(), kind, curve })
        };
        status.plan.cells.iter().filter_map(of).collect()
    }

    /// How much of each cell is done.
    fn shares(&self, status: &ExperimentStatus) -> Vec<f32> {
        let share = |(cell, known): (&perturb_study::Cell, &CellStatus)| match known {
            CellStatus::Done(_) | CellStatus::Failed(_) => 1.0,
            CellStatus::InWork => {
                let training = self.in_work.get(&cell.id).and_then(|training| training.status().ok());
                let (training, testing) = (training.map_or(0.0, |status| status.episodes as f64), testing(cell));
                let budget = cell.config.common.episodes as f64;
                (training.min(budget) / (budget + testing)) as f32
            }
            CellStatus::NotUnderstood(_) | CellStatus::Waiting { .. } => 0.0,
        };
        status.plan.cells.iter().zip(&status.cells).map(share).collect()
    }
}

/// What the tests of a cell take, in episodes of its training.
fn testing(cell: &perturb_study::Cell) -> f64 {
    let times = cell.tests.sets.len() as u64 * (1 + cell.tests.marks.len() as u64);
    TEST_SHARE * (cell.tests.episodes * times + cell.tests.selection.unwrap_or_default()) as f64
}

/// What cells take in terms of others: what those of their kind took, or else as many episodes as they have.
fn weights(status: &ExperimentStatus) -> Vec<f64> {
    let taken = status.taken();
    let cells = &status.plan.cells;
    let episodes =
        |cell: &perturb_study::Cell| generated_episodes(&cell.config, cell.config.common.episodes) + testing(cell);
    // Seconds of an episode, where cells are done.
    let known: Vec<f64> =
        cells.iter().filter_map(|cell| taken.seconds(cell).map(|seconds| seconds / episodes(cell))).collect();
    let usual = if known.is_empty() { 1.0 } else { perturb_study::mean(known.iter().copied()) };
    cells.iter().map(|cell| taken.seconds(cell).unwrap_or_else(|| usual * episodes(cell))).collect()
}

/// Of all that a report is made from: results, failures, heatmaps.
fn state_of_files(status: &ExperimentStatus) -> u64 {
    let mut hasher = DefaultHasher::new();
    let folder = &status.folder;
    Stamp::of(&folder.plan_path()).hash(&mut hasher);
    Stamp::of(&folder.path().join("heatmaps")).hash(&mut hasher);
    for (cell, known) in status.plan.cells.iter().zip(&status.cells) {
        let name = match known {
            CellStatus::Done(_) | CellStatus::NotUnderstood(_) => "result.json",
            CellStatus::Failed(_) => "failure.json",
            CellStatus::InWork | CellStatus::Waiting { .. } => continue,
        };
        (&cell.id, Stamp::of(&folder.cell(&cell.id).path().join(name))).hash(&mut hasher);
    }
    hasher.finish()
}
