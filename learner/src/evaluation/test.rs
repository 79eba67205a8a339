//! Testing a checkpoint on a set of its environment's parameters, and recording every episode.

use perturb_policy::random::{Purpose, stream};
use perturb_protocol::{Distribution, Version, proto};
use perturb_study::interrupt::StopFlag;
use perturb_study::records::{About, Difference, Ending, EpisodeRecord, RecordedTest, Records};
use perturb_study::sets::{self, Context, TestSet};
use perturb_study::settings::TrainConfig;
use perturb_study::success::Rule;
use perturb_study::{TestResult, ValueError};
use rand::Rng;

use super::player;
use super::trials::{RemoteTrials, Trials};
use crate::checkpoint::{Checkpoint, EnvironmentSummary, State};
use crate::client::{ClientError, EndedEpisode, OpenOptions, Servers, Session};

/// The most environments that are tested together, unless a set has more contexts.
const MOST_ENVS: usize = 100;

/// Why a checkpoint could not be tested.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TestError {
    /// A server or the connection to it failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The policy gives numbers that are not finite, or does not fit.
    #[error(transparent)]
    Numbers(#[from] perturb_policy::Error),
    /// The environment does not have the set's parameters, or refuses their values; or the threshold is of something
    /// else than what its success rule compares.
    #[error(transparent)]
    Value(#[from] ValueError),
    /// The checkpoint cannot be named.
    #[error("the checkpoint cannot be named: {0}")]
    Unnamed(String),
    /// Episodes did not run with the parameters that they were to run with.
    #[error("testing on {set}: {difference}; its results would be of another environment: mend the server")]
    NotApplied {
        /// The set's name.
        set: String,
        /// The largest difference.
        difference: Difference,
    },
    /// The server requested something else of its physics than it was asked for.
    #[error(
        "testing on {set}: the server was asked for {parameter} in {asked}, but its receipt says {got}; mend the server"
    )]
    NotRequested {
        /// The set's name.
        set: String,
        /// The parameter.
        parameter: String,
        /// What it may be.
        asked: String,
        /// What the receipt says.
        got: f64,
    },
    /// The environment is no longer what the policy was trained in.
    #[error("the checkpoint was trained in {environment} with {what} {trained}, the server's has {served}: {advice}")]
    Changed {
        /// The environment.
        environment: String,
        /// What differs.
        what: &'static str,
        /// In training.
        trained: String,
        /// On the server.
        served: String,
        /// What to do.
        advice: &'static str,
    },
    /// The program was asked to end.
    #[error("stopped before all episodes were tested")]
    Stopped {
        /// The signal.
        signal: i32,
    },
}

impl TestError {
    /// Whether the same may go well later or with another server, see [`ClientError::can_be_retried`].
    pub fn can_be_retried(&self) -> bool {
        matches!(self, Self::Client(error) if error.can_be_retried())
    }

    /// The signal that ended the test, if one did.
    pub fn signal(&self) -> Option<i32> {
        if let Self::Stopped { signal } = self { Some(*signal) } else { None }
    }
}

/// How to test.
#[derive(Clone, Debug, PartialEq)]
pub struct TestOptions {
    /// Episodes on each set, at least 1; a set of contexts has at least one in each.
    pub episodes: u64,
    /// Fixes all randomness.
    pub seed: u64,
    /// With selection episodes, which no other test has.
    pub selects: bool,
    /// What decides about success; `None` for the environment's own rule.
    pub success: Option<Rule>,
}

impl TestOptions {
    fn purpose(&self) -> Purpose {
        if self.selects { Purpose::SelectionEnvironments } else { Purpose::TestEnvironments }
    }
}

/// Tests a checkpoint.
pub struct Tester<'a> {
    servers: &'a Servers,
    checkpoint: &'a Checkpoint,
    options: TestOptions,
    about: About,
    environment: proto::Environment,
}

/// The seed of the test environments on `version`.
///
/// It is the first, second, third or fourth number (D, R, E, R+E) of the stream of `seed` for `purpose`, which is
/// [`Purpose::TestEnvironments`] or [`Purpose::SelectionEnvironments`], so that a policy never meets its training episodes
/// again, whatever seeds are used, nor those that selected it, and the versions are independent. Sets have the seed of
/// their base version: what differs between two of them is parameters, not initial states.
fn environment_seed(purpose: Purpose, seed: u64, version: Version) -> u64 {
    let mut rng = stream(seed, purpose);
    let drawn: [u64; Version::KNOWN.len()] = std::array::from_fn(|_| rng.next_u64());
    drawn[version as usize]
}

impl<'a> Tester<'a> {
    /// Checks that the served environment is the one that the policy was trained in, and that it knows the threshold.
    ///
    /// # Errors
    /// [`TestError`].
    pub fn new(servers: &'a Servers, checkpoint: &'a Checkpoint, options: TestOptions) -> Result<Self, TestError> {
        let state = &checkpoint.state;
        let environment = servers.environment_seen(&state.config.common)?;
        check_unchanged(checkpoint, EnvironmentSummary::of(&environment))?;
        let id = checkpoint.id().map_err(TestError::Unnamed)?;
        let mut about = About::new(&environment, id, state.config.settings.episodes_per_trial());
        if let Some(rule) = &options.success {
            about.judge_by(rule)?;
        }
        Ok(Self { servers, checkpoint, options, about, environment })
    }

    /// The environment, as it is served.
    pub fn environment(&self) -> &proto::Environment {
        &self.environment
    }

    /// Tests on each of `sets` and records every episode. Calls `report` with the set and its number of episodes done.
    /// The sets are checked before anything is played.
    ///
    /// # Errors
    /// [`TestError`]. Episodes that did not run with what was requested end everything.
    pub fn test(
        &self,
        sets: &[TestSet],
        stop: &StopFlag,
        report: &mut dyn FnMut(&TestSet, u64),
    ) -> Result<Records, TestError> {
        sets::distinct(sets)?;
        sets.iter().try_for_each(|set| set.check(&self.environment))?;
        let mut records = Records::new(self.about.clone());
        for set in sets {
            let seed = environment_seed(self.options.purpose(), self.options.seed, set.version);
            let test = RecordedTest { set: set.clone(), seed };
            let episodes = self.play(&test, stop, &mut |done| report(set, done))?;
            records.add(test, episodes);
            let largest = records.agreement().largest;
            if let Some(difference) = largest.filter(Difference::is_real) {
                return Err(TestError::NotApplied { set: set.name.clone(), difference });
            }
        }
        Ok(records)
    }

    /// Plays the episodes of a test, with sampled actions and frozen statistics. Of a policy that was trained in trials
    /// of several episodes the last one of each trial counts.
    ///
    /// Which episodes count is fixed beforehand: the first ones of each environment, as evenly as possible. Counting the
    /// first to end instead would favour short ones. The result depends on the checkpoint, the set, the number of
    /// episodes and the seed alone.
    fn play(
        &self,
        test: &RecordedTest,
        stop: &StopFlag,
        report: &mut dyn FnMut(u64),
    ) -> Result<Vec<EpisodeRecord>, TestError> {
        let contexts = test.set.listed();
        let quotas = quotas(self.options.episodes, contexts.len());
        let options = OpenOptions {
            environment: self.about.environment.clone(),
            version: test.set.version,
            parameters: test.set.drawn(),
            num_envs: quotas.len(),
            seed: test.seed,
            episodes_per_trial: self.about.episodes_per_trial,
            observe: self.checkpoint.state.config.common.observe,
        };
        let mut observations = Vec::new();
        let mut session = Session::open(self.servers, &options, &mut observations)?;
        let size = session.observation_size();
        for slot in 0..quotas.len() {
            let context: Vec<(&str, f64)> =
                contexts[slot % contexts.len()].iter().map(|(name, value)| (name.as_str(), *value)).collect();
            if !context.is_empty() {
                let row = &mut observations[slot * size..][..size];
                session.reset_with(slot, &context, test.seed, row)?;
            }
        }
        let player = player(self.checkpoint, quotas.len(), test.seed)?;
        let episodes: u64 = quotas.iter().sum();
        // Servers do not know the random policy's distribution of continuous actions.
        let mut trials: Box<dyn FnMut() -> Result<Vec<EndedEpisode>, TestError>> =
            if session.acts() && !self.checkpoint.state.config.settings.is_random() {
                let mut remote = RemoteTrials::new(session, &player, self.checkpoint);
                Box::new(move || remote.play())
            } else {
                let mut trials = Trials::begin(session, player, &observations)?;
                Box::new(move || trials.step())
            };
        let mut counted: Vec<EndedEpisode> = Vec::new();
        while (counted.len() as u64) < episodes {
            if let Some(signal) = stop.signal() {
                return Err(TestError::Stopped { signal });
            }
            // Environments that are done go on, unseen: they cost less than a smaller batch would save.
            let ended = trials()?;
            counted.extend(ended.into_iter().filter(|end| end.trial_index < quotas[end.slot]));
            report(counted.len() as u64);
        }
        drop(trials);
        counted.sort_by_key(|end| (end.environment_index, end.episode_index));
        let parts = test.set.version.parts();
        let asked_in = |context| parts.iter().map(|&part| self.asked(&test.set, part, context)).collect();
        let asked: Vec<Vec<Vec<Distribution>>> = contexts.iter().map(asked_in).collect();
        for end in &counted {
            self.check_requested(&test.set, &asked[end.slot % contexts.len()], end)?;
        }
        Ok(counted.into_iter().map(|end| self.record(test, end)).collect())
    }

    /// What each parameter may be in a context of a set, in a trial of `version`.
    fn asked(&self, set: &TestSet, version: Version, context: &Context) -> Vec<Distribution> {
        let drawn = set.drawn();
        let of = |parameter: &proto::Parameter| {
            let own = context.get(&parameter.name).map(|value| Distribution::fixed(*value));
            let own = own.or_else(|| drawn.get(&parameter.name).cloned());
            let of_version = match version {
                Version::D | Version::RE => None, // a trial of R+E is one of R or of E
                Version::R => parameter.random.as_ref(),
                Version::E => parameter.extreme.as_ref(),
            };
            let versions = || of_version.and_then(|values| values.try_into().ok());
            own.or_else(versions).unwrap_or_else(|| Distribution::fixed(parameter.default_value))
        };
        self.environment.parameters.iter().map(of).collect()
    }

    /// Whether the server requested of its physics what it was asked for: all parameters of one part of the version.
    fn check_requested(&self, set: &TestSet, asked: &[Vec<Distribution>], end: &EndedEpisode) -> Result<(), TestError> {
        let Some(index) = wrong(asked, &end.receipt.requested) else { return Ok(()) };
        let sets: Vec<String> = asked.iter().map(|asked| asked[index].to_string()).collect();
        Err(TestError::NotRequested {
            set: set.name.clone(),
            parameter: self.environment.parameters[index].name.clone(),
            asked: sets.join(", like all others, or in "),
            got: end.receipt.requested.get(index).copied().unwrap_or(f64::NAN),
        })
    }

    fn record(&self, test: &RecordedTest, end: EndedEpisode) -> EpisodeRecord {
        let (achieved, also_achieved) = achieved(&self.about, &end);
        let success = self.about.success.as_ref().map_or(end.success, |criterion| criterion.holds(achieved));
        EpisodeRecord {
            set: test.set.name.clone(),
            seed: test.seed,
            environment_index: end.environment_index,
            episode_index: end.episode_index,
            ending: ending(&end),
            requested: end.receipt.requested,
            applied: end.receipt.applied,
            model_hash: end.receipt.model_hash,
            episode_return: end.episode_return,
            length: end.length,
            success,
            achieved,
            also_achieved,
        }
    }
}

/// The figures of a test on one version, see [`Tester::test`].
///
/// # Errors
/// [`TestError`].
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

/// What an episode achieved of what decides about success, and of the environment's other quantity if it has two.
pub(super) fn achieved(about: &About, end: &EndedEpisode) -> (Option<f64>, Option<f64>) {
    let text = (end.achieved, about.also.is_some().then_some(end.code_achieved).flatten());
    if about.is_judged_by_code() { (text.1, text.0) } else { text }
}

/// How an episode ended.
pub(super) fn ending(end: &EndedEpisode) -> Ending {
    match (end.diverged, end.terminated) {
        (true, _) => Ending::Diverged,
        (false, true) => Ending::Terminated,
        (false, false) => Ending::Truncated,
    }
}

/// The first parameter that is not what it may be in any of the parts, all of whose parameters belong together.
fn wrong(asked: &[Vec<Distribution>], requested: &[f64]) -> Option<usize> {
    let in_part = |asked: &Vec<Distribution>| {
        let requested = requested.iter().copied().chain(std::iter::repeat(f64::NAN));
        asked.iter().zip(requested).position(|(asked, got)| !asked.contains(got))
    };
    let wrongs: Option<Vec<usize>> = asked.iter().map(in_part).collect();
    wrongs?.into_iter().max()
}

/// What a test of one environment opens of a policy that was trained so.
pub fn open_options(TrainConfig { common, settings }: &TrainConfig, set: &TestSet, seed: u64) -> OpenOptions {
    OpenOptions {
        environment: common.environment.clone(),
        version: set.version,
        parameters: set.drawn(),
        num_envs: 1,
        seed: environment_seed(Purpose::TestEnvironments, seed, set.version),
        episodes_per_trial: settings.episodes_per_trial(),
        observe: common.observe,
    }
}

/// How many trials each environment is tested for. Environment i has context i modulo their number, and every context
/// equally many episodes, at least 1.
fn quotas(episodes: u64, contexts: usize) -> Vec<u64> {
    let each = episodes.div_ceil(contexts as u64).max(1);
    // One context has as many environments as it can use, each of several its share.
    let copies = ((MOST_ENVS / contexts) as u64).clamp(1, each);
    (0..copies).flat_map(|i| vec![each / copies + u64::from(i < each % copies); contexts]).collect()
}

/// Whether the served environment is the one that the policy was trained in.
///
/// # Errors
/// [`TestError::Changed`].
pub fn check_unchanged(checkpoint: &Checkpoint, served: Option<EnvironmentSummary>) -> Result<(), TestError> {
    let State { environment_spec: trained, config, .. } = &checkpoint.state;
    let environment = config.common.environment.clone();
    let advice = "test with the version of perturb that trained it, or train again";
    let (what, trained, served) = match served {
        None => ("actions", format!("{:?}", trained.action), "none".into()),
        Some(served) => match trained.difference(&served) {
            None => return Ok(()),
            Some(difference) => difference,
        },
    };
    Err(TestError::Changed { environment, what, trained, served, advice })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_parameters_of_an_episode_are_of_one_part_of_its_version() {
        let part = |low, high| vec!["low..high".replace("low", low).replace("high", high).parse().unwrap(); 2];
        let (r, e) = (part("1", "2"), part("2", "3"));
        let both = [r, e];
        assert_eq!([wrong(&both, &[1.5, 1.0]), wrong(&both, &[2.5, 3.0])], [None, None]);
        assert_eq!(wrong(&both, &[1.5, 2.5]), Some(1), "the second is not of R, the first not of E");
        assert_eq!(wrong(&both, &[4.0, 1.5]), Some(0));
        assert_eq!(
            (wrong(&both[..1], &[1.5, 2.5]), wrong(&both[..1], &[1.5])),
            (Some(1), Some(1)),
            "nor is what is missing"
        );
    }

    #[test]
    fn every_environment_gets_its_share_beforehand() {
        assert_eq!(quotas(3, 1), [1, 1, 1]);
        assert_eq!(quotas(1000, 1), vec![10; 100]);
        let uneven = quotas(250, 1);
        assert_eq!((uneven.len(), uneven.iter().sum::<u64>()), (100, 250));
        assert_eq!((uneven[0], uneven[49], uneven[50], uneven[99]), (3, 3, 2, 2));
    }

    #[test]
    fn every_context_gets_equally_many_episodes() {
        for (episodes, contexts, each) in
            [(10, 5, 2), (11, 5, 3), (1, 5, 1), (1000, 1600, 1), (1000, 3, 334), (7, 100, 1)]
        {
            let quotas = quotas(episodes, contexts);
            for context in 0..contexts {
                let own: u64 = quotas.iter().skip(context).step_by(contexts).sum();
                assert_eq!(own, each, "{episodes} episodes in {contexts} contexts");
            }
            assert!(quotas.len() <= MOST_ENVS.max(contexts) && quotas.iter().all(|&quota| quota > 0));
        }
    }

    #[test]
    fn test_environments_have_seeds_of_their_own() {
        let of = |purpose| {
            (0..100).flat_map(move |seed| Version::KNOWN.map(|version| environment_seed(purpose, seed, version)))
        };
        let seeds: Vec<u64> = of(Purpose::TestEnvironments).chain(of(Purpose::SelectionEnvironments)).collect();
        let distinct: std::collections::HashSet<u64> = seeds.iter().copied().collect();
        assert_eq!(distinct.len(), 800, "those of a test never select");
        assert!(seeds.iter().all(|&seed| seed > 1000), "none is a seed that people train with");
        let config = TrainConfig::from_table("", "environment = 'CartPole'".parse().unwrap()).unwrap();
        for version in Version::KNOWN {
            let options = open_options(&config, &version.into(), 5);
            assert_eq!(
                (options.seed, options.version),
                (environment_seed(Purpose::TestEnvironments, 5, version), version)
            );
        }
    }
}
