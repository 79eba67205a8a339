//! Policies that the server plays give the same bytes as a client that chooses the actions itself.

pub mod game;
mod refusals;
mod turns;

use crate::common::server::{Server, Session, floats};
use game::{Client, FULL, Game, PLAIN, play, wire};
use perturb::proto::{
    Act, Acted, AutoresetMode, EndedAt, EpisodeEnd, Open, Policy, Restore, SavePlayer, SlotGroup, Snapshot, Version,
    act::Task as Asked, policy::Role,
};
use perturb_policy::CollectUntil;
use rstest::rstest;

/// A number of steps that is larger than the step limit of every environment that these tests play.
const STEPS: u32 = 520;

/// Compares two replies array by array, so a failure names the array.
fn assert_same(got: &Acted, expected: &Acted) {
    assert_eq!((got.steps, got.finished), (expected.steps, expected.finished));
    assert_eq!(got.starts, expected.starts);
    let arrays = |it: &Acted| {
        [&it.observations, &it.log_probs, &it.values, &it.rewards, &it.truncation_values, &it.last_values, &it.memory]
            .map(|array| floats(array))
    };
    for (i, (got, expected)) in arrays(got).iter().zip(&arrays(expected)).enumerate() {
        assert_eq!(got, expected, "array {i}");
    }
    assert_eq!(got, expected);
}

#[rstest]
#[case::feed_forward("CartPole", PLAIN)]
#[case::continuous("Pendulum", PLAIN)]
#[case::normalised("MountainCar", Game { normalised: true, ..PLAIN })]
#[case::recurrent("Acrobot", Game { lstm: 6, ..PLAIN })]
#[case::recurrent_and_continuous("Pendulum", Game { per_trial: 1, ..FULL })]
#[case::trials("CartPole", FULL)]
#[case::continuous_trials("Pendulum", FULL)]
#[case::feed_forward_trials("MountainCar", Game { lstm: 0, ..FULL })]
#[case::test("CartPole", Game { testing: true, ..FULL })]
#[case::continuous_test("Pendulum", Game { testing: true, ..PLAIN })]
#[case::with_parameters("Pendulum", Game { sees: true, normalised: true, ..PLAIN })]
#[case::trials_with_parameters("CartPole", Game { sees: true, ..FULL })]
#[case::test_with_parameters("CartPole", Game { sees: true, testing: true, ..FULL })]
#[tokio::test]
async fn the_server_plays_the_bytes_of_a_client_that_acts_by_itself(
    #[case] environment: &'static str,
    #[case] game: Game,
) {
    same_bytes(Game { environment, ..game }).await;
}

#[cfg(feature = "mujoco")]
#[tokio::test]
async fn the_server_plays_the_bytes_of_a_client_in_robots_too() {
    same_bytes(Game { environment: "Hopper", ..FULL }).await;
}

#[cfg(feature = "mujoco")]
#[tokio::test]
async fn the_server_plays_the_bytes_of_a_client_in_folders_too() {
    same_bytes(Game { environment: "ReachingArm", ..FULL }).await;
}

async fn same_bytes(game: Game) {
    let server = Server::with_folders(&["--workers", "2"]);
    let mut client = Client::begin(game, &server).await;
    let (mut session, environment) = game.session(&server).await;
    // The policy plays four tasks, each with new weights: some steps, more steps than an episode has, complete
    // episodes, and some more steps.
    let asked = [Asked::Steps(7), Asked::Steps(STEPS), Asked::Episodes(8), Asked::Steps(5)];
    let mut ends = 0;
    for (version, task) in (0..).zip(asked) {
        let expected = client.play(version, task.into()).await;
        let policy = (version == 0).then(|| game.policy(&environment));
        let act =
            Act { policy, weights: wire(&game.weights(&environment, version)), task: Some(task), ..Act::default() };
        let (acted, _) = play(&mut session, act).await;
        assert_same(&acted, &expected);
        ends += acted.ended.len();
    }
    assert!(ends >= game.n + 8, "{ends} episodes ended");
}

#[rstest]
#[tokio::test]
async fn bytes_do_not_depend_on_workers_shards_or_replies(
    #[values("Pendulum", "CartPole")] environment: &'static str,
    #[values("1", "3")] workers: &str,
    #[values(0, 1, 7)] most_steps: u32,
) {
    let game = Game { environment, n: 300, ..FULL };
    let server = Server::start(&["--workers", workers]);
    let mut client = Client::begin(game, &server).await;
    let (mut session, environment) = game.session(&server).await;
    let expected = client.play(0, CollectUntil::Steps(40)).await;
    let act = Act { most_steps, ..game.act(&environment, Asked::Steps(40)) };
    let (acted, replies) = play(&mut session, act).await;
    assert_same(&acted, &expected);
    assert_eq!(replies, if most_steps == 0 { 1 } else { 40usize.div_ceil(most_steps as usize) });
}

#[tokio::test]
async fn a_player_that_is_saved_goes_on_in_another_session() {
    let server = Server::start(&[]);
    let (mut session, environment) = FULL.session(&server).await;
    play(&mut session, FULL.act(&environment, Asked::Steps(33))).await;
    let saved = session.ask(SavePlayer {}).await;
    let snapshots = session.ask(Snapshot::default()).await.snapshots;
    let weights = wire(&FULL.weights(&environment, 1));
    let go_on = Act { weights, task: Some(Asked::Steps(50)), ..Act::default() };
    let (expected, _) = play(&mut session, go_on.clone()).await;
    assert!(!expected.ended.is_empty() && expected.memory.iter().any(|&byte| byte != 0));

    let (mut other, _) = FULL.session(&server).await;
    other.ask(Restore { snapshots, ..Restore::default() }).await;
    let policy = Policy {
        observations: saved.observations,
        rewards: saved.rewards,
        role: saved.actions.map(Role::Training),
        state: saved.state,
        ..FULL.policy(&environment)
    };
    let (acted, _) = play(&mut other, Act { policy: Some(policy), ..go_on }).await;
    assert_same(&acted, &expected);
    assert_eq!(other.ask(SavePlayer {}).await, session.ask(SavePlayer {}).await);
}

#[tokio::test]
async fn only_ended_leaves_out_everything_else() {
    let server = Server::start(&[]);
    let (mut session, environment) = FULL.session(&server).await;
    let (mut other, _) = FULL.session(&server).await;
    for task in [Asked::Steps(300), Asked::Episodes(7)] {
        let act = FULL.act(&environment, task);
        let (all, _) = play(&mut session, act.clone()).await;
        let (ended, _) = play(&mut other, Act { only_ended: true, ..act }).await;
        assert!(!all.ended.is_empty());
        assert_eq!(ended, Acted { steps: all.steps, ended: all.ended, finished: true, ..Acted::default() });
    }
}

#[tokio::test]
async fn a_test_in_groups_is_that_of_sessions_of_their_own() {
    let server = Server::start(&["--workers", "2"]);
    let group = |size, seed, first_environment_index| SlotGroup {
        size,
        version: Version::Random.into(),
        seed,
        first_environment_index,
        episodes_per_trial: 2,
        ..SlotGroup::default()
    };
    let groups = vec![group(4, 1, 30), group(2, 2, 0), group(90, 1, 30)];
    let game = |n: u32| Game { n: n as usize, testing: true, ..FULL };
    let open = |groups: &[SlotGroup]| Open {
        environment: "CartPole".into(),
        autoreset_mode: AutoresetMode::SameStep.into(),
        groups: groups.to_vec(),
        ..Open::default()
    };
    let (mut together, opened) = Session::open(server.unix(), open(&groups)).await;
    let environment = opened.environment.unwrap();
    let act = |n| Act { only_ended: true, ..game(n).act(&environment, Asked::Steps(150)) };
    let (all, _) = play(&mut together, act(96)).await;
    let mut first = 0;
    for group in groups {
        let (size, slots) = (group.size, first..first + group.size);
        let (mut alone, _) = Session::open(server.unix(), open(&[group])).await;
        let (own, _) = play(&mut alone, act(size)).await;
        let ended = all.ended.iter().cloned().filter_map(|at| {
            let end = at.end.filter(|end| slots.contains(&end.slot))?;
            Some(EndedAt { end: Some(EpisodeEnd { slot: end.slot - first, ..end }), ..at })
        });
        assert_eq!(own.ended, ended.collect::<Vec<_>>());
        assert!(own.ended.len() > size as usize);
        first += size;
    }
}
