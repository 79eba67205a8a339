//! Refused requests `act` and `save_player`. A refusal changes nothing.

use super::game::{FULL, Game, PLAIN, play, wire};
use crate::common::server::{Server, Session, doubles};
use bytes::Bytes;
use perturb::proto::{
    Act, AutoresetMode, Moments, Open, PlayerState, Policy, RandomStream, Release, Reset, Restore, RewardMoments,
    SavePlayer, SlotGroup, Snapshot, Step, TestStreams, Version, act::Task, policy::Role,
};
use rstest::rstest;
use tonic::Code;

/// Returns the policy of a request, which must have one.
fn policy(act: &mut Act) -> &mut Policy {
    act.policy.as_mut().unwrap()
}

fn state(act: &mut Act) -> &mut PlayerState {
    let fresh = PlayerState {
        observations: wire(&[0.0; 20]),
        starts: vec![1; 5].into(),
        outcomes: wire(&[0.0; 20]),
        memory: wire(&[0.0; 60]),
    };
    policy(act).state.get_or_insert(fresh)
}

fn moments(act: &mut Act) -> &mut Moments {
    policy(act).observations.as_mut().unwrap()
}

fn rewards(act: &mut Act) -> &mut RewardMoments {
    policy(act).rewards.as_mut().unwrap()
}

/// Returns `bytes` with the first f32 replaced.
fn with_first(bytes: &Bytes, first: f32) -> Bytes {
    [&first.to_le_bytes()[..], &bytes[4..]].concat().into()
}

#[rstest]
#[case(|a: &mut Act| a.task = Some(Task::Steps(0)), "act.steps is 0; expected at least 1")]
#[case(|a: &mut Act| a.task = Some(Task::Episodes(0)), "act.episodes is 0; expected at least 1")]
#[case(|a: &mut Act| policy(a).hidden = vec![1; 9], "act.policy.hidden is 9 layers; expected at most 8")]
#[case(|a: &mut Act| policy(a).hidden = vec![4, 0], "act.policy.hidden is with a width of 0; expected widths of 1 … 1024")]
#[case(|a: &mut Act| policy(a).hidden = vec![1025], "with a width of 1025")]
#[case(|a: &mut Act| policy(a).lstm = 1025, "act.policy.lstm is 1025; expected a width of 1 … 1024, or 0")]
#[case(|a: &mut Act| policy(a).role = None, "act.policy.role is missing; expected training or testing")]
#[case(|a: &mut Act| policy(a).hidden = vec![9], "act.weights is")]
#[case(|a: &mut Act| a.weights = a.weights.slice(4..), "bytes: float32 [P], ")]
#[case(|a: &mut Act| a.weights = a.weights.slice(1..), "bytes; expected ")]
#[case(|a: &mut Act| a.weights = with_first(&a.weights, f32::NAN), "act.weights is NaN in element 0; expected finite numbers")]
#[case(|a: &mut Act| a.weights = with_first(&a.weights, f32::INFINITY), "act.weights is inf in element 0")]
#[case(|a: &mut Act| moments(a).mean = doubles(&[0.0; 3]), "mean has 3 numbers, expected 4")]
#[case(|a: &mut Act| moments(a).mean = Bytes::from_static(&[0; 7]), "act.policy.observations.mean is 7 bytes; expected 8 bytes")]
#[case(|a: &mut Act| moments(a).squares = doubles(&[-1.0; 4]), "squares holds -1")]
#[case(|a: &mut Act| moments(a).squares = doubles(&[f64::NAN; 4]), "squares holds NaN")]
#[case(|a: &mut Act| moments(a).count = 0, "count is 0, but there are statistics")]
#[case(|a: &mut Act| moments(a).count = u64::MAX, "act.policy.observations.count is 18446744073709551615; expected at most 2^53")]
#[case(|a: &mut Act| rewards(a).gamma = 1.5, "gamma is 1.5")]
#[case(|a: &mut Act| rewards(a).gamma = f64::NAN, "gamma is NaN")]
#[case(|a: &mut Act| rewards(a).returns = doubles(&[0.0; 4]), "the discounted returns [N] has 4 elements, expected 5")]
#[case(|a: &mut Act| rewards(a).returns = doubles(&[f64::INFINITY; 5]), "returns holds inf")]
#[case(|a: &mut Act| rewards(a).moments = None, "act.policy.rewards.moments is missing")]
#[case(
    |a: &mut Act| policy(a).role = Some(Role::Training(RandomStream { key: vec![0; 31].into(), ..RandomStream::default() })),
    "act.policy.training.key is 31 bytes; expected 32 bytes"
)]
#[case(|a: &mut Act| { state(a); policy(a).role = Some(Role::Testing(TestStreams { seed: 1 })); }, "act.policy.state is given in testing")]
#[case(|a: &mut Act| state(a).observations = wire(&[0.0; 19]), "act.policy.state.observations is 76 bytes; expected 80 bytes")]
#[case(|a: &mut Act| state(a).observations = wire(&[f32::NAN; 20]), "act.policy.state.observations is NaN in element 0")]
#[case(|a: &mut Act| state(a).starts = vec![0; 4].into(), "act.policy.state.starts is 4 bytes; expected 5 bytes")]
#[case(|a: &mut Act| state(a).starts = vec![0, 0, 2, 0, 0].into(), "act.policy.state.starts is 2 in slot 2; expected 0 or 1")]
#[case(|a: &mut Act| state(a).outcomes = Bytes::new(), "act.policy.state.outcomes is 0 bytes; expected 80 bytes")]
#[case(|a: &mut Act| state(a).memory = wire(&[0.0; 30]), "act.policy.state.memory is 120 bytes; expected 240 bytes")]
#[tokio::test]
async fn a_bad_value_is_refused(#[case] spoil: fn(&mut Act), #[case] words: &str) {
    let server = Server::start(&[]);
    let (mut session, environment) = FULL.session(&server).await;
    let (mut twin, _) = FULL.session(&server).await;
    let good = FULL.act(&environment, Task::Steps(20));
    let mut bad = good.clone();
    spoil(&mut bad);
    for session in [&mut session, &mut twin] {
        play(session, good.clone()).await;
    }
    let (code, message) = session.refused(bad).await;
    assert_eq!(code, Code::InvalidArgument, "{message}");
    assert!(message.contains(words), "{message}");
    let on = Act { task: Some(Task::Steps(20)), ..Act::default() };
    assert_eq!(play(&mut session, on.clone()).await, play(&mut twin, on).await, "it changed something");
}

/// The state of the session before the refused `act`.
#[derive(Clone, Copy)]
enum Before {
    Nothing,
    Steps,
    HalfATask,
    Step,
    Reset,
    Restore,
    Release,
}

#[rstest]
#[case(Before::Nothing, |a: &mut Act| a.policy = None, "act came without a policy while none plays; send a policy")]
#[case(Before::Nothing, |a: &mut Act| *a = Act { task: a.task, ..Act::default() }, "act came without a policy while none plays")]
#[case(Before::Nothing, |a: &mut Act| a.weights = Bytes::new(), "act came with a new policy but without its weights; send both")]
#[case(Before::Nothing, |a: &mut Act| a.task = None, "act came without a task and none is unfinished; name steps or episodes")]
#[case(Before::Steps, |a: &mut Act| *a = Act::default(), "act came without a task and none is unfinished")]
#[case(Before::HalfATask, |a: &mut Act| a.policy = None, "act came with a task while the previous task is unfinished; finish it")]
#[case(Before::HalfATask, |a: &mut Act| (a.policy, a.task) = (None, None), "act came with weights while a task is unfinished")]
#[case(Before::Step, |a: &mut Act| a.policy = None, "send a policy with its weights, also after a step, reset, restore or release")]
#[case(Before::Reset, |a: &mut Act| a.policy = None, "act came without a policy while none plays")]
#[case(Before::Restore, |a: &mut Act| a.policy = None, "act came without a policy while none plays")]
#[case(Before::Release, |a: &mut Act| a.policy = None, "act came without a policy while none plays")]
#[tokio::test]
async fn an_act_out_of_order_is_refused(#[case] before: Before, #[case] spoil: fn(&mut Act), #[case] words: &str) {
    let server = Server::start(&[]);
    let (mut session, environment) = PLAIN.session(&server).await;
    let good = PLAIN.act(&environment, Task::Steps(20));
    match before {
        Before::Nothing => {}
        Before::HalfATask => assert!(!session.ask(Act { most_steps: 7, ..good.clone() }).await.finished),
        _ => assert!(session.ask(good.clone()).await.finished),
    }
    match before {
        Before::Step => drop(session.step(vec![0; 20].into()).await),
        Before::Reset => drop(session.ask(Reset { mask: vec![1, 0, 0, 0, 0].into(), ..Reset::default() }).await),
        Before::Restore => {
            let snapshots = session.ask(Snapshot::default()).await.snapshots;
            session.ask(Restore { snapshots, ..Restore::default() }).await;
        }
        Before::Release => drop(session.ask(Release { mask: vec![1, 0, 0, 0, 0].into() }).await),
        _ => {}
    }
    let mut bad = good.clone();
    spoil(&mut bad);
    let (code, message) = session.refused(bad).await;
    assert_eq!(code, Code::FailedPrecondition, "{message}");
    assert!(message.contains(words), "{message}");
}

#[tokio::test]
async fn act_is_refused_in_wrong_states_of_the_session() {
    let server = Server::start(&[]);
    let mut session = Session::connect(server.unix()).await;
    assert_eq!(session.refused(Act::default()).await.1, "act came before open; send open first");
    assert_eq!(session.refused(SavePlayer {}).await.1, "save_player came before open; send open first");
    let group = |episodes_per_trial| SlotGroup {
        size: 2,
        version: Version::Default.into(),
        episodes_per_trial,
        ..SlotGroup::default()
    };
    let groups = Open {
        environment: "CartPole".into(),
        autoreset_mode: AutoresetMode::SameStep.into(),
        groups: vec![group(1), group(2)],
        ..Open::default()
    };
    for (open, words) in [
        (
            Open { autoreset_mode: AutoresetMode::NextStep.into(), ..PLAIN.open() },
            "in a session whose autoreset mode is not same-step",
        ),
        (
            Open { autoreset_mode: AutoresetMode::Disabled.into(), ..PLAIN.open() },
            "in a session whose autoreset mode is not same-step",
        ),
        (groups, "in a session whose groups have trials of different lengths"),
    ] {
        let (mut session, opened) = Session::open(server.unix(), open).await;
        let act = PLAIN.act(&opened.environment.unwrap(), Task::Steps(1));
        let (code, message) = session.refused(act).await;
        assert_eq!(code, Code::FailedPrecondition);
        assert!(message.contains(words), "{message}");
    }
}

#[tokio::test]
async fn a_policy_too_large_for_its_environments_is_refused() {
    let server = Server::start(&[]);
    let game = Game { n: 5000, ..PLAIN };
    let (mut session, environment) = game.session(&server).await;
    let mut act = game.act(&environment, Task::Steps(1));
    policy(&mut act).hidden = vec![1024; 8];
    let (code, message) = session.refused(act).await;
    assert_eq!(code, Code::InvalidArgument);
    let words =
        "act.policy is of widths whose sum is 8192, in 5000 environments; expected a product of at most 33554432";
    assert_eq!(message, words);
}

#[tokio::test]
async fn a_player_can_be_saved_between_two_tasks_of_a_training_only() {
    let server = Server::start(&[]);
    let (mut session, environment) = PLAIN.session(&server).await;
    let mut refused = async |request: Option<Act>| {
        if let Some(act) = request {
            session.ask(act).await;
        }
        let (code, message) = session.refused(SavePlayer {}).await;
        assert_eq!(code, Code::FailedPrecondition, "{message}");
        message
    };
    assert!(refused(None).await.starts_with("save_player came while no policy plays; send act"));
    let act = PLAIN.act(&environment, Task::Steps(20));
    let half = Act { most_steps: 7, ..act.clone() };
    assert!(refused(Some(half)).await.starts_with("save_player came in the middle of a task; finish it"));
    let test = Game { testing: true, ..PLAIN }.act(&environment, Task::Steps(20));
    assert!(refused(Some(test)).await.starts_with("save_player came in a test, which has nothing to save"));
    let mut late = act;
    let Some(Role::Training(stream)) = &mut policy(&mut late).role else { panic!("a training") };
    stream.position = u64::MAX;
    assert!(refused(Some(late)).await.starts_with("save_player came after 2^64 words of the stream of actions"));
}

#[tokio::test]
async fn numbers_that_overflow_end_the_play_and_the_session_lives_on() {
    let server = Server::start(&[]);
    let (mut session, environment) = PLAIN.session(&server).await;
    let act = PLAIN.act(&environment, Task::Steps(5));
    let huge = wire(&vec![f32::MAX; act.weights.len() / 4]);
    let (code, message) = session.refused(Act { weights: huge, ..act.clone() }).await;
    assert_eq!(code, Code::InvalidArgument);
    assert!(message.starts_with("the server stopped playing the policy: the policy's output in env"), "{message}");
    let on = Act { task: Some(Task::Steps(5)), ..Act::default() };
    assert_eq!(session.refused(on).await.0, Code::FailedPrecondition);
    session.ask(Step { actions: vec![0; 20].into() }).await;
    assert!(session.ask(act).await.finished);
}
