//! The pool: a batch gives the bytes of its environments, no matter which thread steps them, and frees its
//! environments.

use crate::common::{self, action_bytes, floats, observe, step};
use bytes::Bytes;
use perturb::{
    env::{Distribution, EnvironmentSpec, EpisodeSettings, Episodes, FinishedEpisode, StartedEpisode, Version},
    pool::{Autoreset, Batch, BatchSettings, Error, Pool, ResetEntry, SlotGroupSettings, StepResult},
};
use rstest::rstest;
use std::{
    future::{Future, poll_fn},
    pin::{Pin, pin},
    sync::{Arc, Mutex},
    task::{Context, Poll, Wake, Waker},
    time::{Duration, Instant},
};

const MODES: [Autoreset; 3] = [Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled];

fn batch_settings(spec: &'static EnvironmentSpec, size: usize, autoreset: Autoreset) -> BatchSettings {
    let episodes = common::settings(spec, Version::R, 17, 100, 2);
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

/// Returns random actions for environments with indices from `first` on.
fn actions(spec: &EnvironmentSpec, first: u32, size: usize, t: u64) -> Vec<u8> {
    (0..size as u64).flat_map(|slot| action_bytes(spec, u64::from(first) + slot, t)).collect()
}

fn put(out: &mut Vec<u8>, values: &[f32]) {
    values.iter().for_each(|value| out.extend_from_slice(&value.to_le_bytes()));
}

fn entry(slot: usize) -> ResetEntry {
    ResetEntry { slot, seed: None, distributions: None, state: None }
}

/// Returns the starts of single environments as a batch reports them.
fn starts(models: &[Episodes]) -> Vec<(u32, StartedEpisode)> {
    models.iter().enumerate().map(|(slot, e)| (slot as u32, e.started(true))).collect()
}

fn observations(models: &[Episodes]) -> Vec<u8> {
    let mut out = Vec::new();
    models.iter().for_each(|e| put(&mut out, &observe(e)));
    out
}

/// A reference for a batch: single environments, stepped one after the other.
struct Model {
    models: Vec<Episodes>,
    autoreset: Autoreset,
}

impl Model {
    fn new(settings: &BatchSettings) -> Self {
        let model = |slot| {
            let environment_index = settings.groups[0].episodes.environment_index + slot as u32;
            let settings_of_slot = EpisodeSettings { environment_index, ..settings.groups[0].episodes.clone() };
            Episodes::new((settings.spec.make)().unwrap(), settings_of_slot)
        };
        Self { models: (0..settings.size()).map(model).collect(), autoreset: settings.autoreset }
    }

    fn step(&mut self, actions: &[u8]) -> StepResult {
        let (mut all, mut rewards, mut terms, mut last) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let (mut terminated, mut truncated, mut ended, mut started) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let width = actions.len() / self.models.len();
        for (slot, e) in self.models.iter_mut().enumerate() {
            if e.ended() {
                assert_eq!(self.autoreset, Autoreset::NextStep);
                e.begin(None);
                started.push((slot as u32, e.started(true)));
                put(&mut all, &observe(e));
                put(&mut rewards, &[0.0]);
                put(&mut terms, &vec![0.0; e.spec().reward_terms.len()]);
                terminated.push(0);
                truncated.push(0);
                continue;
            }
            let (outcome, of_step) = step(e, &actions[slot * width..][..width]);
            put(&mut rewards, &[outcome.reward as f32]);
            of_step.iter().for_each(|term| put(&mut terms, &[*term as f32]));
            terminated.push(u8::from(outcome.terminated));
            truncated.push(u8::from(outcome.truncated));
            if e.ended() {
                put(&mut last, &observe(e));
                ended.push((slot as u32, e.finished(true)));
                if self.autoreset == Autoreset::SameStep {
                    e.begin(None);
                    started.push((slot as u32, e.started(true)));
                }
            }
            put(&mut all, &observe(e));
        }
        StepResult {
            observations: all.into(),
            rewards: rewards.into(),
            terminated: terminated.into(),
            truncated: truncated.into(),
            reward_terms: terms.into(),
            final_observations: last.into(),
            ended,
            started,
            ..StepResult::default()
        }
    }

    fn ended(&self) -> Vec<usize> {
        (0..self.models.len()).filter(|&slot| self.models[slot].ended()).collect()
    }
}

#[tokio::test]
async fn batch_gives_the_bytes_of_its_environments() {
    for spec in common::catalogue().specs() {
        for mode in MODES {
            let size = 5;
            let pool = Pool::new(2, size).unwrap();
            let settings = batch_settings(spec, size, mode);
            let mut model = Model::new(&settings);
            let (mut batch, first, started) = Batch::open(&pool, settings).await.unwrap();
            assert_eq!(first, observations(&model.models));
            assert_eq!(started, starts(&model.models));
            let mut ended = 0;
            for t in 0..u64::from(2 * spec.step_limit + 5) {
                let slots = model.ended();
                if mode == Autoreset::Disabled && !slots.is_empty() {
                    slots.iter().for_each(|&slot| model.models[slot].begin(None));
                    let entries = slots.iter().map(|&slot| entry(slot)).collect();
                    let (first, started) = batch.reset(entries).await.unwrap();
                    let all = starts(&model.models);
                    assert_eq!(started, slots.iter().map(|&slot| all[slot].clone()).collect::<Vec<_>>());
                    let width = 4 * spec.observation.len();
                    let expected = observations(&model.models);
                    assert_eq!(
                        first,
                        slots.iter().flat_map(|s| &expected[s * width..][..width]).copied().collect::<Vec<_>>()
                    );
                }
                let actions = actions(spec, 100, size, t);
                let stepped = batch.step(&actions).await.unwrap();
                assert_eq!(stepped, model.step(&actions), "{} {mode:?} step {t}", spec.name);
                ended += stepped.ended.len();
            }
            assert!(ended >= size, "{} {mode:?}: every slot ended about once or more", spec.name);
        }
    }
}

/// Opens a CartPole batch of one and pushes it to one side until it falls. Returns the batch, and the result of the
/// last step.
async fn fall(pool: &Pool, mode: Autoreset) -> (Batch, StepResult) {
    let spec = common::catalogue().find("CartPole").unwrap();
    let (mut batch, _, _) = Batch::open(pool, batch_settings(spec, 1, mode)).await.unwrap();
    loop {
        let stepped = batch.step(&[1, 0, 0, 0]).await.unwrap();
        if !stepped.ended.is_empty() {
            return (batch, stepped);
        }
        assert_eq!((&stepped.terminated[..], &stepped.truncated[..]), (&[0][..], &[0][..]));
        assert!(stepped.started.is_empty() && stepped.final_observations.is_empty());
    }
}

fn beyond_the_limit(observation: &[u8]) -> bool {
    floats(observation)[2].abs() > 0.2
}

#[tokio::test]
async fn next_step_mode_resets_with_reward_0_and_no_flags() {
    let pool = Pool::new(1, 1).unwrap();
    let (mut batch, last) = fall(&pool, Autoreset::NextStep).await;
    assert_eq!((last.terminated[0], last.truncated[0], floats(&last.rewards)[0]), (1, 0, 1.0));
    assert!(beyond_the_limit(&last.observations));
    assert_eq!(last.final_observations, last.observations);
    assert!(last.started.is_empty());

    let next = batch.step(&[0; 4]).await.unwrap();
    assert_eq!((next.terminated[0], next.truncated[0], floats(&next.rewards)[0]), (0, 0, 0.0));
    assert_eq!(floats(&next.reward_terms), [0.0]);
    assert!(!beyond_the_limit(&next.observations) && next.ended.is_empty() && next.final_observations.is_empty());
    assert_eq!(next.started[0].1.id.episode_index, 1);

    // The ignored action has no effect, so another action gives the same result.
    drop(batch);
    let (mut other, _) = fall(pool_with_room(&pool).await, Autoreset::NextStep).await;
    assert_eq!(other.step(&[1, 0, 0, 0]).await.unwrap(), next);
}

/// Waits until no environment of the pool is in use.
async fn pool_with_room(pool: &Pool) -> &Pool {
    wait_until(|| pool.environments() == 0).await;
    pool
}

#[tokio::test]
async fn same_step_mode_keeps_the_final_observation() {
    let pool = Pool::new(1, 1).unwrap();
    let (mut batch, last) = fall(&pool, Autoreset::SameStep).await;
    assert_eq!((last.terminated[0], last.truncated[0], floats(&last.rewards)[0]), (1, 0, 1.0));
    assert!(beyond_the_limit(&last.final_observations));
    assert!(!beyond_the_limit(&last.observations));
    assert_eq!((last.ended[0].1.id.episode_index, last.started[0].1.id.episode_index), (0, 1));

    let next = batch.step(&[0; 4]).await.unwrap();
    assert_eq!((next.terminated[0], floats(&next.rewards)[0]), (0, 1.0), "a step like any other");
    assert!(next.started.is_empty());
}

#[tokio::test]
async fn disabled_mode_refuses_steps_of_ended_environments() {
    let pool = Pool::new(1, 1).unwrap();
    let (mut batch, last) = fall(&pool, Autoreset::Disabled).await;
    assert!(beyond_the_limit(&last.observations) && last.final_observations == last.observations);
    let before = batch.snapshot(vec![0]).await.unwrap();
    for _ in 0..2 {
        assert_eq!(batch.step(&[0; 4]).await, Err(Error::Ended { slots: "0".into() }));
    }
    assert_eq!(batch.snapshot(vec![0]).await.unwrap(), before, "a refused step changes nothing");
    let (first, started) = batch.reset(vec![entry(0)]).await.unwrap();
    assert!(!beyond_the_limit(&first));
    assert_eq!(started[0].1.id.episode_index, 1);
    assert_eq!(floats(&batch.step(&[0; 4]).await.unwrap().rewards), [1.0]);
}

#[tokio::test]
async fn a_refused_step_names_the_slots_that_ended() {
    let spec = common::catalogue().find("CartPole").unwrap();
    let pool = Pool::new(4, 2000).unwrap();
    // The batch is large enough for several shards.
    let size = 2000;
    let (mut batch, _, _) = Batch::open(&pool, batch_settings(spec, size, Autoreset::Disabled)).await.unwrap();
    let fallen = |angle| move |slot| ResetEntry { state: Some(vec![0.0, 0.0, angle, 0.0]), ..entry(slot) };
    batch.reset((0..size).map(fallen(0.0)).collect()).await.unwrap();
    batch.reset(vec![fallen(0.3)(3), fallen(0.3)(1500)]).await.unwrap();
    let actions = vec![0; 4 * size];
    let stepped = batch.step(&actions).await.unwrap();
    assert_eq!(stepped.ended.iter().map(|(slot, _)| *slot).collect::<Vec<_>>(), [3, 1500]);
    assert_eq!(batch.step(&actions).await, Err(Error::Ended { slots: "3, 1500".into() }));
    let many: Vec<_> = (10..20).map(fallen(0.3)).chain([3, 1500].map(fallen(0.0))).collect();
    batch.reset(many).await.unwrap();
    batch.step(&actions).await.unwrap();
    let Err(Error::Ended { slots }) = batch.step(&actions).await else { panic!("refused") };
    assert_eq!(slots, "10, 11, 12, 13, 14, 15, 16, 17 and 2 more");
}

#[tokio::test]
async fn what_was_not_asked_for_is_not_sent() {
    let spec = common::catalogue().find("CartPole").unwrap();
    let pool = Pool::new(1, 4).unwrap();
    let asked = batch_settings(spec, 4, Autoreset::SameStep);
    let settings = BatchSettings { receipts: false, reward_terms: false, ..asked };
    let (mut batch, _, started) = Batch::open(&pool, settings).await.unwrap();
    assert_eq!(started, []);
    let mut ended = 0;
    for t in 0..100 {
        let stepped = batch.step(&actions(spec, 0, 4, t)).await.unwrap();
        assert!(stepped.started.is_empty() && stepped.reward_terms.is_empty());
        assert!(stepped.ended.iter().all(|(_, end)| end.receipt.is_none()));
        ended += stepped.ended.len();
    }
    assert!(ended > 4);
}

/// All outputs of one environment in one step.
#[derive(Debug, PartialEq)]
struct Seen {
    observation: Vec<u8>,
    reward: Vec<u8>,
    flags: [u8; 2],
    terms: Vec<u8>,
    end: Option<(Vec<u8>, FinishedEpisode)>,
    start: Option<StartedEpisode>,
}

/// Splits a batch's result into the results of its environments.
fn cut(spec: &EnvironmentSpec, size: usize, stepped: &StepResult) -> Vec<Seen> {
    let row = |bytes: &Bytes, i: usize, n: usize| bytes[4 * n * i..][..4 * n].to_vec();
    let o = spec.observation.len();
    let seen = |slot: usize| {
        let ended = stepped.ended.iter().position(|(of, _)| *of as usize == slot);
        Seen {
            observation: row(&stepped.observations, slot, o),
            reward: row(&stepped.rewards, slot, 1),
            flags: [stepped.terminated[slot], stepped.truncated[slot]],
            terms: row(&stepped.reward_terms, slot, spec.reward_terms.len()),
            end: ended.map(|k| (row(&stepped.final_observations, k, o), stepped.ended[k].1.clone())),
            start: stepped.started.iter().find(|(of, _)| *of as usize == slot).map(|(_, start)| start.clone()),
        }
    };
    (0..size).map(seen).collect()
}

#[tokio::test]
async fn bytes_do_not_depend_on_the_number_of_workers() {
    for spec in common::catalogue().specs() {
        // The batch is large enough for several shards, even with the cheapest environment.
        let size = (100.0 / spec.step_cost).ceil() as usize;
        let mut runs: Vec<Vec<StepResult>> = Vec::new();
        for workers in [1, 2, 4] {
            let pool = Pool::new(workers, size).unwrap();
            let settings = batch_settings(spec, size, Autoreset::SameStep);
            let (mut batch, first, started) = Batch::open(&pool, settings).await.unwrap();
            let mut run = vec![StepResult { observations: first, started, ..StepResult::default() }];
            for t in 0..40 {
                run.push(batch.step(&actions(spec, 100, size, t)).await.unwrap());
            }
            runs.push(run);
        }
        assert!(runs[0] == runs[1] && runs[0] == runs[2], "{}", spec.name);
    }
}

#[tokio::test]
async fn bytes_do_not_depend_on_how_a_batch_is_split() {
    for spec in common::catalogue().specs() {
        for mode in [Autoreset::NextStep, Autoreset::SameStep] {
            let size = 12;
            let steps = u64::from(spec.step_limit) + 20;
            let mut runs: Vec<Vec<Vec<Seen>>> = Vec::new();
            for split in [&[12][..], &[1, 11], &[5, 4, 3]] {
                let pool = Pool::new(2, size).unwrap();
                let mut batches = Vec::new();
                let mut first = 100;
                for &part in split {
                    let mut settings = batch_settings(spec, part, mode);
                    settings.groups[0].episodes.environment_index = first;
                    batches.push((first, part, Batch::open(&pool, settings).await.unwrap().0));
                    first += part as u32;
                }
                let mut run = Vec::new();
                for t in 0..steps {
                    let mut all = Vec::new();
                    for (first, part, batch) in &mut batches {
                        let stepped = batch.step(&actions(spec, *first, *part, t)).await.unwrap();
                        all.extend(cut(spec, *part, &stepped));
                    }
                    run.push(all);
                }
                runs.push(run);
            }
            assert!(runs[0].iter().flatten().any(|seen| seen.end.is_some()), "{}: some ended", spec.name);
            assert!(runs[0] == runs[1] && runs[0] == runs[2], "{} {mode:?}", spec.name);
        }
    }
}

/// A waker that records the order in which wakers are called.
struct Bell {
    id: usize,
    rung: Arc<Mutex<Vec<usize>>>,
}

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.rung.lock().unwrap().push(self.id);
    }
}

#[tokio::test]
async fn small_batches_finish_before_a_large_one_that_came_first() {
    const ATTEMPTS: usize = 50;
    let spec = common::catalogue().find("Acrobot").unwrap();
    let size = 40_000; // over 200 shards
    // The small batches are still too expensive for polling. With polling, the wakers would be called before the end.
    let small = 1000;
    let pool = Pool::new(1, size + 10 * small).unwrap();
    let mut batches = Vec::new();
    for size in std::iter::once(size).chain([small; 10]) {
        batches.push(Batch::open(&pool, batch_settings(spec, size, Autoreset::SameStep)).await.unwrap().0);
    }
    let actions = vec![0; 4 * size];
    // The workers call the wakers, so the order does not depend on when this thread runs. An attempt is inconclusive
    // only if this thread slept between the requests of the large batch and of the small ones.
    for _ in 0..ATTEMPTS {
        let rung = Arc::new(Mutex::new(Vec::new()));
        let mut steps: Vec<_> = Vec::new();
        for (id, batch) in batches.iter_mut().enumerate() {
            let waker = Waker::from(Arc::new(Bell { id, rung: Arc::clone(&rung) }));
            let part = &actions[..4 * batch.size()];
            let mut step = Box::pin(batch.step(part));
            if step.as_mut().poll(&mut Context::from_waker(&waker)).is_ready() {
                rung.lock().unwrap().push(id);
            } else {
                steps.push(step);
            }
        }
        wait_until(|| rung.lock().unwrap().len() == 11).await;
        for step in steps {
            step.await.unwrap();
        }
        if rung.lock().unwrap().last() == Some(&0) {
            return;
        }
    }
    panic!("the large batch never let the small ones pass");
}

/// Polls the future once, which starts a request without waiting for its end.
async fn poll_once<F: Future>(mut future: Pin<&mut F>) -> Poll<F::Output> {
    poll_fn(|context| Poll::Ready(future.as_mut().poll(context))).await
}

/// Waits until the workers have made a condition true.
async fn wait_until(condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(30);
    while !condition() {
        assert!(Instant::now() < deadline, "not within 30 s");
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

#[tokio::test]
async fn a_step_that_is_soon_done_waits_for_no_worker() {
    for (name, size, is_tiny) in [("CartPole", 1, true), ("CartPole", 150, true), ("CartPole", 600, false)] {
        let pool = Pool::new(1, 41_000).unwrap();
        let open = |name, size| {
            Batch::open(&pool, batch_settings(common::catalogue().find(name).unwrap(), size, Autoreset::SameStep))
        };
        let (mut busy, ..) = open("Acrobot", 40_000).await.unwrap();
        let (mut batch, ..) = open(name, size).await.unwrap();
        let (long, actions) = (vec![0; 4 * 40_000], vec![0; 4 * size]);
        let mut long = Box::pin(busy.step(&long));
        let _ = poll_once(long.as_mut()).await; // occupies the only worker for a long time
        let mut step = Box::pin(batch.step(&actions));
        assert_eq!(poll_once(step.as_mut()).await.is_ready(), is_tiny, "{size} of {name}");
    }
}

#[tokio::test]
async fn uncontended_session_steps_inline_for_longer() {
    let pool = Pool::new(1, 10_000).unwrap();
    let open = |name, size| {
        Batch::open(&pool, batch_settings(common::catalogue().find(name).unwrap(), size, Autoreset::SameStep))
    };
    let (mut one, ..) = open("CartPole", 1024).await.unwrap();
    let (mut other, ..) = open("CartPole", 1).await.unwrap();
    let (mut large, ..) = open("CartPole", 4096).await.unwrap();
    let taken = || pool.waits().counts().iter().map(|(_, count)| count).sum::<u64>();
    let before = taken();
    one.step(&[0; 4 * 1024]).await.unwrap();
    assert!(taken() > before, "nobody knows yet that it is alone");
    let before = taken();
    for _ in 0..5 {
        one.step(&[0; 4 * 1024]).await.unwrap();
    }
    assert_eq!(taken(), before, "alone");
    other.step(&[0; 4]).await.unwrap();
    one.step(&[0; 4 * 1024]).await.unwrap();
    assert!(taken() > before, "another one came in between");
    for _ in 0..2 {
        let before = taken();
        large.step(&[0; 4 * 4096]).await.unwrap();
        assert!(taken() > before, "too much to keep the session's thread");
    }
}

#[tokio::test]
async fn workers_that_fell_asleep_are_woken_for_every_job() {
    let pool = Pool::new(2, 1000).unwrap();
    let open = |name, size| {
        Batch::open(&pool, batch_settings(common::catalogue().find(name).unwrap(), size, Autoreset::SameStep))
    };
    let work = async {
        // The small batches are too expensive to run on the session's thread.
        let (mut small, ..) = open("Acrobot", 50).await.unwrap();
        let (mut other, ..) = open("Acrobot", 50).await.unwrap();
        let (mut large, ..) = open("Acrobot", 900).await.unwrap(); // several shards
        for _ in 0..3 {
            tokio::time::sleep(Duration::from_millis(50)).await; // idle workers sleep much sooner
            let (a, b) = tokio::join!(small.step(&[0; 200]), other.step(&[0; 200]));
            assert!(a.is_ok() && b.is_ok());
            tokio::time::sleep(Duration::from_millis(50)).await;
            assert!(large.step(&[0; 3600]).await.is_ok());
        }
    };
    tokio::time::timeout(Duration::from_secs(30), work).await.expect("within 30 s");
}

#[tokio::test]
async fn full_pool_has_room_again_when_a_batch_is_dropped() {
    let spec = common::catalogue().find("CartPole").unwrap();
    let pool = Pool::new(2, 10).unwrap();
    let open = |size| Batch::open(&pool, batch_settings(spec, size, Autoreset::SameStep));
    assert_eq!(open(11).await.err(), Some(Error::Full { requested: 11, used: 0, limit: 10 }));
    assert_eq!(open(usize::MAX).await.err(), Some(Error::Full { requested: usize::MAX, used: 0, limit: 10 }));
    let (seven, ..) = open(7).await.unwrap();
    assert_eq!(open(4).await.err(), Some(Error::Full { requested: 4, used: 7, limit: 10 }));
    assert_eq!(open(usize::MAX).await.err(), Some(Error::Full { requested: usize::MAX, used: 7, limit: 10 }));
    let (three, ..) = open(3).await.unwrap();
    assert_eq!(pool.environments(), 10);
    drop(seven);
    wait_until(|| pool.environments() == 3).await;
    let (again, ..) = open(7).await.unwrap();
    drop((again, three));
    wait_until(|| pool.environments() == 0).await;
}

#[tokio::test]
async fn a_batch_dropped_in_mid_step_gives_its_environments_back() {
    let spec = common::catalogue().find("Acrobot").unwrap();
    let size = 20_000;
    let pool = Pool::new(2, size).unwrap();
    let mut in_mid_step = 0;
    // An attempt may fail, because this thread may sleep for as long as the step takes.
    for _ in 0..50 {
        let (mut batch, ..) = Batch::open(&pool, batch_settings(spec, size, Autoreset::SameStep)).await.unwrap();
        let actions = vec![0; 4 * size];
        in_mid_step += u32::from(poll_once(pin!(batch.step(&actions))).await.is_pending());
        drop(batch);
        wait_until(|| pool.environments() == 0).await;
        if in_mid_step == 3 {
            break;
        }
    }
    assert!(in_mid_step > 0);
    // The environments are also freed if the batch is dropped while it is being opened.
    {
        let open = pin!(Batch::open(&pool, batch_settings(spec, size, Autoreset::SameStep)));
        let _ = poll_once(open).await;
    }
    wait_until(|| pool.environments() == 0).await;
}

#[tokio::test]
async fn batch_continues_after_an_abandoned_step() {
    const N: usize = 2000;
    let pool = Pool::new(2, N * 2).unwrap();
    let spec = common::catalogue().find("Acrobot").unwrap();
    let settings = batch_settings(spec, N, Autoreset::SameStep);
    let (mut batch, ..) = Batch::open(&pool, settings.clone()).await.unwrap();
    let (mut twin, ..) = Batch::open(&pool, settings).await.unwrap();
    let mut in_mid_step = 0;
    for t in 0..20 {
        let (forgotten, next) = (actions(spec, 0, N, 2 * t), actions(spec, 0, N, 2 * t + 1));
        in_mid_step += u32::from(poll_once(pin!(batch.step(&forgotten))).await.is_pending());
        batch.finish_abandoned().await;
        batch.finish_abandoned().await;
        twin.step(&forgotten).await.unwrap();
        assert!(batch.step(&next).await.unwrap() == twin.step(&next).await.unwrap(), "step {t}");
    }
    assert!(in_mid_step > 0, "no step was forgotten");
}

#[tokio::test]
async fn a_batch_outlives_others_and_a_pool_ends_with_batches_alive() {
    let spec = common::catalogue().find("Pendulum").unwrap();
    let pool = Pool::new(2, 20).unwrap();
    let open = || Batch::open(&pool, batch_settings(spec, 10, Autoreset::SameStep));
    let (mut a, ..) = open().await.unwrap();
    let (b, ..) = open().await.unwrap();
    drop(b);
    assert!(a.step(&[0; 40]).await.is_ok());
    drop(pool);
    drop(a);
}

// Resets, as proto/perturb/v1/perturb.proto specifies them.

async fn open_four(pool: &Pool, name: &str) -> Batch {
    let settings = batch_settings(common::catalogue().find(name).unwrap(), 4, Autoreset::SameStep);
    Batch::open(pool, settings).await.unwrap().0
}

fn ids(started: &[(u32, StartedEpisode)]) -> Vec<(u32, u64, u64, u32)> {
    started.iter().map(|(slot, s)| (*slot, s.id.trial_index, s.id.episode_index, s.id.episode_in_trial)).collect()
}

#[tokio::test]
async fn reset_touches_only_the_selected_slots() {
    for spec in common::catalogue().specs() {
        let pool = Pool::new(2, 8).unwrap();
        let (mut batch, mut untouched) = (open_four(&pool, spec.name).await, open_four(&pool, spec.name).await);
        for t in 0..5 {
            batch.step(&actions(spec, 0, 4, t)).await.unwrap();
            untouched.step(&actions(spec, 0, 4, t)).await.unwrap();
        }
        let (first, started) = batch.reset(vec![entry(1), entry(3)]).await.unwrap();
        assert_eq!(first.len(), 2 * 4 * spec.observation.len());
        // A trial has two episodes: the parameters stay for the second episode and change for the third.
        assert_eq!(ids(&started), [(1, 0, 1, 1), (3, 0, 1, 1)]);
        let opened = |slot: u32| {
            let settings = EpisodeSettings {
                environment_index: 100 + slot,
                ..batch_settings(spec, 4, Autoreset::SameStep).groups[0].episodes.clone()
            };
            Episodes::new((spec.make)().unwrap(), settings)
        };
        assert_eq!(started[0].1.receipt, Some(opened(1).receipt()));
        let (_, started) = batch.reset(vec![entry(1), entry(3)]).await.unwrap();
        assert_eq!(ids(&started), [(1, 1, 2, 0), (3, 1, 2, 0)]);
        assert_ne!(started[0].1.receipt, Some(opened(1).receipt()));

        let both = [batch.snapshot(vec![0, 2]).await.unwrap(), untouched.snapshot(vec![0, 2]).await.unwrap()];
        assert_eq!(both[0], both[1], "{}", spec.name);
        assert_ne!(batch.snapshot(vec![1]).await.unwrap(), untouched.snapshot(vec![1]).await.unwrap());
    }
}

#[tokio::test]
async fn a_broken_off_episode_is_not_reported() {
    let spec = common::catalogue().find("CartPole").unwrap();
    let pool = Pool::new(1, 4).unwrap();
    let mut batch = open_four(&pool, "CartPole").await;
    batch.step(&[0; 16]).await.unwrap();
    batch.reset((0..4).map(entry).collect()).await.unwrap();
    let stepped = batch.step(&actions(spec, 0, 4, 0)).await.unwrap();
    assert!(stepped.ended.is_empty() && stepped.started.is_empty());
}

#[tokio::test]
async fn seeds_restart_the_counts_and_keep_the_index() {
    for spec in common::catalogue().specs() {
        let pool = Pool::new(1, 8).unwrap();
        let mut batch = open_four(&pool, spec.name).await;
        for t in 0..30 {
            batch.step(&actions(spec, 0, 4, t)).await.unwrap();
        }
        batch.reset((0..4).map(entry).collect()).await.unwrap();
        let seeded = |slot, seed| ResetEntry { seed: Some(seed), ..entry(slot) };
        let (first, started) = batch.reset(vec![seeded(0, u64::MAX), seeded(2, 5)]).await.unwrap();
        assert_eq!(ids(&started), [(0, 0, 0, 0), (2, 0, 0, 0)]);
        for (k, (slot, seed)) in [(0, u64::MAX), (2, 5)].into_iter().enumerate() {
            let settings = batch_settings(spec, 4, Autoreset::SameStep).groups[0].episodes.clone();
            let settings = EpisodeSettings { seed, environment_index: 100 + slot, ..settings };
            let fresh = Episodes::new((spec.make)().unwrap(), settings);
            assert_eq!(started[k].1, fresh.started(true));
            let width = spec.observation.len();
            assert_eq!(floats(&first)[k * width..][..width], observe(&fresh)[..], "{}", spec.name);
            assert_eq!(batch.snapshot(vec![slot as usize]).await.unwrap()[0], fresh.snapshot());
        }
    }
}

#[tokio::test]
async fn distributions_hold_from_now_on_and_begin_a_trial() {
    for spec in common::catalogue().specs() {
        let pool = Pool::new(1, 4).unwrap();
        let mut batch = open_four(&pool, spec.name).await;
        let values: Vec<f64> = spec.parameters.iter().map(|p| p.extreme[1].high).collect();
        let fixed: Arc<[Distribution]> = values.iter().map(|&value| Distribution::fixed(value)).collect();
        let entries = [1, 2].map(|slot| ResetEntry { distributions: Some(Arc::clone(&fixed)), ..entry(slot) });
        let (_, started) = batch.reset(entries.into()).await.unwrap();
        assert_eq!(ids(&started), [(1, 1, 1, 0), (2, 1, 1, 0)]);
        for _ in 0..5 {
            let (_, started) = batch.reset((0..4).map(entry).collect()).await.unwrap();
            for (slot, start) in started {
                let requested = start.receipt.unwrap().requested;
                assert_eq!(requested == values, [1, 2].contains(&slot), "{} slot {slot}", spec.name);
            }
        }
    }
}

#[rstest]
#[case("CartPole", &[0.5, -0.25, 0.125, 1.0])]
#[case("MountainCar", &[-0.75, 0.03125])]
#[case("Acrobot", &[0.5, -0.5, 1.0, -1.0])]
#[case("Pendulum", &[0.5, -1.0])]
#[tokio::test]
async fn an_exact_state_is_taken_and_holds_for_this_episode(#[case] name: &str, #[case] state: &[f64]) {
    let pool = Pool::new(1, 4).unwrap();
    let mut batch = open_four(&pool, name).await;
    let exact = |slot| ResetEntry { state: Some(state.to_vec()), ..entry(slot) };
    let (first, started) = batch.reset(vec![exact(1), entry(2), exact(3)]).await.unwrap();
    assert_eq!(ids(&started), [(1, 0, 1, 1), (2, 0, 1, 1), (3, 0, 1, 1)], "the trial goes on");
    let mut environment = common::catalogue().find(name).and_then(|spec| (spec.make)()).unwrap();
    environment.reset_to(state);
    let mut expected = vec![0.0; environment.spec().observation.len()];
    environment.observe(&mut expected);
    let rows: Vec<_> = floats(&first).chunks(expected.len()).map(<[f32]>::to_vec).collect();
    assert!(rows[0] == expected && rows[1] != expected && rows[2] == expected, "{rows:?}");
    let (first, _) = batch.reset(vec![entry(1)]).await.unwrap();
    assert_ne!(floats(&first), expected, "the next state is drawn");
}

#[tokio::test]
async fn a_seed_a_distribution_and_a_state_go_together() {
    let spec = common::catalogue().find("CartPole").unwrap();
    let pool = Pool::new(1, 4).unwrap();
    let mut batch = open_four(&pool, "CartPole").await;
    let fixed: Arc<[Distribution]> = [9.0, 0.5, 0.25].map(Distribution::fixed).into();
    let state = Some(vec![0.5, 0.25, 0.0, 0.0]);
    let all = ResetEntry { slot: 2, seed: Some(3), distributions: Some(fixed), state };
    let (first, started) = batch.reset(vec![all]).await.unwrap();
    assert_eq!(floats(&first), [0.5, 0.25, 0.0, 0.0]);
    assert_eq!(ids(&started), [(2, 0, 0, 0)]);
    assert_eq!(started[0].1.receipt.as_ref().unwrap().requested, [9.0, 0.5, 0.25]);
    assert_eq!(started[0].1.id.environment_index, 102);
    assert_eq!(spec.parameters.len(), 3);
}
