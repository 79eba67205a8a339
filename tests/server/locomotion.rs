//! Hopper and HalfCheetah: physics, task, determinism.

use crate::common::{episodes, step};
use perturb::{
    env::{Action, ActionSpec, DrawPurpose, Environment, PhiloxStream, Version},
    tasks::{half_cheetah::half_cheetah, hopper::hopper, locomotion::Walker},
};
use perturb_mujoco::{ElementKind, Model, Simulation};
use rstest::rstest;

type Make = fn() -> Walker;
const ROBOTS: [Make; 2] = [|| hopper().unwrap(), || half_cheetah().unwrap()];

fn stream(index: u64) -> PhiloxStream {
    PhiloxStream::new(7, 0, DrawPurpose::InitialState, index)
}

/// Returns a copy of the simulated model.
fn model(walker: &Walker) -> Model {
    walker.inspect(|simulation| simulation.model().try_clone()).unwrap().unwrap()
}

fn n_actions(walker: &Walker) -> usize {
    match walker.spec().action {
        ActionSpec::Continuous(channels) => channels.len(),
        ActionSpec::Discrete(_) => panic!("walkers have motors"),
    }
}

/// Returns the eight corners of version E's outer bounds: (power, density, friction).
fn corners(walker: &Walker) -> Vec<[f64; 3]> {
    let ends = |i: usize| {
        let [low, high] = walker.spec().parameters[i].extreme;
        [low.low, high.high]
    };
    let mut corners = Vec::new();
    for power in ends(0) {
        for density in ends(1) {
            for friction in ends(2) {
                corners.push([power, density, friction]);
            }
        }
    }
    corners
}

fn defaults(walker: &Walker) -> [f64; 3] {
    std::array::from_fn(|i| walker.spec().parameters[i].default)
}

#[derive(Clone, Copy)]
enum Actions {
    Uniform,
    BangBang,
}

impl Actions {
    fn draw(self, stream: &mut PhiloxStream, out: &mut [f32]) {
        for value in out {
            let u = stream.uniform(-1.0, 1.0) as f32;
            *value = match self {
                Self::Uniform => u,
                Self::BangBang => u.signum(),
            };
        }
    }
}

/// All outputs of a step, as bits.
#[derive(Debug, PartialEq, Clone)]
struct Seen {
    observation: Vec<u32>,
    terms: [u64; 5],
    terminated: bool,
    goal: bool,
    state: Vec<u64>,
}

fn observation(walker: &Walker) -> Vec<f32> {
    let mut observation = vec![0.0; walker.spec().observation.len()];
    walker.observe(&mut observation);
    observation
}

fn saved(walker: &Walker) -> Vec<f64> {
    let mut state = Vec::new();
    walker.save(&mut state);
    state
}

fn rollout(walker: &mut Walker, actions: &mut PhiloxStream, n_steps: usize) -> Vec<Seen> {
    let mut action = vec![0.0; n_actions(walker)];
    let mut terms = [0.0; 5];
    (0..n_steps)
        .map(|_| {
            Actions::Uniform.draw(actions, &mut action);
            let transition = walker.step(Action::Continuous(&action), &mut terms);
            Seen {
                observation: observation(walker).iter().map(|x| x.to_bits()).collect(),
                terms: terms.map(f64::to_bits),
                terminated: transition.terminated,
                goal: transition.goal,
                state: saved(walker).iter().map(|x| x.to_bits()).collect(),
            }
        })
        .collect()
}

#[test]
fn masses_are_those_of_the_geoms() {
    // The documentation gives four digits.
    let close = |a: f64, b: f64| assert!((a - b).abs() < 5e-4 * b, "{a} is not {b}");
    let torso_mass = |walker: &Walker| {
        let mut applied = [0.0; 4];
        walker.applied(&mut applied);
        let model = model(walker);
        assert_eq!(applied[0], model.body_mass()[model.id(ElementKind::Body, "torso").unwrap()]);
        applied[0]
    };
    close(torso_mass(&hopper().unwrap()), 3.665);
    let mut cheetah = half_cheetah().unwrap();
    close(model(&cheetah).body_mass().iter().sum(), 21.18);
    close(torso_mass(&cheetah), 9.457);
    let [power, _, friction] = defaults(&cheetah);
    for (density, mass) in [(500.0, 4.729), (1500.0, 14.186), (1000.0, 9.457)] {
        cheetah.set_parameters(&[power, density, friction]);
        close(torso_mass(&cheetah), mass);
    }
}

#[test]
fn an_edit_equals_compiling_the_edited_text() {
    for make in ROBOTS {
        let mut walker = make();
        for corner @ [power, density, friction] in corners(&walker) {
            // Makes an earlier edit, to check that edits do not accumulate.
            walker.set_parameters(&[1.0, 1234.0, 0.3]);
            walker.set_parameters(&corner);
            let mut xml = walker.mjcf().replacen(r#"friction="0.8 "#, &format!(r#"friction="{friction} "#), 1);
            for geom in ["torso", "head"] {
                xml = xml.replace(
                    &format!(r#"<geom name="{geom}""#),
                    &format!(r#"<geom name="{geom}" density="{density}""#),
                );
            }
            let compiled = Model::from_xml(&xml).unwrap().float_arrays();
            let edited = walker.inspect(|simulation| simulation.model().float_arrays()).unwrap();
            assert_eq!(edited.len(), compiled.len());
            assert!(edited.iter().any(|array| array.name == "stat"));
            for (a, b) in edited.iter().zip(&compiled) {
                assert_eq!((a.name, a.values.len()), (b.name, b.values.len()));
                for (x, y) in a.values.iter().zip(&b.values) {
                    // The edit scales masses, while the reference model integrates them from a density. So rounding
                    // errors differ, and derived arrays amplify them: 4e-13 is the documented bound. Numbers below 1e-6
                    // are only rounding errors.
                    let error = (x - y).abs() / x.abs().max(y.abs()).max(1e-6);
                    assert!(error <= 4e-13, "{} at {corner:?}: {x} and {y}", a.name);
                }
            }
            let mut applied = [0.0; 4];
            walker.applied(&mut applied);
            assert_eq!(applied[1..3], [friction, power]);
        }
    }
}

/// Measures the friction of a sliding robot: its lost forward momentum, divided by the floor's push. This is valid in
/// any pose in which all contacts slide.
fn felt_friction(walker: &mut Walker, friction: f64) -> f64 {
    let [power, density, _] = defaults(walker);
    walker.set_parameters(&[power, density, friction]);
    let mut simulation = Simulation::new(model(walker)).unwrap();
    simulation.qvel_mut()[0] = 6.0;
    simulation.step1().unwrap();
    let momentum = |simulation: &Simulation| {
        let mut sum = [0.0; 2];
        for (body, mass) in simulation.model().body_mass().iter().enumerate() {
            let velocity = simulation.body_velocity(body);
            sum[0] += mass * velocity[3];
            sum[1] += mass * velocity[5];
        }
        sum
    };
    let [x0, z0] = momentum(&simulation);
    let mut weight_impulse = 0.0;
    for _ in 0..40 {
        simulation.step2().unwrap();
        simulation.step1().unwrap();
        weight_impulse += simulation.model().body_mass().iter().sum::<f64>() * 9.8 * simulation.model().timestep();
    }
    let [x1, z1] = momentum(&simulation);
    let push = z1 - z0 + weight_impulse;
    assert!(push > 0.05 * weight_impulse, "it hardly touched the floor");
    (x0 - x1) / push
}

#[test]
fn friction_decides_how_fast_a_sliding_robot_slows_down() {
    for make in ROBOTS {
        let mut walker = make();
        for friction in [0.2, 0.8, 1.4] {
            let felt = felt_friction(&mut walker, friction);
            // The tolerance is large, because MuJoCo's friction is soft and lets the robot slip a little.
            assert!((felt - friction).abs() < 0.1 * friction, "{} {friction}: {felt}", walker.spec().name);
        }
    }
}

#[test]
fn density_and_power_change_what_happens() {
    for make in ROBOTS {
        let mut walker = make();
        let outcome = |walker: &mut Walker, parameters: [f64; 3]| {
            walker.set_parameters(&parameters);
            walker.reset(&mut stream(0));
            rollout(walker, &mut stream(1), 30).pop().unwrap()
        };
        let plain @ [power, density, friction] = defaults(&walker);
        let base = outcome(&mut walker, plain);
        for changed in [[0.5 * power, density, friction], [power, 0.5 * density, friction]] {
            assert_ne!(outcome(&mut walker, changed), base);
        }
        assert_eq!(outcome(&mut walker, plain), base, "an edit leaves no trace");
    }
}

/// Recomputes the poses and contacts of a saved state.
fn recomputed(walker: &Walker, save: &[f64]) -> Simulation {
    let mut simulation = Simulation::new(model(walker)).unwrap();
    let (n_q, n_v) = (simulation.model().n_q(), simulation.model().n_v());
    simulation.qpos_mut().copy_from_slice(&save[2..2 + n_q]);
    simulation.qvel_mut().copy_from_slice(&save[2 + n_q..2 + n_q + n_v]);
    simulation.step1().unwrap();
    simulation
}

/// Returns the mean x coordinate of the robot's bodies, m.
fn place(simulation: &Simulation) -> f64 {
    let n_body = simulation.model().n_body();
    (1..n_body).map(|body| simulation.xipos(body)[0]).sum::<f64>() / (n_body - 1) as f64
}

/// Returns for each geom 1 if it touches anything, otherwise 0.
fn touching(simulation: &Simulation, geoms: &[&str]) -> Vec<f32> {
    let touches = |name: &&str| {
        let geom = simulation.model().id(ElementKind::Geom, name).unwrap();
        simulation.contacts().any(|(a, b)| a == geom || b == geom)
    };
    geoms.iter().map(|name| f32::from(u8::from(touches(name)))).collect()
}

/// Observation and reward terms according to the task's definition, from the states before and after a step.
#[derive(Debug)]
struct Defined {
    /// The observation without the contact flags, before clamping.
    observation: Vec<f64>,
    height: f64,
    pitch: f64,
    /// The reward terms except for the first, which depends on the contact flags.
    terms: [f64; 4],
}

impl Defined {
    fn of(before: &Simulation, after: &Simulation, initial_height: f64, action: &[f32]) -> Self {
        let torso = after.model().id(ElementKind::Body, "torso").unwrap();
        let (height, pitch) = (after.xipos(torso)[2], (-after.xmat(torso)[6]).asin());
        let mut observation = vec![height - initial_height, 0.0, 1.0];
        observation.extend(after.body_velocity(torso)[3..].iter().map(|v| 0.3 * v));
        observation.extend([0.0, pitch]);
        let (mut electricity, mut torque, mut at_limit) = (0.0, 0.0, 0.0);
        for (i, (low, high)) in after.model().joint_range().skip(3).enumerate() {
            let scaled = 2.0 * (after.qpos()[3 + i] - 0.5 * (low + high)) / (high - low);
            let speed = 0.1 * after.qvel()[3 + i];
            observation.extend([scaled, speed]);
            let (a, n) = (f64::from(action[i]), action.len() as f64);
            electricity += (a * speed).abs() / n;
            torque += a * a / n;
            at_limit += if scaled.abs() > 0.99 { 1.0 } else { 0.0 };
        }
        let progress = (place(after) - place(before)) / 0.0165;
        Self { observation, height, pitch, terms: [progress, -2.0 * electricity, -0.1 * torque, -0.2 * at_limit] }
    }
}

const FEET: &[&str] = &["foot"];
const LEGS: &[&str] = &["ffoot", "fshin", "fthigh", "bfoot", "bshin", "bthigh"];

#[rstest]
#[case::hopper(ROBOTS[0], FEET, |height, _: &[f32]| height > 0.8)]
#[case::half_cheetah(ROBOTS[1], LEGS, |_, flags: &[f32]| [1, 2, 4, 5].into_iter().all(|flag| flags[flag] == 0.0))]
fn observation_and_reward_follow_from_the_state(
    #[case] make: Make,
    #[case] flags: &[&str],
    #[case] safe: fn(f64, &[f32]) -> bool,
) {
    let mut walker = make();
    // Starts tilted, so that the cheetah falls, too.
    let mut start = vec![0.0; walker.spec().state.len()];
    (start[1], start[2]) = (0.3, 0.9);
    walker.reset_to(&start);
    let mut before = recomputed(&walker, &saved(&walker));
    let initial_height = before.xipos(before.model().id(ElementKind::Body, "torso").unwrap())[2];
    let mut previous_flags = vec![0.0; flags.len()];
    let (mut draws, mut action, mut terms) = (stream(1), vec![0.0; n_actions(&walker)], [0.0; 5]);
    let (mut touched, mut fell) = (false, false);
    for _ in 0..300 {
        // Actions exceed the motors' range. The control cost counts them unclamped.
        action.fill_with(|| draws.uniform(-2.0, 2.0) as f32);
        let transition = walker.step(Action::Continuous(&action), &mut terms);
        let after = recomputed(&walker, &saved(&walker));
        let (seen, defined) = (observation(&walker), Defined::of(&before, &after, initial_height, &action));
        for (x, y) in seen.iter().zip(&defined.observation) {
            assert!((f64::from(*x) - y.clamp(-5.0, 5.0)).abs() < 1e-6, "{seen:?} {defined:?}"); // the tolerance of rounding to f32
        }
        assert_eq!(seen[8 + 2 * action.len()..], previous_flags, "flags are one step late");
        let alive = safe(defined.height, &previous_flags) && defined.pitch.abs() < 1.0;
        assert_eq!(transition.terminated, !alive);
        assert_eq!(terms[0], if alive { 1.0 } else { -1.0 });
        for (x, y) in terms[1..].iter().zip(defined.terms) {
            assert!((x - y).abs() < 1e-9 * y.abs().max(1.0), "{terms:?} {defined:?}"); // the order of the sum may differ
        }
        previous_flags = touching(&after, flags);
        touched |= previous_flags.contains(&1.0);
        fell |= transition.terminated;
        before = after;
    }
    assert!(touched && fell, "{touched} {fell}");
}

/// Returns a state in the air at x = `place`, leaning forward by `pitch` and moving at `speed`.
fn thrown(walker: &Walker, place: f64, pitch: f64, speed: f64) -> Vec<f64> {
    let n = walker.spec().state.len();
    let mut state = vec![0.0; n];
    (state[0], state[1], state[2], state[n / 2]) = (place, 1.0, pitch, speed);
    state
}

#[test]
fn robot_succeeds_that_was_20_m_ahead_in_any_step() {
    for make in ROBOTS {
        let mut walker = make();
        let action = vec![0.0; n_actions(&walker)];
        let succeeds = |walker: &mut Walker| walker.step(Action::Continuous(&action), &mut [0.0; 5]).goal;
        walker.reset_to(&thrown(&walker, 19.7, 0.0, 0.0));
        assert!(!succeeds(&mut walker) && walker.achieved().is_some_and(|achieved| achieved < 20.0));
        walker.reset_to(&thrown(&walker, 19.7, 0.0, 40.0));
        assert!(succeeds(&mut walker));
        let (achieved, mut state) = (walker.achieved(), saved(&walker));
        assert!(achieved >= Some(20.0));
        state[2 + walker.spec().state.len() / 2] = -80.0;
        walker.load(&state).unwrap();
        assert!(succeeds(&mut walker) && saved(&walker)[2] < 19.5, "it is back: {state:?}");
        assert_eq!(walker.achieved(), achieved);
    }
}

/// The reference implementation judges success after the reset, so it never judges the step that ends an episode. This
/// environment also judges that step.
#[test]
fn robot_succeeds_that_falls_in_the_step_to_20_m() {
    for make in ROBOTS {
        let walker = make();
        let action = vec![0; 4 * n_actions(&walker)];
        for (speed, success) in [(40.0, true), (0.0, false)] {
            let mut e = episodes(walker.spec(), Version::D, 0, 0, 1);
            e.begin(Some(&thrown(&walker, 19.7, 1.1, speed)));
            assert!(step(&mut e, &action).0.terminated);
            let end = e.finished(false);
            assert_eq!((end.length, end.success), (1, success), "{end:?}");
        }
    }
}

/// Runs episodes of 1000 steps, which continue after the robot has fallen.
fn endure(make: Make, corner: [f64; 3], actions: Actions, n_steps: usize) {
    let mut walker = make();
    walker.set_parameters(&corner);
    let mut action = vec![0.0; n_actions(&walker)];
    let mut observation = vec![0.0; walker.spec().observation.len()];
    let mut terms = [0.0; 5];
    let mut draws = stream(1);
    for step in 0..n_steps {
        if step % 1000 == 0 {
            walker.reset(&mut stream(step as u64));
        }
        actions.draw(&mut draws, &mut action);
        let transition = walker.step(Action::Continuous(&action), &mut terms);
        walker.observe(&mut observation);
        assert!(!transition.diverged, "{} diverged at {corner:?}, step {step}", walker.spec().name);
        assert!(terms.iter().all(|x| x.is_finite()) && observation.iter().all(|x| x.abs() <= 5.0));
    }
}

/// Plays twenty episodes in each corner.
#[rstest]
fn nothing_diverges_in_the_corners_of_the_extreme_sets(
    #[values(ROBOTS[0], ROBOTS[1])] make: Make,
    #[values(Actions::Uniform, Actions::BangBang)] actions: Actions,
) {
    for corner in corners(&make()) {
        endure(make, corner, actions, 20_000);
    }
}

#[test]
fn a_snapshot_replays_to_the_same_bytes() {
    for make in ROBOTS {
        for steps in [0, 1, 7, 60] {
            let mut walker = make();
            walker.reset(&mut stream(3));
            let mut actions = stream(4);
            rollout(&mut walker, &mut actions, steps);
            let (state, seen) = (saved(&walker), observation(&walker));
            let expected = rollout(&mut walker, &mut actions.clone(), 200);
            // Loads the state into a used walker and into a new one.
            for mut other in [walker, make()] {
                other.load(&state).unwrap();
                assert_eq!(observation(&other), seen);
                assert_eq!(saved(&other), state);
                assert_eq!(rollout(&mut other, &mut actions.clone(), 200), expected, "after {steps} steps");
            }
        }
    }
}

#[test]
fn impossible_snapshots_are_refused() {
    for make in ROBOTS {
        let mut walker = make();
        let good = saved(&walker);
        assert!(walker.load(&good[2..]).is_err());
        assert!(walker.load(&[]).is_err());
        for (place, value) in [(2, f64::NAN), (3, f64::INFINITY), (2, 1e300)] {
            let mut bad = good.clone();
            bad[place] = value;
            assert!(walker.load(&bad).is_err(), "{value} in place {place}");
        }
        walker.load(&good).unwrap();
    }
}

#[test]
fn a_reset_after_use_equals_a_fresh_one() {
    for make in ROBOTS {
        let restart = |walker: &mut Walker| {
            walker.reset(&mut stream(5));
            (observation(walker), saved(walker), rollout(walker, &mut stream(6), 200))
        };
        let parameters = [0.8, 900.0, 0.6];
        let mut used = make();
        used.set_parameters(&parameters);
        let fresh = restart(&mut used);
        for corner in corners(&used) {
            used.set_parameters(&corner);
            used.reset(&mut stream(1));
            rollout(&mut used, &mut stream(2), 300);
            used.set_parameters(&parameters);
            assert_eq!(restart(&mut used), fresh);
        }
        // The result is the same without new parameters, as within a trial.
        assert_eq!(restart(&mut used), fresh);
        // The result is the same after a divergence.
        let n = used.spec().state.len();
        used.reset_to(&vec![1e20; n]);
        assert_eq!(restart(&mut used), fresh);
    }
}

#[test]
fn an_exact_state_is_taken_over_exactly() {
    for make in ROBOTS {
        let mut walker = make();
        let n = walker.spec().state.len();
        let state: Vec<f64> = (0..n).map(|i| if i == 1 { 0.3 } else { 0.01 * i as f64 }).collect();
        walker.reset_to(&state);
        assert_eq!(saved(&walker)[2..2 + n], state);
        let seen = observation(&walker);
        assert_eq!(seen[0], 0.0, "the height counts from the reset");
        assert!(seen[8 + 2 * n_actions(&walker)..].iter().all(|&flag| flag == 0.0));
        let first = rollout(&mut walker, &mut stream(0), 50);
        rollout(&mut walker, &mut stream(1), 50);
        walker.reset_to(&state);
        assert_eq!(rollout(&mut walker, &mut stream(0), 50), first);
    }
}

#[test]
fn divergence_ends_the_episode_with_finite_numbers() {
    for make in ROBOTS {
        let mut walker = make();
        let action = vec![1.0; n_actions(&walker)];
        let check = |walker: &mut Walker, seen: &[f32]| {
            let mut terms = [0.0; 5];
            let transition = walker.step(Action::Continuous(&action), &mut terms);
            assert!(transition.terminated && transition.diverged && !transition.goal);
            assert_eq!(terms, [-1.0, 0.0, 0.0, 0.0, 0.0]);
            assert_eq!(observation(walker), seen);
            assert!(walker.scene().is_none(), "what MuJoCo put in the state's place is not shown");
            let state = saved(walker);
            walker.load(&state).unwrap();
            assert_eq!(saved(walker), state);
        };
        // The physics diverge during a step, because of a control above MuJoCo's limit of 1e10.
        walker.set_parameters(&[1e11, 1000.0, 0.8]);
        walker.reset(&mut stream(0));
        let before = observation(&walker);
        check(&mut walker, &before);
        check(&mut walker, &before);
        // The physics diverge at the reset.
        let n = walker.spec().state.len();
        walker.reset_to(&vec![1e20; n]);
        let zeros = vec![0.0; walker.spec().observation.len()];
        check(&mut walker, &zeros);
        // The next reset ends the divergence.
        walker.set_parameters(&[1.0, 1000.0, 0.8]);
        walker.reset(&mut stream(0));
        assert!(!walker.step(Action::Continuous(&action), &mut [0.0; 5]).diverged);
        assert!(walker.scene().is_some());
    }
}
