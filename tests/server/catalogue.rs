//! Properties that every environment of the catalogue must have.

use crate::common::{self, action_bytes, episodes, observe, play, settings, start_line, step};
use perturb::{
    env::{
        self, ActionSpec, ChannelSpec, Distribution, DrawPurpose, EnvironmentSpec, Episodes, Error, ParameterSpec,
        PhiloxStream, SuccessComparison, SuccessRuleSpec, Version,
    },
    tasks,
};
use std::{collections::HashSet, ptr};

const VERSIONS: [Version; 3] = [Version::D, Version::R, Version::E];

fn unique<'a>(names: impl Iterator<Item = &'a str>) -> bool {
    let mut seen = HashSet::new();
    names.into_iter().all(|name| !name.is_empty() && seen.insert(name))
}

/// Returns a legal initial state of the environment: near the origin, within the ranges of the channels.
fn some_state(spec: &EnvironmentSpec, seed: u64) -> Vec<f64> {
    let mut stream = PhiloxStream::new(seed, 0, DrawPurpose::InitialState, 0);
    spec.state.iter().map(|c| stream.uniform(c.low.max(-0.05), c.high.min(0.05))).collect()
}

// Names, units, lengths.

#[test]
fn names_are_unique_and_found() {
    assert!(unique(common::catalogue().names()));
    for spec in common::catalogue().specs() {
        assert!(ptr::eq(common::catalogue().find(spec.name).unwrap(), spec));
        assert!(ptr::eq((spec.make)().unwrap().spec(), spec));
    }
    for name in ["cartpole", "cart-pole", "perturb/CartPole-v1"] {
        assert_eq!(common::catalogue().find(name).unwrap().name, "CartPole");
    }
    for name in ["", "CartPol", "CartPole-v0", "perturb/CartPole-v0", "CartPole "] {
        let refused = common::catalogue().find(name).unwrap_err();
        assert!(
            matches!(refused, Error::UnknownEnvironment(_)) && refused.to_string().contains("CartPole"),
            "{refused}"
        );
    }
}

#[test]
fn the_catalogue_has_the_papers_environments() {
    let classic = ["CartPole", "MountainCar", "Acrobot", "Pendulum"];
    let locomotion: &[&str] = if cfg!(feature = "mujoco") { &["HalfCheetah", "Hopper"] } else { &[] };
    assert_eq!(tasks::catalogue().names().collect::<Vec<_>>(), [&classic, locomotion].concat());
}

#[test]
fn specs_are_complete_and_consistent() {
    for spec in common::catalogue().specs() {
        let name = spec.name;
        assert!(unique(spec.parameters.iter().map(|p| p.name)), "{name}: parameters");
        assert!(unique(spec.observation.iter().map(|c| c.name)), "{name}: observation");
        assert!(unique(spec.state.iter().map(|c| c.name)), "{name}: state");
        assert!(unique(spec.reward_terms.iter().map(|t| t.name)), "{name}: reward terms");
        assert!(unique(spec.applied.iter().map(|q| q.name)), "{name}: applied");
        for list in [spec.parameters.len(), spec.observation.len(), spec.state.len(), spec.reward_terms.len()] {
            assert!(list > 0, "{name}");
        }
        assert!(spec.applied.len() >= spec.parameters.len(), "{name}: every parameter can be read back");
        match spec.action {
            ActionSpec::Discrete(names) => assert!(names.len() >= 2 && unique(names.iter().copied()), "{name}"),
            ActionSpec::Continuous(channels) => {
                assert!(!channels.is_empty() && unique(channels.iter().map(|c| c.name)), "{name}");
                assert!(channels.iter().all(|c| c.low.is_finite() && c.high.is_finite()), "{name}: bounded actions");
            }
        }
        let channels = spec.observation.iter().chain(spec.state);
        assert!(channels.clone().all(|c| c.low <= c.high), "{name}: ranges");
        assert!(channels.clone().all(|c| !c.unit.is_empty()), "{name}: units");
        assert!(spec.parameters.iter().all(|p| !p.unit.is_empty() && !p.description.is_empty()), "{name}: units");
        assert!(spec.control_timestep > 0.0 && spec.step_cost > 0.0, "{name}");
        if spec.success.quantity().name == "steps" {
            assert!(
                (1..=spec.step_limit).contains(&(spec.success.threshold as u32)),
                "{name}: the rule fits the limit"
            );
        }
        for axis in spec.heatmap_axes.iter().flatten() {
            assert!(spec.parameters.iter().any(|p| p.name == *axis), "{name}: {axis}");
        }
    }
}

#[test]
fn limits_and_success_rules_are_the_documents() {
    let document = [
        ("CartPole", 200, "steps", SuccessComparison::AtLeast, 195.0),
        ("MountainCar", 200, "steps", SuccessComparison::AtMost, 110.0),
        ("Acrobot", 500, "steps", SuccessComparison::AtMost, 80.0),
        ("Pendulum", 200, "steps", SuccessComparison::AtLeast, 100.0),
        ("HalfCheetah", 1000, "distance", SuccessComparison::AtLeast, 20.0),
        ("Hopper", 1000, "distance", SuccessComparison::AtLeast, 20.0),
    ];
    for spec in tasks::catalogue().specs() {
        let row = document.iter().find(|row| row.0 == spec.name).unwrap();
        let SuccessRuleSpec { comparison, threshold, .. } = spec.success;
        assert_eq!((spec.name, spec.step_limit, spec.success.quantity().name, comparison, threshold), *row);
    }
}

#[test]
fn success_is_what_was_achieved_compared_with_the_threshold() {
    for spec in common::catalogue().specs() {
        for index in 0..20 {
            let mut e = episodes(spec, Version::E, 6, index, 1);
            for t in 0.. {
                if e.ended() {
                    break;
                }
                step(&mut e, &action_bytes(spec, index.into(), t));
                let end = e.finished(false);
                let success = end.achieved.is_some_and(|achieved| match spec.success.comparison {
                    SuccessComparison::AtLeast => achieved >= spec.success.threshold,
                    SuccessComparison::AtMost => achieved <= spec.success.threshold,
                });
                assert_eq!(end.success, success, "{}: {end:?}", spec.name);
            }
        }
    }
}

/// The tolerance for the rounding of a few operations in double precision. An edit without effect would differ by
/// percents.
const ROUNDING: f64 = 1e-9;

#[test]
fn every_parameter_is_read_back_from_the_physics() {
    for spec in common::catalogue().specs() {
        let quantities: Vec<_> = (spec.parameters.iter())
            .map(|p| spec.applied.iter().position(|q| (q.name, q.unit) == (p.applied, p.unit)).expect(p.name))
            .collect();
        let mut environment = (spec.make)().unwrap();
        let mut stream = PhiloxStream::new(3, 0, DrawPurpose::Parameters, 0);
        let mut applied = vec![f64::NAN; spec.applied.len()];
        for i in 0..300 {
            let mut draw = |p: &ParameterSpec| match i % 3 {
                0 => p.distribution(VERSIONS[i / 3 % 3]).at(stream.unit()),
                1 => stream.uniform(p.bounds.low, p.bounds.high),
                _ => [p.bounds.low, p.bounds.high, p.default][(4.0 * stream.unit()) as usize % 3],
            };
            let requested: Vec<f64> = spec.parameters.iter().map(&mut draw).collect();
            environment.set_parameters(&requested);
            environment.applied(&mut applied);
            for ((p, requested), &quantity) in spec.parameters.iter().zip(&requested).zip(&quantities) {
                let difference = (applied[quantity] - requested).abs();
                assert!(difference <= ROUNDING * requested.abs(), "{} {}: {requested}, {applied:?}", spec.name, p.name);
            }
        }
    }
}

#[test]
fn observations_and_rewards_keep_to_the_spec() {
    for spec in common::catalogue().specs() {
        for version in VERSIONS {
            let mut e = episodes(spec, version, 11, 4, 1);
            for t in 0..2000 {
                if e.ended() {
                    e.begin(None);
                }
                let check = |e: &Episodes| {
                    for (value, ChannelSpec { name, low, high, .. }) in observe(e).into_iter().zip(spec.observation) {
                        let range = *low as f32..=*high as f32;
                        assert!(value.is_finite() && range.contains(&value), "{} {name}: {value}", spec.name);
                    }
                };
                check(&e);
                let (outcome, terms) = step(&mut e, &action_bytes(spec, 8, t));
                check(&e);
                assert!(terms.iter().all(|term| term.is_finite()), "{}: every term is written: {terms:?}", spec.name);
                assert!(outcome.reward.is_finite());
            }
        }
    }
}

#[test]
fn reward_is_the_sum_of_its_terms() {
    for spec in common::catalogue().specs() {
        let mut e = episodes(spec, Version::R, 3, 0, 1);
        let mut total = 0.0;
        for t in 0..1500 {
            let (outcome, terms) = step(&mut e, &action_bytes(spec, 1, t));
            assert_eq!(terms.len(), spec.reward_terms.len());
            // The sums are exactly equal, because the same numbers are added in the same order.
            assert_eq!(outcome.reward, terms.iter().sum::<f64>(), "{}", spec.name);
            total += outcome.reward;
            if e.ended() {
                assert_eq!(e.finished(false).total_reward, total, "{}", spec.name);
                total = 0.0;
                e.begin(None);
            }
        }
    }
}

// Randomness: the same seed, index and counts give the same bytes; nothing else matters.

#[test]
fn the_same_seed_gives_the_same_bytes() {
    for spec in common::catalogue().specs() {
        for version in VERSIONS {
            let run = || {
                let mut e = episodes(spec, version, 5, 7, 2);
                let first = start_line(&e);
                (first, play(&mut e, 1, 0, 700))
            };
            assert_eq!(run(), run(), "{} {version:?}", spec.name);
        }
    }
}

#[test]
fn another_seed_index_or_episode_gives_another_start() {
    for spec in common::catalogue().specs() {
        let mut observations = Vec::new();
        let mut parameters = Vec::new();
        for seed in [0, 1, u64::MAX] {
            for index in [0, 1, u32::MAX] {
                let mut e = episodes(spec, Version::R, seed, index, 1);
                for _ in 0..3 {
                    observations.push(format!("{:?}", observe(&e)));
                    parameters.push(format!("{:?}", e.receipt().requested));
                    e.begin(None);
                }
            }
        }
        assert!(unique(observations.iter().map(String::as_str)), "{}: initial states", spec.name);
        assert!(unique(parameters.iter().map(String::as_str)), "{}: parameters", spec.name);
    }
}

#[test]
fn what_ran_before_does_not_matter() {
    for spec in common::catalogue().specs() {
        for version in VERSIONS {
            let run = |history: &[u64], actor| {
                let mut e = episodes(spec, version, 21, 6, 2);
                for &steps in history {
                    for t in 0..steps {
                        if !e.ended() {
                            step(&mut e, &action_bytes(spec, actor, t));
                        }
                    }
                    e.begin(None);
                }
                let start = start_line(&e);
                (start, play(&mut e, 99, 0, 60))
            };
            let untouched = run(&[0, 0, 0], 1);
            assert_eq!(run(&[5, 120, 1], 2), untouched, "{} {version:?}", spec.name);
            assert_eq!(run(&[300, 0, 40], 3), untouched, "{} {version:?}", spec.name);
        }
    }
}

#[test]
fn a_reset_after_use_equals_a_fresh_environment() {
    for spec in common::catalogue().specs() {
        for version in VERSIONS {
            let mut fresh = episodes(spec, version, 77, 2, 3);
            let mut used = episodes(spec, Version::E, 1, 2, 3);
            play(&mut used, 5, 0, 333);
            let distributions = fresh.settings().distributions.clone();
            used.begin_trial(Some(77), Some(distributions), None);
            assert_eq!(start_line(&used), start_line(&fresh));
            assert_eq!(play(&mut used, 6, 0, 400), play(&mut fresh, 6, 0, 400), "{} {version:?}", spec.name);
        }
    }
}

#[test]
fn an_exact_state_gives_the_same_bytes_whatever_ran_before() {
    for spec in common::catalogue().specs() {
        let state = some_state(spec, 1);
        let mut fresh = episodes(spec, Version::R, 4, 0, 10);
        let mut used = episodes(spec, Version::R, 4, 0, 10);
        play(&mut used, 1, 0, 10);
        // Both environments are in the second episode of a trial, so their counts are equal.
        used.begin_trial(Some(4), None, None);
        fresh.begin(Some(&state));
        used.begin(Some(&state));
        assert_eq!(start_line(&used), start_line(&fresh), "{}", spec.name);
        assert_eq!(play(&mut used, 2, 0, 50), play(&mut fresh, 2, 0, 50), "{}", spec.name);

        let mut other = episodes(spec, Version::R, 4, 0, 10);
        other.begin(Some(&some_state(spec, 2)));
        fresh.begin_trial(Some(4), None, None);
        fresh.begin(Some(&state));
        assert_ne!(observe(&other), observe(&fresh), "{}: the state matters", spec.name);
    }
}

#[test]
fn an_exact_state_spends_no_draw_of_later_episodes() {
    for spec in common::catalogue().specs() {
        let mut drawn = episodes(spec, Version::R, 4, 0, 1);
        let mut exact = episodes(spec, Version::R, 4, 0, 1);
        drawn.begin(None);
        exact.begin(Some(&some_state(spec, 1)));
        assert_eq!(drawn.receipt(), exact.receipt());
        drawn.begin(None);
        exact.begin(None);
        assert_eq!(start_line(&drawn), start_line(&exact));
    }
}

// Trials, parameters and receipts.

#[test]
fn parameters_stay_within_a_trial_and_are_drawn_anew_after_it() {
    for spec in common::catalogue().specs() {
        for n in [1, 2, 5] {
            let mut e = episodes(spec, Version::R, 8, 1, n);
            let mut trials: Vec<Vec<f64>> = Vec::new();
            for episode in 0..4 * n {
                let id = e.id();
                assert_eq!((id.trial_index, id.episode_in_trial), ((episode / n).into(), episode % n), "{}", spec.name);
                assert_eq!((id.episode_index, id.environment_index), (episode.into(), 1));
                let requested = e.receipt().requested;
                if id.episode_in_trial == 0 {
                    assert!(!trials.contains(&requested), "{}: drawn anew", spec.name);
                    trials.push(requested);
                } else {
                    assert_eq!(trials.last(), Some(&requested), "{}: constant", spec.name);
                }
                play_to_its_end(&mut e, 3);
                e.begin(None);
            }
            assert_eq!(trials.len(), 4);
        }
    }
}

/// Plays the running episode, at most `steps` steps.
fn play_to_its_end(e: &mut Episodes, steps: u64) {
    for t in 0..steps {
        if !e.ended() {
            step(e, &action_bytes(e.spec(), 4, t));
        }
    }
}

#[test]
fn the_trial_alone_fixes_the_parameters() {
    for spec in common::catalogue().specs() {
        let parameters = |n: u32| {
            let mut e = episodes(spec, Version::E, 8, 1, n);
            (0..3 * n).for_each(|_| e.begin(None));
            assert_eq!(e.id().trial_index, 3);
            e.receipt().requested
        };
        assert_eq!(parameters(1), parameters(4), "{}", spec.name);
    }
}

#[test]
fn new_distributions_or_seeds_begin_a_trial() {
    for spec in common::catalogue().specs() {
        let mut e = episodes(spec, Version::R, 8, 1, 3);
        e.begin(None);
        assert_eq!((e.id().trial_index, e.id().episode_index, e.id().episode_in_trial), (0, 1, 1));
        let fixed: Vec<_> = spec.parameters.iter().map(|p| Distribution::fixed(p.extreme[0].low)).collect();
        e.begin_trial(None, Some(fixed.into()), None);
        assert_eq!((e.id().trial_index, e.id().episode_index, e.id().episode_in_trial), (1, 2, 0));
        let expected: Vec<f64> = spec.parameters.iter().map(|p| p.extreme[0].low).collect();
        assert_eq!(e.receipt().requested, expected);
        e.begin_trial(Some(9), None, None);
        assert_eq!((e.id().trial_index, e.id().episode_index, e.id().episode_in_trial), (0, 0, 0));
        assert_eq!(e.receipt().requested, expected, "distributions stay");
    }
}

#[test]
fn receipts_read_back_what_was_requested() {
    for spec in common::catalogue().specs() {
        let mut e = episodes(spec, Version::E, 13, 0, 1);
        for _ in 0..50 {
            let receipt = e.receipt();
            assert_eq!(receipt.applied.len(), spec.applied.len());
            assert!(receipt.applied.iter().all(|value| value.is_finite()));
            for (parameter, requested) in spec.parameters.iter().zip(&receipt.requested) {
                let position = spec.applied.iter().position(|quantity| quantity.name == parameter.applied).unwrap();
                let difference = (receipt.applied[position] - requested).abs();
                assert!(difference <= ROUNDING * requested.abs(), "{} {}", spec.name, parameter.name);
            }
            e.begin(None);
        }
    }
}

#[test]
fn derived_quantities_follow_every_edit() {
    let mut e = episodes(common::catalogue().find("CartPole").unwrap(), Version::E, 13, 0, 1);
    for _ in 0..50 {
        let [_, length, mass] = e.receipt().requested[..] else { panic!("three parameters") };
        // The cart's mass is 1 kg.
        assert_eq!(e.receipt().applied[3..], [mass + 1.0, mass * length]);
        e.begin(None);
    }
}

#[test]
fn every_parameter_changes_the_receipt_and_the_physics() {
    for spec in common::catalogue().specs() {
        let run = |edited: Option<usize>| {
            let value = |i: usize| {
                let p = spec.parameters[i];
                Distribution::fixed(if edited == Some(i) { p.extreme[1].high } else { p.default })
            };
            let distributions = (0..spec.parameters.len()).map(value).collect();
            let settings = env::EpisodeSettings { distributions, ..settings(spec, Version::D, 1, 0, 1) };
            let mut e = Episodes::new((spec.make)().unwrap(), settings);
            let applied = e.receipt().applied;
            // 40 steps are enough for an effect of every parameter, also through contacts with the floor.
            let observations: Vec<_> = (0..40)
                .map(|t| {
                    if !e.ended() {
                        step(&mut e, &action_bytes(spec, 2, t));
                    }
                    observe(&e)
                })
                .collect();
            (applied, observations)
        };
        let (applied, observations) = run(None);
        for (i, parameter) in spec.parameters.iter().enumerate() {
            let edited = run(Some(i));
            assert_ne!(edited.0, applied, "{} {}", spec.name, parameter.name);
            assert_ne!(edited.1, observations, "{} {}", spec.name, parameter.name);
        }
    }
}

#[test]
fn edits_do_not_accumulate() {
    for spec in common::catalogue().specs() {
        let mut fresh = episodes(spec, Version::D, 1, 0, 1);
        let mut edited = episodes(spec, Version::E, 1, 0, 1);
        (0..100).for_each(|_| edited.begin(None));
        let defaults = fresh.settings().distributions.clone();
        edited.begin_trial(Some(1), Some(defaults), None);
        assert_eq!(start_line(&edited), start_line(&fresh));
        assert_eq!(play(&mut edited, 1, 0, 100), play(&mut fresh, 1, 0, 100), "{}", spec.name);
    }
}

// Endings.

#[test]
fn an_episode_is_truncated_exactly_at_the_step_limit() {
    for spec in common::catalogue().specs() {
        let mut e = episodes(spec, Version::D, 2, 0, 1);
        let (mut length, mut truncations) = (0, 0);
        for t in 0..u64::from(6 * spec.step_limit) {
            let (outcome, _) = step(&mut e, &action_bytes(spec, 3, t));
            length += 1;
            assert_eq!(outcome.truncated, length == spec.step_limit, "{} after {length} steps", spec.name);
            assert_eq!(e.ended(), outcome.terminated || outcome.truncated);
            truncations += u32::from(outcome.truncated);
            if e.ended() {
                assert_eq!(e.finished(false).length, length);
                length = 0;
                e.begin(None);
            }
        }
        if ["MountainCar", "Acrobot", "Pendulum"].contains(&spec.name) {
            assert!(truncations > 0, "{}: random actions reach the limit", spec.name);
        }
    }
}

#[test]
fn everything_stays_finite_at_the_corners_of_the_bounds() {
    for spec in common::catalogue().specs() {
        for ends in 0..1 << spec.parameters.len() {
            let corner = |i: usize| {
                let bounds = spec.parameters[i].bounds;
                Distribution::fixed(if ends >> i & 1 == 1 { bounds.high } else { bounds.low })
            };
            let distributions = (0..spec.parameters.len()).map(corner).collect();
            let settings = env::EpisodeSettings { distributions, ..settings(spec, Version::D, 1, 0, 1) };
            let mut e = Episodes::new((spec.make)().unwrap(), settings);
            for t in 0..600 {
                let (outcome, terms) = step(&mut e, &action_bytes(spec, 2, t));
                let place = format!("{}, corner {ends:b} of the bounds", spec.name);
                assert!(observe(&e).iter().all(|x| x.is_finite()), "{place}");
                assert!(terms.iter().all(|x| x.is_finite()), "{place}: {terms:?}");
                if e.ended() {
                    let end = e.finished(false);
                    assert!(!end.diverged || outcome.terminated, "{place}");
                    e.begin(None);
                }
            }
        }
    }
}
