//! Choice and recording of a test's episodes. A policy's records do not depend on the program that plays the policy.

use perturb_policy::random::{Purpose, stream};
use perturb_protocol::region::{self, Region};
use perturb_protocol::{Distribution, EndedEpisode, Version, proto};
use perturb_settings::sets::{Context, TestSet};
use rand::Rng;

use crate::heatmap::Heatmap;
use crate::records::{Difference, EpisodeRecord, RecordedTest, Records};

/// Maximum number of environments in a test, unless the test set has more contexts. Each context has an environment.
const MAX_ENVS: usize = 100;

/// The reason why a test's episodes cannot be recorded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum NotRecorded {
    /// An episode did not run with the requested parameters.
    #[error("testing on {set}: {difference}, so results would be wrong; this is a server bug, please report it")]
    NotApplied { set: String, difference: Difference },
    /// The server drew a parameter from other values than the client requested.
    #[error(
        "testing on {set}: the server was asked for {parameter} in {asked}, but its receipt says {got}; this is a server \
         bug, please report it"
    )]
    NotRequested { set: String, parameter: String, asked: String, got: f64 },
}

/// Returns the seed of the environments of a test on `version`.
///
/// `seed` is the seed in the test's options. `purpose` is [`Purpose::TestEnvironments`], or
/// [`Purpose::SelectionEnvironments`] for a test whose result selects a configuration. The random stream of `seed` and
/// `purpose` gives one seed for each of the versions D, R, E and R+E, in this order. A test therefore never repeats
/// episodes of a training or of a test for the other purpose, whatever the seeds. Seeds for different versions are
/// independent. Test sets with the same version get the same seed, so their environments have the same initial states.
pub fn environment_seed(purpose: Purpose, seed: u64, version: Version) -> u64 {
    let mut rng = stream(seed, purpose);
    let drawn: [u64; Version::KNOWN.len()] = std::array::from_fn(|_| rng.next_u64());
    drawn[version as usize]
}

/// Returns for each of the N environments the number of its trials that count. Environment i has context i modulo
/// `contexts`. Every context gets the same number of episodes, at least 1. In total there are at least `episodes`
/// episodes. `contexts` must be at least 1.
fn quotas(episodes: u64, contexts: usize) -> Vec<u64> {
    let each = episodes.div_ceil(contexts as u64).max(1);
    // The 100 environments are divided equally among the contexts. A context gets at least one environment, and at most
    // one for each episode.
    let copies = ((MAX_ENVS / contexts) as u64).clamp(1, each);
    (0..copies).flat_map(|i| vec![each / copies + u64::from(i < each % copies); contexts]).collect()
}

/// Collects the episodes of a running test. The number of trials that count is fixed in advance for each environment,
/// because taking the first episodes to end would favour short episodes. A trial is one episode, or with RL² several,
/// of which only the last counts.
#[derive(Clone, Debug)]
pub struct TestCollector {
    test: RecordedTest,
    quotas: Vec<u64>,
    episodes_per_trial: u32,
    counted: Vec<EndedEpisode>,
}

impl TestCollector {
    /// Creates a collector of `episodes` episodes on `set`. For `seed` and `purpose` see [`environment_seed`]. Only the
    /// last of a trial's `episodes_per_trial` episodes counts.
    pub fn new(set: TestSet, purpose: Purpose, seed: u64, episodes: u64, episodes_per_trial: u32) -> Self {
        let quotas = quotas(episodes, set.listed().len());
        let seed = environment_seed(purpose, seed, set.version);
        Self { test: RecordedTest { set, seed, axes: None }, quotas, episodes_per_trial, counted: Vec::new() }
    }

    /// Returns the test, with the seed of its environments.
    pub fn test(&self) -> &RecordedTest {
        &self.test
    }

    /// Returns N, the number of environments.
    pub fn num_envs(&self) -> usize {
        self.quotas.len()
    }

    /// Adds episodes that have just ended. Ignores all but the last episode of a trial, and trials beyond the number
    /// that counts in their environment.
    pub fn take(&mut self, ended: impl IntoIterator<Item = EndedEpisode>) {
        let Self { quotas, episodes_per_trial, .. } = self;
        let counts = |end: &EndedEpisode| {
            end.episode_in_trial + 1 == *episodes_per_trial
                && quotas.get(end.slot).is_some_and(|quota| end.trial_index < *quota)
        };
        self.counted.extend(ended.into_iter().filter(counts));
    }

    /// Returns the number of episodes collected so far, and the number of episodes to collect.
    pub fn progress(&self) -> (u64, u64) {
        // The sum saturates, because an overflow would give a small number. The test would then end too early.
        (self.counted.len() as u64, self.quotas.iter().fold(0, |sum, &quota| sum.saturating_add(quota)))
    }

    /// Adds the test and its episodes to `records`, which must be of a policy in `environment`.
    ///
    /// # Errors
    /// [`NotRecorded`] if an episode did not have the parameters of the test. Nothing is then added.
    pub fn finish(self, environment: &proto::Environment, records: &mut Records) -> Result<(), NotRecorded> {
        let Self { mut test, mut counted, .. } = self;
        test.axes = Heatmap::axes_of(&test.set, environment);
        counted.sort_by_key(|end| (end.environment_index, end.episode_index));
        let contexts = test.set.listed();
        let asked: Vec<_> = contexts.iter().map(|context| permitted_values(environment, &test.set, context)).collect();
        for end in &counted {
            check_requested(environment, &test.set, &asked[end.slot % contexts.len()], &end.receipt.requested)?;
        }
        let record = |end| EpisodeRecord::new(&records.about, &test.set.name, test.seed, end);
        let episodes = counted.into_iter().map(record).collect();
        let mut added = Records::new(records.about.clone());
        added.episodes = episodes;
        if let Some(difference) = added.agreement().largest.filter(Difference::exceeds_tolerance) {
            return Err(NotRecorded::NotApplied { set: test.set.name, difference });
        }
        records.add(test, added.episodes);
        Ok(())
    }
}

/// Returns the permitted values of all parameters in one context of a set, `[alternatives][parameters]`. Version R+E
/// has two alternatives, because a trial draws either all parameters from R or all from E. Other versions have one.
fn permitted_values(environment: &proto::Environment, set: &TestSet, context: &Context) -> Vec<Vec<Distribution>> {
    let region = Region::from_version(environment, set.version, &set.parameters(context));
    let in_order = |values: &region::ParameterBox| {
        environment.parameters.iter().filter_map(|parameter| values.get(&parameter.name).cloned()).collect()
    };
    region.boxes().iter().map(in_order).collect()
}

/// Checks `requested`, the values that the server reports as requested for an episode. `asked` has the values that the
/// test permits, see [`permitted_values`]. In version R+E, all values must be from R or all from E.
fn check_requested(
    environment: &proto::Environment,
    set: &TestSet,
    asked: &[Vec<Distribution>],
    requested: &[f64],
) -> Result<(), NotRecorded> {
    let Some(index) = forbidden_index(asked, requested) else { return Ok(()) };
    let sets: Vec<String> = asked.iter().map(|asked| asked[index].to_string()).collect();
    Err(NotRecorded::NotRequested {
        set: set.name.clone(),
        parameter: environment.parameters[index].name.clone(),
        asked: sets.join(", like all others, or in "),
        got: requested.get(index).copied().unwrap_or(f64::NAN),
    })
}

/// Returns the index of a parameter whose value is not permitted. Returns `None` if one alternative of `asked` permits
/// the values of all parameters.
fn forbidden_index(asked: &[Vec<Distribution>], requested: &[f64]) -> Option<usize> {
    let in_part = |asked: &Vec<Distribution>| {
        let requested = requested.iter().copied().chain(std::iter::repeat(f64::NAN));
        asked.iter().zip(requested).position(|(asked, got)| !asked.contains(got))
    };
    let wrongs: Option<Vec<usize>> = asked.iter().map(in_part).collect();
    wrongs?.into_iter().max()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::records::{Ending, RecordsMetadata};

    fn environment() -> proto::Environment {
        let drawn = |low, high| Some(proto::Distribution { intervals: vec![proto::Interval { low, high }] });
        let length = proto::Parameter {
            name: "length".into(),
            unit: "m".into(),
            applied: "length".into(),
            low: 0.0,
            high: 9.0,
            default_value: 1.0,
            random: drawn(0.5, 2.0),
            extreme: drawn(3.0, 4.0),
            ..Default::default()
        };
        let applied = vec![proto::Quantity { name: "length".into(), unit: "m".into() }];
        proto::Environment { name: "Toy".into(), parameters: vec![length], applied, ..Default::default() }
    }

    fn end(slot: u32, trial_index: u64, length: f64, applied: f64) -> EndedEpisode {
        let episode =
            proto::Episode { environment_index: slot, trial_index, episode_index: trial_index, episode_in_trial: 0 };
        let receipt = proto::Receipt { requested: vec![length], applied: vec![applied], model_hash: String::new() };
        let end = proto::EpisodeEnd {
            episode: Some(episode),
            r#return: f64::from(slot),
            length: 7,
            success: true,
            receipt: Some(receipt),
            ..Default::default()
        };
        EndedEpisode::from_proto(end, slot as usize, slot == 0).unwrap()
    }

    fn finished(version: Version, ends: &[EndedEpisode]) -> Result<Records, NotRecorded> {
        let mut records = Records::new(RecordsMetadata::new(&environment(), "policy".into(), 1));
        let mut counting = TestCollector::new(version.into(), Purpose::TestEnvironments, 1, 2, 1);
        for end in ends {
            counting.take([end.clone()]);
        }
        counting.finish(&environment(), &mut records)?;
        Ok(records)
    }

    #[test]
    fn the_first_episodes_of_each_environment_count_in_their_order() {
        let records = finished(Version::D, &[end(1, 0, 1.0, 1.0), end(1, 1, 1.0, 1.0), end(0, 0, 1.0, 1.0)]).unwrap();
        let recorded: Vec<(u32, u64, Ending)> =
            records.episodes.iter().map(|row| (row.environment_index, row.episode_index, row.ending)).collect();
        assert_eq!(recorded, [(0, 0, Ending::Terminated), (1, 0, Ending::Truncated)]);
        assert_eq!(records.about.tests[0].seed, environment_seed(Purpose::TestEnvironments, 1, Version::D));
    }

    #[test]
    fn episodes_that_did_not_run_as_requested_are_not_recorded() {
        assert!(finished(Version::E, &[end(0, 0, 3.5, 3.5)]).is_ok());
        for (version, end, part) in [
            (Version::E, end(0, 0, 1.0, 1.0), "asked for length in [3, 4], but its receipt says 1"),
            (Version::RE, end(0, 0, 2.5, 2.5), "length in [0.5, 2], like all others, or in [3, 4]"),
            (Version::E, end(0, 0, 3.5, 3.6), "length was requested as 3.5, but the physics ran with 3.6"),
        ] {
            let error = finished(version, &[end]).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn all_parameters_of_an_episode_are_of_one_part_of_its_version() {
        let part = |low, high| vec!["low..high".replace("low", low).replace("high", high).parse().unwrap(); 2];
        let (r, e) = (part("1", "2"), part("2", "3"));
        let both = [r, e];
        assert_eq!([forbidden_index(&both, &[1.5, 1.0]), forbidden_index(&both, &[2.5, 3.0])], [None, None]);
        assert_eq!(forbidden_index(&both, &[1.5, 2.5]), Some(1), "the second is not of R, the first not of E");
        assert_eq!(forbidden_index(&both, &[4.0, 1.5]), Some(0));
        assert_eq!(
            (forbidden_index(&both[..1], &[1.5, 2.5]), forbidden_index(&both[..1], &[1.5])),
            (Some(1), Some(1)),
            "a missing value is forbidden, too"
        );
    }

    #[test]
    fn progress_of_too_many_episodes_saturates() {
        let contexts = perturb_settings::sets::Contexts::Listed(vec![Context::new(); 2]);
        let set = TestSet { name: "two".into(), version: Version::D, contexts };
        let counting = TestCollector::new(set, Purpose::TestEnvironments, 1, u64::MAX, 1);
        assert_eq!(counting.progress(), (0, u64::MAX), "the sum of the quotas is 2^64");
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
            assert!(quotas.len() <= MAX_ENVS.max(contexts) && quotas.iter().all(|&quota| quota > 0));
        }
    }

    #[test]
    fn test_environments_have_seeds_of_their_own() {
        let of = |purpose| {
            (0..100).flat_map(move |seed| Version::KNOWN.map(|version| environment_seed(purpose, seed, version)))
        };
        let seeds: Vec<u64> = of(Purpose::TestEnvironments).chain(of(Purpose::SelectionEnvironments)).collect();
        let distinct: std::collections::HashSet<u64> = seeds.iter().copied().collect();
        assert_eq!(distinct.len(), 800, "a seed of reported tests is never a seed of a selection");
        assert!(seeds.iter().all(|&seed| seed > 1000), "none is a seed that people train with");
    }
}
