//! What a player makes of what came of its actions.

use perturb_policy::{
    ActionKind, Ended, Inputs, Normalisers, ObservationNormaliser, Outcome, Player, PolicySpec, RewardNormaliser, Role,
    RunningMoments,
};
use rstest::rstest;

const DISCRETE: ActionKind = ActionKind::Discrete { n: 2 };
const GAMMA: f64 = 0.5;

/// A player of one environment whose observations are one number.
fn player(episodes_per_trial: u32, with_outcomes: bool, normalisers: Normalisers, role: Role) -> Player {
    let inputs = Inputs::new(1, DISCRETE, 1, with_outcomes);
    let spec = PolicySpec { observation_size: inputs.size(), action: DISCRETE, hidden: vec![], lstm: None };
    let mut player = Player::new(&spec, inputs, 1, episodes_per_trial, normalisers, role);
    player.load(&vec![0.0; spec.n_weights()]).expect("weights that fit");
    player.begin(&[3.0], None).expect("an observation");
    player
}

/// Step `t` of episodes of two steps each, observed as 3.
fn step(player: &mut Player, t: u64, episodes_per_trial: u32, reward: f32) {
    player.act().expect("an action");
    let (episode, ends) = (t / 2, t % 2 == 1);
    let per_trial = u64::from(episodes_per_trial);
    let end = Ended { slot: 0, trial_index: episode / per_trial, episode_in_trial: (episode % per_trial) as u32 };
    let outcome = Outcome {
        observations: &[3.0],
        rewards: &[reward],
        terminated: &[ends],
        truncated: &[false],
        final_observations: if ends { &[3.0] } else { &[] },
        ended: if ends { std::slice::from_ref(&end) } else { &[] },
    };
    player.observe(&outcome, None).expect("numbers that fit");
}

/// Each step pays 1. After five of them EPOpt's next iteration begins.
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
    let mut player = player(episodes_per_trial, false, normalisers, Role::training(1));
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

/// The reference gives a policy of RL² raw rewards in tests.
#[test]
fn a_test_has_the_statistics_of_the_training_and_leaves_them_as_they_are() {
    // Means of 1 and variances of 4 and 100.
    let moments = |squares: f64| RunningMoments::from_parts(2, vec![1.0], vec![squares]);
    let normalisers = Normalisers {
        observations: Some(ObservationNormaliser::from_moments(moments(8.0))),
        rewards: Some(RewardNormaliser::from_parts(GAMMA, vec![0.0], moments(200.0))),
    };
    let mut player = player(2, true, normalisers.clone(), Role::testing(1, 0, 1));
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
