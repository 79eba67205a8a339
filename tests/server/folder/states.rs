//! Environments of task folders share simulations, but are independent of what ran before.

use super::{CART, TASK, folder, load};
use crate::common::{self, action_bytes, observe, play, start_line, step};
use perturb::env::{Action, Environment, EnvironmentSpec, Error, Version};

fn saved(environment: &dyn Environment) -> Vec<u64> {
    let mut state = Vec::new();
    environment.save(&mut state);
    state.iter().map(|value| value.to_bits()).collect()
}

#[test]
fn environments_that_take_turns_go_where_each_goes_alone() {
    for spec in common::folder_specs() {
        let n = 5;
        let make = |index| common::episodes(spec, Version::E, 3, index, 1);
        let alone: Vec<Vec<String>> = (0..n)
            .map(|index| {
                let mut episodes = make(index);
                play(&mut episodes, index.into(), 0, 60)
            })
            .collect();
        let mut together: Vec<_> = (0..n).map(make).collect();
        let mut lines = vec![Vec::new(); n as usize];
        for t in 0..60 {
            for index in (0..n as usize).map(|i| (i * 3 + t as usize) % n as usize) {
                lines[index].extend(play(&mut together[index], index as u64, t, 1));
            }
        }
        assert_eq!(lines, alone, "{}", spec.name);
    }
}

#[test]
fn snapshots_go_on_with_the_same_bytes() {
    for spec in common::folder_specs() {
        for steps in [0, 1, 7, 40] {
            let mut original = common::episodes(spec, Version::E, 5, 1, 2);
            play(&mut original, 1, 0, steps);
            let snapshot = original.snapshot();
            let mut restored = common::episodes(spec, Version::R, 99, 7, 1);
            play(&mut restored, 2, 0, 13);
            restored.restore(&snapshot).unwrap();
            assert_eq!(observe(&restored), observe(&original), "{}", spec.name);
            assert_eq!(restored.snapshot(), snapshot);
            let (a, b) = (play(&mut restored, 3, 100, 80), play(&mut original, 3, 100, 80));
            assert_eq!(a, b, "{} after {steps} steps", spec.name);
        }
    }
}

#[test]
fn snapshots_of_another_model_are_refused() {
    let task = TASK.replace("CartAndPole", "CartOfTwoModels");
    let other = CART.replace("gear=\"20\"", "gear=\"21\"");
    let first = load(folder(&[("task.toml", &task), ("cart.xml", CART)]).path());
    let second = load(folder(&[("task.toml", &task), ("cart.xml", &other)]).path());
    let snapshot = common::episodes(first, Version::R, 1, 0, 1).snapshot();
    let mut episodes = common::episodes(second, Version::R, 1, 0, 1);
    let before = start_line(&episodes);
    let error = episodes.restore(&snapshot).unwrap_err();
    assert!(matches!(&error, Error::Snapshot { reason } if reason.contains("another model")), "{error}");
    assert_eq!(start_line(&episodes), before, "nothing changed");
}

#[test]
fn a_changed_weight_is_another_hash() {
    let hash = |task: &str, model: &str| {
        let folder = folder(&[("task.toml", task), ("cart.xml", model)]);
        (load(folder.path()).make)().unwrap().model_hash().to_owned()
    };
    let own = hash(TASK, CART);
    assert_eq!(own.len(), 64);
    assert_eq!(own, hash(TASK, CART), "the same files");
    assert_ne!(own, hash(&TASK.replace("-0.1", "-0.2"), CART));
    assert_ne!(own, hash(TASK, &CART.replace("gear=\"20\"", "gear=\"21\"")));
}

#[test]
fn states_of_wrong_lengths_and_numbers_are_refused() {
    for spec in common::folder_specs() {
        let mut environment = (spec.make)().unwrap();
        let mut state = Vec::new();
        environment.save(&mut state);
        assert!(environment.load(&state[1..]).is_err());
        for i in 0..state.len() {
            let mut spoilt = state.clone();
            spoilt[i] = f64::NAN;
            assert!(environment.load(&spoilt).is_err(), "{}: number {i}", spec.name);
        }
        let mut absurd = state.clone();
        absurd[2] = 1e300;
        assert!(environment.load(&absurd).is_err());
        environment.load(&state).unwrap();
    }
}

/// Loads a cart whose state exceeds MuJoCo's range after some steps.
fn diverging() -> &'static EnvironmentSpec {
    let model = CART.replace("gear=\"20\"", "gear=\"1e12\"").replace("limited=\"true\" range=\"-2 2\"", "");
    let task = TASK.replace("CartAndPole", "DivergingCart").replace(", above = -0.5, below = 0.5", ", above = -1e30");
    let task = task.replace("healthy = 1.0", "healthy = 1.0, otherwise = -3.0");
    load(folder(&[("task.toml", &task), ("cart.xml", &model)]).path())
}

#[test]
fn divergence_ends_the_episode_until_the_reset() {
    let spec = diverging();
    let mut episodes = common::episodes(spec, Version::D, 1, 0, 1);
    let push = 1.0f32.to_le_bytes();
    let mut last = observe(&episodes);
    let ended = (0..100).find(|_| {
        let (outcome, terms) = step(&mut episodes, &push);
        if outcome.terminated {
            assert_eq!(terms, [-3.0, 0.0], "health's term says so, and no other");
            assert_eq!(observe(&episodes), last, "the observation stays");
        }
        last = observe(&episodes);
        outcome.terminated
    });
    assert!(ended.is_some());
    assert!(episodes.finished(false).diverged);
    assert!(episodes.scene().is_none());
    let snapshot = episodes.snapshot();
    episodes.restore(&snapshot).unwrap();
    episodes.begin(None);
    assert!(!episodes.ended() && observe(&episodes).iter().all(|value| value.is_finite()));
}

#[test]
fn an_exact_state_is_the_state() {
    let spec = load(folder(&[("task.toml", TASK), ("cart.xml", CART)]).path());
    let mut environment = (spec.make)().unwrap();
    let names: Vec<&str> = spec.state.iter().map(|channel| channel.name).collect();
    assert_eq!(names, ["rail", "hinge", "rail_velocity", "hinge_velocity"]);
    environment.reset_to(&[0.5, 0.1, -0.25, 2.0]);
    let mut observation = [0.0; 4];
    environment.observe(&mut observation);
    assert_eq!(observation, [0.5, 0.1, -0.25, 2.0]);
    let before = saved(environment.as_ref());
    environment.step(Action::Continuous(&[0.3]), &mut [0.0; 2]);
    assert_ne!(saved(environment.as_ref()), before);
    environment.reset_to(&[0.5, 0.1, -0.25, 2.0]);
    assert_eq!(saved(environment.as_ref()), before);
}

#[test]
fn an_environment_takes_less_than_eight_kilobytes() {
    for spec in common::folder_specs() {
        let mut environment = (spec.make)().unwrap();
        environment.step(
            Action::Continuous(&vec![0.0; 8][..action_bytes(spec, 0, 0).len() / 4]),
            &mut vec![0.0; spec.reward_terms.len()],
        );
        let mut state = Vec::new();
        environment.save(&mut state);
        // An environment keeps its saved state and its part of the edited model. Both must be small.
        assert!(8 * state.len() < 4096, "{}: {} numbers", spec.name, state.len());
    }
}
