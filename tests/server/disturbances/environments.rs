//! Properties of disturbances in every environment of the catalogue.

use super::{all, disturbed, settings};
use crate::common::{self, action_bytes, episodes, observe, play, start_line, step};
use perturb::env::{
    ActionSpec, Distribution, Episodes, Error, ParameterSpec, Version, check_distribution, disturbance, resolve,
};

const VERSIONS: [Version; 4] = [Version::D, Version::R, Version::E, Version::RE];

#[test]
fn catalogue_has_no_disturbances_among_parameters() {
    for spec in common::catalogue().specs() {
        let disturbances = disturbance::disturbances(spec);
        let is_own = |disturbance: &ParameterSpec| spec.parameters.iter().any(|own| own.name == disturbance.name);
        assert!(!disturbances.iter().any(is_own), "{}", spec.name);
        let twin = disturbance::disturbed(spec);
        assert!(std::ptr::eq(twin, disturbance::disturbed(twin)) && std::ptr::eq((twin.make)().unwrap().spec(), twin));
        assert!(
            std::ptr::eq(disturbance::undisturbed(twin), spec) && std::ptr::eq(disturbance::undisturbed(spec), spec)
        );
        assert_eq!(twin.parameters.len(), spec.parameters.len() + disturbances.len());
        assert_eq!((twin.name, twin.revision), (spec.name, spec.revision));
        for parameter in disturbances {
            assert!(perturb_protocol::disturbance::is_disturbance(parameter.name), "clients know the names");
            if parameter.name.starts_with("changed_") {
                continue;
            }
            let known = perturb_protocol::disturbance::default_value(parameter.name);
            assert_eq!(known, Some(parameter.default), "{}: clients know the names", parameter.name);
            for version in VERSIONS {
                assert_eq!(parameter.distribution(version), Distribution::fixed(parameter.default));
            }
        }
        let names: Vec<&str> = disturbances.iter().map(|disturbance| disturbance.name).collect();
        let of_actions: &[&str] = match spec.action {
            ActionSpec::Discrete(_) => &["action_delay", "action_hold"],
            ActionSpec::Continuous(_) => &["action_delay", "action_hold", "action_noise", "action_scale"],
        };
        assert_eq!(&names[..of_actions.len()], of_actions, "{}", spec.name);
        let mut others: Vec<String> =
            ["push", "push_interval", "sensor_delay", "sensor_noise", "sensor_dropout"].map(String::from).into();
        if !spec.parameters.is_empty() {
            others.extend(["change_at", "change_every", "change_probability"].map(String::from));
            others.extend(spec.parameters.iter().map(|own| format!("changed_{}", own.name)));
        }
        assert_eq!(names[names.len() - others.len()..], others, "{}", spec.name);
    }
}

#[test]
fn disturbances_at_their_defaults_change_no_byte() {
    for spec in common::catalogue().specs() {
        for version in VERSIONS {
            let mut plain = episodes(spec, version, 3, 7, 2);
            let twin = disturbance::disturbed(spec);
            let mut twin = episodes(twin, version, 3, 7, 2);
            let own = spec.parameters.len();
            for t in 0..600 {
                assert_eq!(plain.receipt().requested, twin.receipt().requested[..own], "{}", spec.name);
                assert_eq!(plain.receipt().applied, twin.receipt().applied[..spec.applied.len()], "{}", spec.name);
                assert_eq!(observe(&plain), observe(&twin), "{}", spec.name);
                let action = action_bytes(spec, 1, t);
                assert_eq!(step(&mut plain, &action), step(&mut twin, &action), "{}", spec.name);
                if plain.ended() {
                    let (end, other) = (plain.finished(false), twin.finished(false));
                    assert_eq!(end, other, "{}", spec.name);
                    plain.begin(None);
                    twin.begin(None);
                }
            }
        }
    }
}

#[test]
fn noise_drawn_ahead_changes_no_byte() {
    for spec in common::catalogue().specs() {
        let values = all(spec);
        let mut plain = disturbed(spec, Version::R, &values, (7, 3));
        let mut ahead = disturbed(spec, Version::R, &values, (7, 3));
        for t in 0..400 {
            if t % 3 > 0 {
                ahead.draw_ahead();
            }
            if t % 50 == 49 {
                // A snapshot of one episode replaces another episode, for whose next step noise was drawn.
                let snapshot = ahead.snapshot();
                ahead.begin(None);
                ahead.draw_ahead();
                ahead.restore(&snapshot).unwrap();
            }
            assert_eq!(observe(&plain), observe(&ahead), "{} after {t} steps", spec.name);
            let action = action_bytes(spec, 1, t);
            assert_eq!(step(&mut plain, &action), step(&mut ahead, &action), "{} at step {t}", spec.name);
            if plain.ended() {
                plain.begin(None);
                ahead.begin(None);
            }
        }
    }
}

#[test]
fn disturbances_leave_the_other_draws_alone() {
    for spec in common::catalogue().specs() {
        for version in VERSIONS {
            let mut plain = episodes(spec, version, 3, 7, 1);
            let mut late = disturbed(spec, version, &all(spec), (3, 7));
            for _ in 0..20 {
                assert_eq!(plain.receipt().requested, late.receipt().requested[..spec.parameters.len()]);
                let receipt = late.receipt();
                let own = disturbance::disturbances(spec).len();
                let tail = |values: &[f64]| values[values.len() - own..].to_vec();
                for (requested, applied) in tail(&receipt.requested).into_iter().zip(tail(&receipt.applied)) {
                    // Masses after a change are read back from the physics. They are exact up to rounding.
                    assert!((requested - applied).abs() <= 1e-9 * requested, "{}: {requested} {applied}", spec.name);
                }
                plain.begin(None);
                late.begin(None);
            }
        }
    }
}

#[test]
fn disturbed_sensors_change_no_physics() {
    for spec in common::catalogue().specs() {
        let sensors: Vec<_> = all(spec).into_iter().filter(|(name, _)| name.starts_with("sensor")).collect();
        let mut plain = episodes(spec, Version::R, 3, 7, 1);
        let mut noisy = disturbed(spec, Version::R, &sensors, (3, 7));
        let mut different = 0;
        for t in 0..600 {
            let action = action_bytes(spec, 1, t);
            assert_eq!(step(&mut plain, &action), step(&mut noisy, &action), "{}", spec.name);
            different += u32::from(observe(&plain) != observe(&noisy));
            if plain.ended() {
                assert_eq!(plain.finished(false), noisy.finished(false), "{}", spec.name);
                plain.begin(None);
                noisy.begin(None);
            }
        }
        assert!(different > 590, "{}: {different} of 600 observations are disturbed", spec.name);
    }
}

#[test]
fn observations_stay_within_their_ranges() {
    for spec in common::catalogue().specs() {
        let mut wild = disturbed(spec, Version::R, &[("sensor_noise", 10.0), ("sensor_dropout", 0.1)], (1, 0));
        for t in 0..200 {
            step(&mut wild, &action_bytes(spec, 1, t));
            for (value, channel) in observe(&wild).into_iter().zip(spec.observation) {
                let (low, high) = (channel.low as f32, channel.high as f32);
                assert!(value.is_finite() && (low..=high).contains(&value), "{}: {value}", channel.name);
            }
            if wild.ended() {
                wild.begin(None);
            }
        }
    }
}

#[test]
fn what_follows_a_snapshot_amid_a_delay_is_what_followed_it() {
    for spec in common::catalogue().specs() {
        for before in [0, 1, 2, 7, 40] {
            let mut played = disturbed(spec, Version::R, &all(spec), (11, 4));
            play(&mut played, 1, 0, before);
            let snapshot = played.snapshot();
            let mut restored = disturbed(spec, Version::D, &[], (1, 0));
            play(&mut restored, 2, 0, 5);
            restored.restore(&snapshot).unwrap();
            assert_eq!(start_line(&restored), start_line(&played), "{}", spec.name);
            assert_eq!(restored.snapshot(), snapshot, "{}", spec.name);
            assert_eq!(play(&mut restored, 1, before, 300), play(&mut played, 1, before, 300), "{}", spec.name);
        }
    }
}

#[test]
fn spoilt_snapshots_are_refused_and_change_nothing() {
    for spec in common::catalogue().specs() {
        let mut played = disturbed(spec, Version::R, &all(spec), (11, 4));
        play(&mut played, 1, 0, 7);
        let before = (played.snapshot(), observe(&played));
        let plain = episodes(spec, Version::R, 11, 4, 1).snapshot();
        assert!(matches!(played.restore(&plain), Err(Error::Snapshot { .. })), "{}", spec.name);
        assert_eq!((played.snapshot(), observe(&played)), before, "{}", spec.name);
        assert!(episodes(spec, Version::R, 11, 4, 1).restore(&before.0).is_err(), "{}", spec.name);
    }
}

#[test]
fn delays_are_whole_numbers_within_their_bounds() {
    for spec in common::catalogue().specs() {
        let twin = disturbance::disturbed(spec);
        let delays = twin.parameters.iter().filter(|parameter| parameter.name.ends_with("_delay"));
        for parameter in delays {
            assert!(parameter.is_integer);
            let check = |text: &str| check_distribution(twin, parameter, &text.parse().unwrap());
            for text in ["0", "2", "0.5..1.5", "0..4", "0..1,2..3"] {
                assert_eq!(check(text), Ok(()), "{text}");
            }
            for text in ["0.5", "0.2..0.8", "0..1,1.2..1.8"] {
                assert!(matches!(check(text), Err(Error::NotWhole { .. })), "{text}");
            }
            assert!(matches!(check("0..1000"), Err(Error::OutOfRange { .. })));
        }
    }
}

#[test]
fn longest_delays_fit_into_a_snapshot() {
    for spec in common::catalogue().specs() {
        let twin = disturbance::disturbed(spec);
        let most = |name: &'static str| {
            let parameter = twin.parameters.iter().find(|parameter| parameter.name == name).unwrap();
            (name, parameter.bounds.high)
        };
        let values = [most("action_delay"), most("sensor_delay")];
        let mut late = disturbed(spec, Version::R, &values, (1, 0));
        play(&mut late, 1, 0, 130);
        let snapshot = late.snapshot();
        let mut restored = disturbed(spec, Version::R, &values, (2, 0));
        restored.restore(&snapshot).unwrap();
        assert_eq!(play(&mut restored, 1, 130, 200), play(&mut late, 1, 130, 200), "{}", spec.name);
    }
}

#[test]
fn names_that_are_neither_are_refused_with_those_that_are() {
    let spec = common::catalogue().find("CartPole").unwrap();
    let refused = disturbance::with_parameters(spec, ["length", "action_dely"]).unwrap_err().to_string();
    assert_eq!(
        refused,
        "CartPole has no parameter \"action_dely\"; it has force, length, mass; and the disturbances action_delay, \
         action_hold, push, push_interval, sensor_delay, sensor_noise, sensor_dropout, change_at, change_every, change_probability, changed_force, \
         changed_length, changed_mass"
    );
    assert!(std::ptr::eq(disturbance::with_parameters(spec, ["length", "mass"]).unwrap(), spec));
    let mut base = settings(spec, Version::D, &[], (0, 0)).distributions.to_vec();
    assert!(resolve(spec, &mut base, [("action_delay", Distribution::fixed(1.0))]).is_err());
    let open = disturbance::check_open(spec, ["action_delay"]).unwrap_err();
    assert!(matches!(open, Error::NotDisturbed { .. }), "{open}");
    assert_eq!(disturbance::check_open(disturbance::disturbed(spec), ["action_delay", "mass"]), Ok(()));
}

#[test]
fn disturbed_episodes_follow_from_their_addresses() {
    for spec in common::catalogue().specs() {
        // Begins the third episode of an environment, once after two other episodes and once directly.
        let mut after_others: Episodes = disturbed(spec, Version::D, &all(spec), (8, 2));
        play(&mut after_others, 1, 0, 3);
        after_others.begin(None);
        play(&mut after_others, 1, 3, 9);
        after_others.begin(None);
        let mut at_once = disturbed(spec, Version::D, &all(spec), (8, 2));
        at_once.begin(None);
        at_once.begin(None);
        while after_others.id() != at_once.id() {
            at_once.begin(None);
        }
        assert_eq!(start_line(&after_others), start_line(&at_once), "{}", spec.name);
        assert_eq!(play(&mut after_others, 1, 12, 200), play(&mut at_once, 1, 12, 200), "{}", spec.name);
    }
}
