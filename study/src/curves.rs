//! Training curves: the selected trainings' returns and successes over their episodes, averaged over runs.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::folder::{Folder, FolderError, io};
use super::plan::Method;
use super::selection::{Group, Results};
use super::statistics::Summary;
use crate::Version;

/// A point is a mean over at least so many episodes of each run …
const LEAST_EPISODES: usize = 20;
/// … and a curve has at most so many points.
const MOST_POINTS: usize = 100;

/// The curves of an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentCurves {
    /// The environment.
    pub environment: String,
    /// For each method and training version that has a finished training.
    pub curves: Vec<Curve>,
}

/// A method's curve on a training version.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// What learned.
    pub method: Method,
    /// Where it was trained.
    pub version: Version,
    /// In order of episodes.
    pub points: Vec<Point>,
}

/// Part of a training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Episodes that had ended in the middle of it.
    pub episodes: f64,
    /// The mean undiscounted return, over runs.
    pub episode_return: Summary,
    /// The success rate, %, over runs.
    pub success: Summary,
}

/// A line of `monitor.csv`.
#[derive(Deserialize)]
struct Line {
    r: f64,
    success: u8,
}

/// Reads the curves of all selected trainings; those whose `monitor.csv` is gone are left out.
///
/// # Errors
/// [`FolderError`] if a file is there that cannot be read.
pub fn read_curves(
    results: &Results<'_>,
    groups: &[Group],
    folder: &Folder,
) -> Result<Vec<EnvironmentCurves>, FolderError> {
    let mut all: Vec<EnvironmentCurves> = Vec::new();
    for name in results.plan.environments() {
        let mut curves = Vec::new();
        for group in groups.iter().filter(|group| group.environment == name) {
            for version in Version::ALL {
                let mut runs = Vec::new();
                for selected in group.runs.values() {
                    let Some(index) = selected.cells[version as usize] else { continue };
                    let cell = &results.plan.cells[index];
                    let path = folder.cell(&cell.id).training().join("monitor.csv");
                    let episodes = read_monitor(&path)?;
                    if !episodes.is_empty() {
                        runs.push((cell.config.common.episodes, episodes));
                    }
                }
                let points = points(&runs);
                if !points.is_empty() {
                    curves.push(Curve { method: group.method.clone(), version, points });
                }
            }
        }
        all.push(EnvironmentCurves { environment: name.to_owned(), curves });
    }
    Ok(all)
}

/// Return and success (0 or 1) of each episode, in the order in which they ended; none without a file.
fn read_monitor(path: &Path) -> Result<Vec<[f64; 2]>, FolderError> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let damaged = |error: csv::Error| FolderError::Damaged { path: PathBuf::from(path), reason: error.to_string() };
    let file = std::fs::File::open(path).map_err(io("read", path))?;
    csv::ReaderBuilder::new()
        .comment(Some(b'#'))
        .from_reader(file)
        .deserialize()
        .map(|line| line.map(|Line { r, success }| [r, f64::from(success)]).map_err(damaged))
        .collect()
}

/// Parts each run evenly, and averages each part over runs. `runs` are budgets with episodes. What is averaged are
/// equal shares of a training, since a training ends some episodes after its budget.
fn points(runs: &[(u64, Vec<[f64; 2]>)]) -> Vec<Point> {
    let shortest = runs.iter().map(|(_, episodes)| episodes.len()).min().unwrap_or_default();
    let count = (shortest / LEAST_EPISODES).clamp(usize::from(shortest > 0), MOST_POINTS);
    let budget = runs.iter().map(|(budget, _)| *budget).max().unwrap_or_default() as f64;
    let part_of = |episodes: &[[f64; 2]], part: usize| -> [f64; 2] {
        let part = &episodes[part * episodes.len() / count..(part + 1) * episodes.len() / count];
        [0, 1].map(|column| part.iter().map(|episode| episode[column]).sum::<f64>() / part.len() as f64)
    };
    let point = |part: usize| {
        let means: Vec<[f64; 2]> = runs.iter().map(|(_, episodes)| part_of(episodes, part)).collect();
        let summary =
            |column: usize, scale: f64| Summary::of(&means.iter().map(|mean| scale * mean[column]).collect::<Vec<_>>());
        let episodes = (part as f64 + 0.5) / count as f64 * budget;
        Some(Point { episodes, episode_return: summary(0, 1.0)?, success: summary(1, 100.0)? })
    };
    (0..count).filter_map(point).collect()
}

/// The curves as CSV.
///
/// # Errors
/// [`csv::Error`], which writing to memory does not give.
pub fn curves_csv(all: &[EnvironmentCurves]) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record([
        "environment",
        "algorithm",
        "architecture",
        "episodes_per_trial",
        "train",
        "runs",
        "episodes",
        "return_mean",
        "return_std",
        "success_mean",
        "success_std",
    ])?;
    for EnvironmentCurves { environment, curves } in all {
        for Curve { method, version, points } in curves {
            let trials = method.episodes_per_trial.map(|episodes| episodes.to_string()).unwrap_or_default();
            let (algorithm, architecture) = (&method.algorithm, &method.architecture);
            for Point { episodes, episode_return, success } in points {
                let numbers = [*episodes, episode_return.mean, episode_return.std, success.mean, success.std];
                let names =
                    [environment, algorithm, architecture, &trials, &version.to_string(), &success.runs.to_string()];
                let names = names.map(String::clone);
                writer.write_record(names.into_iter().chain(numbers.map(|number| number.to_string())))?;
            }
        }
    }
    writer.into_inner().map_err(|error| error.into_error().into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_is_a_mean_over_a_part_of_each_run() {
        // 40 and 43 episodes: two parts of 20 and 20, or 21 and 22.
        let first: Vec<[f64; 2]> = (0..40).map(|i| if i < 20 { [1.0, 0.0] } else { [3.0, 1.0] }).collect();
        let second: Vec<[f64; 2]> = (0..43).map(|i| if i < 21 { [5.0, 1.0] } else { [5.0, 0.0] }).collect();
        let points = points(&[(40, first), (40, second)]);
        assert_eq!(points.iter().map(|point| point.episodes).collect::<Vec<_>>(), [10.0, 30.0]);
        let returns: Vec<Summary> = points.iter().map(|point| point.episode_return).collect();
        assert_eq!(returns[0], Summary { mean: 3.0, std: 2.0, runs: 2 });
        assert_eq!(returns[1], Summary { mean: 4.0, std: 1.0, runs: 2 });
        let success: Vec<f64> = points.iter().map(|point| point.success.mean).collect();
        assert_eq!(success, [50.0, 50.0]);
    }

    #[test]
    fn curves_have_a_hundred_points_at_most_and_one_at_least() {
        let episodes = |count: usize| vec![(15_000, vec![[0.0, 0.0]; count])];
        assert_eq!([0, 3, 39, 400, 15_008].map(|count| points(&episodes(count)).len()), [0, 1, 1, 20, 100]);
        assert!(points(&[]).is_empty());
    }

    #[test]
    fn a_monitor_file_is_read_and_a_damaged_one_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("monitor.csv");
        assert!(read_monitor(&path).unwrap().is_empty());
        std::fs::write(&path, "#{\"t_start\": 1}\nr,l,t,success,terminated,mass\n-1.5,9,0.1,1,0,2\n2,9,0.1,0,1,2\n")
            .unwrap();
        assert_eq!(read_monitor(&path).unwrap(), [[-1.5, 1.0], [2.0, 0.0]]);
        std::fs::write(&path, "r,success\nx,1\n").unwrap();
        assert!(read_monitor(&path).unwrap_err().to_string().contains("monitor.csv is not understood"));
    }
}
