//! Which episodes a test plays, and how they are recorded, whoever plays them: equal policies have equal records.

use perturb_policy::random::{Purpose, stream};
use perturb_protocol::{Distribution, Version, proto};
use rand::Rng;

use crate::records::{About, Difference, Ending, EpisodeRecord, RecordedTest, Records};
use crate::sets::{Context, TestSet};

/// The most environments that are tested together, unless a set has more contexts.
const MOST_ENVS: usize = 100;

/// Why a test's episodes are not recorded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum NotRecorded {
    /// Episodes did not run with the parameters that they were to run with.
    #[error("testing on {set}: {difference}; its results would be of another environment: mend the server")]
    NotApplied { set: String, difference: Difference },
    /// The server requested something else of its physics than it was asked for.
    #[error(
        "testing on {set}: the server was asked for {parameter} in {asked}, but its receipt says {got}; mend the server"
    )]
    NotRequested { set: String, parameter: String, asked: String, got: f64 },
    /// The server ended an episode without saying which, or with what physics.
    #[error("testing on {set}: the server sent the end of an episode without its address or its receipt")]
    NoReceipt { set: String },
}

/// The seed of the test environments on `version`.
///
/// It is the first, second, third or fourth number (D, R, E, R+E) of the stream of `seed` for test environments, so that a
/// policy never meets its training episodes again, whatever seeds are used, and the versions are independent. Sets have the
/// seed of their base version: what differs between two of them is parameters, not initial states.
pub fn environment_seed(seed: u64, version: Version) -> u64 {
    let mut rng = stream(seed, Purpose::TestEnvironments);
    let drawn: [u64; Version::KNOWN.len()] = std::array::from_fn(|_| rng.next_u64());
    drawn[version as usize]
}

/// `[N]` how many trials each environment is tested for. Environment i has context i modulo their number, and every
/// context equally many episodes, at least 1; `contexts` is at least 1.
pub fn quotas(episodes: u64, contexts: usize) -> Vec<u64> {
    let each = episodes.div_ceil(contexts as u64).max(1);
    // One context has as many environments as it can use, each of several its share.
    let copies = ((MOST_ENVS / contexts) as u64).clamp(1, each);
    (0..copies).flat_map(|i| vec![each / copies + u64::from(i < each % copies); contexts]).collect()
}

/// A test under way: of each environment the first trials count, and of each the last episode. Counting the first to end
/// instead would favour short ones.
#[derive(Clone, Debug)]
pub struct Counting {
    test: RecordedTest,
    quotas: Vec<u64>,
    episodes_per_trial: u32,
    /// With whether the task ended the episode.
    counted: Vec<(proto::EpisodeEnd, bool)>,
}

impl Counting {
    /// Of `episodes` episodes on `set`, of a test with `seed`.
    pub fn new(set: TestSet, seed: u64, episodes: u64, episodes_per_trial: u32) -> Self {
        let quotas = quotas(episodes, set.listed().len());
        let seed = environment_seed(seed, set.version);
        Self { test: RecordedTest { set, seed }, quotas, episodes_per_trial, counted: Vec::new() }
    }

    /// The test, with the seed of its environments.
    pub fn test(&self) -> &RecordedTest {
        &self.test
    }

    /// N.
    pub fn num_envs(&self) -> usize {
        self.quotas.len()
    }

    /// Takes the episodes that `ended` in a step; `terminated` `[N]`. Those that do not count are passed over.
    pub fn take<'a>(&mut self, ended: impl Iterator<Item = &'a proto::EpisodeEnd>, terminated: &[bool]) {
        for end in ended {
            let slot = end.slot as usize;
            let counts = end.episode.as_ref().is_none_or(|episode| {
                episode.episode_in_trial + 1 == self.episodes_per_trial
                    && self.quotas.get(slot).is_some_and(|quota| episode.trial_index < *quota)
            });
            if counts {
                self.counted.push((end.clone(), terminated.get(slot).copied().unwrap_or_default()));
            }
        }
    }

    /// Episodes that were counted, and how many there are to be.
    pub fn progress(&self) -> (u64, u64) {
        (self.counted.len() as u64, self.quotas.iter().sum())
    }

    /// Adds the episodes to `records`, which are of policies in `environment`.
    ///
    /// # Errors
    /// [`NotRecorded`], if the server played something else; nothing was added then.
    pub fn finish(self, environment: &proto::Environment, records: &mut Records) -> Result<(), NotRecorded> {
        let Self { test, mut counted, .. } = self;
        counted.sort_by_key(|(end, _)| end.episode.as_ref().map(|at| (at.environment_index, at.episode_index)));
        let contexts = test.set.listed();
        let parts = test.set.version.parts();
        let asked_in = |context| parts.iter().map(|&part| asked(environment, &test.set, part, context)).collect();
        let asked: Vec<Vec<Vec<Distribution>>> = contexts.iter().map(asked_in).collect();
        let mut episodes = Vec::with_capacity(counted.len());
        for (end, terminated) in counted {
            let requested = end.receipt.as_ref().map(|receipt| receipt.requested.as_slice()).unwrap_or_default();
            check_requested(environment, &test.set, &asked[end.slot as usize % contexts.len()], requested)?;
            episodes.push(record(&records.about, &test, end, terminated)?);
        }
        let mut added = Records::new(records.about.clone());
        added.episodes = episodes;
        if let Some(difference) = added.agreement().largest.filter(Difference::is_real) {
            return Err(NotRecorded::NotApplied { set: test.set.name, difference });
        }
        records.add(test, added.episodes);
        Ok(())
    }
}

/// What each parameter may be in a context of a set, in a trial of `version`.
fn asked(environment: &proto::Environment, set: &TestSet, version: Version, context: &Context) -> Vec<Distribution> {
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
    environment.parameters.iter().map(of).collect()
}

/// Whether the server requested of its physics what it was asked for: all parameters of one part of the version.
fn check_requested(
    environment: &proto::Environment,
    set: &TestSet,
    asked: &[Vec<Distribution>],
    requested: &[f64],
) -> Result<(), NotRecorded> {
    let Some(index) = wrong(asked, requested) else { return Ok(()) };
    let sets: Vec<String> = asked.iter().map(|asked| asked[index].to_string()).collect();
    Err(NotRecorded::NotRequested {
        set: set.name.clone(),
        parameter: environment.parameters[index].name.clone(),
        asked: sets.join(", like all others, or in "),
        got: requested.get(index).copied().unwrap_or(f64::NAN),
    })
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

fn record(
    about: &About,
    test: &RecordedTest,
    end: proto::EpisodeEnd,
    terminated: bool,
) -> Result<EpisodeRecord, NotRecorded> {
    let (Some(episode), Some(receipt)) = (end.episode, end.receipt) else {
        return Err(NotRecorded::NoReceipt { set: test.set.name.clone() });
    };
    let (achieved, also_achieved) = match about.also.is_some().then_some(end.code_achieved).flatten() {
        code if about.is_judged_by_code() => (code, end.achieved),
        code => (end.achieved, code),
    };
    Ok(EpisodeRecord {
        set: test.set.name.clone(),
        seed: test.seed,
        environment_index: episode.environment_index,
        episode_index: episode.episode_index,
        ending: match (end.diverged, terminated) {
            (true, _) => Ending::Diverged,
            (false, true) => Ending::Terminated,
            (false, false) => Ending::Truncated,
        },
        requested: receipt.requested,
        applied: receipt.applied,
        model_hash: receipt.model_hash,
        episode_return: end.r#return,
        length: end.length,
        success: about.success.as_ref().map_or(end.success, |criterion| criterion.holds(achieved)),
        achieved,
        also_achieved,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

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

    fn end(slot: u32, trial_index: u64, length: f64, applied: f64) -> proto::EpisodeEnd {
        proto::EpisodeEnd {
            slot,
            episode: Some(proto::Episode {
                environment_index: slot,
                trial_index,
                episode_index: trial_index,
                episode_in_trial: 0,
            }),
            r#return: f64::from(slot),
            length: 7,
            success: true,
            receipt: Some(proto::Receipt {
                requested: vec![length],
                applied: vec![applied],
                model_hash: String::new(),
            }),
            ..Default::default()
        }
    }

    fn finished(version: Version, ends: &[proto::EpisodeEnd]) -> Result<Records, NotRecorded> {
        let mut records = Records::new(About::new(&environment(), "policy".into(), 1));
        let mut counting = Counting::new(version.into(), 1, 2, 1);
        for end in ends {
            counting.take([end].into_iter(), &[true, false]);
        }
        counting.finish(&environment(), &mut records)?;
        Ok(records)
    }

    #[test]
    fn the_first_episodes_of_each_environment_count_in_their_order() {
        let records = finished(Version::D, &[end(1, 0, 1.0, 1.0), end(1, 1, 1.0, 1.0), end(0, 0, 1.0, 1.0)]).unwrap();
        let told: Vec<(u32, u64, Ending)> =
            records.episodes.iter().map(|row| (row.environment_index, row.episode_index, row.ending)).collect();
        assert_eq!(told, [(0, 0, Ending::Terminated), (1, 0, Ending::Truncated)]);
        assert_eq!(records.about.tests[0].seed, environment_seed(1, Version::D));
    }

    #[test]
    fn what_did_not_run_as_it_was_asked_to_is_no_record() {
        assert!(finished(Version::E, &[end(0, 0, 3.5, 3.5)]).is_ok());
        for (version, end, part) in [
            (Version::E, end(0, 0, 1.0, 1.0), "asked for length in [3, 4], but its receipt says 1"),
            (Version::RE, end(0, 0, 2.5, 2.5), "length in [0.5, 2], like all others, or in [3, 4]"),
            (Version::E, end(0, 0, 3.5, 3.6), "length was requested as 3.5, but the physics ran with 3.6"),
            (Version::D, proto::EpisodeEnd { episode: None, ..end(0, 0, 1.0, 1.0) }, "without its address"),
        ] {
            let error = finished(version, &[end]).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn every_environment_gets_its_share_beforehand() {
        assert_eq!(quotas(3, 1), [1, 1, 1]);
        assert_eq!(quotas(1000, 1), vec![10; 100]);
        let uneven = quotas(250, 1);
        assert_eq!((uneven.len(), uneven.iter().sum::<u64>()), (100, 250));
        assert_eq!((uneven[0], uneven[49], uneven[50], uneven[99]), (3, 3, 2, 2));
        assert_eq!(quotas(11, 5), [vec![1; 5], vec![1; 5], vec![1; 5]].concat());
    }
}
