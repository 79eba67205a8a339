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
    /// The tests of all policies, in the order in which they were recorded.
    pub tests: Vec<AssessedTest>,
}

/// A test of a policy.
#[derive(Clone, Debug)]
pub struct AssessedTest {
    /// The policy's training distribution, or "unknown".
    pub trained_on: String,
    /// The version or set of the test.
    pub tested_on: String,
    /// Success rate, mean return and mean length in the test.
    pub result: TestResult,
}

impl AssessmentStatus {
    /// Reads the assessment in `path`.
    ///
    /// # Errors
    /// An error if the files are damaged or do not belong together.
    pub fn read(path: &Path) -> Result<Self, AnyError> {
        let evaluation = ExternalEvaluation::read(path)?;
        let tests = evaluation.policies().iter().flat_map(|policy| {
            let names = policy.records.about.tests.iter().map(|test| &test.set.name);
            names.filter_map(|name| {
                let (trained_on, tested_on) = (policy.trained_on().to_string(), name.clone());
                Some(AssessedTest { trained_on, tested_on, result: policy.test(name)?.clone() })
            })
        });
        Ok(Self {
            path: path.to_owned(),
            environment: evaluation.environment().to_owned(),
            tests: tests.collect(),
            agent: evaluation.agent,
        })
    }

    /// Returns the summary of the assessment for a list of runs.
    pub fn summary(&self) -> RunSummary {
        let episodes = self.tests.iter().map(|test| test.result.episodes).sum();
        RunSummary {
            path: self.path.clone(),
            what: format!("{} {}", self.environment, self.agent),
            done: episodes,
            budget: episodes,
            unit: "episodes",
            success_percent: Some(mean(self.tests.iter().map(|test| test.result.success_percent))),
            state: "assessed",
        }
    }
}
