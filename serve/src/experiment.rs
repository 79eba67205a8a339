//! The state of an experiment, which consists of cells: trainings with their tests. It is read again when its files
//! change.

use std::collections::{HashMap, HashSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use perturb_experiment::runs::{CellStatus, ExperimentStatus, LEADS_OUT, RunSummary, last_progress};
use perturb_experiment::{Cell, generated_episodes, tested_episodes};
use perturb_files::{self as files, Stamp, escapes_root};
use perturb_records::{self as records};
use perturb_text::shortened;
use serde::Serialize;

use crate::curve::LearningCurve;
use crate::eta::Eta;
use crate::training::{LOCK_INTERVAL, LiveTraining};

/// Maximum number of running cells (trainings) whose learning curves are read.
pub(crate) const MAX_CURVES: usize = 48;
/// Approximate duration of a test episode, as a fraction of the duration of a training episode.
const TEST_SHARE: f64 = 0.25;
/// Time for which the experiment still counts as running after its last running cell was seen. It covers the time
/// between the end of a cell and the start of the next one.
const BETWEEN_CELLS: Duration = Duration::from_secs(15);
/// Pause before an experiment that could not be read is read again, as a multiple of the time that the last attempt
/// took.
const REREAD_FACTOR: u32 = 20;

/// The state of an experiment at the last refresh.
#[derive(Debug)]
pub(crate) struct LiveExperiment {
    /// The served folder. Symbolic links that lead out of it are not followed.
    root: PathBuf,
    path: PathBuf,
    /// Time at which the experiment's files were last read; `None` before the first time.
    read: Option<Instant>,
    /// Time that it took to read the experiment's files the last time.
    read_duration: Duration,
    /// Stamps (sizes and times) of the folder `cells/` and of the plan.
    stamps: [Option<Stamp>; 2],
    status: Result<ExperimentStatus, String>,
    /// Time at which a cell was last seen running.
    last_running: Option<Instant>,
    /// Trainings of the first [`MAX_CURVES`] running cells, by the cells' ids.
    trainings: HashMap<String, LiveTraining>,
    /// Progress of all running cells, by their ids.
    progress: HashMap<String, CellProgress>,
    eta: Eta,
    /// Number of settled cells (finished or failed) when `weights` was computed.
    weighted: usize,
    /// Duration of each cell relative to the others.
    weights: Vec<f64>,
    report_files: ReportFiles,
    /// Ids of cells whose trainings have a page, i.e. whose trainings have begun.
    with_page: HashSet<String>,
}

/// The progress of a running cell, from the last line of its `progress.csv`.
#[derive(Clone, Copy, Debug, Default)]
struct CellProgress {
    stamp: Option<Stamp>,
    episodes: u64,
}

/// The files from which the report is built.
#[derive(Debug, Default)]
struct ReportFiles {
    /// Time at which the files were listed.
    at: Option<Instant>,
    /// Number of settled cells (finished or failed), and the time of the last change of the plan, a result or a failure
    /// in seconds since 1970.
    settled: (usize, i64),
    /// A hash of the files' names and stamps.
    fingerprint: u64,
    /// Name of a symbolic link that leads out of the served folder and must not be followed.
    outside: Option<String>,
}

/// The learning curve of a running cell.
#[derive(Debug, Serialize)]
pub(crate) struct CellCurve {
    pub(crate) id: String,
    /// A text with the environment, the method, and the version or set of the training.
    pub(crate) kind: String,
    /// x coordinates: the number of episodes before the point, plus half of the point's episodes.
    pub(crate) episodes: Vec<f64>,
    /// Success rate of each point, in percent.
    pub(crate) success: Vec<f64>,
}

impl LiveExperiment {
    /// Makes an empty state of the experiment in the folder `path`. [`refresh`](Self::refresh) fills it. Files outside
    /// of `root` are not read.
    pub(crate) fn new(root: &Path, path: &Path) -> Self {
        Self {
            root: root.to_owned(),
            path: path.to_owned(),
            read: None,
            read_duration: Duration::ZERO,
            stamps: [None; 2],
            status: Err("it has not been read yet".into()),
            last_running: None,
            trainings: HashMap::new(),
            progress: HashMap::new(),
            eta: Eta::default(),
            weighted: 0,
            weights: Vec::new(),
            report_files: ReportFiles::default(),
            with_page: HashSet::new(),
        }
    }

    /// Reads the status again if the experiment is running, if its files have changed, or if enough time has passed.
    pub(crate) fn refresh(&mut self) {
        // A new cell changes the stamp of `cells/`, but a change inside a cell's folder does not. Therefore the status
        // is also read again while the experiment is running, and otherwise after a pause.
        let stamps = ["cells", "plan.toml"].map(|name| Stamp::read(&self.path.join(name)));
        let is_idle = self.state() != "in work";
        let reread_pause = LOCK_INTERVAL.max(self.read_duration * REREAD_FACTOR);
        let pause = if self.status.is_err() { reread_pause } else { LOCK_INTERVAL };
        let is_due = self.read.is_none_or(|read| read.elapsed() >= pause);
        if stamps == self.stamps && is_idle && !is_due {
            return;
        }
        let start = Instant::now();
        self.stamps = stamps;
        let read = match &mut self.status {
            Ok(status) => status.refresh(),
            Err(_) => ExperimentStatus::read_within(&self.path, &self.root).map(|status| self.status = Ok(status)),
        };
        if let Err(error) = read {
            self.status = Err(shortened(error.to_string()));
        }
        if self.status.as_ref().is_ok_and(|status| status.state() == "in work") {
            self.last_running = Some(Instant::now());
        }
        self.read_progress();
        self.read = Some(Instant::now());
        self.read_duration = start.elapsed();
    }

    /// Reads the progress of the running cells.
    fn read_progress(&mut self) {
        let Ok(status) = &self.status else { return self.progress.clear() };
        let mut before = std::mem::take(&mut self.progress);
        for id in working(status) {
            let file = Path::new("cells").join(id).join("training/progress.csv");
            let mut progress = before.remove(id).unwrap_or_default();
            let stamp = Stamp::read(&self.path.join(&file)).filter(|_| !escapes_root(&self.root, &self.path, &file));
            if stamp != progress.stamp {
                let last = stamp.and_then(|_| last_progress(&self.path.join(&file)));
                progress = CellProgress { stamp, episodes: last.and_then(|last| last.episodes()).unwrap_or_default() };
            }
            self.progress.insert(id.to_owned(), progress);
        }
    }

    /// Refreshes the status, the curves, and everything else that the experiment's own page shows.
    pub(crate) fn refresh_details(&mut self) {
        self.refresh();
        let Ok(status) = &self.status else { return self.trainings.clear() };
        let is_inside = |id: &str| !escapes_root(&self.root, &self.path, Path::new("cells").join(id).join("training"));
        // Refreshes the learning curves of running cells.
        let first: Vec<&str> = working(status).filter(|id| is_inside(id)).take(MAX_CURVES).collect();
        self.trainings.retain(|id, _| first.contains(&id.as_str()));
        for id in first {
            let training = || LiveTraining::new(&self.root, &status.folder.cell(id).training());
            self.trainings.entry(id.to_owned()).or_insert_with(training).refresh_details();
        }
        // Updates the estimate of the remaining time.
        let settled = status.count(CellStatus::is_settled);
        if self.weighted != settled || self.weights.len() != status.cells.len() {
            self.weighted = settled;
            self.weights = weights(status);
        }
        let shares = self.shares(status);
        if self.state() != "in work" {
            self.eta.reset();
        } else {
            self.eta.sample(Instant::now(), &shares);
        }
        // Lists the files of the report, and the cells whose trainings have a page.
        let settled = (settled, status.changed());
        let files = &self.report_files;
        let is_due = files.settled != settled || files.at.is_none_or(|at| at.elapsed() >= LOCK_INTERVAL);
        if is_due {
            self.report_files = ReportFiles::list(status, settled, &self.root);
            self.with_page.clear();
        }
        for (cell, known) in status.plan.cells.iter().zip(&status.cells) {
            let is_new = *known == CellStatus::InWork && !self.with_page.contains(&cell.id);
            if is_new || is_due && *known != (CellStatus::Waiting { begun: false }) {
                let config = status.folder.cell(&cell.id).training().join("config.toml");
                if config.is_file() && is_inside(&cell.id) {
                    self.with_page.insert(cell.id.clone());
                }
            }
        }
    }

    /// Returns the status, or the reason why it could not be read.
    pub(crate) fn status(&self) -> Result<&ExperimentStatus, &str> {
        self.status.as_ref().map_err(String::as_str)
    }

    /// Returns the state as a text, such as "in work" for a running experiment. In contrast to
    /// [`ExperimentStatus::state`], an experiment still counts as running for a short time between two cells.
    pub(crate) fn state(&self) -> &'static str {
        let Ok(status) = &self.status else { return "not understood" };
        let has_open_cells = status.cells.iter().any(|cell| !cell.is_settled());
        let worked_lately = self.last_running.is_some_and(|last_running| last_running.elapsed() < BETWEEN_CELLS);
        if has_open_cells && worked_lately { "in work" } else { status.state() }
    }

    pub(crate) fn summary(&self) -> RunSummary {
        match &self.status {
            Ok(status) => RunSummary { state: self.state(), ..status.summary() },
            Err(_) => RunSummary::not_understood(&self.path),
        }
    }

    /// Returns the time of the last change, in seconds since 1970.
    pub(crate) fn changed(&self) -> i64 {
        let progress = self.progress.values().map(|progress| progress.stamp);
        let stamps = self.stamps.into_iter().chain(progress).flatten().map(|stamp| stamp.seconds());
        stamps.chain(self.status.as_ref().map(ExperimentStatus::changed)).max().unwrap_or_default()
    }

    /// Returns a number that changes with the files from which the report is built.
    pub(crate) fn report_fingerprint(&self) -> u64 {
        self.report_files.fingerprint
    }

    /// Returns the folder from which the report is built, or the reason why no report can be built.
    pub(crate) fn report_folder(&self) -> Result<PathBuf, String> {
        let outside = self.report_files.outside.clone();
        self.status().map_err(|reason| format!("this experiment is not understood: {reason}"))?;
        outside.map_or_else(|| Ok(self.path.clone()), |name| Err(format!("{name} is {LEADS_OUT}")))
    }

    /// Returns the training of a running cell. Returns `None` if the cell is not among the first [`MAX_CURVES`] running
    /// cells.
    pub(crate) fn training(&self, id: &str) -> Option<&LiveTraining> {
        self.trainings.get(id)
    }

    /// Tells whether a cell's training has a page, i.e. whether it has begun.
    pub(crate) fn has_page(&self, id: &str) -> bool {
        self.with_page.contains(id)
    }

    /// Returns the remaining time in seconds, or `None` if it is not known yet.
    pub(crate) fn remaining_seconds(&self) -> Option<f64> {
        let status = self.status.as_ref().ok()?;
        self.eta.remaining_seconds(Instant::now(), &self.shares(status), &self.weights)
    }

    /// Returns the learning curves of running cells, in the order of the plan.
    pub(crate) fn curves(&self) -> Vec<CellCurve> {
        let Ok(status) = &self.status else { return Vec::new() };
        let curve = |cell: &Cell| {
            let LearningCurve { episodes, success, .. } = self.trainings.get(&cell.id)?.curve();
            let kind = format!("{} {}, {}", cell.config.common.environment, cell.method(), cell.trained_on());
            (success.len() > 1).then(|| CellCurve { id: cell.id.clone(), kind, episodes, success })
        };
        status.plan.cells.iter().filter_map(curve).collect()
    }

    /// Returns the finished share of each cell, 0 to 1.
    fn shares(&self, status: &ExperimentStatus) -> Vec<f32> {
        let share = |(cell, known): (&Cell, &CellStatus)| match known {
            CellStatus::Done(_) | CellStatus::Failed(_) => 1.0,
            CellStatus::InWork => {
                let trained = self.progress.get(&cell.id).map_or(0.0, |progress| progress.episodes as f64);
                let budget = cell.config.common.episodes as f64;
                (trained.min(budget) / (budget + test_cost(cell))) as f32
            }
            CellStatus::NotUnderstood(_) | CellStatus::Waiting { .. } => 0.0,
        };
        status.plan.cells.iter().zip(&status.cells).map(share).collect()
    }
}

/// Returns the ids of the running cells, in the order of the plan.
fn working(status: &ExperimentStatus) -> impl Iterator<Item = &str> {
    let all = status.plan.cells.iter().zip(&status.cells);
    all.filter(|(_, known)| **known == CellStatus::InWork).map(|(cell, _)| cell.id.as_str())
}

/// Returns the duration of a cell's tests, as the number of training episodes that take the same time.
fn test_cost(cell: &Cell) -> f64 {
    TEST_SHARE * tested_episodes(cell)
}

/// Returns the duration of each cell relative to the others. The duration is the measured mean of finished cells with
/// the same environment and method. If there are none, it is estimated from the number of the cell's episodes.
fn weights(status: &ExperimentStatus) -> Vec<f64> {
    let taken = status.durations();
    let cells = &status.plan.cells;
    let episodes = |cell: &Cell| generated_episodes(&cell.config, cell.config.common.episodes) + test_cost(cell);
    // The seconds per episode of each cell whose duration is measured.
    let measured: Vec<f64> =
        cells.iter().filter_map(|cell| taken.seconds(cell).map(|seconds| seconds / episodes(cell))).collect();
    let mean = if measured.is_empty() { 1.0 } else { perturb_records::statistics::mean(measured.iter().copied()) };
    cells.iter().map(|cell| taken.seconds(cell).unwrap_or_else(|| mean * episodes(cell))).collect()
}

impl ReportFiles {
    /// Finds the files that a report reads: the plan, the tables beside it, the heatmaps, and the files of cells with a
    /// result or failure.
    fn list(status: &ExperimentStatus, settled: (usize, i64), root: &Path) -> Self {
        let mut hasher = DefaultHasher::new();
        let mut outside = None;
        let folder = status.folder.path();
        let mut add = |path: &Path| {
            let name = path.strip_prefix(folder).unwrap_or(path);
            if outside.is_none() && escapes_root(root, folder, name) {
                outside = Some(name.display().to_string());
            }
            (name, Stamp::read(path)).hash(&mut hasher);
        };
        add(&status.folder.plan_path());
        let listed = |folder: &Path| files::list(folder).unwrap_or_default();
        listed(folder)
            .iter()
            .filter(|path| path.extension().is_some_and(|extension| extension == "csv"))
            .for_each(|path| add(path));
        let heatmaps = folder.join("heatmaps");
        add(&heatmaps);
        listed(&heatmaps).iter().for_each(|path| add(path));
        for (cell, known) in status.plan.cells.iter().zip(&status.cells) {
            let cell_folder = status.folder.cell(&cell.id);
            let names: &[&str] = match known {
                CellStatus::Done(_) => &["result.json"],
                CellStatus::Failed(_) => &["failure.json"],
                CellStatus::NotUnderstood(_) => &["result.json", "failure.json"],
                CellStatus::InWork | CellStatus::Waiting { .. } => &[],
            };
            names.iter().for_each(|name| add(&cell_folder.path().join(name)));
            if let CellStatus::Done(_) = known {
                add(&cell_folder.path().join(records::FILE));
                add(&cell_folder.training().join("monitor.csv"));
                cell.tests.marks.iter().for_each(|mark| add(&cell_folder.mark(*mark).join(records::FILE)));
            }
        }
        Self { at: Some(Instant::now()), settled, fingerprint: hasher.finish(), outside }
    }
}

#[cfg(test)]
mod tests;
