//! Tests of a policy that acts in Python. The episodes and the records equal those of `perturb evaluate`.

use std::sync::Arc;

use numpy::PyReadonlyArray1;
use perturb_policy::random::Purpose;
use perturb_protocol::{EndedEpisode, proto};
use perturb_records::RecordsMetadata;
use perturb_records::success::Rule;
use perturb_records::testing::TestCollector;
use perturb_settings::sets;
use perturb_settings::sets::TestSet;
use pyo3::prelude::*;

use crate::failure::{INVALID, MALFORMED, UNUSABLE, failure};
use crate::infos::Events;
use crate::policy::PythonPolicy;
use crate::records::PythonRecords;
use crate::session::PythonOpened;
use crate::sets::{Set, from_python};

/// Plans and records the tests of a policy, one set after the other.
#[pyclass(name = "Tests", module = "perturb._native")]
pub struct PythonTests {
    sets: Vec<TestSet>,
    episodes: u64,
    seed: u64,
    success: Option<Rule>,
    policy: String,
    episodes_per_trial: u32,
    /// The environment of the first test, and the records of all finished tests. `None` before the first test.
    begun: Option<(Arc<proto::Environment>, perturb_records::Records)>,
    /// Collects the episodes of the running test. `None` if no test is running.
    counting: Option<TestCollector>,
}

#[pymethods]
impl PythonTests {
    #[new]
    fn new(
        sets: Vec<Set>,
        episodes: u64,
        seed: u64,
        success: Option<&str>,
        policy: String,
        episodes_per_trial: u32,
    ) -> PyResult<Self> {
        let sets = sets.into_iter().map(from_python).collect::<PyResult<Vec<TestSet>>>()?;
        sets::distinct(&sets).map_err(|error| invalid(&error))?;
        let success = success.map(str::parse).transpose().map_err(|error| invalid(&error))?;
        Ok(Self { sets, episodes, seed, success, policy, episodes_per_trial, begun: None, counting: None })
    }

    /// Begins the test on the test set at position `place` in the list of sets. Returns the seed of the test and its
    /// number of environments N.
    fn plan(&mut self, place: usize) -> PyResult<(u64, usize)> {
        let Some(set) = self.sets.get(place) else { return Err(failure(UNUSABLE, 0, "there is no such set")) };
        let counting = TestCollector::new(
            set.clone(),
            Purpose::TestEnvironments,
            self.seed,
            self.episodes,
            self.episodes_per_trial,
        );
        let plan = (counting.test().seed, counting.num_envs());
        self.counting = Some(counting);
        Ok(plan)
    }

    /// Checks the server's description of the environment after a test's session was opened. In the first test, the
    /// environment must fit all sets, and must equal the environment that `policy` was trained in. In later tests, the
    /// environment must equal that of the first test.
    #[pyo3(signature = (opened, policy))]
    fn opened(&mut self, opened: &PythonOpened, policy: Option<&PythonPolicy>) -> PyResult<()> {
        let served = opened.served();
        if let Some((environment, _)) = &self.begun {
            if **environment == **served {
                return Ok(());
            }
            return Err(failure(
                MALFORMED,
                0,
                "the server describes the environment differently than in the first test",
            ));
        }
        policy.map_or(Ok(()), |policy| policy.check_unchanged(served))?;
        self.sets.iter().try_for_each(|set| set.check(served)).map_err(|error| invalid(&error))?;
        let mut about = RecordsMetadata::new(served, self.policy.clone(), self.episodes_per_trial);
        if let Some(rule) = &self.success {
            about.judge_by(rule).map_err(|error| invalid(&error))?;
        }
        self.begun = Some((Arc::clone(served), perturb_records::Records::new(about)));
        Ok(())
    }

    /// Records the episodes that ended in a step and that count in the test. Only the last episode of a trial counts,
    /// and only the first trials of each environment, up to a planned number. Returns the number of recorded episodes,
    /// and the number that the test needs.
    fn take(&mut self, events: Option<&Events>, terminated: PyReadonlyArray1<'_, bool>) -> PyResult<(u64, u64)> {
        let Some(counting) = &mut self.counting else { return Err(failure(UNUSABLE, 0, "no test has begun")) };
        if let Some(events) = events {
            let terminated = terminated.as_array();
            let ended = |end: proto::EpisodeEnd| {
                let slot = end.slot as usize;
                EndedEpisode::from_proto(end, slot, terminated.get(slot).copied().unwrap_or_default())
            };
            let ended: Option<Vec<EndedEpisode>> = events.ended().map(ended).collect();
            let unnamed = "the server sent the end of an episode without its indices or its receipt; this is a server bug, \
                           please report it";
            counting.take(ended.ok_or_else(|| failure(MALFORMED, 0, unnamed))?);
        }
        Ok(counting.progress())
    }

    /// Finishes the running test, and adds its episodes to the records.
    fn finish(&mut self) -> PyResult<()> {
        let (Some(counting), Some((environment, records))) = (self.counting.take(), &mut self.begun) else {
            return Err(failure(UNUSABLE, 0, "no test has begun"));
        };
        counting.finish(environment, records).map_err(|error| failure(MALFORMED, 0, error.to_string()))
    }

    /// Returns the records of all finished tests.
    fn records(&self) -> PyResult<PythonRecords> {
        let Some((_, records)) = &self.begun else { return Err(failure(UNUSABLE, 0, "no test has begun")) };
        Ok(PythonRecords(records.clone()))
    }
}

fn invalid(error: &dyn std::error::Error) -> PyErr {
    failure(INVALID, 0, error.to_string())
}
