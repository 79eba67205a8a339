//! The list of all runs (trainings, experiments and assessments) below the served folder.

use perturb_experiment::runs::{RunFolder, RunKind, RunSummary, places};
use perturb_files::FileError;

use crate::assessment::LiveAssessment;
use crate::experiment::LiveExperiment;
use crate::paths::{RelativePath, Root};
use crate::pictures::{Pictures, scan_folder};
use crate::runs::Runs;
use crate::training::LiveTraining;

/// Maximum number of folders that are searched for runs.
pub(crate) const MAX_FOLDERS: usize = 10_000;
/// Maximum number of listed runs.
pub(crate) const MAX_ROWS: usize = 500;
/// Maximum number of shown pictures from folders that are not runs.
const MAX_PICTURES: usize = 24;

/// The list of all runs (trainings, experiments and assessments) below the served folder.
#[derive(Debug)]
pub(crate) struct Index {
    /// At most [`MAX_ROWS`] runs. Running ones come first, and the others follow by the time of their last change,
    /// latest first.
    pub(crate) runs: Vec<Row>,
    /// Number of runs that are left out because of the limit.
    pub(crate) more_runs: usize,
    /// Symbolic links to folders outside of the served folder. They are not followed.
    pub(crate) links_out: Vec<RelativePath>,
    /// Whether there are more folders than were searched.
    pub(crate) has_more_folders: bool,
    /// Pictures from folders that are not runs.
    pub(crate) pictures: Pictures,
}

/// A run in the list.
#[derive(Debug)]
pub(crate) struct Row {
    pub(crate) relative: RelativePath,
    pub(crate) kind: RunKind,
    pub(crate) summary: RunSummary,
    /// Time of the last change, in seconds since 1970.
    pub(crate) changed: i64,
    /// Remaining time in seconds; `None` if it is not known.
    pub(crate) remaining_seconds: Option<f64>,
}

impl Index {
    pub(crate) fn scan(root: &Root, runs: &Runs) -> Result<Self, FileError> {
        Self::scan_within(root, runs, MAX_FOLDERS, MAX_ROWS)
    }

    fn scan_within(root: &Root, known: &Runs, max_folders: usize, max_rows: usize) -> Result<Self, FileError> {
        let found = places(root.path(), max_folders, Some(root.path()))?;
        // `relative` returns `None` for hidden folders, which are not served.
        let rows =
            found.runs.iter().filter_map(|place| Some(Row::new(root.relative(&place.path)?, place, root, known)));
        let mut runs: Vec<Row> = rows.collect();
        runs.sort_by_key(|row| (row.summary.state != "in work", std::cmp::Reverse(row.changed)));
        let more_runs = runs.len().saturating_sub(max_rows);
        runs.truncate(max_rows);
        let mut pictures = Pictures::default();
        for path in &found.others {
            if let Some(relative) = root.relative(path) {
                let max_shown = MAX_PICTURES - pictures.shown.len();
                pictures.add(scan_folder(&relative, path, max_shown));
            }
        }
        let links_out = found.links_out.iter().filter_map(|link| root.relative(link)).collect();
        Ok(Self { runs, more_runs, links_out, has_more_folders: found.more, pictures })
    }
}

impl Row {
    fn new(relative: RelativePath, RunFolder { path, kind }: &RunFolder, root: &Root, runs: &Runs) -> Self {
        let (summary, changed, remaining_seconds) = match kind {
            RunKind::Training => runs.trainings.with(
                path,
                || LiveTraining::new(root.path(), path),
                |training| {
                    training.refresh();
                    if training.status().is_ok_and(|status| status.state == "in work") {
                        // The remaining time is estimated from the log of episodes, which is read here.
                        training.refresh_details();
                    }
                    (training.summary(), training.changed(), training.remaining_seconds())
                },
            ),
            RunKind::Experiment => runs.experiments.with(
                path,
                || LiveExperiment::new(root.path(), path),
                |experiment| {
                    experiment.refresh();
                    (experiment.summary(), experiment.changed(), None)
                },
            ),
            RunKind::Assessment => runs.assessments.with(
                path,
                || LiveAssessment::new(root.path(), path),
                |assessment| {
                    assessment.refresh();
                    (assessment.summary(), assessment.changed(), None)
                },
            ),
        };
        Self { relative, kind: *kind, summary, changed, remaining_seconds }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_and_pictures_beyond_the_limits_are_counted() {
        let directory = tempfile::tempdir().unwrap();
        let write = |name: &str| {
            let path = directory.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        };
        (0..3).for_each(|run| write(&format!("run-{run}/config.toml")));
        (0..20).for_each(|picture| write(&format!("a/{picture}.png")));
        (0..20).for_each(|picture| write(&format!("b/{picture}.svg")));
        (0..20).for_each(|picture| write(&format!("b/{picture}.png")));
        let root = Root::open(directory.path()).unwrap();
        let index = Index::scan_within(&root, &Runs::default(), 100, 2).unwrap();
        assert_eq!((index.runs.len(), index.more_runs, index.has_more_folders), (2, 1, false));
        assert_eq!((index.pictures.shown.len(), index.pictures.more), (MAX_PICTURES, 16), "none counts twice");
        assert!(Index::scan_within(&root, &Runs::default(), 3, 2).unwrap().has_more_folders);
        std::fs::remove_dir_all(directory.path()).unwrap();
        assert!(Index::scan(&root, &Runs::default()).unwrap_err().to_string().starts_with("cannot list "));
    }
}
