//! Tests of players: noise, statistics and memories.

use perturb_policy::{
    ActionKind, Inputs, Normalisers, ObservationNormaliser, Player, PlayerRole, PolicySpec, RewardNormaliser,
    RunningMoments, SlotEnd, StepOutcome,
};
use rstest::rstest;

const DISCRETE: ActionKind = ActionKind::Discrete { n: 2 };
const GAMMA: f64 = 0.5;

/// Creates a player of one environment whose observation is one number.
fn player(episodes_per_trial: u32, with_outcomes: bool, normalisers: Normalisers, role: PlayerRole) -> Player {
    let inputs = Inputs::new(1, DISCRETE, 1, with_outcomes);
    let spec = PolicySpec { observation_size: inputs.size(), action: DISCRETE, hidden: vec![], lstm: None };
    let mut player = Player::new(&spec, inputs, 1, episodes_per_trial, normalisers, role);
    player.load(&vec![0.0; spec.n_weights()]).expect("weights that fit");
    player.begin(&[3.0], None).expect("an observation");
    player
}

/// Plays step `t` of a series of episodes of two steps, in which every observation is 3.
fn step(player: &mut Player, t: u64, episodes_per_trial: u32, reward: f32) {
    player.act().expect("an action");
    let episode = t / 2;
    let ends = t % 2 == 1;
    let per_trial = u64::from(episodes_per_trial);
    let end = SlotEnd { slot: 0, trial_index: episode / per_trial, episode_in_trial: (episode % per_trial) as u32 };
    let outcome = StepOutcome {
        observations: &[3.0],
        rewards: &[reward],
        terminated: &[ends],
        truncated: &[false],
        final_observations: if ends { &[3.0] } else { &[] },
        ended: if ends { std::slice::from_ref(&end) } else { &[] },
    };
    player.observe(&outcome, None).expect("numbers that fit");
}

/// Checks the discounted return after each of five steps with reward 1, and after the reset at the start of EPOpt's
/// next iteration.
#[rstest]
#[case::an_episode(1, false, [1.0, 0.0, 1.0, 0.0, 1.0, 0.0])]
#[case::a_trial(2, false, [1.0, 1.5, 1.75, 0.0, 1.0, 0.0])]
#[case::all_episodes(1, true, [1.0, 1.5, 1.75, 1.875, 1.9375, 1.9375])]
#[case::all_trials(2, true, [1.0, 1.5, 1.75, 1.875, 1.9375, 1.9375])]
fn the_return_that_rewards_are_divided_by_runs_over(
    #[case] episodes_per_trial: u32,
    #[case] runs_on: bool,
    #[case] expected: [f64; 6],
) {
    let rewards = Some(RewardNormaliser::new(1, GAMMA).running_on(runs_on));
    let normalisers = Normalisers { observations: None, rewards };
    let mut player = player(episodes_per_trial, false, normalisers, PlayerRole::training(1));
    let at = |player: &Player| player.normalisers().rewards.as_ref().expect("statistics").returns()[0];
    let mut returns: Vec<f64> = Vec::new();
    for t in 0..5 {
        step(&mut player, t, episodes_per_trial, 1.0);
        returns.push(at(&player));
    }
    player.begin(&[3.0], None).expect("an observation");
    returns.push(at(&player));
    assert_eq!(returns, expected);
}

/// Every observation is 3. The normaliser's mean is 1 and its standard deviation 2, so the normalised observation is 1.
/// With noise of standard deviation 0.25, the policy's input follows N(1, 0.25²).
#[test]
fn only_training_sees_noise() {
    let played = |noise: f64, role: PlayerRole| {
        let moments = RunningMoments::from_parts(1 << 40, vec![1.0], vec![4.0 * (1u64 << 40) as f64]);
        let observations = Some(ObservationNormaliser::from_moments(moments));
        let mut player = player(1, false, Normalisers { observations, rewards: None }, role).with_noise(noise);
        player.begin(&[3.0], None).expect("an observation");
        let seen = |t: u64| {
            step(&mut player, t, 1, 1.0);
            player.played().observations[0]
        };
        let seen: Vec<f32> = (0..10_000).map(seen).collect();
        (seen, player)
    };
    let (seen, player) = played(0.25, PlayerRole::training(1));
    assert_eq!(seen, played(0.25, PlayerRole::training(1)).0);
    let mean = seen.iter().sum::<f32>() / 1e4;
    let deviation = (seen.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / 1e4).sqrt();
    assert!((mean - 1.0).abs() < 0.01 && (deviation - 0.25).abs() < 0.01, "{mean} {deviation}, four standard errors");
    let (clean, without) = played(0.0, PlayerRole::training(1));
    assert!(clean.iter().all(|x| (x - 1.0).abs() < 1e-4), "no noise");
    assert_eq!(player.normalisers(), without.normalisers(), "statistics are of what was observed");
    assert!(played(0.25, PlayerRole::testing(1, 0, 1)).0.iter().all(|x| (x - 1.0).abs() < 1e-4));
}

/// Plays two environments whose observations are always (3, 3). The step limit ends both first episodes in the same
/// step.
#[test]
fn final_observations_have_no_noise() {
    let played = |noise: f64| {
        let spec = PolicySpec { observation_size: 2, action: DISCRETE, hidden: vec![], lstm: None };
        let inputs = Inputs::new(2, DISCRETE, 2, false);
        let none = Normalisers::default();
        let mut player = Player::new(&spec, inputs, 2, 1, none, PlayerRole::training(1)).with_noise(noise);
        player.load(&(0..spec.n_weights()).map(|i| i as f32 / 8.0).collect::<Vec<_>>()).expect("weights that fit");
        player.begin(&[3.0; 4], None).expect("observations");
        player.act().expect("actions");
        let ended: Vec<_> = (0..2).map(|slot| SlotEnd { slot, trial_index: 0, episode_in_trial: 0 }).collect();
        let outcome = StepOutcome {
            observations: &[3.0; 4],
            rewards: &[1.0; 2],
            terminated: &[false; 2],
            truncated: &[true; 2],
            final_observations: &[3.0; 4],
            ended: &ended,
        };
        player.observe(&outcome, None).expect("numbers that fit");
        let first = (player.played().observations.to_vec(), player.played().truncation_values.to_vec());
        player.act().expect("actions");
        ([first.0, player.played().observations.to_vec()].concat(), first.1)
    };
    let ((clean, value_of_clean), (seen, values)) = (played(0.0), played(0.5));
    assert_eq!(clean, [3.0; 8]);
    for (i, x) in seen.iter().enumerate() {
        assert!(*x != 3.0 && !seen[..i].contains(x), "{seen:?}");
    }
    assert!(values == value_of_clean && values[0] != 0.0, "{values:?}");
}

/// A saved state determines all later noise, and everything that depends on this noise.
#[test]
fn noise_continues_from_a_saved_state() {
    let none = || Normalisers::default();
    let mut expected = player(1, false, none(), PlayerRole::training(1)).with_noise(1.0);
    step(&mut expected, 0, 1, 1.0);
    let mut resumed = player(1, false, none(), PlayerRole::training(2)).with_noise(1.0);
    resumed.restore(&expected.state().expect("a training's")).expect("a state that fits");
    for t in 1..4 {
        step(&mut expected, t, 1, 1.0);
        step(&mut resumed, t, 1, 1.0);
        assert_eq!(resumed.played().observations, expected.played().observations);
        assert_eq!(resumed.state(), expected.state());
    }
}

/// While a policy is being tested, the normalisers' statistics are not updated. Rewards are still normalised with these
/// statistics. In contrast, the code of Packer et al. (2018) gives raw rewards to an RL² policy in tests.
#[test]
fn tests_leave_statistics_unchanged() {
    // The means are 1. The variances are 4 for observations and 100 for returns.
    let moments = |squares: f64| RunningMoments::from_parts(2, vec![1.0], vec![squares]);
    let normalisers = Normalisers {
        observations: Some(ObservationNormaliser::from_moments(moments(8.0))),
        rewards: Some(RewardNormaliser::from_parts(GAMMA, vec![0.0], moments(200.0))),
    };
    let mut player = player(2, true, normalisers.clone(), PlayerRole::testing(1, 0, 1));
    for t in 0..3 {
        step(&mut player, t, 2, 20.0);
    }
    assert_eq!(player.normalisers(), &normalisers);
    player.act().expect("an action");
    let played = player.played();
    assert_eq!(played.rewards, [2.0], "divided by the deviation");
    let &[observation, _, _, reward, done] = played.observations else { panic!("an input of five numbers") };
    assert_eq!((observation, reward, done), (1.0, 2.0, 0.0), "what the policy sees");
}
