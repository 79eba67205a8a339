//! Sessions whose observations contain the parameters at their end.

use crate::common::server::{Actor, Server, Session, catalogue, floats, open, parameters};
use bytes::Bytes;
use perturb::proto::{
    AutoresetMode, Environment, EpisodeEnd, EpisodeStart, Open, Receipt, Release, Reset, Restore, SlotGroup, Snapshot,
    Stepped, Version,
};
use rstest::rstest;

/// A number of steps that is larger than the step limit of every environment.
const STEPS: u64 = 1010;

fn observing(open: Open) -> Open {
    Open { observe_parameters: true, ..open }
}

/// Returns the observed parameters for a receipt's applied values, computed as the catalogue describes.
fn entries(environment: &Environment, receipt: &Receipt) -> Vec<f32> {
    let seen = environment.parameters.iter().zip(&environment.parameter_observations);
    let entry = seen.map(|(parameter, seen)| {
        let place = environment.applied.iter().position(|quantity| quantity.name == parameter.applied).unwrap();
        let (low, high) = (seen.at_minus_one, seen.at_plus_one);
        (2.0 * (receipt.applied[place] - low) / (high - low) - 1.0) as f32
    });
    entry.collect()
}

/// Splits each row of observations into the environment's own entries and the parameters.
fn rows(environment: &Environment, observations: &Bytes) -> Vec<(Vec<f32>, Vec<f32>)> {
    let (own, seen) = (environment.observation.len(), environment.parameter_observations.len());
    let cut = |row: &[f32]| (row[..own].to_vec(), row[own..].to_vec());
    floats(observations).chunks_exact(own + seen).map(cut).collect()
}

fn own_rows(environment: &Environment, observations: &Bytes) -> Vec<Vec<f32>> {
    floats(observations).chunks_exact(environment.observation.len()).map(<[f32]>::to_vec).collect()
}

/// The parameters that the observations of running episodes must contain, by slot.
struct Expected<'a> {
    environment: &'a Environment,
    running: Vec<Vec<f32>>,
}

impl Expected<'_> {
    fn begin(&mut self, started: &[EpisodeStart]) {
        for start in started {
            self.running[start.slot as usize] = entries(self.environment, start.receipt.as_ref().unwrap());
        }
    }

    /// Checks the parameters in a step result, and that everything else equals the result of a session without
    /// parameters.
    fn check(&mut self, plain: &Stepped, seen: &Stepped) {
        let environment = self.environment;
        self.begin(&seen.started);
        for (slot, (own, entries)) in rows(environment, &seen.observations).into_iter().enumerate() {
            assert_eq!(entries, self.running[slot], "slot {slot}");
            assert_eq!(own, own_rows(environment, &plain.observations)[slot]);
        }
        let of = |end: &EpisodeEnd| entries(environment, end.receipt.as_ref().unwrap());
        let finals = rows(environment, &seen.final_observations);
        assert_eq!(
            finals.iter().map(|row| row.1.clone()).collect::<Vec<_>>(),
            seen.ended.iter().map(of).collect::<Vec<_>>(),
            "final observations are those of the ended episodes"
        );
        assert_eq!(
            finals.into_iter().map(|row| row.0).collect::<Vec<_>>(),
            own_rows(environment, &plain.final_observations)
        );
        let (observations, final_observations) = (plain.observations.clone(), plain.final_observations.clone());
        assert_eq!(Stepped { observations, final_observations, ..seen.clone() }, *plain);
    }
}

#[rstest]
#[tokio::test]
async fn the_parameters_of_its_own_episode_follow_every_observation(
    #[values(AutoresetMode::NextStep, AutoresetMode::SameStep)] mode: AutoresetMode,
) {
    const N: u32 = 3;
    let server = Server::with_folders(&["--workers", "2"]);
    let episodes_per_trial = if mode == AutoresetMode::NextStep { 1 } else { 2 };
    for environment in &catalogue(server.unix()).await {
        let open = Open {
            version: Version::Extreme.into(),
            episodes_per_trial,
            autoreset_mode: mode.into(),
            ..open(&environment.name, N, 11)
        };
        let (mut plain, opened) = Session::open(server.unix(), open.clone()).await;
        assert!(!opened.observes_parameters);
        assert_eq!(opened.environment.as_ref(), Some(environment));
        let (mut session, seen) = Session::open(server.unix(), observing(open)).await;
        assert!(seen.observes_parameters);
        assert_eq!(seen.environment.unwrap().observation, observation(environment));
        let mut expected = Expected { environment, running: vec![Vec::new(); N as usize] };
        expected.begin(&seen.started);
        let first = rows(environment, &seen.observations);
        assert_eq!(first.iter().map(|row| row.1.clone()).collect::<Vec<_>>(), expected.running);
        assert_eq!(first.into_iter().map(|row| row.0).collect::<Vec<_>>(), own_rows(environment, &opened.observations));
        let actor = Actor::new(environment, N as usize);
        let (mut ended, mut values) = (0, std::collections::BTreeSet::new());
        for t in 0..STEPS {
            let reply = session.step(actor.actions(t)).await;
            expected.check(&plain.step(actor.actions(t)).await, &reply);
            ended += reply.ended.len();
            values.extend(expected.running.iter().map(|entries| entries[0].to_bits()));
        }
        let trials = ended / episodes_per_trial as usize;
        assert!(ended >= N as usize && values.len() >= trials, "{}: {ended} episodes, {values:?}", environment.name);
    }
}

fn observation(environment: &Environment) -> Vec<perturb::proto::Channel> {
    let entries = environment.parameter_observations.iter().map(|seen| seen.entry.clone().unwrap());
    environment.observation.iter().cloned().chain(entries).collect()
}

#[tokio::test]
async fn the_catalogue_says_how_each_parameter_is_observed() {
    let server = Server::with_folders(&[]);
    for environment in catalogue(server.unix()).await {
        assert_eq!(environment.parameter_observations.len(), environment.parameters.len());
        let mut names: Vec<String> = observation(&environment).into_iter().map(|channel| channel.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), observation(&environment).len(), "{}: every name is another", environment.name);
        for (parameter, seen) in environment.parameters.iter().zip(&environment.parameter_observations) {
            let entry = seen.entry.as_ref().unwrap();
            assert_eq!((entry.name.as_str(), entry.unit.as_str()), (&*format!("parameter_{}", parameter.name), "1"));
            let sets = [&parameter.random, &parameter.extreme].map(|set| set.clone().unwrap().intervals);
            let ends: Vec<f64> = sets.concat().iter().flat_map(|interval| [interval.low, interval.high]).collect();
            assert_eq!(seen.at_minus_one, ends.iter().copied().fold(f64::INFINITY, f64::min));
            assert_eq!(seen.at_plus_one, ends.iter().copied().fold(f64::NEG_INFINITY, f64::max));
            assert!((seen.at_minus_one..=seen.at_plus_one).contains(&parameter.default_value));
            assert!(entry.low <= -1.0 && entry.high >= 1.0, "{entry:?}");
        }
    }
}

/// Tests parameters at their bounds: observed values reach as far as the catalogue says, and are not clipped.
#[rstest]
#[case::least(|seen: &perturb::proto::Parameter| seen.low, |entry: &perturb::proto::Channel| entry.low)]
#[case::greatest(|seen: &perturb::proto::Parameter| seen.high, |entry: &perturb::proto::Channel| entry.high)]
#[tokio::test]
async fn own_values_are_observed_beyond_the_versions(
    #[case] value: fn(&perturb::proto::Parameter) -> f64,
    #[case] bound: fn(&perturb::proto::Channel) -> f64,
) {
    let server = Server::with_folders(&[]);
    for environment in catalogue(server.unix()).await {
        let sets: Vec<(&str, [(f64, f64); 1])> =
            environment.parameters.iter().map(|it| (it.name.as_str(), [(value(it), value(it))])).collect();
        let sets: Vec<(&str, &[(f64, f64)])> = sets.iter().map(|(name, set)| (*name, &set[..])).collect();
        let open = Open { parameters: parameters(&sets), ..observing(open(&environment.name, 1, 1)) };
        let (_, opened) = Session::open(server.unix(), open).await;
        let seen = rows(&environment, &opened.observations).remove(0).1;
        let bounds = environment.parameter_observations.iter().map(|seen| bound(seen.entry.as_ref().unwrap()));
        assert_eq!(seen.into_iter().map(f64::from).collect::<Vec<_>>(), bounds.collect::<Vec<_>>());
    }
}

#[rstest]
#[case("CartPole")]
#[cfg_attr(feature = "mujoco", case("Hopper"))]
#[tokio::test]
async fn a_reset_and_a_restore_bring_other_parameters(#[case] name: &str) {
    let server = Server::with_folders(&[]);
    let (mut session, opened) = Session::open(server.unix(), observing(open(name, 2, 5))).await;
    let environment = catalogue(server.unix()).await.into_iter().find(|it| it.name == name).unwrap();
    let before = rows(&environment, &opened.observations);
    let saved = session.ask(Snapshot { mask: Bytes::from_static(&[0, 1]) }).await.snapshots;
    let named = environment.parameters[0].name.as_str();
    let seen = &environment.parameter_observations[0];
    let request = Reset {
        mask: Bytes::from_static(&[1, 0]),
        parameters: parameters(&[(named, &[(seen.at_plus_one, seen.at_plus_one)])]),
        ..Reset::default()
    };
    let reset = session.ask(request).await;
    let row = rows(&environment, &reset.observations).remove(0);
    assert_eq!(row.1, entries(&environment, reset.started[0].receipt.as_ref().unwrap()));
    assert_eq!(row.1[0], 1.0);
    // Restores into another slot, and into sessions with and without observed parameters.
    let restore = |mask: &'static [u8]| Restore { mask: Bytes::from_static(mask), snapshots: saved.clone() };
    let restored = session.ask(restore(&[1, 0])).await.observations;
    assert_eq!(rows(&environment, &restored), [before[1].clone()]);
    let (mut other, _) = Session::open(server.unix(), observing(open(name, 1, 6))).await;
    assert_eq!(other.ask(restore(&[])).await.observations, restored);
    let (mut plain, _) = Session::open(server.unix(), open(name, 1, 6)).await;
    assert_eq!(own_rows(&environment, &plain.ask(restore(&[])).await.observations), [before[1].0.clone()]);
    let snapshots = plain.ask(Snapshot::default()).await.snapshots;
    assert_eq!(snapshots, saved, "a snapshot does not know who observes");
    // Later episodes have the same parameters until the trial ends.
    let actions = Actor::new(&environment, 1).actions(0);
    let stepped = rows(&environment, &other.step(actions).await.observations);
    assert_eq!(stepped[0].1, before[1].1);
}

#[tokio::test]
async fn groups_observe_like_sessions_of_their_own() {
    let server = Server::with_folders(&["--workers", "2"]);
    let groups: Vec<SlotGroup> = [(Version::Random, 3), (Version::Extreme, 2), (Version::Default, 60)]
        .map(|(version, size)| SlotGroup { size, version: version.into(), seed: 9, ..SlotGroup::default() })
        .into();
    let same = |open: Open| Open { autoreset_mode: AutoresetMode::SameStep.into(), ..observing(open) };
    let environment = "CartPole".into();
    let together = Open { environment, receipts: true, groups: groups.clone(), ..Open::default() };
    let (mut together, opened) = Session::open(server.unix(), same(together)).await;
    let environment = opened.environment.unwrap();
    let width = 4 * environment.observation.len();
    let mut alone = Vec::new();
    let mut first = 0;
    for group in groups {
        let of = Open { version: group.version, ..open("CartPole", group.size, 9) };
        let (session, own) = Session::open(server.unix(), same(of)).await;
        let rows = first..first + width * group.size as usize;
        assert_eq!(opened.observations.slice(rows.clone()), own.observations);
        alone.push((session, Actor::new(&environment, group.size as usize), rows.clone()));
        first = rows.end;
    }
    for t in 0..60 {
        if t == 30 {
            let mask = [[1; 3].as_slice(), &[0; 62]].concat().into();
            together.ask(Release { mask }).await;
            let (_, _, gone) = alone.remove(0);
            alone.iter_mut().for_each(|(_, _, rows)| *rows = rows.start - gone.end..rows.end - gone.end);
        }
        let actions: Vec<u8> = alone.iter().flat_map(|(_, actor, _)| actor.actions(t)).collect();
        let all = together.step(actions.into()).await;
        for (session, actor, rows) in &mut alone {
            assert_eq!(all.observations.slice(rows.clone()), session.step(actor.actions(t)).await.observations);
        }
    }
}
