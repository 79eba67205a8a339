//! Training curves: return and success rate of the selected trainings over episodes and over steps, averaged over runs.

use std::path::Path;

use perturb_files::{AnyError, read_if_exists};
use perturb_protocol::Version;
use perturb_records::TrainedOn;
use perturb_records::statistics::{Summary, mean};
use perturb_settings::Method;

use crate::folder::{ExperimentFolder, FolderError};
use crate::selection::MethodResults;

/// Minimum number of episodes that each point averages in the shortest run.
const MIN_EPISODES_PER_POINT: usize = 20;
/// Maximum number of points of a curve.
const MAX_POINTS: usize = 100;

/// The horizontal axis of training curves: the quantity by which the progress of trainings is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BudgetAxis {
    /// Finished episodes, including those that EPOpt generates but does not learn from.
    Episodes,
    /// Steps of the finished episodes, summed over all environments.
    Steps,
}

impl BudgetAxis {
    /// Both axes: episodes, then steps.
    pub const ALL: [BudgetAxis; 2] = [BudgetAxis::Episodes, BudgetAxis::Steps];

    /// Returns how much an episode counts on this axis: 1, or its number of steps.
    fn weight(self, episode: &MonitorEpisode) -> f64 {
        match self {
            BudgetAxis::Episodes => 1.0,
            BudgetAxis::Steps => episode.length,
        }
    }
}

impl std::fmt::Display for BudgetAxis {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            BudgetAxis::Episodes => "episodes",
            BudgetAxis::Steps => "steps",
        })
    }
}

/// The training curves of all methods in one environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentCurves {
    /// The environment's name.
    pub environment: String,
    /// A curve for each method and training version with a finished training.
    pub curves: Vec<Curve>,
}

/// The curve of one method that was trained on one version.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// The method: algorithm, architecture and kind of observation.
    pub method: Method,
    /// The version (D, R, E or R+E) that the policies were trained on.
    pub version: Version,
    /// The curve over episodes and over steps.
    lines: [AxisCurve; 2],
}

/// The points of a curve over one [`BudgetAxis`].
#[derive(Clone, Debug, Default, PartialEq)]
struct AxisCurve {
    total: f64,
    points: Vec<CurvePoint>,
}

/// Averages over the same part, for example the third hundredth, of each run's training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CurvePoint {
    /// Number of episodes or steps at the middle of the part, averaged over runs.
    pub progress: f64,
    /// The mean undiscounted return of the part's episodes, summarized over runs. An episode belongs to the part that
    /// contains the episode's middle.
    pub episode_return: Summary,
    /// The success rate of the part's episodes, %, summarized over runs.
    pub success: Summary,
}

/// An episode, as in a line of `monitor.csv`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct MonitorEpisode {
    episode_return: f64,
    /// Length in steps.
    length: f64,
    /// 1 for a success, otherwise 0.
    success: f64,
}

impl Curve {
    /// Computes the curve of a method from the episodes of its runs.
    fn from_runs(method: &Method, version: Version, runs: &[Vec<MonitorEpisode>]) -> Self {
        Self { method: method.clone(), version, lines: BudgetAxis::ALL.map(|axis| line(runs, axis)) }
    }

    /// Returns the points of the curve over the axis `by`, in order of progress.
    pub fn points(&self, by: BudgetAxis) -> &[CurvePoint] {
        &self.lines[by as usize].points
    }

    /// Returns the length of a whole training in episodes or steps, averaged over runs.
    pub fn total(&self, by: BudgetAxis) -> f64 {
        self.lines[by as usize].total
    }
}

/// Reads the curves of all selected trainings from their files `monitor.csv`. Skips trainings without this file.
///
/// # Errors
/// [`FolderError`] if a file exists but cannot be read.
pub fn read_curves(
    selections: &[MethodResults<'_>],
    folder: &ExperimentFolder,
) -> Result<Vec<EnvironmentCurves>, FolderError> {
    let mut all = Vec::new();
    for of_environment in selections.chunk_by(|a, b| a.environment == b.environment) {
        let mut curves = Vec::new();
        for selection in of_environment {
            for version in Version::KNOWN {
                let runs = read_runs(selection, version, folder)?;
                if !runs.is_empty() {
                    curves.push(Curve::from_runs(&selection.method, version, &runs));
                }
            }
        }
        all.push(EnvironmentCurves { environment: of_environment[0].environment.to_owned(), curves });
    }
    Ok(all)
}

/// Returns the training episodes of each run. Skips runs without episodes.
fn read_runs(
    selection: &MethodResults<'_>,
    version: Version,
    folder: &ExperimentFolder,
) -> Result<Vec<Vec<MonitorEpisode>>, FolderError> {
    let mut runs = Vec::new();
    for selected in selection.runs.values().filter_map(|run| run.cell_trained_on(TrainedOn::Version(version))) {
        let episodes = read_monitor(&folder.cell(&selected.cell.id).training().join("monitor.csv"))?;
        if !episodes.is_empty() {
            runs.push(episodes);
        }
    }
    Ok(runs)
}

/// Reads the episodes in the order in which they ended. Returns an empty list if there is no file.
fn read_monitor(path: &Path) -> Result<Vec<MonitorEpisode>, FolderError> {
    let Some(content) = read_if_exists(path)? else { return Ok(Vec::new()) };
    let damaged = |error: AnyError| FolderError::Damaged { path: path.to_owned(), reason: error.to_string() };
    parse_monitor(&content).map_err(damaged)
}

/// Parses the columns `r`, `l` and `success` of a `monitor.csv`.
fn parse_monitor(content: &[u8]) -> Result<Vec<MonitorEpisode>, AnyError> {
    // The last line may be incomplete if the training is still running or was killed.
    let whole = content.iter().rposition(|&byte| byte == b'\n').map_or(0, |end| end + 1);
    if whole == 0 {
        return Ok(Vec::new()); // even the header is incomplete
    }
    let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).from_reader(&content[..whole]);
    let names = reader.headers()?.clone();
    let place = |name: &str| names.iter().position(|known| known == name).ok_or_else(|| format!("no column {name}"));
    let places = [place("r")?, place("l")?, place("success")?];
    let (mut line, mut episodes) = (csv::StringRecord::new(), Vec::new());
    while reader.read_record(&mut line)? {
        let number = |place: usize| {
            let text = line.get(place).unwrap_or_default();
            let place = || line.position().map_or(0, csv::Position::line);
            text.parse::<f64>().map_err(|error| format!("`{text}` in line {}: {error}", place()))
        };
        let [episode_return, length, success] = places;
        let (episode_return, length, success) = (number(episode_return)?, number(length)?, number(success)?);
        episodes.push(MonitorEpisode { episode_return, length, success });
    }
    Ok(episodes)
}

/// Computes a curve: divides each run into equal parts along the axis `axis`, and averages each part over runs.
/// Parts are fractions of a run's own length, because runs end a few episodes after their budget and so differ in
/// length. A part that contains no episode's middle has no point.
fn line(runs: &[Vec<MonitorEpisode>], axis: BudgetAxis) -> AxisCurve {
    let shortest = runs.iter().map(Vec::len).min().unwrap_or_default();
    let count = (shortest / MIN_EPISODES_PER_POINT).clamp(usize::from(shortest > 0), MAX_POINTS);
    let totals: Vec<f64> = runs.iter().map(|run| run.iter().map(|episode| axis.weight(episode)).sum()).collect();
    let total = Summary::from_values(&totals).map_or(0.0, |total| total.mean);
    let parts: Vec<Vec<&[MonitorEpisode]>> =
        runs.iter().zip(&totals).map(|(run, total)| split(run, count, *total, axis)).collect();
    let point = |part: usize| {
        let over_runs = |number: fn(&MonitorEpisode) -> f64| {
            let there = parts.iter().map(|run| run[part]).filter(|part| !part.is_empty());
            Summary::from_values(&there.map(|part| mean(part.iter().map(number))).collect::<Vec<_>>())
        };
        Some(CurvePoint {
            progress: (part as f64 + 0.5) / count as f64 * total,
            episode_return: over_runs(|episode| episode.episode_return)?,
            success: over_runs(|episode| 100.0 * episode.success)?,
        })
    };
    AxisCurve { total, points: (0..count).filter_map(point).collect() }
}

/// Divides the episodes of `run` into `count` parts of equal length along the axis `axis`. `total` is the length of
/// the run on this axis. An episode belongs to the part that contains its middle.
fn split(run: &[MonitorEpisode], count: usize, total: f64, axis: BudgetAxis) -> Vec<&[MonitorEpisode]> {
    let mut before = 0.0;
    let mut part_of = Vec::with_capacity(run.len());
    for episode in run {
        let own = axis.weight(episode);
        part_of.push(((before + own / 2.0) / total * count as f64) as usize);
        before += own;
    }
    let begin = |part: usize| part_of.partition_point(|of| *of < part);
    (0..count).map(|part| &run[begin(part)..if part + 1 == count { run.len() } else { begin(part + 1) }]).collect()
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;
    use crate::plan::Plan;

    const PLAN: &str = "environments = ['CartPole']\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

    fn episodes(count: usize, of: impl Fn(usize) -> (f64, f64, f64)) -> Vec<MonitorEpisode> {
        let episode = |(episode_return, length, success)| MonitorEpisode { episode_return, length, success };
        (0..count).map(|i| episode(of(i))).collect()
    }

    #[test]
    fn a_point_is_a_mean_over_a_part_of_each_run() {
        // Both runs have two parts: 40 episodes are divided into 20 and 20, and 43 into 21 and 22.
        let first = episodes(40, |i| if i < 20 { (1.0, 1.0, 0.0) } else { (3.0, 1.0, 1.0) });
        let second = episodes(43, |i| if i < 21 { (5.0, 1.0, 1.0) } else { (5.0, 1.0, 0.0) });
        let point = |progress: f64, mean: f64, std: f64| CurvePoint {
            progress,
            episode_return: Summary { mean, std: Some(std), runs: 2 },
            success: Summary { mean: 50.0, std: Some(50.0), runs: 2 },
        };
        let expected = [point(10.375, 3.0, 2.0), point(31.125, 4.0, 1.0)];
        assert_eq!(line(&[first, second], BudgetAxis::Episodes), AxisCurve { total: 41.5, points: expected.into() });
    }

    #[test]
    fn by_steps_long_episodes_weigh_more() {
        // 30 episodes of 1 step fail, then 10 episodes of 27 steps succeed. The run has 300 steps, and the fifth long
        // episode has its middle at 30 + 4.5 · 27 = 151.5, in the second half.
        let run = episodes(40, |i| if i < 30 { (0.0, 1.0, 0.0) } else { (1.0, 27.0, 1.0) });
        let rates =
            |by| line(std::slice::from_ref(&run), by).points.iter().map(|point| point.success.mean).collect::<Vec<_>>();
        assert_eq!(rates(BudgetAxis::Episodes), [0.0, 50.0]);
        assert_eq!(rates(BudgetAxis::Steps), [100.0 * 4.0 / 34.0, 100.0]);
        assert_eq!(line(&[run], BudgetAxis::Steps).total, 300.0);
    }

    #[test]
    fn a_part_without_an_episode_has_no_point() {
        // The last of 60 episodes has most of the steps. Its middle is in the second of three parts.
        let run = episodes(60, |i| (0.0, if i < 59 { 1.0 } else { 121.0 }, 0.0));
        let method = Plan::parse("test", PLAN.into()).unwrap().methods().remove(0);
        let curve = Curve::from_runs(&method, Version::D, &[run]);
        let places = |by| curve.points(by).iter().map(|point| point.progress).collect::<Vec<_>>();
        assert_eq!(places(BudgetAxis::Steps), [30.0, 90.0]);
    }

    #[rstest]
    #[case(0, 0)]
    #[case(3, 1)]
    #[case(39, 1)]
    #[case(400, 20)]
    #[case(15_008, 100)]
    fn curves_have_a_hundred_points_at_most_and_one_at_least(#[case] count: usize, #[case] expected: usize) {
        for by in BudgetAxis::ALL {
            assert_eq!(line(&[episodes(count, |_| (0.0, 3.0, 0.0))], by).points.len(), expected);
        }
    }

    #[test]
    fn without_runs_there_is_no_curve() {
        assert_eq!(line(&[], BudgetAxis::Steps), AxisCurve::default());
    }

    #[test]
    fn a_monitor_file_is_read_and_a_damaged_one_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("monitor.csv");
        assert!(read_monitor(&path).unwrap().is_empty());
        std::fs::write(&path, "#{\"t_start\": 1}\nr,l,t,success,terminated,mass\n-1.5,9,0.1,1,0,2\n2,8,0.1,0,1,2\n")
            .unwrap();
        let file = std::fs::File::options().append(true).open(&path).unwrap();
        std::io::Write::write_all(&mut &file, b"-0.5,1").unwrap(); // a line that is being written
        let expected = episodes(2, |i| [(-1.5, 9.0, 1.0), (2.0, 8.0, 0.0)][i]);
        assert_eq!(read_monitor(&path).unwrap(), expected);
        for (damaged, reason) in [("r,l,success\n1,2,x\n", "`x` in line 2"), ("r,success\n1,1\n", "no column l")] {
            std::fs::write(&path, damaged).unwrap();
            let error = read_monitor(&path).unwrap_err().to_string();
            assert!(error.contains("monitor.csv is not understood") && error.contains(reason), "{error}");
        }
    }
}
