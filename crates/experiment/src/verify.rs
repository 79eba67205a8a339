//! Checks that stored results agree with their recorded episodes.

use std::collections::BTreeMap;
use std::path::Path;

use perturb_records::{ParameterCheck, Records, RecordsError, TestResult};

use crate::folder::CellResult;

/// The reason why a result is not confirmed by its recorded episodes.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum VerifyError {
    /// Recorded episodes cannot be read.
    #[error(transparent)]
    Records(#[from] RecordsError),
    /// A test in the result differs from the numbers computed from its recorded episodes.
    #[error(
        "the result of cell {cell} does not match its recorded episodes: its test on {test} has {kept} in \
         result.json, but {recorded} in {file}; delete result.json to run the tests again",
        file = perturb_records::FILE
    )]
    Test {
        cell: String,
        /// The name of the tested set or version.
        test: String,
        kept: Box<TestResult>,
        /// The test computed from the recorded episodes.
        recorded: Box<TestResult>,
    },
    /// The result's comparison of requested and applied parameters differs from the comparison computed from the
    /// recorded episodes.
    #[error(
        "the result of cell {cell} does not match its recorded episodes: its check of requested and applied \
         parameters has a different outcome; delete result.json to run the tests again"
    )]
    ParameterCheck { cell: String },
}

/// Reads the recorded episodes in the folder `path`, and checks that they give the same `results` and, if present, the
/// same `agreement`. Both are parts of `result`. Returns the episodes, or `None` if none were recorded.
pub(crate) fn follows(
    result: &CellResult,
    path: &Path,
    results: &BTreeMap<String, TestResult>,
    agreement: Option<&ParameterCheck>,
) -> Result<Option<Records>, VerifyError> {
    let records = match Records::read(&path.join(perturb_records::FILE)) {
        Err(RecordsError::Missing { .. }) => return Ok(None),
        records => records?,
    };
    for (test, kept) in results {
        let recorded = records.result(test, None);
        if recorded != *kept {
            let (kept, recorded) = (Box::new(kept.clone()), Box::new(recorded));
            return Err(VerifyError::Test { cell: result.id.clone(), test: test.clone(), kept, recorded });
        }
    }
    if agreement.is_some_and(|agreement| *agreement != records.agreement()) {
        return Err(VerifyError::ParameterCheck { cell: result.id.clone() });
    }
    Ok(Some(records))
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;
    use crate::fixture;
    use crate::folder::{CellState, ExperimentFolder};
    use crate::plan::Plan;
    use perturb_protocol::Version;
    use perturb_records::{Ending, EpisodeRecord, RecordedTest, RecordsMetadata};

    const PLAN: &str = "environments = ['CartPole']\nversions = ['D']\ntest_versions = ['D']
        [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

    fn records() -> Records {
        let episode = |environment_index: u32| EpisodeRecord {
            set: "D".into(),
            seed: 7,
            environment_index,
            episode_index: 0,
            requested: Vec::new(),
            applied: Vec::new(),
            model_hash: String::new(),
            episode_return: 0.1 + f64::from(environment_index),
            length: 10,
            success: environment_index == 0,
            ending: Ending::Terminated,
            achieved: None,
            also_achieved: None,
        };
        let about = RecordsMetadata {
            environment: "CartPole".into(),
            revision: 0,
            parameters: Vec::new(),
            applied: Vec::new(),
            policy: String::new(),
            episodes_per_trial: 1,
            success: None,
            text_success: None,
            code_success: None,
            also: None,
            tests: Vec::new(),
        };
        let mut records = Records::new(about);
        records.add(RecordedTest { set: Version::D.into(), seed: 7, axes: None }, (0..3).map(episode).collect());
        records
    }

    #[rstest]
    #[case(|_: &mut CellResult| (), None)]
    #[case(|result: &mut CellResult| result.results.get_mut("D").unwrap().mean_return += 1e-9, Some("its test on D has 3 episodes"))]
    #[case(|result: &mut CellResult| result.agreement.as_mut().unwrap().episodes = 2, Some("has a different outcome"))]
    fn a_result_must_agree_with_its_records(#[case] change: fn(&mut CellResult), #[case] refused: Option<&str>) {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(directory.path());
        let records = records();
        records.write(&folder.cell(&plan.cells[0].id).path().join(perturb_records::FILE)).unwrap();
        let mut results = fixture::results(&plan, |_| Some(([0.0; 3], 0.0)));
        let CellState::Done(result) = &mut results.states[0] else { unreachable!("it is done") };
        result.results = [("D".to_owned(), records.result("D", None))].into();
        result.agreement = Some(records.agreement());
        change(result);
        let result = result.clone();
        let found = follows(&result, folder.cell(&result.id).path(), &result.results, result.agreement.as_ref());
        match (found, refused) {
            (Ok(found), None) => assert_eq!(found, Some(records)),
            (Err(error), Some(expected)) => {
                let message = error.to_string();
                assert!(message.contains(expected) && message.contains(&plan.cells[0].id), "{message}");
            }
            (outcome, _) => panic!("{outcome:?}"),
        }
    }

    #[test]
    fn a_result_of_an_earlier_program_has_no_episodes_to_compare() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let result = fixture::result(&plan.cells[0], [0.0; 3], 0.0);
        assert_eq!(follows(&result, directory.path(), &result.results, None).unwrap(), None);
    }
}
