//! What is below the folder.

use perturb_study::files::FileError;
use perturb_study::runs::{Kind, Place, RunSummary, places};

use crate::experiment::Experiment;
use crate::pages::pictures::{Pictures, in_folder};
use crate::paths::{Relative, Root};
use crate::training::Training;
use crate::watch::Views;

/// At most so many folders are looked at.
pub(crate) const MOST_FOLDERS: usize = 10_000;
/// At most so many runs are listed.
pub(crate) const MOST_ROWS: usize = 500;
/// At most so many pictures that lie beside runs are shown.
const MOST_PICTURES: usize = 24;

/// All runs.
#[derive(Debug)]
pub(crate) struct Index {
    /// Those in work first, then those that changed last; at most [`MOST_ROWS`].
    pub(crate) runs: Vec<Row>,
    /// How many runs there are beside these.
    pub(crate) more_runs: usize,
    /// Whether there are more folders than were looked at.
    pub(crate) more: bool,
    /// In folders that are no runs.
    pub(crate) pictures: Pictures,
}

/// A run.
#[derive(Debug)]
pub(crate) struct Row {
    pub(crate) relative: Relative,
    pub(crate) kind: Kind,
    pub(crate) summary: RunSummary,
    /// s since 1970.
    pub(crate) changed: i64,
    /// s, if that is known.
    pub(crate) left: Option<f64>,
}

impl Index {
    pub(crate) fn look(root: &Root, views: &Views) -> Result<Self, FileError> {
        Self::of(root, views, MOST_FOLDERS, MOST_ROWS)
    }

    /// Of so many folders at most, with so many rows.
    fn of(root: &Root, views: &Views, most_folders: usize, most_rows: usize) -> Result<Self, FileError> {
        let found = places(root.path(), most_folders)?;
        // A hidden folder is no part of what is served.
        let rows = found.runs.iter().filter_map(|place| Some(Row::of(root.relative(&place.path)?, place, root, views)));
        let mut runs: Vec<Row> = rows.collect();
        runs.sort_by_key(|row| (row.summary.state != "in work", std::cmp::Reverse(row.changed)));
        let more_runs = runs.len().saturating_sub(most_rows);
        runs.truncate(most_rows);
        let mut pictures = Pictures::default();
        for path in &found.others {
            if let Some(relative) = root.relative(path) {
                let room = MOST_PICTURES - pictures.shown.len();
                pictures.add(in_folder(&relative, path, room));
            }
        }
        Ok(Self { runs, more_runs, more: found.more, pictures })
    }
}

impl Row {
    fn of(relative: Relative, Place { path, kind }: &Place, root: &Root, views: &Views) -> Self {
        let (summary, changed, left) = match kind {
            Kind::Training => views.trainings.with(
                path,
                || Training::of(root.path(), path),
                |training| {
                    training.look();
                    if training.status().is_ok_and(|status| status.state == "in work") {
                        training.follow(); // how long it may take follows from its log
                    }
                    (training.summary(), training.changed(), training.left())
                },
            ),
            Kind::Experiment => views.experiments.with(
                path,
                || Experiment::of(root.path(), path),
                |experiment| {
                    experiment.look();
                    (experiment.summary(), experiment.changed(), None)
                },
            ),
        };
        Self { relative, kind: *kind, summary, changed, left }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_many_folders_runs_and_pictures_some_are_shown_and_the_others_counted() {
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
        let index = Index::of(&root, &Views::default(), 100, 2).unwrap();
        assert_eq!((index.runs.len(), index.more_runs, index.more), (2, 1, false));
        assert_eq!((index.pictures.shown.len(), index.pictures.more), (MOST_PICTURES, 16), "none counts twice");
        assert!(Index::of(&root, &Views::default(), 3, 2).unwrap().more);
        std::fs::remove_dir_all(directory.path()).unwrap();
        assert!(Index::look(&root, &Views::default()).unwrap_err().to_string().starts_with("cannot list "));
    }
}
