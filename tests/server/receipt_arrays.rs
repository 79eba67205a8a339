//! Receipts as arrays.

use crate::common::server::{Actor, Server, Session, catalogue, open};
use bytes::Bytes;
use perturb::proto::{AutoresetMode, EpisodeEnd, Open, Stepped, Version};
use rstest::rstest;

/// Returns the arrays that correspond to a step result with receipts as messages.
fn arrays(stepped: &Stepped) -> (Bytes, Bytes) {
    let ended = stepped.ended.iter().map(|end| (end.slot, end.episode.unwrap(), end.receipt.as_ref().unwrap()));
    let started =
        stepped.started.iter().map(|start| (start.slot, start.episode.unwrap(), start.receipt.as_ref().unwrap()));
    let (mut episodes, mut values) = (Vec::new(), Vec::new());
    for (slot, episode, receipt) in ended.chain(started) {
        let trial = [episode.trial_index, episode.episode_index, episode.episode_in_trial.into()];
        let numbers = [u64::from(slot), episode.environment_index.into()].into_iter().chain(trial);
        episodes.extend(numbers.flat_map(u64::to_le_bytes));
        values.extend(receipt.requested.iter().chain(&receipt.applied).flat_map(|value| value.to_le_bytes()));
    }
    (episodes.into(), values.into())
}

#[rstest]
#[tokio::test]
async fn arrays_have_what_messages_have_and_all_else_is_the_same(
    #[values(AutoresetMode::NextStep, AutoresetMode::SameStep)] mode: AutoresetMode,
) {
    const N: usize = 7;
    let server = Server::start(&["--workers", "3"]);
    for environment in &catalogue(server.unix()).await {
        let by_messages = Open {
            version: Version::Extreme.into(),
            episodes_per_trial: 2,
            first_environment_index: 5,
            autoreset_mode: mode.into(),
            ..open(&environment.name, N as u32, 3)
        };
        let (mut session, opened) = Session::open(server.unix(), by_messages.clone()).await;
        assert!(!opened.receipt_arrays);
        let asked = Open { receipt_arrays: true, ..by_messages.clone() };
        let (mut by_arrays, first) = Session::open(server.unix(), asked.clone()).await;
        assert!(first.receipt_arrays);
        assert_eq!(first.started, opened.started, "the reply to open has receipts as messages in any case");
        let (mut without, _) = Session::open(server.unix(), Open { receipts: false, ..asked }).await;
        let actor = Actor::new(environment, N);
        let (mut ended, mut began) = (0, 0);
        for t in 0..u64::from(environment.step_limit) + 20 {
            let stepped = session.step(actor.actions(t)).await;
            let (receipt_episodes, receipt_values) = arrays(&stepped);
            ended += stepped.ended.len();
            began += stepped.started.len();
            let bare = |end: &EpisodeEnd| EpisodeEnd { receipt: None, ..end.clone() };
            let bare = stepped.ended.iter().map(bare).collect();
            let expected = Stepped { ended: bare, started: Vec::new(), receipt_episodes, receipt_values, ..stepped };
            assert_eq!(by_arrays.step(actor.actions(t)).await, expected, "{}, step {t}", environment.name);
            let nothing = Stepped { receipt_episodes: Bytes::new(), receipt_values: Bytes::new(), ..expected };
            assert_eq!(without.step(actor.actions(t)).await, nothing, "nothing unless receipts were asked for");
        }
        assert!(ended >= N && began >= N, "{}", environment.name);
    }
}
