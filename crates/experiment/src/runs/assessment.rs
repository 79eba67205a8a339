//! The status of a saved assessment: the recorded tests of policies that were trained elsewhere.

use std::path::{Path, PathBuf};

use perturb_files::AnyError;
use perturb_records::statistics::mean;
use perturb_records::{ExternalEvaluation, TestResult};

use super::RunSummary;

/// A saved assessment, as read from its folder.
#[derive(Clone, Debug)]
pub struct AssessmentStatus {
    /// The folder of the assessment.
    pub path: PathBuf,
    /// The environment of all its tests.
    pub environment: String,
    /// The agent's name, e.g. "PPO".
    pub agent: String,
    /// The results of the tests of all policies, in the order in which they were recorded.
    pub results: Vec<TestResult>,
}

impl AssessmentStatus {
    /// Reads the assessment in `path`.
    ///
    /// # Errors
    /// An error if the files are damaged or do not belong together.
    pub fn read(path: &Path) -> Result<Self, AnyError> {
        let evaluation = ExternalEvaluation::read(path)?;
        let results = evaluation.policies().iter().flat_map(|policy| {
            policy.records.about.tests.iter().filter_map(|test| policy.test(&test.set.name).cloned())
        });
        Ok(Self {
            path: path.to_owned(),
            environment: evaluation.environment().to_owned(),
            results: results.collect(),
            agent: evaluation.agent,
        })
    }

    /// Returns the summary of the assessment for a list of runs.
    pub fn summary(&self) -> RunSummary {
        let episodes = self.results.iter().map(|test| test.episodes).sum();
        RunSummary {
            path: self.path.clone(),
            what: format!("{} {}", self.environment, self.agent),
            done: episodes,
            budget: episodes,
            unit: "episodes",
            success_percent: Some(mean(self.results.iter().map(|test| test.success_percent))),
            state: "assessed",
        }
    }
}
