//! Tests of everything that each server of the protocol must do, through the protocol only. They test the server at the
//! address PERTURB_ADDRESS if this variable is set, otherwise a server that they start.

use crate::common::server::{self, Actor, Server, Session, action, doubles, floats, open, parameters, stepped};
use bytes::Bytes;
use perturb::proto::{
    AutoresetMode, Comparison, Distribution, Environment, EpisodeEnd, EpisodeStart, Open, Opened, Reset, Restore,
    Snapshot, Stepped, Version, action_space::Kind, session_request::Request, session_response::Response,
};
use std::collections::HashSet;
use tonic::Code;

/// The server under test.
struct Target {
    address: String,
    _server: Option<Server>,
}

impl Target {
    fn get() -> Self {
        match std::env::var("PERTURB_ADDRESS") {
            Ok(address) => Self { address, _server: None },
            Err(_) => {
                let server = Server::with_folders(&["--workers", "2"]);
                Self { address: server.tcp().into(), _server: Some(server) }
            }
        }
    }

    async fn catalogue(&self) -> Vec<Environment> {
        server::catalogue(&self.address).await
    }

    async fn open(&self, open: Open) -> (Session, Opened) {
        Session::open(&self.address, open).await
    }
}

fn mode(open: Open, mode: AutoresetMode) -> Open {
    Open { autoreset_mode: mode.into(), ..open }
}

fn version(open: Open, version: Version) -> Open {
    Open { version: version.into(), ..open }
}

fn contains(set: &Distribution, x: f64) -> bool {
    set.intervals.iter().any(|i| i.low <= x && x <= i.high)
}

/// Returns a legal exact state, different for every `k`.
fn state(environment: &Environment, k: usize) -> Vec<f64> {
    let entry = |(i, c): (usize, &perturb::proto::Channel)| (0.003 * (1 + i + k) as f64).clamp(c.low, c.high);
    environment.state.iter().enumerate().map(entry).collect()
}

fn requested(starts: &[EpisodeStart]) -> Vec<Vec<f64>> {
    starts.iter().map(|start| start.receipt.as_ref().unwrap().requested.clone()).collect()
}

/// Returns the indices (environment, trial, episode, episode in trial).
fn numbers(episode: &Option<perturb::proto::Episode>) -> (u32, u64, u64, u32) {
    let episode = episode.as_ref().unwrap();
    (episode.environment_index, episode.trial_index, episode.episode_index, episode.episode_in_trial)
}

/// Returns row `i` of an array whose rows have `width` bytes.
fn row(bytes: &Bytes, i: usize, width: usize) -> Bytes {
    bytes.slice(i * width..(i + 1) * width)
}

#[tokio::test]
async fn the_catalogue_is_complete_and_consistent() {
    let target = Target::get();
    let mut client = server::client(&target.address).await;
    let list = client.list_environments(perturb::proto::ListEnvironmentsRequest {}).await.unwrap().into_inner();
    assert!(!list.server_version.is_empty() && list.max_batch_size >= 1);
    assert!(list.environments.len() >= 4);
    assert_eq!(list.environments, target.catalogue().await, "the order is fixed");
    let names: HashSet<_> = list.environments.iter().map(|e| &e.name).collect();
    assert_eq!(names.len(), list.environments.len(), "names are unique");
    for e in &list.environments {
        assert!(e.description.ends_with('.') && e.step_limit > 0 && e.control_timestep > 0.0, "{e:?}");
        let success = e.success.as_ref().unwrap();
        assert!(!success.description.is_empty() && (1..=e.step_limit).contains(&success.steps), "{e:?}");
        assert!(!success.quantity.is_empty() && !success.unit.is_empty() && success.threshold.is_finite(), "{e:?}");
        assert_ne!(success.comparison(), Comparison::Unspecified, "{e:?}");
        let code = e.code_success.as_ref().unwrap();
        let other = [("CartPole", 196.0), ("Acrobot", 90.0), ("Pendulum", 100.0)];
        match other.iter().find(|(name, _)| *name == e.name) {
            Some((_, threshold)) => assert!(code.threshold == *threshold && code != success, "{e:?}"),
            None => assert_eq!(code, success, "{}: the text's rule", e.name),
        }
        let is_parameter = |name: &String| e.parameters.iter().any(|p| p.name == *name);
        assert!(matches!(e.heatmap_axes.len(), 0 | 2) && e.heatmap_axes.iter().all(is_parameter), "{e:?}");
        assert!(!e.observation.is_empty() && !e.state.is_empty() && !e.reward_terms.is_empty(), "{e:?}");
        for channels in [&e.observation, &e.state] {
            assert_eq!(channels.iter().map(|c| &c.name).collect::<HashSet<_>>().len(), channels.len(), "{e:?}");
            assert!(channels.iter().all(|c| c.low < c.high && !c.unit.is_empty()), "{e:?}");
        }
        assert!(!e.parameters.is_empty());
        for p in &e.parameters {
            let (random, extreme) = (&p.random.as_ref().unwrap().intervals, &p.extreme.as_ref().unwrap().intervals);
            assert_eq!((random.len(), extreme.len()), (1, 2), "{}: R is an interval, E two: {p:?}", e.name);
            assert!(contains(p.random.as_ref().unwrap(), p.default_value), "D lies in R: {p:?}");
            assert!(extreme[0].high == random[0].low && random[0].high == extreme[1].low, "E surrounds R: {p:?}");
            assert!(e.applied.iter().any(|q| q.name == p.applied && q.unit == p.unit), "it is read back: {p:?}");
            assert!(p.low <= extreme[0].low && extreme[1].high <= p.high, "E is within bounds: {p:?}");
        }
        match e.action.as_ref().unwrap().kind.as_ref().unwrap() {
            Kind::Discrete(space) => assert!(space.names.len() > 1),
            Kind::Continuous(space) => assert!(space.channels.iter().all(|c| c.low.is_finite() && c.high.is_finite())),
        }
    }
}

#[tokio::test]
async fn every_request_is_answered_once_and_in_order() {
    let target = Target::get();
    for e in &target.catalogue().await {
        let actor = Actor::new(e, 3);
        let step = |t| server::step(actor.actions(t));
        let bad = || server::step(Bytes::from_static(b"x"));
        let mut requests = vec![step(0), Request::Open(open(&e.name, 3, 1)), Request::Open(open(&e.name, 3, 1))];
        for t in 0..300 {
            requests.extend(if t % 10 == 0 { vec![bad(), step(t)] } else { vec![step(t)] });
        }
        requests.push(Request::Snapshot(Snapshot::default()));
        requests.push(Request::Reset(Reset::default()));
        requests.push(Request::Restore(Restore::default()));
        requests.push(step(300));

        let mut one_by_one = Session::connect(&target.address).await;
        let mut expected = Vec::new();
        for request in &requests {
            expected.push(one_by_one.answer(request.clone()).await);
        }
        let mut pipelined = Session::connect(&target.address).await;
        for request in &requests {
            pipelined.send(request.clone()).await;
        }
        pipelined.close();
        for (request, expected) in requests.iter().zip(expected) {
            let response = pipelined.receive().await.unwrap().unwrap().response.unwrap();
            assert_eq!(response, expected, "{}: {request:?}", e.name);
            match (request, response) {
                (Request::Open(_), Response::Opened(_) | Response::Error(_))
                | (Request::Step(_), Response::Stepped(_) | Response::Error(_))
                | (Request::Reset(_), Response::Reset(_))
                | (Request::Snapshot(_), Response::Snapshot(_))
                | (Request::Restore(_), Response::Error(_)) => {}
                (request, response) => panic!("{request:?} was answered by {response:?}"),
            }
        }
        assert_eq!(pipelined.receive().await.unwrap(), None, "nothing follows the last response");
    }
}

#[tokio::test]
async fn open_tells_what_was_opened_and_how_the_first_episodes_began() {
    let target = Target::get();
    for e in &target.catalogue().await {
        for autoreset in [AutoresetMode::NextStep, AutoresetMode::SameStep, AutoresetMode::Disabled] {
            let request = Open { first_environment_index: 7, ..mode(open(&e.name, 5, 1), autoreset) };
            let (_, opened) = target.open(request.clone()).await;
            assert_eq!(opened.environment.as_ref(), Some(e));
            assert_eq!(opened.autoreset_mode(), autoreset);
            let observations = floats(&opened.observations);
            assert_eq!(observations.len(), 5 * e.observation.len());
            for (x, channel) in observations.iter().zip(e.observation.iter().cycle()) {
                assert!(channel.low as f32 <= *x && *x <= channel.high as f32, "{}: {x} for {channel:?}", e.name);
            }
            let starts: Vec<_> = opened.started.iter().map(|s| (s.slot, numbers(&s.episode))).collect();
            assert_eq!(starts, (0..5).map(|i| (i, (7 + i, 0, 0, 0))).collect::<Vec<_>>());

            let (_, bare) = target.open(Open { receipts: false, ..request }).await;
            assert_eq!(bare.started, [], "nothing is listed unless receipts were asked for");
            assert_eq!(bare.observations, opened.observations);
        }
    }
}

#[tokio::test]
async fn step_replies_have_the_promised_shapes_and_reward_sums() {
    const N: usize = 4;
    let target = Target::get();
    for e in &target.catalogue().await {
        let (mut session, _) = target.open(open(&e.name, N as u32, 5)).await;
        let all_off = Open { receipts: false, reward_terms: false, ..open(&e.name, N as u32, 5) };
        let (mut bare, _) = target.open(all_off).await;
        let (actor, steps) = (Actor::new(e, N), u64::from(e.step_limit) + 100);
        let (full, bare) = (session.play(actor, 0, steps).await, bare.play(actor, 0, steps).await);
        let mut episodes = 0;
        for (full, bare) in full.iter().zip(&bare) {
            let (full, bare) = (stepped(full), stepped(bare));
            let (o, k) = (4 * e.observation.len(), full.ended.len());
            assert_eq!(full.observations.len(), N * o);
            assert_eq!(full.rewards.len(), N * 4);
            assert_eq!((full.terminated.len(), full.truncated.len()), (N, N));
            assert!(full.terminated.iter().chain(&full.truncated).all(|flag| *flag <= 1));
            assert_eq!(full.final_observations.len(), k * o);
            let terms = floats(&full.reward_terms);
            assert_eq!(terms.len(), N * e.reward_terms.len());
            for (terms, reward) in terms.chunks(e.reward_terms.len()).zip(floats(&full.rewards)) {
                // The terms and the sum were rounded to f32 separately.
                let (sum, size) = (terms.iter().sum::<f32>(), terms.iter().map(|t| t.abs()).sum::<f32>());
                assert!((sum - reward).abs() <= 1e-6 * (1.0 + size), "{}: {terms:?} is not {reward}", e.name);
            }
            for (end, slot) in full.ended.iter().zip((0..N).filter(|&i| full.terminated[i] | full.truncated[i] > 0)) {
                episodes += 1;
                assert_eq!(end.slot as usize, slot, "in order of slots, and where the flags are");
                assert_eq!(full.truncated[slot] == 1, end.length == e.step_limit, "{}: {end:?}", e.name);
                assert!(end.length <= e.step_limit && !end.diverged);
            }
            // Removes the fields that were not requested.
            let strip = |end: &EpisodeEnd| EpisodeEnd { receipt: None, ..end.clone() };
            let ended = full.ended.iter().map(strip).collect();
            let expected = Stepped { ended, started: vec![], reward_terms: Bytes::new(), ..full.clone() };
            assert_eq!(*bare, expected);
        }
        assert!(episodes >= N, "{}: every environment ended an episode", e.name);
    }
}

/// Everything that a client receives of one episode.
#[derive(Debug, PartialEq, Default, Clone)]
struct Seen {
    first: Bytes,
    steps: Vec<(Bytes, Bytes, u8, u8)>,
    end: Option<EpisodeEnd>,
}

/// Plays until every environment has finished `episodes` episodes. An action is a function of environment, episode and
/// step only.
async fn episodes(target: &Target, e: &Environment, autoreset: AutoresetMode, episodes: usize) -> Vec<Vec<Seen>> {
    const N: usize = 3;
    let o = 4 * e.observation.len();
    let (mut session, opened) = target.open(mode(open(&e.name, N as u32, 9), autoreset)).await;
    let begin = |observations: &Bytes, slot| Seen { first: row(observations, slot, o), ..Seen::default() };
    let mut seen: Vec<Vec<Seen>> = (0..N).map(|slot| vec![begin(&opened.observations, slot)]).collect();
    while seen.iter().any(|seen| seen.len() <= episodes) {
        let actions = seen.iter().enumerate().flat_map(|(slot, seen)| {
            let last = seen.last().unwrap();
            action(e, slot as u64, (1000 * seen.len() + last.steps.len()) as u64)
        });
        let reply = session.step(actions.collect()).await;
        let mut ends = reply.ended.iter().enumerate();
        let mut broken = Vec::new();
        for (slot, seen) in seen.iter_mut().enumerate() {
            let flags = (reply.terminated[slot], reply.truncated[slot]);
            let reward = row(&reply.rewards, slot, 4);
            let observation = row(&reply.observations, slot, o);
            if seen.last().unwrap().end.is_some() {
                assert_eq!((flags, floats(&reward)), ((0, 0), vec![0.0]), "a step that resets has no outcome");
                seen.push(Seen { first: observation, ..Seen::default() });
            } else if flags == (0, 0) {
                seen.last_mut().unwrap().steps.push((observation, reward, 0, 0));
            } else {
                let (k, end) = ends.next().unwrap();
                assert_eq!(end.slot as usize, slot);
                let last = row(&reply.final_observations, k, o);
                let episode = seen.last_mut().unwrap();
                episode.steps.push((last.clone(), reward, flags.0, flags.1));
                episode.end = Some(end.clone());
                if autoreset == AutoresetMode::SameStep {
                    seen.push(Seen { first: observation, ..Seen::default() });
                } else {
                    assert_eq!(observation, last, "the last observation stays where it was");
                    broken.push(slot);
                }
            }
        }
        assert_eq!(ends.next(), None);
        if autoreset == AutoresetMode::Disabled && !broken.is_empty() {
            let actions = Actor::new(e, N).actions(0);
            let (code, message) = session.refused(server::step(actions)).await;
            assert_eq!(code, Code::FailedPrecondition, "{message}");
            assert!(broken.iter().all(|slot| message.contains(&slot.to_string())), "names the slots: {message}");
            let mask: Vec<u8> = (0..N).map(|slot| broken.contains(&slot).into()).collect();
            let done = session.ask(Reset { mask: mask.into(), ..Reset::default() }).await;
            for (i, &slot) in broken.iter().enumerate() {
                seen[slot].push(begin(&done.observations, i));
            }
        }
    }
    seen.iter_mut().for_each(|seen| seen.truncate(episodes));
    seen
}

#[tokio::test]
async fn autoreset_modes_run_the_same_episodes() {
    let target = Target::get();
    for e in &target.catalogue().await {
        let next_step = episodes(&target, e, AutoresetMode::NextStep, 2).await;
        let same_step = episodes(&target, e, AutoresetMode::SameStep, 2).await;
        let disabled = episodes(&target, e, AutoresetMode::Disabled, 2).await;
        assert!(next_step == same_step && same_step == disabled, "{}", e.name);
        for (slot, seen) in next_step.iter().enumerate() {
            for (i, seen) in seen.iter().enumerate() {
                let end = seen.end.as_ref().unwrap();
                assert_eq!(end.length as usize, seen.steps.len());
                assert_eq!(numbers(&end.episode), (slot as u32, i as u64, i as u64, 0));
                let sum: f64 = seen.steps.iter().map(|step| f64::from(floats(&step.1)[0])).sum();
                // Each reward was rounded to f32.
                assert!((sum - end.r#return).abs() < 1e-6 * (1.0 + sum.abs()) * 16.0, "{sum}: {end:?}");
            }
        }
    }
}

#[tokio::test]
async fn a_reset_touches_the_selected_environments_only() {
    const N: usize = 4;
    let target = Target::get();
    for e in &target.catalogue().await {
        let (mut session, _) = target.open(open(&e.name, N as u32, 2)).await;
        let (mut twin, _) = target.open(open(&e.name, N as u32, 2)).await;
        let actor = Actor::new(e, N);
        assert_eq!(session.play(actor, 0, 5).await, twin.play(actor, 0, 5).await);
        let done = session.ask(Reset { mask: Bytes::from_static(&[0, 1, 0, 1]), ..Reset::default() }).await;
        let o = 4 * e.observation.len();
        assert_eq!(done.observations.len(), 2 * o);
        let starts: Vec<_> = done.started.iter().map(|s| (s.slot, numbers(&s.episode))).collect();
        assert_eq!(starts, [(1, (1, 1, 1, 0)), (3, (3, 1, 1, 0))]);
        let (after, twin) = (session.step(actor.actions(5)).await, twin.step(actor.actions(5)).await);
        for slot in 0..N {
            let same = row(&after.observations, slot, o) == row(&twin.observations, slot, o);
            assert_eq!(same, slot % 2 == 0, "{}: slot {slot}", e.name);
        }
        let none = session.ask(Reset { mask: Bytes::from_static(&[0; N]), ..Reset::default() }).await;
        assert_eq!((none.observations.len(), none.started.len()), (0, 0), "a mask may select nothing");
    }
}

#[tokio::test]
async fn reset_with_seeds_begins_like_a_fresh_session_of_those_seeds() {
    let target = Target::get();
    for e in &target.catalogue().await {
        let (mut session, _) = target.open(open(&e.name, 3, 1)).await;
        session.play(Actor::new(e, 3), 0, 50).await;
        let mask = Bytes::from_static(&[0, 1, 1]);
        let done = session.ask(Reset { mask, seeds: vec![77, u64::MAX], ..Reset::default() }).await;
        let o = 4 * e.observation.len();
        for (i, (slot, seed)) in [(1, 77), (2, u64::MAX)].into_iter().enumerate() {
            let fresh = Open { first_environment_index: slot, ..open(&e.name, 1, seed) };
            let (_, fresh) = target.open(fresh).await;
            assert_eq!(row(&done.observations, i, o), fresh.observations, "{}: slot {slot}", e.name);
            assert_eq!(done.started[i].episode, fresh.started[0].episode, "counts restart, the index stays");
            assert_eq!(done.started[i].receipt, fresh.started[0].receipt);
        }
    }
}

#[tokio::test]
async fn a_seed_fixes_all_bytes_and_another_seed_gives_others() {
    let target = Target::get();
    for e in &target.catalogue().await {
        let run = async |seed| {
            let (mut session, opened) = target.open(open(&e.name, 2, seed)).await;
            (opened, session.play(Actor::new(e, 2), 0, 300).await)
        };
        let (a, b, c) = (run(0).await, run(0).await, run(u64::MAX).await);
        assert!(a == b, "{}", e.name);
        assert_ne!(a.0.observations, c.0.observations, "{}", e.name);
        assert_ne!(requested(&a.0.started), requested(&c.0.started), "{}", e.name);
    }
}

#[tokio::test]
async fn versions_draw_from_their_sets_and_receipts_say_so() {
    let target = Target::get();
    for e in &target.catalogue().await {
        for asked in [Version::Default, Version::Random, Version::Extreme] {
            let (_, opened) = target.open(version(open(&e.name, 64, 3), asked)).await;
            let drawn = requested(&opened.started);
            for (i, p) in e.parameters.iter().enumerate() {
                let (random, extreme) = (p.random.as_ref().unwrap(), p.extreme.as_ref().unwrap());
                let mut values = drawn.iter().map(|values| values[i]);
                match asked {
                    Version::Default => assert!(values.all(|x| x == p.default_value), "{p:?}: {drawn:?}"),
                    Version::Random => assert!(values.all(|x| contains(random, x)), "{p:?}: {drawn:?}"),
                    _ => {
                        assert!(values.all(|x| contains(extreme, x)), "{p:?}: {drawn:?}");
                        let inside = |x: f64| random.intervals[0].low < x && x < random.intervals[0].high;
                        assert!(!drawn.iter().any(|values| inside(values[i])), "nothing inside R: {p:?}");
                    }
                }
                let distinct: HashSet<u64> = drawn.iter().map(|values| values[i].to_bits()).collect();
                assert_eq!(distinct.len() > 32, asked != Version::Default, "every environment draws: {p:?}");
            }
            for start in &opened.started {
                let receipt = start.receipt.as_ref().unwrap();
                assert_eq!(receipt.applied.len(), e.applied.len());
                assert_eq!(receipt.model_hash, e.model_hash);
                for (p, requested) in e.parameters.iter().zip(&receipt.requested) {
                    let applied = receipt.applied[e.applied.iter().position(|q| q.name == p.applied).unwrap()];
                    // Tolerance for rounding where the physics stores a mass instead of a density.
                    assert!((applied - requested).abs() <= 1e-9 * requested.abs(), "{}: {}", e.name, p.name);
                }
            }
        }
    }
}

#[tokio::test]
async fn open_takes_fixed_values_intervals_and_unions() {
    let target = Target::get();
    for e in &target.catalogue().await {
        let p = &e.parameters[0];
        let at = |u: f64| p.default_value * (0.8 + 0.4 * u); // within all bounds
        let sets: [&[(f64, f64)]; 3] =
            [&[(at(0.3), at(0.3))], &[(at(0.1), at(0.9))], &[(at(0.0), at(0.2)), (at(0.8), at(1.0))]];
        for set in sets {
            let given = parameters(&[(&p.name, set)]);
            let request = Open { parameters: given.clone(), ..version(open(&e.name, 128, 4), Version::Default) };
            let (_, opened) = target.open(request).await;
            for values in requested(&opened.started) {
                assert!(contains(&given[&p.name], values[0]), "{}: {values:?}", e.name);
                let others = e.parameters.iter().zip(&values).skip(1);
                assert!(others.into_iter().all(|(p, x)| p.default_value == *x), "the others keep the version's");
            }
            for &(low, high) in set {
                let hit = |values: &Vec<f64>| low <= values[0] && values[0] <= high;
                assert!(requested(&opened.started).iter().any(hit), "{}: nothing from [{low}, {high}]", e.name);
            }
        }
    }
}

#[tokio::test]
async fn parameters_at_reset_begin_a_trial_and_stay_in_force() {
    let target = Target::get();
    for e in &target.catalogue().await {
        let request = Open { episodes_per_trial: 100, ..version(open(&e.name, 2, 6), Version::Default) };
        let (mut session, _) = target.open(request).await;
        let last = e.parameters.last().unwrap();
        let x = last.default_value * 1.05;
        let given = parameters(&[(&last.name, &[(x, x)])]);
        let mask = Bytes::from_static(&[0, 1]);
        let done = session.ask(Reset { mask, parameters: given, ..Reset::default() }).await;
        assert_eq!(numbers(&done.started[0].episode), (1, 1, 1, 0), "a new trial");
        let mut expected: Vec<f64> = e.parameters.iter().map(|p| p.default_value).collect();
        let defaults = expected.clone();
        *expected.last_mut().unwrap() = x;
        assert_eq!(requested(&done.started), [expected.clone()], "{}", e.name);
        let done = session.ask(Reset::default()).await;
        assert_eq!(numbers(&done.started[0].episode), (0, 0, 1, 1), "the trial goes on");
        assert_eq!(numbers(&done.started[1].episode), (1, 1, 2, 1), "the trial goes on");
        assert_eq!(requested(&done.started), [defaults, expected], "{}", e.name);
    }
}

#[tokio::test]
async fn parameters_are_drawn_anew_when_a_trial_begins_and_only_then() {
    let target = Target::get();
    for e in &target.catalogue().await {
        for (per_trial, expected) in [(0, 1), (1, 1), (3, 3)] {
            let request = Open { episodes_per_trial: per_trial, ..open(&e.name, 1, 8) };
            let (mut session, opened) = target.open(request).await;
            let mut starts = opened.started;
            for _ in 1..3 * expected {
                starts.extend(session.ask(Reset::default()).await.started);
            }
            let drawn = requested(&starts);
            for (i, start) in starts.iter().enumerate() {
                let (trial, place) = (i / expected, i % expected);
                assert_eq!(numbers(&start.episode), (0, trial as u64, i as u64, place as u32));
                for (j, other) in drawn.iter().enumerate() {
                    assert_eq!(drawn[i] == *other, trial == j / expected, "{}: {drawn:?}", e.name);
                }
            }
        }
    }
}

#[tokio::test]
async fn an_exact_state_replaces_the_drawn_one_for_one_episode() {
    let target = Target::get();
    for e in &target.catalogue().await {
        let (mut session, _) = target.open(version(open(&e.name, 2, 1), Version::Default)).await;
        let (mut twin, _) = target.open(version(open(&e.name, 2, 1), Version::Default)).await;
        let same = [state(e, 0), state(e, 0)].concat();
        let done = session.ask(Reset { states: doubles(&same), ..Reset::default() }).await;
        let o = 4 * e.observation.len();
        assert_eq!(row(&done.observations, 0, o), row(&done.observations, 1, o), "{}: one state, one look", e.name);
        for (i, channel) in e.observation.iter().enumerate() {
            if let Some(j) = e.state.iter().position(|s| s.name == channel.name) {
                assert_eq!(floats(&done.observations)[i], state(e, 0)[j] as f32, "{}: {}", e.name, channel.name);
            }
        }
        let mask = Bytes::from_static(&[0, 1]);
        let one = session.ask(Reset { mask, states: doubles(&state(e, 3)), ..Reset::default() }).await;
        assert_ne!(one.observations, row(&done.observations, 1, o), "{}: another state, another look", e.name);
        // The next episode is drawn as if there had been no exact state.
        for _ in 0..2 {
            twin.ask(Reset::default()).await;
        }
        session.ask(Reset { mask: Bytes::from_static(&[1, 0]), ..Reset::default() }).await;
        assert_eq!(session.ask(Reset::default()).await, twin.ask(Reset::default()).await, "{}", e.name);
    }
}

#[tokio::test]
async fn a_restored_environment_goes_on_as_it_did() {
    const N: usize = 3;
    let target = Target::get();
    for e in &target.catalogue().await {
        let request = Open { episodes_per_trial: 2, ..open(&e.name, N as u32, 1) };
        let (actor, steps) = (Actor::new(e, N), u64::from(e.step_limit) + 60);
        let (mut session, _) = target.open(request).await;
        session.play(actor, 0, 37).await;
        let before = stepped(&session.play(actor, 37, 38).await[0]).observations.clone();
        let snapshots = session.snapshot(&[]).await;
        assert_eq!(snapshots.len(), N);
        let after = session.play(actor, 38, steps).await;
        assert!(after.iter().any(|reply| !stepped(reply).ended.is_empty()), "an episode ended meanwhile");

        assert_eq!(session.restore(&[], snapshots.clone()).await, before, "{}: the observations as saved", e.name);
        assert!(session.play(actor, 38, steps).await == after, "{}: in the same session", e.name);

        let other = Open { first_environment_index: 50, ..version(open(&e.name, N as u32, 2), Version::Extreme) };
        let (mut other, _) = target.open(other).await;
        other.play(actor, 0, 10).await;
        assert_eq!(other.restore(&[], snapshots.clone()).await, before);
        assert!(other.play(actor, 38, steps).await == after, "{}: in a session opened otherwise", e.name);

        // Restores the environment of slot 0 into slot 2. The restored environment keeps its index, and the other
        // environments are unaffected.
        let (mut moved, opened) = target.open(open(&e.name, N as u32, 4)).await;
        let o = 4 * e.observation.len();
        let restored = moved.restore(&[0, 0, 1], vec![snapshots[0].clone()]).await;
        assert_eq!(restored, row(&before, 0, o), "{}", e.name);
        let done = moved.ask(Reset::default()).await;
        assert_eq!(done.started.iter().map(|s| numbers(&s.episode).0).collect::<Vec<_>>(), [0, 1, 0]);
        assert_eq!(opened.started.len(), N);
    }
}

#[tokio::test]
async fn a_receipt_at_the_end_is_that_of_the_start() {
    let target = Target::get();
    for e in &target.catalogue().await {
        let request = mode(Open { episodes_per_trial: 2, ..open(&e.name, 3, 1) }, AutoresetMode::SameStep);
        let (mut session, opened) = target.open(request).await;
        let mut running = opened.started;
        let mut ended = 0;
        for reply in session.play(Actor::new(e, 3), 0, 2 * u64::from(e.step_limit) + 10).await {
            let reply = stepped(&reply);
            assert_eq!(
                reply.ended.iter().map(|e| e.slot).collect::<Vec<_>>(),
                reply.started.iter().map(|s| s.slot).collect::<Vec<_>>(),
                "where one ends, the next begins"
            );
            for (end, start) in reply.ended.iter().zip(&reply.started) {
                let begun = &mut running[end.slot as usize];
                assert_eq!((&end.episode, &end.receipt), (&begun.episode, &begun.receipt), "{}", e.name);
                *begun = start.clone();
                ended += 1;
            }
        }
        assert!(ended >= 6, "{}", e.name);
    }
}

#[tokio::test]
async fn a_refused_request_changes_nothing() {
    const N: usize = 3;
    let target = Target::get();
    for e in &target.catalogue().await {
        let actor = Actor::new(e, N);
        let (mut session, _) = target.open(open(&e.name, N as u32, 1)).await;
        let (mut twin, _) = target.open(open(&e.name, N as u32, 1)).await;
        assert!(session.play(actor, 0, 20).await == twin.play(actor, 0, 20).await);
        let mut snapshots = session.snapshot(&[]).await;
        let elsewhere = session.play(actor, 20, 30).await;
        snapshots[N - 1] = snapshots[N - 1].slice(1..);
        let p = &e.parameters[0].name;
        let half = parameters(&[(p, &[(1e300, 1e301)]), (&e.parameters[1].name, &[(0.0, f64::NAN)])]);
        let mut states = [state(e, 0), state(e, 1), state(e, 2)].concat();
        *states.last_mut().unwrap() = f64::INFINITY;
        let bad = [
            Request::Open(open(&e.name, N as u32, 1)),
            server::step(actor.actions(0).slice(1..)),
            Request::Reset(Reset { mask: Bytes::from_static(&[1, 1, 2]), ..Reset::default() }),
            Request::Reset(Reset { seeds: vec![1; N + 1], ..Reset::default() }),
            Request::Reset(Reset { seeds: vec![1; N], parameters: half, ..Reset::default() }),
            Request::Reset(Reset { seeds: vec![1; N], states: doubles(&states), ..Reset::default() }),
            Request::Snapshot(Snapshot { mask: Bytes::from_static(&[1]) }),
            // The first two snapshots are valid, but none may be restored.
            Request::Restore(Restore { mask: Bytes::new(), snapshots }),
        ];
        assert!(elsewhere == twin.play(actor, 20, 30).await);
        for (i, request) in bad.into_iter().enumerate() {
            let (code, message) = session.refused(request.clone()).await;
            let expected = if i == 0 { Code::FailedPrecondition } else { Code::InvalidArgument };
            assert_eq!(code, expected, "{request:?}: {message}");
            let from = 30 + 200 * i as u64;
            assert!(
                session.play(actor, from, from + 200).await == twin.play(actor, from, from + 200).await,
                "{}: {request:?}",
                e.name
            );
        }
        assert_eq!(session.snapshot(&[]).await, twin.snapshot(&[]).await, "{}", e.name);
    }
}

#[tokio::test]
async fn sessions_on_one_connection_are_independent() {
    let target = Target::get();
    let mut client = server::client(&target.address).await;
    for e in &target.catalogue().await {
        let actor = Actor::new(e, 2);
        let mut sessions = Vec::new();
        for seed in 0..4 {
            let mut session = Session::start(&mut client).await.unwrap();
            session.answer(open(&e.name, 2, seed)).await;
            sessions.push(session);
        }
        let mut interleaved = vec![Vec::new(); 4];
        for t in 0..100 {
            for (session, replies) in sessions.iter_mut().zip(&mut interleaved) {
                replies.push(session.step(actor.actions(t)).await);
            }
        }
        for (seed, replies) in interleaved.iter().enumerate() {
            let (mut alone, _) = target.open(open(&e.name, 2, seed as u64)).await;
            let alone = alone.play(actor, 0, 100).await;
            assert!(replies.iter().eq(alone.iter().map(stepped)), "{}: seed {seed}", e.name);
        }
    }
}
