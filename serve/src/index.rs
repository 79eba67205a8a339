//! What is below the folder.

use perturb_study::files::FileError;
use perturb_study::runs::{Kind, Place, RunSummary, places};

use crate::pages::pictures::{Picture, in_folder};
use crate::paths::{Relative, Root};
use crate::watch::Views;

/// At most so many folders are looked at.
pub(crate) const MOST_FOLDERS: usize = 10_000;
/// At most so many pictures that lie beside runs are shown.
const MOST_PICTURES: usize = 24;

/// All runs.
#[derive(Debug)]
pub(crate) struct Index {
    /// Those in work first, then those that changed last.
    pub(crate) runs: Vec<Row>,
    /// Whether there are more folders than were looked at.
    pub(crate) more: bool,
    /// In folders that are no runs.
    pub(crate) pictures: Vec<Picture>,
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
    pub(crate) fn look(root: &Root, views: &mut Views) -> Result<Self, FileError> {
        let found = places(root.path(), MOST_FOLDERS)?;
        // A hidden folder is no part of what is served.
        let named = |place: &Place| Some((root.relative(&place.path)?, place.kind, place.path.clone()));
        let mut runs: Vec<Row> = found
            .runs
            .iter()
            .filter_map(named)
            .map(|(relative, kind, path)| {
                let (summary, changed, left) = match kind {
                    Kind::Training => {
                        let training = views.training(&path);
                        training.look();
                        if training.status().is_ok_and(|status| status.state == "in work") {
                            training.follow(); // how long it may take follows from its log
                        }
                        (training.summary(), training.changed(), training.left())
                    }
                    Kind::Experiment => {
                        let experiment = views.experiment(&path);
                        experiment.look();
                        (experiment.summary(), experiment.changed(), None)
                    }
                };
                Row { relative, kind, summary, changed, left }
            })
            .collect();
        runs.sort_by_key(|row| (row.summary.state != "in work", std::cmp::Reverse(row.changed)));
        let folders = found.others.iter().filter_map(|path| Some((root.relative(path)?, path)));
        let pictures = folders.flat_map(|(relative, path)| in_folder(&relative, path)).take(MOST_PICTURES).collect();
        Ok(Self { runs, more: found.more, pictures })
    }
}
