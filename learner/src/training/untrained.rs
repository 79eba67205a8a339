//! Makes the policies that learn nothing: checkpoints that can be tested like any other, but need no training.
//!
//! The rules of heuristic policies are in [`heuristic`].
//!
//! The random policy acts like Gymnasium's `action_space.sample()` and ignores observations: discrete actions are
//! equally likely, and continuous actions are uniform within their bounds. The weights encode this: weights of
//! observations are 0, biases are the middles of the bounds, and `log_std` is the logarithm of half the distance between
//! the bounds.

use perturb_checkpoint::Counters;
use perturb_files::write_atomically;
use perturb_policy::math::ln;
use perturb_policy::{NamedArray, PolicySpec, RewardNormaliser, Weights};
use perturb_settings::{Common, TrainConfig};

use super::{Result, TrainError, TrainOutcome, TrainRequest, heuristic};
use crate::checkpoint::{Checkpoint, EnvironmentSummary, State};
use crate::client::Servers;
use crate::logging::Progress;
use crate::proto::{Channel, Environment, action_space::Kind};

/// Writes the policy to the directory of `entry`: as the last checkpoint, and as the policy of every mark.
///
/// # Errors
/// An error if the server does not know the environment, if the environment has no heuristic policy, if random actions
/// have no bounds, or if files cannot be written.
pub(super) fn make(servers: &Servers, entry: &TrainRequest<'_>) -> Result<TrainOutcome> {
    let TrainRequest { directory, ref start, marks } = *entry;
    let config = start.config();
    let environment = servers.environment_seen(&config.common)?;
    let checkpoint = checkpoint(config, &environment)?;
    directory.prepare()?; // this deletes an earlier run
    write_atomically(&directory.path().join("config.toml"), config.to_toml().as_bytes())?;
    marks.iter().try_for_each(|&mark| checkpoint.save(&directory.mark(mark), None))?;
    checkpoint.save(&directory.checkpoint(), None)?;
    Ok(TrainOutcome { checkpoint, progress: Progress::default(), signal: None })
}

/// Returns the checkpoint of the policy in `environment`.
pub(super) fn checkpoint(config: &TrainConfig, environment: &Environment) -> Result<Checkpoint> {
    let Common { normalize_rewards, num_envs, reward_return_runs_on, .. } = config.common;
    let summary = EnvironmentSummary::from_environment(environment).ok_or(TrainError::NoActions)?;
    let rewards = normalize_rewards
        .then(|| RewardNormaliser::new(num_envs, config.settings.gamma()).running_on(reward_return_runs_on));
    let mut state = State {
        environment_spec: summary,
        observation_normaliser: None,
        reward_normaliser: rewards,
        counters: Counters::default(),
        config: config.clone(),
        commits: vec![perturb_experiment::VERSION.into()],
    };
    state.observation_normaliser = state.fresh_normaliser();
    let policy = state.policy();
    let weights = if config.settings.is_random() {
        random(&policy, environment)?
    } else {
        heuristic::weights(&policy, environment)?
    };
    Ok(Checkpoint { state, policy, weights })
}

/// Returns the weights of the random policy. Returns an error if an action has no finite bounds.
fn random(policy: &PolicySpec, environment: &Environment) -> Result<Weights> {
    let channels: &[Channel] = match environment.action.as_ref().and_then(|action| action.kind.as_ref()) {
        Some(Kind::Continuous(continuous)) => &continuous.channels,
        _ => &[],
    };
    let bounded = |channel: &Channel| channel.low.is_finite() && channel.high.is_finite() && channel.low < channel.high;
    if let Some(Channel { name, low, high, .. }) = channels.iter().find(|channel| !bounded(channel)) {
        return Err(TrainError::Unbounded { name: name.clone(), low: *low, high: *high });
    }
    let of = |number: fn(&Channel) -> f64| channels.iter().map(|channel| number(channel) as f32).collect();
    let array = |(name, shape): (String, Vec<usize>)| {
        let data = match name.as_str() {
            "policy.0.bias" if !channels.is_empty() => of(|channel| (channel.low + channel.high) / 2.0),
            "log_std" => of(|channel| f64::from(ln(((channel.high - channel.low) / 2.0) as f32))),
            _ => vec![0.0; shape.iter().product()],
        };
        NamedArray { name, shape, data }
    };
    Ok(policy.layout().into_iter().map(array).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::proto::{ActionSpace, Continuous, Discrete};

    fn checkpoint_for(kind: Kind) -> Result<Checkpoint> {
        checkpoint_with("", kind)
    }

    fn checkpoint_with(settings: &str, kind: Kind) -> Result<Checkpoint> {
        let table = format!("environment = 'Test'\nalgorithm = 'random'\n{settings}").parse().unwrap();
        let observation = vec![Channel::default(); 3];
        let action = Some(ActionSpace { kind: Some(kind) });
        let environment = Environment { observation, action, ..Environment::default() };
        checkpoint(&TrainConfig::from_table("", table).unwrap(), &environment)
    }

    fn continuous(bounds: &[(f64, f64)]) -> Kind {
        let channel = |&(low, high): &(f64, f64)| Channel { low, high, ..Channel::default() };
        Kind::Continuous(Continuous { channels: bounds.iter().map(channel).collect() })
    }

    /// Returns the actions of the first step in `n` environments with different observations.
    fn actions(checkpoint: &Checkpoint, n: usize) -> Vec<[u8; 4]> {
        let mut player = checkpoint.player(n, 7, 0).unwrap();
        let observations: Vec<f32> = (0..3 * n).map(|i| i as f32 - 100.0).collect();
        player.begin(&observations, None).unwrap();
        player.act().unwrap().as_chunks::<4>().0.to_vec()
    }

    #[test]
    fn discrete_actions_are_equally_frequent() {
        let names = vec![String::new(); 3];
        let checkpoint = checkpoint_for(Kind::Discrete(Discrete { names })).unwrap();
        let mut counts = [0u32; 3];
        actions(&checkpoint, 9000).iter().for_each(|action| counts[i32::from_le_bytes(*action) as usize] += 1);
        // The tolerance is four standard deviations √(9000 · ⅓ · ⅔).
        assert!(counts.iter().all(|count| (f64::from(*count) - 3000.0).abs() < 179.0), "{counts:?}");
    }

    #[test]
    fn continuous_actions_are_uniform_in_their_bounds() {
        let checkpoint = checkpoint_for(continuous(&[(-2.0, 2.0), (1.0, 2.0)])).unwrap();
        let actions: Vec<f32> = actions(&checkpoint, 9000).into_iter().map(f32::from_le_bytes).collect();
        for (entry, low, high) in [(0, -2.0f32, 2.0f32), (1, 1.0, 2.0)] {
            let mut quarters = [0u32; 4];
            for action in actions.iter().skip(entry).step_by(2) {
                assert!((low - 1e-6..=high + 1e-6).contains(action), "{action}");
                quarters[((4.0 * (action - low) / (high - low)) as usize).min(3)] += 1;
            }
            // The tolerance is four standard deviations √(9000 · ¼ · ¾).
            assert!(quarters.iter().all(|count| (f64::from(*count) - 2250.0).abs() < 165.0), "{quarters:?}");
        }
    }

    #[test]
    fn reward_statistics_follow_the_preset() {
        let choices = || Kind::Discrete(Discrete { names: vec![String::new(); 3] });
        assert!(checkpoint_with("preset = 'paper'", choices()).unwrap().state.reward_normaliser.is_none());
        // `runs_on` says whether the discounted return of the reward statistics continues over the end of an episode.
        for (preset, num_envs, runs_on) in [("perturb", 1, false), ("paper", 1, true)] {
            let settings = format!("preset = '{preset}'\nnormalize_rewards = true");
            let made = checkpoint_with(&settings, choices()).unwrap();
            let rewards = made.state.reward_normaliser.as_ref().unwrap();
            assert_eq!((rewards.returns().len(), rewards.runs_on()), (num_envs, runs_on));
            let directory = tempfile::tempdir().unwrap();
            made.save(directory.path(), None).unwrap();
            assert_eq!(Checkpoint::load(directory.path()).unwrap(), made);
        }
    }

    #[test]
    fn unbounded_actions_are_refused() {
        for bounds in [(f64::NEG_INFINITY, 1.0), (0.0, f64::INFINITY), (1.0, 1.0)] {
            let error = checkpoint_for(continuous(&[bounds])).unwrap_err().to_string();
            assert!(error.contains("draws actions from their bounds"), "{error}");
        }
    }
}
