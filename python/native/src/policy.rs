//! The Python classes of a trained policy and of its player, which chooses actions with the learner's arithmetic.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, TryLockError};

use numpy::{PyArray1, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use perturb_checkpoint::Checkpoint;
use perturb_policy::{ActionKind, SlotEnd, StepOutcome};
use pyo3::prelude::*;

use crate::failure::{POLICY, UNUSABLE, failure};

/// A policy, loaded from a checkpoint.
#[pyclass(frozen, name = "Policy", module = "perturb._native")]
pub struct PythonPolicy {
    pub(crate) checkpoint: Checkpoint,
    /// Identifies the policy by the number of its training iterations and a checksum of its weights.
    #[pyo3(get)]
    id: String,
}

#[pymethods]
impl PythonPolicy {
    /// Loads a policy from a policy file, from the folder of a checkpoint, or from the folder of a training, which has
    /// the folder `checkpoint`. Also accepts the id of an experiment's cell; see [`Checkpoint::load`].
    #[staticmethod]
    fn load(path: PathBuf) -> PyResult<Self> {
        let checkpoint = Checkpoint::load(&path).map_err(|error| refused(&error))?;
        let id = checkpoint.id().map_err(|reason| failure(POLICY, 0, reason))?;
        Ok(Self { checkpoint, id })
    }

    /// Writes the checkpoint into a folder, which is created if necessary. The files are not enough to resume the
    /// training.
    fn save(&self, path: PathBuf) -> PyResult<()> {
        self.checkpoint.save(&path, None).map_err(|error| refused(&error))
    }

    /// The environment that the policy was trained in.
    #[getter]
    fn environment(&self) -> &str {
        &self.checkpoint.state.config.common.environment
    }

    /// The version that the parameters of the training came from: `D`, `R`, `E` or `R+E`.
    #[getter]
    fn version(&self) -> String {
        self.checkpoint.state.config.common.version.to_string()
    }

    /// The version that the parameters of the training came from, and the values that replaced some of them, such as
    /// `D with length [0.3, 0.4]`.
    #[getter]
    fn trained_on(&self) -> String {
        self.checkpoint.state.config.common.trained_on()
    }

    /// The algorithm and architecture, e.g. "ppo ff".
    #[getter]
    fn method(&self) -> String {
        self.checkpoint.state.config.method().to_string()
    }

    /// Number of episodes in a trial. The policy's memory is reset at the end of a trial.
    #[getter]
    fn episodes_per_trial(&self) -> u32 {
        self.checkpoint.state.config.settings.episodes_per_trial()
    }

    /// Whether the policy's inputs also include the last action, its reward and whether an episode ended (RL²).
    #[getter]
    fn sees_rewards(&self) -> bool {
        self.checkpoint.state.config.settings.has_trials()
    }

    /// Whether the policy is recurrent.
    #[getter]
    fn has_memory(&self) -> bool {
        self.checkpoint.policy.memory_size() > 0
    }

    /// The policy's setting `observe`: "state", or "parameters" if the parameters are part of its observations.
    #[getter]
    fn observe(&self) -> String {
        self.checkpoint.state.config.common.observe.to_string()
    }

    /// The seed of the policy's training.
    #[getter]
    fn seed(&self) -> u64 {
        self.checkpoint.state.config.common.seed
    }

    /// Number of training steps, of all environments together.
    #[getter]
    fn timesteps(&self) -> u64 {
        self.checkpoint.state.counters.timesteps
    }

    /// Number O of values in an observation.
    #[getter]
    fn observation_size(&self) -> usize {
        self.checkpoint.state.environment_spec.observation.len()
    }

    /// Makes a player for N environments. Their indices are successive numbers from `first_environment_index`.
    fn player(&self, num_envs: usize, seed: u64, first_environment_index: u32) -> PyResult<PythonPlayer> {
        let player =
            self.checkpoint.player(num_envs, seed, first_environment_index).map_err(|error| refused(&error))?;
        let finals = Vec::with_capacity(num_envs * player.observation_size());
        Ok(PythonPlayer(Mutex::new(Playing {
            player,
            action: self.checkpoint.policy.action,
            seed,
            trials: vec![(0, 0); num_envs],
            ended: Vec::new(),
            finals,
        })))
    }
}

impl PythonPolicy {
    /// Checks that the server's environment `served` is the one that the policy was trained in.
    ///
    /// # Errors
    /// [`POLICY`], with the difference, if it is not.
    pub(crate) fn check_unchanged(&self, served: &perturb_protocol::proto::Environment) -> PyResult<()> {
        self.checkpoint.state.check_unchanged(served).map_err(|error| refused(&error))
    }
}

/// A policy that chooses actions in N environments, with a separate memory for each environment. Only one thread at a
/// time may use it.
#[pyclass(frozen, name = "Player", module = "perturb._native")]
pub struct PythonPlayer(Mutex<Playing>);

struct Playing {
    player: perturb_policy::Player,
    action: ActionKind,
    seed: u64,
    /// For each of N environments: index of the present trial, and number of the present episode in this trial.
    trials: Vec<(u64, u32)>,
    /// Episodes that ended in the last step.
    ended: Vec<SlotEnd>,
    /// Zeros `[ended, O]` in place of the final observations of ended episodes. The player's interface requires final
    /// observations, but actions do not depend on them.
    finals: Vec<f32>,
}

#[pymethods]
impl PythonPlayer {
    /// Begins the first trial in every environment, with observations `[N, O]`.
    fn begin(&self, observations: PyReadonlyArray2<'_, f32>) -> PyResult<()> {
        self.lock()?.begin(&observations)
    }

    /// Samples the next actions: int64 `[N]`, or float32 `[N, A]`.
    fn act<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.lock()?.act(py)
    }

    /// Records the outcome of the last actions: observations `[N, O]`, rewards `[N]`, and `starts` `[N]`. `starts` is
    /// true where an episode ended and the observation is the first one of the next episode.
    fn observe(
        &self,
        observations: PyReadonlyArray2<'_, f32>,
        rewards: PyReadonlyArray1<'_, f32>,
        starts: PyReadonlyArray1<'_, bool>,
    ) -> PyResult<()> {
        self.lock()?.observe(&observations, &rewards, &starts)
    }
}

impl PythonPlayer {
    fn lock(&self) -> PyResult<MutexGuard<'_, Playing>> {
        match self.0.try_lock() {
            Ok(playing) => Ok(playing),
            Err(TryLockError::Poisoned(poisoned)) => Ok(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => {
                Err(failure(UNUSABLE, 0, "another thread is using this actor; only one thread at a time may use it"))
            }
        }
    }
}

impl Playing {
    fn begin(&mut self, observations: &PyReadonlyArray2<'_, f32>) -> PyResult<()> {
        let observations = self.rows(observations)?;
        self.trials.fill((0, 0));
        self.player.begin(&observations, None).map_err(|error| refused(&error))?;
        // After an earlier use of this player, its random streams may be those of later trials. Go back to the streams
        // of the first trial.
        (0..self.trials.len()).for_each(|slot| self.player.begin_trial(slot, self.seed, 0));
        Ok(())
    }

    fn act<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let bytes = self.player.act().map_err(|error| refused(&error))?;
        let words = bytes.as_chunks::<4>().0;
        match self.action {
            ActionKind::Discrete { .. } => {
                let choices = words.iter().map(|word| i64::from(i32::from_le_bytes(*word))).collect();
                Ok(PyArray1::from_vec(py, choices).into_any())
            }
            ActionKind::Continuous { size } => {
                let numbers = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
                Ok(PyArray1::from_vec(py, numbers).reshape([self.trials.len(), size])?.into_any())
            }
        }
    }

    fn observe(
        &mut self,
        observations: &PyReadonlyArray2<'_, f32>,
        rewards: &PyReadonlyArray1<'_, f32>,
        starts: &PyReadonlyArray1<'_, bool>,
    ) -> PyResult<()> {
        let observations = self.rows(observations)?;
        let (rewards, starts) = (rewards.as_array().to_vec(), starts.as_array().to_vec());
        self.ended.clear();
        let episodes_per_trial = self.player.episodes_per_trial();
        for (slot, trial) in self.trials.iter_mut().enumerate().filter(|(slot, _)| starts.get(*slot) == Some(&true)) {
            self.ended.push(SlotEnd { slot, trial_index: trial.0, episode_in_trial: trial.1 });
            *trial = if trial.1 + 1 >= episodes_per_trial { (trial.0 + 1, 0) } else { (trial.0, trial.1 + 1) };
        }
        self.finals.clear();
        self.finals.resize(self.ended.len() * self.player.observation_size(), 0.0);
        let outcome = StepOutcome {
            observations: &observations,
            rewards: &rewards,
            terminated: &starts,
            truncated: &vec![false; starts.len()],
            final_observations: &self.finals,
            ended: &self.ended,
        };
        self.player.observe(&outcome, None).map_err(|error| refused(&error))
    }

    /// Copies observations `[N, O]` to a vector, row by row.
    fn rows(&self, observations: &PyReadonlyArray2<'_, f32>) -> PyResult<Vec<f32>> {
        let expected = [self.trials.len(), self.player.observation_size()];
        if observations.shape() != expected {
            let words = format!("observations have the shape {:?}; expected {expected:?}", observations.shape());
            return Err(failure(POLICY, 0, words));
        }
        Ok(observations.as_array().iter().copied().collect())
    }
}

fn refused(error: &dyn std::error::Error) -> PyErr {
    failure(POLICY, 0, error.to_string())
}
