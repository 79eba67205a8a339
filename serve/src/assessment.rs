//! The state of a saved assessment: recorded tests of one or several policies, which the Python package wrote. The
//! state is read again when its files change.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};

use perturb_experiment::runs::{AssessmentStatus, LEADS_OUT, RunSummary};
use perturb_files::{Stamp, escapes_root, list};
use perturb_text::shortened;

/// The state of an assessment at the last refresh.
#[derive(Debug)]
pub(crate) struct LiveAssessment {
    /// The served folder. Symbolic links that lead out of it are not followed.
    root: PathBuf,
    path: PathBuf,
    /// The stamps (sizes and times) of all files in the folder.
    stamps: Vec<Option<Stamp>>,
    status: Result<AssessmentStatus, String>,
}

impl LiveAssessment {
    /// Makes an empty state of the assessment in the folder `path`. [`refresh`](Self::refresh) fills it. Files outside
    /// of `root` are not read.
    pub(crate) fn new(root: &Path, path: &Path) -> Self {
        let status = Err("it has not been read yet".into());
        Self { root: root.to_owned(), path: path.to_owned(), stamps: Vec::new(), status }
    }

    /// Reads the assessment again if a file in its folder has changed.
    pub(crate) fn refresh(&mut self) {
        let files = list(&self.path).unwrap_or_default();
        let names = files.iter().filter_map(|path| path.file_name());
        if let Some(name) = names.into_iter().find(|name| escapes_root(&self.root, &self.path, name)) {
            let status = Err(format!("{} is {LEADS_OUT}", Path::new(name).display()));
            *self = Self { status, ..Self::new(&self.root, &self.path) };
            return;
        }
        let stamps: Vec<_> = files.iter().map(|path| Stamp::read(path)).collect();
        if stamps != self.stamps {
            self.status = AssessmentStatus::read(&self.path).map_err(|error| shortened(error.to_string()));
            self.stamps = stamps;
        }
    }

    /// Returns the status, or the reason why it could not be read.
    pub(crate) fn status(&self) -> Result<&AssessmentStatus, &str> {
        self.status.as_ref().map_err(String::as_str)
    }

    /// Returns a hash of the files' sizes and times. It changes when the report must be built again.
    pub(crate) fn report_fingerprint(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        self.stamps.hash(&mut hasher);
        hasher.finish()
    }

    /// Returns the folder from which the report is built, or the reason why no report can be built.
    pub(crate) fn report_folder(&self) -> Result<PathBuf, String> {
        self.status().map_err(|reason| format!("this assessment is not understood: {reason}"))?;
        Ok(self.path.clone())
    }

    pub(crate) fn summary(&self) -> RunSummary {
        self.status.as_ref().map_or_else(|_| RunSummary::not_understood(&self.path), AssessmentStatus::summary)
    }

    /// Returns the time of the last change, in seconds since 1970.
    pub(crate) fn changed(&self) -> i64 {
        self.stamps.iter().flatten().map(Stamp::seconds).max().unwrap_or_default()
    }
}
