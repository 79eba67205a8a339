//! Testing a checkpoint on a version of its environment.

use perturb_study::{TestResult, Version, mean, wilson};
use rand::Rng;

use super::agent::Agent;
use crate::checkpoint::{Checkpoint, EnvironmentSummary};
use crate::client::{ClientError, EndedEpisode, OpenOptions, Servers, Session, StepReply};
use perturb_study::interrupt::StopFlag;
use perturb_study::random::{Purpose, stream};

/// The most environments that are tested together.
const MOST_ENVS: u64 = 100;

/// Why a checkpoint could not be tested.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TestError {
    /// A server or the connection to it failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The policy gives numbers that are not finite, or does not fit.
    #[error(transparent)]
    Numbers(#[from] crate::error::Error),
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

/// The seed of the test environments on `version`.
///
/// It is the first, second or third number (D, R, E) of the stream of `seed` for [`Purpose::TestEnvironments`], so that
/// a policy never meets its training episodes again, whatever seeds are used, and the versions are independent.
pub fn environment_seed(seed: u64, version: Version) -> u64 {
    let mut rng = stream(seed, Purpose::TestEnvironments);
    let drawn: [u64; 3] = std::array::from_fn(|_| rng.next_u64());
    drawn[version as usize]
}

/// Tests `checkpoint` on `version`: `episodes` episodes with sampled actions and frozen statistics. Calls `report` with
/// the number of episodes done. Of a policy that was trained in trials of several episodes the last one of each of
/// `episodes` trials counts.
///
/// Which episodes count is fixed beforehand: the first ones of each of at most 100 environments, as evenly as possible.
/// Counting the first to end instead would favour short ones. The result depends on the checkpoint, the version, the
/// number of episodes and the seed alone.
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
    let state = &checkpoint.state;
    let quotas = quotas(episodes);
    let options = OpenOptions {
        episodes_per_trial: state.episodes_per_trial,
        ..open_options(&state.environment, version, quotas.len(), seed)
    };
    let mut reply = StepReply::default();
    let mut session = Session::open(servers, &options, &mut reply.observations)?;
    check_unchanged(checkpoint, EnvironmentSummary::of(session.environment()))?;
    let episodes = play(&mut session, reply.observations, checkpoint, &quotas, seed, stop, &mut report)?;
    Ok(summarise(&episodes))
}

/// Lets the policy act in the environments of `session`, which are at their first `observations` `[N, O]`, until each has
/// ended as many episodes as `quotas` `[N]` says, and returns these. Calls `report` with their number.
///
/// # Errors
/// [`TestError`].
pub fn play(
    session: &mut Session<'_>,
    observations: Vec<f32>,
    checkpoint: &Checkpoint,
    quotas: &[u64],
    seed: u64,
    stop: &StopFlag,
    report: &mut dyn FnMut(u64),
) -> Result<Vec<EndedEpisode>, TestError> {
    let state = &checkpoint.state;
    let mut reply = StepReply { observations, ..StepReply::default() };
    let mut agent = Agent::new(checkpoint, quotas.len(), seed)?;
    let mut done = vec![false; quotas.len()];
    let mut counted: Vec<EndedEpisode> = Vec::new();
    let episodes: u64 = quotas.iter().sum();
    while (counted.len() as u64) < episodes {
        if let Some(signal) = stop.signal() {
            return Err(TestError::Stopped { signal });
        }
        session.step(agent.act(&mut reply.observations)?, &mut reply)?;
        done.fill(false);
        reply.ended.iter().for_each(|end| done[end.slot] = true);
        agent.remember(&mut reply.rewards, &done)?;
        reply.ended.retain(|end| end.episode_in_trial + 1 == state.episodes_per_trial);
        reply.ended.iter().for_each(|end| agent.forget(end.slot));
        // Environments that are done go on, unseen: they cost less than a smaller batch would save.
        count(reply.ended.drain(..), quotas, &mut counted);
        report(counted.len() as u64);
    }
    Ok(counted)
}

/// What a test opens of a policy without trials.
pub fn open_options(environment: &str, version: Version, num_envs: usize, seed: u64) -> OpenOptions {
    OpenOptions {
        environment: environment.to_owned(),
        version: version.to_proto(),
        num_envs,
        seed: environment_seed(seed, version),
        episodes_per_trial: 1,
    }
}

/// How many trials each environment is tested for.
fn quotas(episodes: u64) -> Vec<u64> {
    let n = episodes.clamp(1, MOST_ENVS);
    (0..n).map(|i| episodes / n + u64::from(i < episodes % n)).collect()
}

/// Adds those of the `ended` episodes, each its trial's last, that were to be counted from the start.
fn count(ended: impl Iterator<Item = EndedEpisode>, quotas: &[u64], counted: &mut Vec<EndedEpisode>) {
    counted.extend(ended.filter(|end| end.trial_index < quotas[end.slot]));
}

fn summarise(episodes: &[EndedEpisode]) -> TestResult {
    let n = episodes.len() as u64;
    let successes = episodes.iter().filter(|episode| episode.success).count() as u64;
    let (low, high) = wilson(successes, n);
    TestResult {
        episodes: n,
        success_percent: 100.0 * successes as f64 / n as f64,
        success_percent_95: [100.0 * low, 100.0 * high],
        mean_return: mean(episodes.iter().map(|episode| episode.episode_return)),
        mean_length: mean(episodes.iter().map(|episode| f64::from(episode.length))),
    }
}

/// Whether the served environment is the one that the policy was trained in.
///
/// # Errors
/// [`TestError::Changed`].
pub fn check_unchanged(checkpoint: &Checkpoint, served: Option<EnvironmentSummary>) -> Result<(), TestError> {
    let (trained, environment) = (&checkpoint.state.environment_spec, checkpoint.state.environment.clone());
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
    fn every_environment_gets_its_share_beforehand() {
        assert_eq!(quotas(3), [1, 1, 1]);
        assert_eq!(quotas(1000), vec![10; 100]);
        let uneven = quotas(250);
        assert_eq!((uneven.len(), uneven.iter().sum::<u64>()), (100, 250));
        assert_eq!((uneven[0], uneven[49], uneven[50], uneven[99]), (3, 3, 2, 2));
    }

    #[test]
    fn test_environments_have_seeds_of_their_own() {
        let seeds: Vec<u64> =
            (0..100).flat_map(|seed| Version::ALL.map(|version| environment_seed(seed, version))).collect();
        let distinct: std::collections::HashSet<u64> = seeds.iter().copied().collect();
        assert_eq!(distinct.len(), 300);
        assert!(seeds.iter().all(|&seed| seed > 1000), "none is a seed that people train with");
        for version in Version::ALL {
            let options = open_options("CartPole", version, 3, 5);
            assert_eq!(options.seed, environment_seed(5, version));
            assert_eq!(options.version, version.to_proto());
        }
    }

    fn episode(success: bool, episode_return: f64, length: u32) -> EndedEpisode {
        EndedEpisode {
            slot: 0,
            environment_index: 0,
            episode_index: 0,
            trial_index: 0,
            episode_in_trial: 0,
            episode_return,
            length,
            success,
            terminated: false,
            parameters: Vec::new(),
        }
    }

    /// Environment 0 has short episodes: the first three to end are all its own.
    #[test]
    fn the_first_episodes_of_each_environment_count_not_the_first_to_end() {
        let of = |slot: usize, trial_index: u64| EndedEpisode {
            slot,
            environment_index: slot as u32,
            trial_index,
            ..episode(true, 1.0, 1)
        };
        let quotas = quotas(3);
        let mut counted = Vec::new();
        for ended in [vec![of(0, 0)], vec![of(0, 1)], vec![of(0, 2), of(2, 0)], vec![of(0, 3), of(1, 0)]] {
            count(ended.into_iter(), &quotas, &mut counted);
        }
        let counted: Vec<_> = counted.iter().map(|episode| (episode.slot, episode.trial_index)).collect();
        assert_eq!(counted, [(0, 0), (2, 0), (1, 0)]);

        let mut counted = Vec::new();
        count([of(0, 0), of(0, 1), of(0, 2), of(1, 0), of(1, 1)].into_iter(), &[2, 1], &mut counted);
        let counted: Vec<_> = counted.iter().map(|episode| (episode.slot, episode.trial_index)).collect();
        assert_eq!(counted, [(0, 0), (0, 1), (1, 0)]);
    }

    #[test]
    fn figures_are_means_over_the_episodes() {
        let result = summarise(&[
            episode(true, 4.0, 10),
            episode(false, -2.0, 20),
            episode(true, 1.0, 60),
            episode(true, 1.0, 10),
        ]);
        assert_eq!((result.episodes, result.success_percent), (4, 75.0));
        assert_eq!((result.mean_return, result.mean_length), (1.0, 25.0));
        let [low, high] = result.success_percent_95;
        assert!((low - 30.064).abs() < 1e-3 && (high - 95.441).abs() < 1e-3, "{low} {high}");
    }
}
