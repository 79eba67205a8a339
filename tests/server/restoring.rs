//! A restored environment continues exactly as after the snapshot, wherever it is restored. Invalid snapshots do no
//! harm.

use crate::common::{self, action_bytes, episodes, observe, play, start_line, step};
use bytes::Bytes;
use perturb::{
    env::{Distribution, EnvironmentSpec, Episodes, Error, Interval, Version},
    pool::{self, Autoreset, Batch, BatchSettings, Pool, ResetEntry, SlotGroupSettings, StepResult},
};
use proptest::prelude::*;
use serde::{Deserialize, Serialize};
use std::{path::Path, process::Command};

/// The layout of snapshots, as in src/env/snapshot.rs, to make snapshots that no server would make.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Saved {
    format: u32,
    environment: String,
    revision: u32,
    model_hash: String,
    seed: u64,
    environment_index: u32,
    episodes_per_trial: u32,
    distributions: Vec<Vec<(f64, f64)>>,
    values: Vec<f64>,
    progress: Progress,
    state: Vec<f64>,
    held_longest: u32,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Progress {
    trial: u64,
    episode: u64,
    episode_in_trial: u32,
    length: u32,
    total_reward: f64,
    reached_at: u32,
    held_for: u32,
    ended: bool,
    diverged: bool,
}

fn decode(snapshot: &[u8]) -> Saved {
    postcard::from_bytes(&snapshot[..snapshot.len() - CHECKSUM]).unwrap()
}

fn encode(saved: &Saved) -> Vec<u8> {
    sealed(postcard::to_stdvec(saved).unwrap())
}

/// The length of the checksum at the end of a snapshot, bytes.
const CHECKSUM: usize = 4;

fn sealed(content: Vec<u8>) -> Vec<u8> {
    let sum = crc32c::crc32c(&content).to_le_bytes();
    [content, sum.to_vec()].concat()
}

/// Returns an environment in the second episode of its first trial. It has taken at most 4 steps, because episodes of
/// some environments end soon.
fn used(spec: &EnvironmentSpec) -> Episodes {
    let mut e = episodes(spec, Version::E, 31, 5, 3);
    step(&mut e, &action_bytes(spec, 1, 0));
    e.begin(None);
    for t in 1..=4 {
        let before = e.snapshot();
        step(&mut e, &action_bytes(spec, 1, t));
        if e.ended() {
            e.restore(&before).unwrap();
            break;
        }
    }
    e
}

/// Returns an environment with another history.
fn other(spec: &EnvironmentSpec) -> Episodes {
    let mut e = episodes(spec, Version::R, 99, 1000, 1);
    play(&mut e, 2, 0, 77);
    e
}

fn refused(result: Result<(), Error>) -> String {
    match result {
        Err(Error::Snapshot { reason }) => reason,
        other => panic!("not refused as a snapshot: {other:?}"),
    }
}

#[test]
fn restored_environment_of_r_and_e_continues_with_both() {
    for spec in common::catalogue().specs() {
        let mut e = episodes(spec, Version::RE, 31, 5, 1);
        let saved = e.snapshot();
        let mut other = episodes(spec, Version::D, 1, 1, 1);
        other.restore(&saved).unwrap();
        assert_eq!(other.settings(), e.settings());
        for _ in 0..20 {
            e.begin(None);
            other.begin(None);
            assert_eq!(start_line(&other), start_line(&e));
        }
        let mut saved = decode(&saved);
        saved.distributions.pop(); // the last box lacks a distribution
        let refused = other.restore(&encode(&saved)).unwrap_err().to_string();
        assert!(refused.contains("it does not have the"), "{refused}");
    }
}

#[test]
fn a_snapshot_in_mid_episode_continues_with_the_same_bytes() {
    for spec in common::catalogue().specs() {
        let mut e = used(spec);
        assert!(!e.ended(), "{}", spec.name);
        let snapshot = e.snapshot();
        let steps = u64::from(spec.step_limit) + 100;
        let expected = play(&mut e, 3, 0, steps);
        assert!(expected.iter().any(|line| line.starts_with("start")), "{}: later episodes are compared", spec.name);
        // Restores into the same environment, into an environment with another history, and into a new environment.
        for mut target in [e, other(spec), episodes(spec, Version::D, 0, 0, 1)] {
            target.restore(&snapshot).unwrap();
            assert_eq!(target.snapshot(), snapshot, "{}", spec.name);
            assert_eq!(play(&mut target, 3, 0, steps), expected, "{}", spec.name);
        }
    }
}

#[test]
fn every_moment_of_an_episode_can_be_restored() {
    for spec in common::catalogue().specs() {
        let mut e = episodes(spec, Version::E, 31, 5, 2);
        let mut target = other(spec);
        for t in 0..150 {
            if e.ended() {
                e.begin(None);
            }
            step(&mut e, &action_bytes(spec, 1, t));
            target.restore(&e.snapshot()).unwrap();
            assert_eq!((observe(&target), target.id(), target.ended()), (observe(&e), e.id(), e.ended()));
            assert_eq!(target.receipt(), e.receipt(), "{}", spec.name);
            assert_eq!(target.finished(true), e.finished(true), "{}", spec.name);
            assert_eq!(play(&mut target, 2, 0, 12), {
                let snapshot = e.snapshot();
                let lines = play(&mut e, 2, 0, 12);
                e.restore(&snapshot).unwrap();
                lines
            });
        }
    }
}

#[test]
fn restored_ended_environment_stays_ended() {
    for spec in common::catalogue().specs() {
        for episode_in_trial in 0..2 {
            let mut e = episodes(spec, Version::R, 31, 5, 2);
            (0..episode_in_trial).for_each(|_| e.begin(None));
            for t in 0.. {
                if e.ended() {
                    break;
                }
                step(&mut e, &action_bytes(spec, 1, t));
            }
            let snapshot = e.snapshot();
            let mut target = other(spec);
            target.restore(&snapshot).unwrap();
            assert!(target.ended());
            assert_eq!(target.finished(true), e.finished(true));
            e.begin(None);
            target.begin(None);
            // After the second episode comes a new trial, with parameters drawn from the restored distributions.
            assert_eq!(e.id().trial_index, episode_in_trial);
            assert_eq!(start_line(&target), start_line(&e));
            assert_eq!(play(&mut target, 4, 0, 300), play(&mut e, 4, 0, 300), "{}", spec.name);
        }
    }
}

#[test]
fn overridden_distributions_are_saved() {
    for spec in common::catalogue().specs() {
        let distributions = spec
            .parameters
            .iter()
            .map(|p| Distribution::union(&[p.random, Interval::new(p.extreme[1].low, p.extreme[1].high)]).unwrap())
            .collect();
        let mut e = episodes(spec, Version::D, 3, 0, 1);
        e.begin_trial(None, Some(distributions), None);
        let mut target = other(spec);
        target.restore(&e.snapshot()).unwrap();
        assert_eq!(target.settings(), e.settings());
        e.begin(None);
        target.begin(None);
        assert_eq!(start_line(&target), start_line(&e));
    }
}

#[test]
fn an_episode_from_an_exact_state_can_be_restored() {
    for spec in common::catalogue().specs() {
        let mut e = episodes(spec, Version::R, 3, 0, 1);
        let state: Vec<f64> = spec.state.iter().map(|c| 0.01_f64.clamp(c.low, c.high)).collect();
        e.begin(Some(&state));
        let mut target = other(spec);
        target.restore(&e.snapshot()).unwrap();
        assert_eq!(play(&mut target, 4, 0, 100), play(&mut e, 4, 0, 100), "{}", spec.name);
    }
}

const CHILD: &str = "PERTURB_TEST_SNAPSHOTS";

#[test]
fn a_snapshot_continues_in_another_process() {
    if let Some(directory) = std::env::var_os(CHILD) {
        // This code runs in the other process.
        for spec in common::catalogue().specs() {
            let path = Path::new(&directory).join(spec.name);
            let mut e = episodes(spec, Version::D, 0, 0, 1);
            e.restore(&std::fs::read(&path).unwrap()).unwrap();
            std::fs::write(path.with_extension("lines"), play(&mut e, 3, 0, 700).join("\n")).unwrap();
        }
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    for spec in common::catalogue().specs() {
        std::fs::write(directory.path().join(spec.name), used(spec).snapshot()).unwrap();
    }
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "restoring::a_snapshot_continues_in_another_process"])
        .env(CHILD, directory.path())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
    for spec in common::catalogue().specs() {
        let lines = std::fs::read_to_string(directory.path().join(spec.name).with_extension("lines")).unwrap();
        assert_eq!(lines, play(&mut used(spec), 3, 0, 700).join("\n"), "{}", spec.name);
    }
}

// Refused snapshots.

#[test]
fn the_layout_here_is_that_of_snapshots() {
    for spec in common::catalogue().specs() {
        let snapshot = used(spec).snapshot();
        assert_eq!(encode(&decode(&snapshot)), snapshot);
    }
}

#[test]
fn snapshots_of_other_environments_are_refused() {
    for spec in common::catalogue().specs() {
        for foreign in common::catalogue().specs().filter(|foreign| foreign.name != spec.name) {
            let mut e = used(spec);
            let before = e.snapshot();
            let reason = refused(e.restore(&used(foreign).snapshot()));
            assert!(reason.contains(foreign.name) && reason.contains(spec.name), "{reason}");
            assert_eq!(e.snapshot(), before);
        }
    }
}

#[test]
fn contradictory_snapshots_are_refused() {
    type Edit = fn(&mut Saved, &EnvironmentSpec);
    let edits: &[(&str, Edit)] = &[
        ("another format", |s, _| s.format += 1),
        ("another revision", |s, _| s.revision += 1),
        ("another model", |s, _| s.model_hash.push('0')),
        ("a name that is none", |s, _| s.environment.push('x')),
        ("a parameter too few", |s, _| {
            s.values.pop();
        }),
        ("a parameter too many", |s, _| s.values.push(1.0)),
        ("a distribution too few", |s, _| {
            s.distributions.pop();
        }),
        ("a distribution too many", |s, _| s.distributions.push(vec![(1.0, 1.0)])),
        ("an empty distribution", |s, _| s.distributions[0].clear()),
        ("a reversed interval", |s, _| s.distributions[0] = vec![(2.0, 1.0)]),
        ("an infinite interval", |s, _| s.distributions[0] = vec![(1.0, f64::INFINITY)]),
        ("a distribution out of bounds", |s, spec| s.distributions[0][0].0 = spec.parameters[0].bounds.low.next_down()),
        ("a value out of bounds", |s, spec| s.values[1] = spec.parameters[1].bounds.high.next_up()),
        ("a value that is none", |s, _| s.values[0] = f64::NAN),
        ("no episodes in a trial", |s, _| (s.episodes_per_trial, s.progress.episode_in_trial) = (0, 0)),
        ("an episode beyond the trial", |s, _| s.progress.episode_in_trial = s.episodes_per_trial),
        ("a return that is no number", |s, _| s.progress.total_reward = f64::NAN),
        ("an infinite return", |s, _| s.progress.total_reward = f64::INFINITY),
        ("an episode beyond the limit", |s, spec| s.progress.length = spec.step_limit + 1),
        ("an episode at the limit that goes on", |s, spec| s.progress.length = spec.step_limit),
        ("a goal held for longer than the episode", |s, _| s.progress.held_for = s.progress.length + 1),
        ("a goal held for longer than the longest time", |s, _| (s.progress.held_for, s.held_longest) = (1, 0)),
        ("a longest time longer than the episode", |s, _| s.held_longest = s.progress.length + 1),
        ("a goal held for ever", |s, _| s.progress.held_for = u32::MAX),
        ("a goal reached in the future", |s, _| s.progress.reached_at = s.progress.length + 1),
        ("more trials than episodes", |s, _| s.progress.trial = s.progress.episode + 1),
        ("counts at their end", |s, _| (s.progress.trial, s.progress.episode) = (u64::MAX, u64::MAX)),
        // A state with one number fewer is valid: it is the old format, in which robots did not store their largest
        // distance.
        ("two numbers too few in the state", |s, _| s.state.truncate(s.state.len() - 2)),
        ("a number too many in the state", |s, _| s.state.push(0.0)),
        ("a state that is no number", |s, _| s.state[0] = f64::NAN),
        ("an infinite state", |s, _| s.state[1] = f64::NEG_INFINITY),
    ];
    for spec in common::catalogue().specs() {
        let valid = decode(&used(spec).snapshot());
        for (what, edit) in edits {
            let mut saved = valid.clone();
            edit(&mut saved, spec);
            let mut e = other(spec);
            let (before, observed) = (e.snapshot(), observe(&e));
            let result = e.restore(&encode(&saved));
            assert!(matches!(result, Err(Error::Snapshot { .. })), "{}: {what}: {result:?}", spec.name);
            assert_eq!((e.snapshot(), observe(&e)), (before, observed), "{}: {what}", spec.name);
            assert_eq!(play(&mut e, 1, 0, 50), play_other(spec), "{}: {what}", spec.name);
        }
    }
}

fn play_other(spec: &EnvironmentSpec) -> Vec<String> {
    play(&mut other(spec), 1, 0, 50)
}

#[test]
fn every_truncated_snapshot_is_refused() {
    for spec in common::catalogue().specs() {
        let snapshot = used(spec).snapshot();
        let mut e = other(spec);
        let before = e.snapshot();
        for length in 0..snapshot.len() {
            refused(e.restore(&snapshot[..length]));
        }
        assert_eq!(e.snapshot(), before);
    }
}

#[test]
fn every_changed_byte_of_a_snapshot_is_refused() {
    for spec in common::catalogue().specs() {
        let snapshot = used(spec).snapshot();
        let mut e = other(spec);
        let before = e.snapshot();
        for place in 0..snapshot.len() {
            let mut changed = snapshot.clone();
            changed[place] ^= 1 << (place % 8);
            refused(e.restore(&changed));
        }
        assert_eq!(e.snapshot(), before);
    }
}

#[test]
fn a_snapshot_with_something_behind_it_is_refused() {
    for spec in common::catalogue().specs() {
        refused(other(spec).restore(&[used(spec).snapshot(), vec![0]].concat()));
    }
}

/// Restores bytes that may be no valid snapshot. Asserts that they are either refused without a change, or accepted
/// without harm.
fn try_restore(spec: &EnvironmentSpec, bytes: &[u8]) -> Result<(), TestCaseError> {
    let mut e = other(spec);
    let before = e.snapshot();
    match e.restore(bytes) {
        Err(Error::Snapshot { .. }) => prop_assert_eq!(e.snapshot(), before),
        Err(error) => prop_assert!(false, "{}", error),
        Ok(()) => {
            for t in 0..60 {
                if e.ended() {
                    e.begin(None);
                }
                let (outcome, _) = step(&mut e, &action_bytes(spec, 1, t));
                prop_assert!(outcome.reward.is_finite());
                prop_assert!(observe(&e).iter().all(|x| x.is_finite()));
            }
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

    #[test]
    fn garbage_does_no_harm(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        for spec in common::catalogue().specs() {
            try_restore(spec, &bytes)?;
        }
    }

    #[test]
    fn flipped_bits_do_no_harm(flips in prop::collection::vec((any::<prop::sample::Index>(), 0..8_u32), 1..4)) {
        for spec in common::catalogue().specs() {
            let mut snapshot = used(spec).snapshot();
            snapshot.truncate(snapshot.len() - CHECKSUM);
            for (index, bit) in &flips {
                let index = index.index(snapshot.len());
                snapshot[index] ^= 1 << bit;
            }
            try_restore(spec, &sealed(snapshot))?; // with a valid checksum
        }
    }
}

// Snapshots of batches.

fn batch_settings(spec: &'static EnvironmentSpec, seed: u64, size: usize, autoreset: Autoreset) -> BatchSettings {
    let episodes = common::settings(spec, Version::R, seed, 0, 2);
    let groups = vec![SlotGroupSettings { size, episodes }];
    BatchSettings {
        spec,
        groups,
        autoreset,
        receipts: true,
        receipt_arrays: false,
        reward_terms: true,
        observe_parameters: false,
    }
}

fn actions(spec: &EnvironmentSpec, size: usize, t: u64) -> Vec<u8> {
    (0..size as u64).flat_map(|slot| action_bytes(spec, slot, t)).collect()
}

async fn run(batch: &mut Batch, steps: std::ops::Range<u64>) -> Vec<StepResult> {
    let (spec, size) = (batch.settings().spec, batch.size());
    let mut all = Vec::new();
    for t in steps {
        all.push(batch.step(&actions(spec, size, t)).await.unwrap());
    }
    all
}

#[tokio::test]
async fn a_batch_restored_into_another_goes_on_with_the_same_bytes() {
    for spec in common::catalogue().specs() {
        for mode in [Autoreset::NextStep, Autoreset::SameStep] {
            // The batch is large enough for several shards, and is cut differently for one worker and for four workers.
            let size = (if spec.step_cost < 1.0 { 60.0 } else { 200.0 } / spec.step_cost).ceil() as usize;
            let (one, four) = (Pool::new(1, size).unwrap(), Pool::new(4, size).unwrap());
            let (mut batch, ..) = Batch::open(&one, batch_settings(spec, 1, size, mode)).await.unwrap();
            run(&mut batch, 0..25).await;
            let snapshots = batch.snapshot((0..size).collect()).await.unwrap();
            if mode == Autoreset::NextStep && spec.name == "CartPole" {
                assert!(snapshots.iter().any(|s| decode(s).progress.ended), "some wait for their next step");
            }
            let expected = run(&mut batch, 25..60).await;

            let (mut target, ..) = Batch::open(&four, batch_settings(spec, 2, size, mode)).await.unwrap();
            run(&mut target, 0..7).await;
            let entries = snapshots.iter().cloned().enumerate().collect();
            let observed = target.restore(entries).await.unwrap();
            assert_eq!(observed.len(), 4 * size * spec.observation.len());
            assert_eq!(target.snapshot((0..size).collect()).await.unwrap(), snapshots);
            assert!(run(&mut target, 25..60).await == expected, "{} {mode:?}", spec.name);
        }
    }
}

#[tokio::test]
async fn a_snapshot_goes_on_in_another_slot() {
    for spec in common::catalogue().specs() {
        let pool = Pool::new(2, 6).unwrap();
        let (mut batch, ..) = Batch::open(&pool, batch_settings(spec, 1, 6, Autoreset::SameStep)).await.unwrap();
        run(&mut batch, 0..9).await;
        let snapshot = batch.snapshot(vec![1]).await.unwrap().remove(0);
        let observed = batch.restore(vec![(4, snapshot.clone()), (5, snapshot)]).await.unwrap();
        let width = 4 * spec.observation.len();
        assert_eq!(observed[..width], observed[width..]);
        // The three slots get the same actions, and give the same bytes, including episodes and their indices.
        for t in 0..u64::from(spec.step_limit + 5) {
            let action = action_bytes(spec, 1, t);
            let stepped = batch.step(&action.repeat(6)).await.unwrap();
            let row = |slot: usize| &stepped.observations[slot * width..][..width];
            assert!(row(1) == row(4) && row(1) == row(5), "{} step {t}", spec.name);
            let end = |slot: u32| stepped.ended.iter().find(|(of, _)| *of == slot).map(|(_, end)| end);
            assert!(end(1) == end(4) && end(1) == end(5), "{} step {t}", spec.name);
            let start = |slot: u32| stepped.started.iter().find(|(of, _)| *of == slot).map(|(_, start)| start);
            assert!(start(1) == start(4) && start(1) == start(5), "{} step {t}", spec.name);
        }
    }
}

#[tokio::test]
async fn a_refused_restore_of_several_changes_nothing_in_any_shard() {
    for spec in common::catalogue().specs() {
        let size = (if spec.step_cost < 1.0 { 60.0 } else { 200.0 } / spec.step_cost).ceil() as usize;
        let pool = Pool::new(4, size).unwrap();
        let settings = batch_settings(spec, 1, size, Autoreset::SameStep);
        let (mut batch, ..) = Batch::open(&pool, settings).await.unwrap();
        let all = || (0..size).collect::<Vec<_>>();
        let early = batch.snapshot(all()).await.unwrap();
        run(&mut batch, 0..9).await;
        let before = batch.snapshot(all()).await.unwrap();
        assert!(before.iter().zip(&early).all(|(a, b)| a != b));
        // The snapshot at the start, in the middle or at the end is invalid. All other snapshots are valid.
        for wrong in [0, size / 2, size - 1] {
            let mut entries: Vec<(usize, Bytes)> = early.iter().cloned().enumerate().collect();
            entries[wrong].1 = Bytes::from_static(b"garbage");
            let refused = batch.restore(entries).await;
            assert!(matches!(refused, Err(pool::Error::Environment(Error::Snapshot { .. }))), "{refused:?}");
            assert!(batch.snapshot(all()).await.unwrap() == before, "{}: slot {wrong} is wrong", spec.name);
        }
        // The batch continues as if nothing had been requested.
        let after = run(&mut batch, 9..30).await;
        batch.restore(before.into_iter().enumerate().collect()).await.unwrap();
        assert!(run(&mut batch, 9..30).await == after, "{}", spec.name);
    }
}

#[tokio::test]
async fn ended_snapshot_is_refused_in_same_step_mode() {
    let spec = common::catalogue().find("CartPole").unwrap();
    let pool = Pool::new(1, 2).unwrap();
    let (mut next, ..) = Batch::open(&pool, batch_settings(spec, 1, 1, Autoreset::NextStep)).await.unwrap();
    while next.step(&0_i32.to_le_bytes()).await.unwrap().ended.is_empty() {}
    let ended = next.snapshot(vec![0]).await.unwrap().remove(0);
    next.step(&0_i32.to_le_bytes()).await.unwrap();
    next.restore(vec![(0, ended.clone())]).await.unwrap();
    let (mut same, ..) = Batch::open(&pool, batch_settings(spec, 1, 1, Autoreset::SameStep)).await.unwrap();
    let before = same.snapshot(vec![0]).await.unwrap();
    let refused = same.restore(vec![(0, ended)]).await;
    assert!(matches!(refused, Err(pool::Error::Environment(Error::Snapshot { .. }))), "{refused:?}");
    assert_eq!(same.snapshot(vec![0]).await.unwrap(), before);
}

#[tokio::test]
async fn after_a_refused_restore_observations_are_those_of_before() {
    for spec in common::catalogue().specs() {
        let pool = Pool::new(1, 3).unwrap();
        let (mut batch, ..) = Batch::open(&pool, batch_settings(spec, 1, 3, Autoreset::Disabled)).await.unwrap();
        let early = batch.snapshot(vec![0]).await.unwrap().remove(0);
        let last = run(&mut batch, 0..4).await.pop().unwrap();
        batch.restore(vec![(0, early), (1, Bytes::new())]).await.unwrap_err();
        // A step reports all observations. A reset of another slot shows that the first slot kept its observation.
        batch.reset(vec![ResetEntry { slot: 2, seed: None, distributions: None, state: None }]).await.unwrap();
        let now = batch.snapshot(vec![0]).await.unwrap().remove(0);
        let observed = batch.restore(vec![(0, now)]).await.unwrap();
        let width = 4 * spec.observation.len();
        assert_eq!(observed[..], last.observations[..width], "{}", spec.name);
    }
}

#[rstest::rstest]
#[case("Pendulum", 1, 8.5)]
#[case("Pendulum", 1, -1e30)]
#[case("Pendulum", 0, 11_000.0)]
#[case("MountainCar", 0, 1.3)]
#[case("MountainCar", 1, -0.08)]
#[case("Acrobot", 0, 3.2)]
#[case("Acrobot", 3, 29.0)]
fn a_state_that_the_dynamics_never_reach_is_refused(#[case] name: &str, #[case] entry: usize, #[case] value: f64) {
    let spec = common::catalogue().find(name).unwrap();
    let mut environment = episodes(spec, Version::D, 1, 0, 1);
    let before = environment.snapshot();
    let mut saved: Saved = postcard::from_bytes(&before).unwrap();
    saved.state[entry] = value;
    let refused = environment.restore(&sealed(postcard::to_stdvec(&saved).unwrap()));
    assert!(matches!(&refused, Err(Error::Snapshot { reason }) if reason.contains("within")), "{refused:?}");
    assert_eq!(environment.snapshot(), before);
}
