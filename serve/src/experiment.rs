//! What is known of an experiment.

use std::collections::{HashMap, HashSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use perturb_study::files::{self, Stamp, leads_out};
use perturb_study::runs::{CellStatus, ExperimentStatus, LEADS_OUT, RunSummary, last_progress};
use perturb_study::words::shortened;
use perturb_study::{Cell, generated_episodes, records, tested_episodes};
use serde::Serialize;

use crate::curve::Curve;
use crate::remaining::Pace;
use crate::training::{LOCK_INTERVAL, Training};

/// Of at most so many cells in work the curves are followed.
pub(crate) const MOST_FOLLOWED: usize = 48;
/// A test episode takes about so much of the time of a training's.
const TEST_SHARE: f64 = 0.25;
/// From one cell to the next it may take so long.
const BETWEEN: Duration = Duration::from_secs(15);
/// How often, as a share of the time that it took, a plan that is not understood is read again.
const REREAD: u32 = 20;

/// An experiment that is looked at now and then.
#[derive(Debug)]
pub(crate) struct Experiment {
    /// What links may not lead out of.
    root: PathBuf,
    path: PathBuf,
    looked: Option<Instant>,
    took: Duration,
    /// Of `cells/`, and of the plan.
    stamps: [Option<Stamp>; 2],
    status: Result<ExperimentStatus, String>,
    /// When somebody was last seen to work on it.
    worked: Option<Instant>,
    /// The first cells in work, by their ids, with their curves.
    followed: HashMap<String, Training>,
    /// How far all cells in work are, by their ids.
    logs: HashMap<String, Log>,
    pace: Pace,
    /// What cells take in terms of others, for so many that are done.
    weights: (usize, Vec<f64>),
    sources: Sources,
    /// Cells that have a page of their own.
    with_page: HashSet<String>,
}

/// The end of a cell's `progress.csv`.
#[derive(Clone, Copy, Debug, Default)]
struct Log {
    stamp: Option<Stamp>,
    episodes: u64,
}

/// Of all that the report is made from.
#[derive(Debug, Default)]
struct Sources {
    at: Option<Instant>,
    /// For so many cells that are settled, and when these last changed.
    settled: (usize, i64),
    /// Another number when the report would be another one.
    state: u64,
    /// One that must not be read.
    out: Option<String>,
}

/// The curve of a cell in work.
#[derive(Debug, Serialize)]
pub(crate) struct CellCurve {
    pub(crate) id: String,
    /// Environment, learner and what it is trained on.
    pub(crate) kind: String,
    /// Episodes in the middle of a point.
    pub(crate) episodes: Vec<f64>,
    /// Its success rate, %.
    pub(crate) success: Vec<f64>,
}

impl Experiment {
    /// That in `path`, of which nothing is shown that is outside of `root`.
    pub(crate) fn of(root: &Path, path: &Path) -> Self {
        Self {
            root: root.to_owned(),
            path: path.to_owned(),
            looked: None,
            took: Duration::ZERO,
            stamps: [None; 2],
            status: Err("it was not looked at".into()),
            worked: None,
            followed: HashMap::new(),
            logs: HashMap::new(),
            pace: Pace::default(),
            weights: Default::default(),
            sources: Sources::default(),
            with_page: HashSet::new(),
        }
    }

    /// Reads what has changed of its state.
    pub(crate) fn look(&mut self) {
        // A cell's first file makes its folder; what follows is in there.
        let stamps = ["cells", "plan.toml"].map(|name| Stamp::of(&self.path.join(name)));
        let idle = self.state() != "in work";
        let rest = if self.status.is_err() { LOCK_INTERVAL.max(self.took * REREAD) } else { LOCK_INTERVAL };
        let rested = self.looked.is_none_or(|looked| looked.elapsed() >= rest);
        if stamps == self.stamps && idle && !rested {
            return;
        }
        let begun = Instant::now();
        self.stamps = stamps;
        let read = match &mut self.status {
            Ok(status) => status.refresh(),
            Err(_) => ExperimentStatus::read_within(&self.path, &self.root).map(|status| self.status = Ok(status)),
        };
        if let Err(error) = read {
            self.status = Err(shortened(error.to_string()));
        }
        if self.status.as_ref().is_ok_and(|status| status.state() == "in work") {
            self.worked = Some(Instant::now());
        }
        self.read_logs();
        (self.looked, self.took) = (Some(Instant::now()), begun.elapsed());
    }

    /// How far the cells in work are.
    fn read_logs(&mut self) {
        let Ok(status) = &self.status else { return self.logs.clear() };
        let mut before = std::mem::take(&mut self.logs);
        for id in working(status) {
            let place = Path::new("cells").join(id).join("training/progress.csv");
            let mut log = before.remove(id).unwrap_or_default();
            let stamp = Stamp::of(&self.path.join(&place)).filter(|_| !leads_out(&self.root, &self.path, &place));
            if stamp != log.stamp {
                let last = stamp.and_then(|_| last_progress(&self.path.join(&place)));
                log = Log { stamp, episodes: last.and_then(|last| last.episodes()).unwrap_or_default() };
            }
            self.logs.insert(id.to_owned(), log);
        }
    }

    /// The same, and all that its page shows.
    pub(crate) fn follow(&mut self) {
        self.look();
        let Ok(status) = &self.status else { return self.followed.clear() };
        let within = |id: &str| !leads_out(&self.root, &self.path, Path::new("cells").join(id).join("training"));
        let first: Vec<&str> = working(status).filter(|id| within(id)).take(MOST_FOLLOWED).collect();
        self.followed.retain(|id, _| first.contains(&id.as_str()));
        for id in first {
            let training = || Training::of(&self.root, &status.folder.cell(id).training());
            self.followed.entry(id.to_owned()).or_insert_with(training).follow();
        }
        let settled = status.count(CellStatus::is_settled);
        if self.weights.0 != settled || self.weights.1.len() != status.cells.len() {
            self.weights = (settled, weights(status));
        }
        let shares = self.shares(status);
        if self.state() != "in work" {
            self.pace.forget();
        } else {
            self.pace.hear(Instant::now(), &shares);
        }
        let settled = (settled, status.changed());
        let anew = self.sources.settled != settled || self.sources.at.is_none_or(|at| at.elapsed() >= LOCK_INTERVAL);
        if anew {
            self.sources = Sources::of(status, settled, &self.root);
            self.with_page.clear();
        }
        for (cell, known) in status.plan.cells.iter().zip(&status.cells) {
            let asked = *known == CellStatus::InWork && !self.with_page.contains(&cell.id);
            if asked || anew && *known != (CellStatus::Waiting { begun: false }) {
                let config = status.folder.cell(&cell.id).training().join("config.toml");
                if config.is_file() && within(&cell.id) {
                    self.with_page.insert(cell.id.clone());
                }
            }
        }
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
        let logs = self.logs.values().map(|log| log.stamp);
        let stamps = self.stamps.into_iter().chain(logs).flatten().map(|stamp| stamp.seconds());
        stamps.chain(self.status.as_ref().map(ExperimentStatus::changed)).max().unwrap_or_default()
    }

    /// Another number when its report would be another one.
    pub(crate) fn files(&self) -> u64 {
        self.sources.state
    }

    /// Where it is, for a report; in its place why none is made.
    pub(crate) fn reported(&self) -> Result<PathBuf, String> {
        let out = self.sources.out.clone();
        self.status().map_err(|reason| format!("this experiment is not understood: {reason}"))?;
        out.map_or_else(|| Ok(self.path.clone()), |name| Err(format!("{name} is {LEADS_OUT}")))
    }

    /// The training of a cell in work, unless there are too many.
    pub(crate) fn training(&self, id: &str) -> Option<&Training> {
        self.followed.get(id)
    }

    /// Whether a cell has a page of its own.
    pub(crate) fn has_page(&self, id: &str) -> bool {
        self.with_page.contains(id)
    }

    /// How long it may still take, s.
    pub(crate) fn left(&self) -> Option<f64> {
        let status = self.status.as_ref().ok()?;
        self.pace.left(Instant::now(), &self.shares(status), &self.weights.1)
    }

    /// The curves of cells in work, in the order of the plan.
    pub(crate) fn curves(&self) -> Vec<CellCurve> {
        let Ok(status) = &self.status else { return Vec::new() };
        let of = |cell: &Cell| {
            let Curve { episodes, success, .. } = self.followed.get(&cell.id)?.curve();
            let kind = format!("{} {}, {}", cell.config.common.environment, cell.method(), cell.trained_on());
            (success.len() > 1).then(|| CellCurve { id: cell.id.clone(), kind, episodes, success })
        };
        status.plan.cells.iter().filter_map(of).collect()
    }

    /// How much of each cell is done.
    fn shares(&self, status: &ExperimentStatus) -> Vec<f32> {
        let share = |(cell, known): (&Cell, &CellStatus)| match known {
            CellStatus::Done(_) | CellStatus::Failed(_) => 1.0,
            CellStatus::InWork => {
                let training = self.logs.get(&cell.id).map_or(0.0, |log| log.episodes as f64);
                let budget = cell.config.common.episodes as f64;
                (training.min(budget) / (budget + testing(cell))) as f32
            }
            CellStatus::NotUnderstood(_) | CellStatus::Waiting { .. } => 0.0,
        };
        status.plan.cells.iter().zip(&status.cells).map(share).collect()
    }
}

/// The cells in work, in the order of the plan.
fn working(status: &ExperimentStatus) -> impl Iterator<Item = &str> {
    let all = status.plan.cells.iter().zip(&status.cells);
    all.filter(|(_, known)| **known == CellStatus::InWork).map(|(cell, _)| cell.id.as_str())
}

/// What the tests of a cell take, in episodes of its training.
fn testing(cell: &Cell) -> f64 {
    TEST_SHARE * tested_episodes(cell)
}

/// What cells take in terms of others: what those of their kind took, or else as many episodes as they have.
fn weights(status: &ExperimentStatus) -> Vec<f64> {
    let taken = status.taken();
    let cells = &status.plan.cells;
    let episodes = |cell: &Cell| generated_episodes(&cell.config, cell.config.common.episodes) + testing(cell);
    // Seconds of an episode, where cells are done.
    let known: Vec<f64> =
        cells.iter().filter_map(|cell| taken.seconds(cell).map(|seconds| seconds / episodes(cell))).collect();
    let usual = if known.is_empty() { 1.0 } else { perturb_study::mean(known.iter().copied()) };
    cells.iter().map(|cell| taken.seconds(cell).unwrap_or_else(|| usual * episodes(cell))).collect()
}

impl Sources {
    /// Looks at the plan with its tables, heatmaps, and of each cell that is settled at what the report reads of it.
    fn of(status: &ExperimentStatus, settled: (usize, i64), root: &Path) -> Self {
        let (mut hasher, mut out) = (DefaultHasher::new(), None);
        let place = status.folder.path();
        let mut add = |path: &Path| {
            let name = path.strip_prefix(place).unwrap_or(path);
            if out.is_none() && leads_out(root, place, name) {
                out = Some(name.display().to_string());
            }
            (name, Stamp::of(path)).hash(&mut hasher);
        };
        add(&status.folder.plan_path());
        let listed = |folder: &Path| files::list(folder).unwrap_or_default();
        listed(place)
            .iter()
            .filter(|path| path.extension().is_some_and(|ending| ending == "csv"))
            .for_each(|path| add(path));
        let heatmaps = place.join("heatmaps");
        add(&heatmaps);
        listed(&heatmaps).iter().for_each(|path| add(path));
        for (cell, known) in status.plan.cells.iter().zip(&status.cells) {
            let folder = status.folder.cell(&cell.id);
            let names: &[&str] = match known {
                CellStatus::Done(_) => &["result.json"],
                CellStatus::Failed(_) => &["failure.json"],
                CellStatus::NotUnderstood(_) => &["result.json", "failure.json"],
                CellStatus::InWork | CellStatus::Waiting { .. } => &[],
            };
            names.iter().for_each(|name| add(&folder.path().join(name)));
            if let CellStatus::Done(_) = known {
                add(&folder.path().join(records::FILE));
                add(&folder.training().join("monitor.csv"));
                cell.tests.marks.iter().for_each(|mark| add(&folder.mark(*mark).join(records::FILE)));
            }
        }
        Self { at: Some(Instant::now()), settled, state: hasher.finish(), out }
    }
}

#[cfg(test)]
mod tests;
