//! The Python class of an assessment, which reads and writes folders of recorded tests, and the report page.

use std::path::PathBuf;

use perturb_records::{ExternalEvaluation, ExternalEvaluationError, ExternalPolicy, PolicyMetadata, RecordsError};
use perturb_report::{ReportError, ReportInputs};
use pyo3::exceptions::PyOSError;
use pyo3::prelude::*;

use crate::failure::{INVALID, failure};
use crate::records::PythonRecords;

/// The fields of [`PolicyMetadata`] for Python: training version, training steps, seed of the tests, episodes of each
/// test, what the policy observed (`state` or `parameters`), and whether the policy was deterministic.
type PolicyMetadataTuple = (Option<String>, Option<u64>, u64, u64, String, Option<bool>);

/// The recorded tests of one policy, or of several related policies, in one environment.
#[pyclass(frozen, module = "perturb._native")]
pub struct Assessment(ExternalEvaluation);

#[pymethods]
impl Assessment {
    #[new]
    fn new(agent: String, policies: Vec<(PolicyMetadataTuple, PyRef<'_, PythonRecords>)>) -> PyResult<Self> {
        let policy = |(known, records): (PolicyMetadataTuple, PyRef<'_, PythonRecords>)| {
            Ok(ExternalPolicy::new(policy_metadata(known)?, records.0.clone()))
        };
        let policies = policies.into_iter().map(policy).collect::<PyResult<_>>()?;
        ExternalEvaluation::new(String::new(), agent, policies).map(Self).map_err(refused)
    }

    /// Reads an assessment from the folder that [`write`](Self::write) wrote.
    #[staticmethod]
    fn read(path: PathBuf) -> PyResult<Self> {
        ExternalEvaluation::read(&path).map(Self).map_err(refused)
    }

    /// Writes the assessment into a folder. `overwrite` permits it to replace an assessment in the folder.
    fn write(&self, path: PathBuf, overwrite: bool) -> PyResult<()> {
        self.0.write(&path, overwrite).map_err(refused)
    }

    /// The name in reports that the policies share.
    #[getter]
    fn agent(&self) -> &str {
        &self.0.agent
    }

    /// Returns the metadata and the records of each policy.
    fn policies(&self) -> Vec<(PolicyMetadataTuple, PythonRecords)> {
        let of = |policy: &ExternalPolicy| {
            let PolicyMetadata { trained_on, timesteps, seed, episodes, observe, deterministic } = policy.known.clone();
            let trained_on = trained_on.map(|version| version.to_string());
            let known = (trained_on, timesteps, seed, episodes, observe.to_string(), deterministic);
            (known, PythonRecords(policy.records.clone()))
        };
        self.0.policies().iter().map(of).collect()
    }
}

/// Returns the report page, as HTML, of `assessments` and of the experiments and assessments in the folders `beside`.
#[pyfunction]
pub fn report_page(py: Python<'_>, assessments: Vec<PyRef<'_, Assessment>>, beside: Vec<PathBuf>) -> PyResult<String> {
    let assessed = assessments.iter().map(|one| one.0.clone()).collect();
    py.detach(|| {
        let mut sources = ReportInputs { assessed, ..ReportInputs::default() };
        beside.iter().try_for_each(|path| sources.add(path))?;
        sources.read(|whole| whole.page().map_err(ReportError::from))
    })
    .map_err(|error| match error {
        ReportError::ExternalEvaluation(error) => refused(error),
        error => failure(INVALID, 0, error.to_string()),
    })
}

fn policy_metadata(
    (trained_on, timesteps, seed, episodes, observe, deterministic): PolicyMetadataTuple,
) -> PyResult<PolicyMetadata> {
    let invalid = |error: String| failure(INVALID, 0, error);
    let trained_on = trained_on.map(|version| version.parse()).transpose();
    let trained_on = trained_on.map_err(|error: perturb_protocol::UnknownVersion| invalid(error.to_string()))?;
    let observe = serde_json::from_value(observe.into()).map_err(|error| invalid(error.to_string()))?;
    Ok(PolicyMetadata { trained_on, timesteps, seed, episodes, observe, deterministic })
}

fn refused(error: ExternalEvaluationError) -> PyErr {
    match error {
        ExternalEvaluationError::File(error) | ExternalEvaluationError::Records(RecordsError::File(error)) => {
            PyOSError::new_err(error.to_string())
        }
        error => failure(INVALID, 0, error.to_string()),
    }
}
