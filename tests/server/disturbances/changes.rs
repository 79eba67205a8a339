//! Changes of the physics within an episode: their time, the new parameters, and the state that is carried over.

use super::{disturbed, settings};
use crate::common::{self, action_bytes, observe, play, start_line, step};
use perturb::env::{
    Action, ActionSpec, Draw, DrawPurpose, Environment, EnvironmentSpec, Episodes, ParameterSpec, PhiloxStream,
    Version, check_distribution, disturbance,
};

const ADDRESS: (u64, u32) = (5, 9);

/// Returns a value for each parameter after a change, different from the value in version D.
fn changed(spec: &'static EnvironmentSpec) -> Vec<(&'static str, f64)> {
    let value = |disturbance: &ParameterSpec| {
        let [_, above] = disturbance.extreme;
        let is_changed = disturbance.name.starts_with("changed_");
        is_changed.then_some((disturbance.name, 0.5 * (above.low + above.high)))
    };
    disturbance::disturbances(spec).iter().filter_map(value).collect()
}

fn catalogue() -> impl Iterator<Item = &'static EnvironmentSpec> {
    let specs: Vec<_> = common::catalogue().specs().filter(|spec| !spec.parameters.is_empty()).collect();
    specs.into_iter()
}

/// Returns an environment of version D whose physics change as `when` says.
fn changing(spec: &'static EnvironmentSpec, when: &[(&'static str, f64)]) -> Episodes {
    disturbed(spec, Version::D, &[when, &changed(spec)].concat(), ADDRESS)
}

/// Plays the same episode in an environment without the disturbance. When `is_changed` changes, the environment gets
/// the other parameters, and then its state again.
struct ByHand {
    environment: Box<dyn Environment>,
    sets: [Vec<f64>; 2],
    is_changed: bool,
}

impl ByHand {
    fn new(spec: &'static EnvironmentSpec) -> Self {
        let mut environment = (spec.make)().unwrap();
        let defaults: Vec<f64> = spec.parameters.iter().map(|parameter| parameter.default).collect();
        environment.set_parameters(&defaults);
        environment.reset(&mut PhiloxStream::new(ADDRESS.0, ADDRESS.1.into(), DrawPurpose::InitialState, 0));
        Self {
            environment,
            sets: [defaults, changed(spec).into_iter().map(|(_, value)| value).collect()],
            is_changed: false,
        }
    }

    /// Takes a step. Returns the terms of the reward, and the observation after it.
    fn step(&mut self, action: Action<'_>, is_changed: bool) -> (Vec<f64>, Vec<f32>, bool) {
        if is_changed != self.is_changed {
            self.is_changed = is_changed;
            let mut state = Vec::new();
            self.environment.save(&mut state);
            self.environment.set_parameters(&self.sets[usize::from(is_changed)]);
            self.environment.load(&state).unwrap();
        }
        let spec = self.environment.spec();
        let mut terms = vec![0.0; spec.reward_terms.len()];
        let transition = self.environment.step(action, &mut terms);
        let mut observation = vec![0.0; spec.observation.len()];
        self.environment.observe(&mut observation);
        (terms, observation, transition.terminated)
    }
}

fn first_stream(step: u32) -> PhiloxStream {
    let draw = Draw { seed: ADDRESS.0, environment_index: ADDRESS.1, episode_index: 0 };
    PhiloxStream::at_step(&draw, DrawPurpose::Change, step)
}

#[test]
fn physics_change_where_it_says_and_the_state_goes_over() {
    type Law = (&'static [(&'static str, f64)], fn(u32) -> bool);
    let laws: [Law; 4] = [
        (&[("change_at", 3.0)], |step| step == 3),
        (&[("change_every", 4.0)], |step| step > 0 && step % 4 == 0),
        (&[("change_probability", 0.3)], |step| step > 0 && first_stream(step).unit() < 0.3),
        (&[("change_at", 2.0), ("change_every", 5.0), ("change_probability", 0.2)], |step| {
            step > 0 && (step == 2 || step % 5 == 0 || first_stream(step).unit() < 0.2)
        }),
    ];
    for spec in catalogue() {
        for (when, changes) in laws {
            let (mut episodes, mut by_hand) = (changing(spec, when), ByHand::new(spec));
            let mut is_changed = false;
            for t in 0..60 {
                is_changed ^= changes(t);
                let bytes = action_bytes(spec, 1, t.into());
                let mut terms = vec![0.0; spec.reward_terms.len()];
                let numbers = common::floats(&bytes);
                let action = match spec.action {
                    ActionSpec::Discrete(_) => Action::Discrete(numbers[0].to_bits()),
                    ActionSpec::Continuous(_) => Action::Continuous(&numbers),
                };
                episodes.step(action, &mut terms);
                let expected = by_hand.step(action, is_changed);
                assert_eq!((terms, observe(&episodes), episodes.ended()), expected, "{} {when:?} {t}", spec.name);
                if episodes.ended() {
                    break;
                }
            }
        }
    }
}

#[test]
fn receipts_tell_the_physics_before_and_after_a_change() {
    for spec in catalogue() {
        let mut settings = settings(spec, Version::D, &[&[("change_at", 2.0)], &changed(spec)[..]].concat(), ADDRESS);
        settings.episodes_per_trial = 2;
        let mut episodes = Episodes::new((disturbance::disturbed(spec).make)().unwrap(), settings);
        let first = episodes.receipt();
        let twin = episodes.spec();
        for (parameter, &requested) in twin.parameters.iter().zip(&first.requested) {
            let place = twin.applied.iter().position(|quantity| quantity.name == parameter.applied).unwrap();
            let error = (first.applied[place] - requested).abs();
            assert!(error <= 1e-9 * requested.abs(), "{} {}: read back to rounding", spec.name, parameter.name);
        }
        for t in 0..5 {
            step(&mut episodes, &action_bytes(spec, 1, t));
        }
        assert_eq!(episodes.receipt(), first, "{}", spec.name);
        // The next episode of the trial begins with the physics before the change.
        episodes.begin(None);
        let mut plain = common::episodes(spec, Version::D, ADDRESS.0, ADDRESS.1, 2);
        plain.begin(None);
        assert_eq!(observe(&episodes), observe(&plain));
        for t in 0..2 {
            let action = action_bytes(spec, 1, t);
            assert_eq!(step(&mut episodes, &action), step(&mut plain, &action), "{}", spec.name);
        }
    }
}

#[test]
fn what_follows_a_snapshot_amid_a_change_is_what_followed_it() {
    for spec in catalogue() {
        for before in [2, 3, 5, 9] {
            let mut played = changing(spec, &[("change_at", 3.0), ("change_every", 7.0)]);
            play(&mut played, 1, 0, before);
            let snapshot = played.snapshot();
            let mut restored = disturbed(spec, Version::R, &[], (1, 0));
            play(&mut restored, 2, 0, 4);
            restored.restore(&snapshot).unwrap();
            assert_eq!(start_line(&restored), start_line(&played), "{}", spec.name);
            assert_eq!(restored.snapshot(), snapshot, "{}", spec.name);
            assert_eq!(play(&mut restored, 1, before, 100), play(&mut played, 1, before, 100), "{}", spec.name);
        }
    }
}

#[test]
fn parameters_after_a_change_have_the_sets_of_those_before() {
    for spec in catalogue() {
        let twin = disturbance::disturbed(spec);
        for own in spec.parameters {
            let changed = twin.parameters.iter().find(|other| other.name == format!("changed_{}", own.name)).unwrap();
            for version in [Version::D, Version::R, Version::E, Version::RE] {
                assert_eq!(changed.distribution(version), own.distribution(version), "{}", changed.name);
            }
            assert_eq!((changed.unit, changed.bounds), (own.unit, own.bounds));
        }
        let at = twin.parameters.iter().find(|parameter| parameter.name == "change_at").unwrap();
        assert!(check_distribution(twin, at, &"0.5".parse().unwrap()).is_err(), "steps are whole");
    }
}
