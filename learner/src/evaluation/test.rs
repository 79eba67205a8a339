//! Tests a checkpoint on parameter sets of its environment, and records every episode.

use perturb_files::interrupt::StopFlag;
use perturb_policy::random::Purpose;
use perturb_protocol::{Distribution, Version, proto};
use perturb_records::success::Rule;
use perturb_records::testing::{TestCollector, environment_seed};
use perturb_records::{Records, RecordsMetadata, TestResult};
use perturb_settings::sets::{Parameters, TestSet};
use perturb_settings::{TrainConfig, ValueError, sets};

use super::error::TestError;
use super::trials::{RemoteTrials, Trials};
use crate::checkpoint::Checkpoint;
use crate::client::{Backoff, ClientSession, EndedEpisode, OpenOptions, Reconnect, Servers};

/// Options of a test.
#[derive(Clone, Debug, PartialEq)]
pub struct TestOptions {
    /// Number of episodes on each set, at least 1. On a set of contexts, each context gets at least one episode.
    pub episodes: u64,
    /// The seed of environments and actions.
    pub seed: u64,
    /// Whether to play selection episodes: their random streams are used by no other test.
    pub selects: bool,
    /// The success rule; `None` for the environment's own rule.
    pub success: Option<Rule>,
}

impl TestOptions {
    /// Returns the purpose that derives the seeds of the test's environments.
    fn purpose(&self) -> Purpose {
        if self.selects { Purpose::SelectionEnvironments } else { Purpose::TestEnvironments }
    }
}

/// Tests a checkpoint on one or more parameter sets.
pub struct Tester<'a> {
    servers: &'a Servers,
    checkpoint: &'a Checkpoint,
    options: TestOptions,
    about: RecordsMetadata,
    environment: proto::Environment,
    policy: String,
}

impl<'a> Tester<'a> {
    /// Prepares tests of `checkpoint`. Checks that the served environment is the one that the policy was trained in,
    /// and that the success rule fits it.
    ///
    /// # Errors
    /// [`TestError`] if a check fails.
    pub fn new(servers: &'a Servers, checkpoint: &'a Checkpoint, options: TestOptions) -> Result<Self, TestError> {
        let state = &checkpoint.state;
        let environment = servers.environment_seen(&state.config.common)?;
        state.check_unchanged(&environment)?;
        let policy = checkpoint.id().map_err(TestError::Unnamed)?;
        let about = Self::about(&environment, &policy, checkpoint, &options)?;
        Ok(Self { servers, checkpoint, options, about, environment, policy })
    }

    /// Returns the description of the test in its records.
    fn about(
        environment: &proto::Environment,
        policy: &str,
        checkpoint: &Checkpoint,
        options: &TestOptions,
    ) -> Result<RecordsMetadata, TestError> {
        let episodes_per_trial = checkpoint.state.config.settings.episodes_per_trial();
        let mut about = RecordsMetadata::new(environment, policy.to_owned(), episodes_per_trial);
        if let Some(rule) = &options.success {
            about.judge_by(rule)?;
        }
        Ok(about)
    }

    /// Makes all tests record the same parameters as tests on `sets` do: if one of `sets` names a disturbance, all
    /// episodes are recorded with their disturbances. So records of several tests have the same columns.
    ///
    /// # Errors
    /// [`TestError`] if the policy observes parameters and was trained without disturbances, so its observations would
    /// not fit.
    pub fn recording_for(mut self, sets: &[TestSet]) -> Result<Self, TestError> {
        let common = &self.checkpoint.state.config.common;
        let environment = self.servers.environment_seen_with(common, sets.iter().flat_map(TestSet::names))?;
        if environment.observation.len() != self.environment.observation.len() {
            let expected = "without: the policy sees parameters, and was trained without those of disturbances";
            return Err(ValueError::new("a test set", "with a disturbance", expected).into());
        }
        if environment.parameters.len() != self.environment.parameters.len() {
            self.about = Self::about(&environment, &self.policy, self.checkpoint, &self.options)?;
            self.environment = environment;
        }
        Ok(self)
    }

    /// Returns the served environment, with the parameters that are recorded.
    pub fn environment(&self) -> &proto::Environment {
        &self.environment
    }

    /// Tests the policy on each of `sets`, and returns the records of all episodes. Checks all sets before it plays.
    /// Calls `report` with the current set and its number of finished episodes.
    ///
    /// # Errors
    /// [`TestError`] if a set is invalid, playing fails, or an episode ran with other parameters than requested.
    pub fn test(
        self,
        sets: &[TestSet],
        stop: &StopFlag,
        report: &mut dyn FnMut(&TestSet, u64),
    ) -> Result<Records, TestError> {
        sets::distinct(sets)?;
        sets.iter().try_for_each(|set| set.check(&self.environment))?;
        self.recording_for(sets)?.test_recorded(sets, stop, report)
    }

    /// Plays all sets, which have been checked, and returns the records.
    fn test_recorded(
        &self,
        sets: &[TestSet],
        stop: &StopFlag,
        report: &mut dyn FnMut(&TestSet, u64),
    ) -> Result<Records, TestError> {
        let mut records = Records::new(self.about.clone());
        for set in sets {
            let episodes_per_trial = self.about.episodes_per_trial;
            let TestOptions { episodes, seed, .. } = self.options;
            let purpose = self.options.purpose();
            let counting = retry_on_disconnect(self.servers, stop, || {
                let mut counting = TestCollector::new(set.clone(), purpose, seed, episodes, episodes_per_trial);
                self.play(&mut counting, stop, &mut |done| report(set, done))?;
                Ok(counting)
            })?;
            counting.finish(&self.environment, &mut records)?;
        }
        Ok(records)
    }

    /// Plays the episodes of a test, with sampled actions and unchanging normalisers. The result depends only on the
    /// checkpoint, the set, the number of episodes and the seed.
    fn play(
        &self,
        counting: &mut TestCollector,
        stop: &StopFlag,
        report: &mut dyn FnMut(u64),
    ) -> Result<(), TestError> {
        let test = counting.test();
        let num_envs = counting.num_envs();
        let contexts = test.set.listed();
        let options = OpenOptions {
            environment: self.about.environment.clone(),
            version: test.set.version,
            parameters: with_disturbances(test.set.drawn(), &self.environment),
            contexts: Vec::new(),
            num_envs,
            seed: test.seed,
            episodes_per_trial: self.about.episodes_per_trial,
            observe: self.checkpoint.state.config.common.observe,
        };
        let mut observations = Vec::new();
        let mut session = ClientSession::open(self.servers, &options, &mut observations)?;
        let size = session.observation_size();
        for slot in 0..num_envs {
            let context: Vec<(&str, f64)> =
                contexts[slot % contexts.len()].iter().map(|(name, value)| (name.as_str(), *value)).collect();
            if !context.is_empty() {
                let row = &mut observations[slot * size..][..size];
                session.reset_with(slot, &context, test.seed, row)?;
            }
        }
        let player = self.checkpoint.player(num_envs, test.seed, 0)?;
        // Servers cannot play the random policy, because its continuous actions are uniform.
        let mut trials: Box<dyn FnMut() -> Result<Vec<EndedEpisode>, TestError>> =
            if session.acts() && !self.checkpoint.state.config.settings.is_random() {
                let mut remote = RemoteTrials::new(session, &player, self.checkpoint);
                Box::new(move || remote.play())
            } else {
                let mut trials = Trials::begin(session, player, &observations)?;
                Box::new(move || trials.step())
            };
        loop {
            let (done, asked) = counting.progress();
            report(done);
            if done == asked {
                return Ok(());
            }
            if let Some(signal) = stop.signal() {
                return Err(TestError::Stopped { signal });
            }
            // Environments that have finished their episodes are still stepped, without being recorded. Shrinking the
            // batch would cost more than it saves.
            counting.take(trials()?);
        }
    }
}

/// Adds a disturbance with its default value to `parameters`, if disturbances are among the `environment`'s parameters
/// and `parameters` has no value for the first one. A session has disturbances only if its parameters name at least
/// one.
pub(super) fn with_disturbances(mut parameters: Parameters, environment: &proto::Environment) -> Parameters {
    let first = environment.disturbances.first();
    let is_own = |parameter: &&proto::Parameter| environment.parameters.iter().any(|own| own.name == parameter.name);
    if let Some(parameter) = first.filter(is_own) {
        let default = Distribution::fixed(parameter.default_value);
        parameters.entry(parameter.name.clone()).or_insert(default);
    }
    parameters
}

/// Runs `work`. If servers are lost, waits for them and runs `work` again from its start. The result of `work` must not
/// depend on the number of attempts.
pub(super) fn retry_on_disconnect<T>(
    servers: &Servers,
    stop: &StopFlag,
    mut work: impl FnMut() -> Result<T, TestError>,
) -> Result<T, TestError> {
    let mut backoff = Backoff::default();
    loop {
        let error = match work() {
            Err(TestError::Client(error)) => error,
            done => return done,
        };
        match backoff.reconnect(servers, &error, stop) {
            Reconnect::Connected => {}
            Reconnect::TimedOut => return Err(error.into()),
            Reconnect::Stopped { signal } => return Err(TestError::Stopped { signal }),
        }
    }
}

/// Tests `checkpoint` on one version, and returns success rate, mean return and mean length. See [`Tester::test`].
///
/// # Errors
/// [`TestError`] if the test fails.
pub fn test(
    servers: &Servers,
    checkpoint: &Checkpoint,
    version: Version,
    episodes: u64,
    seed: u64,
    stop: &StopFlag,
    mut report: impl FnMut(u64),
) -> Result<TestResult, TestError> {
    let options = TestOptions { episodes, seed, selects: false, success: None };
    let tester = Tester::new(servers, checkpoint, options)?;
    let records = tester.test(&[version.into()], stop, &mut |_, done| report(done))?;
    Ok(records.result(&version.to_string(), None))
}

/// Returns the options with which a test on `set` opens environments, for a policy with this configuration. The number
/// of environments is 1.
pub fn open_options(TrainConfig { common, settings }: &TrainConfig, set: &TestSet, seed: u64) -> OpenOptions {
    OpenOptions {
        environment: common.environment.clone(),
        version: set.version,
        parameters: set.drawn(),
        contexts: Vec::new(),
        num_envs: 1,
        seed: environment_seed(Purpose::TestEnvironments, seed, set.version),
        episodes_per_trial: settings.episodes_per_trial(),
        observe: common.observe,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rendered_episodes_are_the_tested_ones() {
        let config = TrainConfig::from_table("", "environment = 'CartPole'".parse().unwrap()).unwrap();
        for version in Version::KNOWN {
            let options = open_options(&config, &version.into(), 5);
            let seed = environment_seed(Purpose::TestEnvironments, 5, version);
            assert_eq!((options.seed, options.version), (seed, version));
        }
    }
}
