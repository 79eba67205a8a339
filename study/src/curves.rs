//! Training curves: the selected trainings' returns and successes over their episodes, averaged over runs.

use std::path::Path;

use serde::Deserialize;

use super::folder::{Folder, FolderError};
use super::plan::TrainedOn;
use super::selection::MethodResults;
use super::statistics::Summary;
use super::table::Table;
use crate::files::read_if_there;
use crate::{Method, Version, mean};

/// A point is a mean over at least so many episodes of each run …
const LEAST_EPISODES: usize = 20;
/// … and a curve has at most so many points.
const MOST_POINTS: usize = 100;

/// The curves of all methods in an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentCurves {
    /// Its name.
    pub environment: String,
    /// For each method and training version that has a finished training.
    pub curves: Vec<Curve>,
}

/// A method's curve on a training version.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// What was trained.
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
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
struct Episode {
    #[serde(rename = "r")]
    episode_return: f64,
    /// 0 or 1.
    success: u8,
}

/// Reads the curves of all selected trainings; those whose `monitor.csv` is gone are left out.
///
/// # Errors
/// [`FolderError`] if a file is there that cannot be read.
pub fn read_curves(selections: &[MethodResults<'_>], folder: &Folder) -> Result<Vec<EnvironmentCurves>, FolderError> {
    let mut all = Vec::new();
    for of_environment in selections.chunk_by(|a, b| a.environment == b.environment) {
        let mut curves = Vec::new();
        for selection in of_environment {
            for version in Version::ALL {
                let points = points(&read_runs(selection, version, folder)?);
                if !points.is_empty() {
                    curves.push(Curve { method: selection.method.clone(), version, points });
                }
            }
        }
        all.push(EnvironmentCurves { environment: of_environment[0].environment.to_owned(), curves });
    }
    Ok(all)
}

/// A training's budget and the episodes that it became.
type Run = (u64, Vec<Episode>);

fn read_runs(selection: &MethodResults<'_>, version: Version, folder: &Folder) -> Result<Vec<Run>, FolderError> {
    let mut runs = Vec::new();
    for selected in selection.runs.values().filter_map(|run| run.trained_on(TrainedOn::Version(version))) {
        let episodes = read_monitor(&folder.cell(&selected.cell.id).training().join("monitor.csv"))?;
        if !episodes.is_empty() {
            runs.push((selected.cell.config.common.episodes, episodes));
        }
    }
    Ok(runs)
}

/// The episodes in the order in which they ended; none without a file.
fn read_monitor(path: &Path) -> Result<Vec<Episode>, FolderError> {
    let Some(content) = read_if_there(path)? else { return Ok(Vec::new()) };
    let damaged = |error: csv::Error| FolderError::Damaged { path: path.to_owned(), reason: error.to_string() };
    let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).from_reader(&content[..]);
    reader.deserialize().collect::<Result<_, _>>().map_err(damaged)
}

/// Parts each run evenly, and averages each part over runs. What is averaged are equal shares of a training, since a
/// training ends some episodes after its budget.
fn points(runs: &[Run]) -> Vec<Point> {
    let shortest = runs.iter().map(|(_, episodes)| episodes.len()).min().unwrap_or_default();
    let count = (shortest / LEAST_EPISODES).clamp(usize::from(shortest > 0), MOST_POINTS);
    let budget = runs.iter().map(|(budget, _)| *budget).max().unwrap_or_default() as f64;
    let point = |part: usize| {
        let over_runs = |number: fn(&Episode) -> f64| {
            let of_run = |(_, episodes): &Run| {
                let part = &episodes[part * episodes.len() / count..(part + 1) * episodes.len() / count];
                mean(part.iter().map(number))
            };
            Summary::of(&runs.iter().map(of_run).collect::<Vec<_>>())
        };
        Some(Point {
            episodes: (part as f64 + 0.5) / count as f64 * budget,
            episode_return: over_runs(|episode| episode.episode_return)?,
            success: over_runs(|episode| 100.0 * f64::from(episode.success))?,
        })
    };
    (0..count).filter_map(point).collect()
}

/// A line for each point.
pub fn curves_table(all: &[EnvironmentCurves]) -> Table {
    let curves = all.iter().flat_map(|of| of.curves.iter().map(|curve| (&of.environment, curve)));
    let lines: Vec<_> = curves
        .flat_map(|(environment, curve)| curve.points.iter().map(move |point| (environment, curve, point)))
        .collect();
    Table::of("curves.csv", &lines)
        .text("environment", |(environment, ..)| environment)
        .method(|(_, curve, _)| &curve.method)
        .text("train", |(_, curve, _)| curve.version)
        .number("runs", |(.., point)| point.success.runs)
        .number("episodes", |(.., point)| point.episodes)
        .number("return_mean", |(.., point)| point.episode_return.mean)
        .number("return_std", |(.., point)| point.episode_return.std.unwrap_or_default())
        .number("success_mean", |(.., point)| point.success.mean)
        .number("success_std", |(.., point)| point.success.std.unwrap_or_default())
        .build()
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    fn episodes(count: usize, of: impl Fn(usize) -> (f64, u8)) -> Vec<Episode> {
        let episode = |(episode_return, success)| Episode { episode_return, success };
        (0..count).map(|i| episode(of(i))).collect()
    }

    #[test]
    fn a_point_is_a_mean_over_a_part_of_each_run() {
        // 40 and 43 episodes: two parts of 20 and 20, or 21 and 22.
        let first = episodes(40, |i| if i < 20 { (1.0, 0) } else { (3.0, 1) });
        let second = episodes(43, |i| if i < 21 { (5.0, 1) } else { (5.0, 0) });
        let point = |episodes: f64, mean: f64, std: f64| Point {
            episodes,
            episode_return: Summary { mean, std: Some(std), runs: 2 },
            success: Summary { mean: 50.0, std: Some(50.0), runs: 2 },
        };
        assert_eq!(points(&[(40, first), (40, second)]), [point(10.0, 3.0, 2.0), point(30.0, 4.0, 1.0)]);
    }

    #[rstest]
    #[case(0, 0)]
    #[case(3, 1)]
    #[case(39, 1)]
    #[case(400, 20)]
    #[case(15_008, 100)]
    fn curves_have_a_hundred_points_at_most_and_one_at_least(#[case] count: usize, #[case] expected: usize) {
        assert_eq!(points(&[(15_000, episodes(count, |_| (0.0, 0)))]).len(), expected);
    }

    #[test]
    fn without_runs_there_is_no_curve() {
        assert!(points(&[]).is_empty());
    }

    #[test]
    fn a_monitor_file_is_read_and_a_damaged_one_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("monitor.csv");
        assert!(read_monitor(&path).unwrap().is_empty());
        std::fs::write(&path, "#{\"t_start\": 1}\nr,l,t,success,terminated,mass\n-1.5,9,0.1,1,0,2\n2,9,0.1,0,1,2\n")
            .unwrap();
        let [won, lost] = [(-1.5, 1), (2.0, 0)].map(|(episode_return, success)| Episode { episode_return, success });
        assert_eq!(read_monitor(&path).unwrap(), [won, lost]);
        std::fs::write(&path, "r,success\nx,1\n").unwrap();
        assert!(read_monitor(&path).unwrap_err().to_string().contains("monitor.csv is not understood"));
    }
}
