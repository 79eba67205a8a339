//! A push changes the momentum by its impulse in one step, and changes nothing else.

use crate::{
    common,
    folder::{CART, TASK, folder, load},
};
use perturb::{
    env::{Action, ActionSpec, Environment, EnvironmentSpec},
    tasks::{hopper, locomotion::Walker},
};
use perturb_mujoco::Simulation;

fn make(spec: &'static EnvironmentSpec) -> Box<dyn Environment> {
    (spec.make)().unwrap()
}

/// Takes a step with the neutral action, with or without a push. Returns the saved state.
fn step(environment: &mut dyn Environment, impulse: Option<f64>) -> Vec<f64> {
    let spec = environment.spec();
    if let Some(impulse) = impulse {
        environment.push([impulse, 0.0, 0.0]);
    }
    let mut terms = vec![0.0; spec.reward_terms.len()];
    match spec.action {
        ActionSpec::Discrete(_) => environment.step(Action::Discrete(1), &mut terms),
        ActionSpec::Continuous(channels) => {
            environment.step(Action::Continuous(&vec![0.0; channels.len()]), &mut terms)
        }
    };
    let mut state = Vec::new();
    environment.save(&mut state);
    state
}

/// Returns the change of the state by a push in one step from `state`.
fn difference(name: &str, state: &[f64], impulse: f64) -> Vec<f64> {
    let after = |impulse| {
        let mut environment = make(common::catalogue().find(name).unwrap());
        environment.reset_to(state);
        step(environment.as_mut(), impulse)
    };
    after(Some(impulse)).iter().zip(after(None)).map(|(pushed, other)| pushed - other).collect()
}

/// The tolerance for differences of numbers near 1, which have rounding errors of some 1e-16.
const ROUNDING: f64 = 1e-12;

#[test]
fn a_push_gives_the_cart_its_momentum() {
    let (angle, half_length, pole, cart) = (0.15_f64, 0.5, 0.1, 1.0);
    let [x, v, theta, omega] = difference("CartPole", &[0.1, 0.2, angle, 0.3], 0.7)[..] else { unreachable!() };
    assert_eq!((x, theta), (0.0, 0.0), "positions follow a step later");
    let along_x = (cart + pole) * v + pole * half_length * angle.cos() * omega;
    assert!((along_x - 0.7).abs() < ROUNDING, "{along_x}");
    let about_hinge = pole * half_length * (angle.cos() * v + 4.0 / 3.0 * half_length * omega);
    assert!(about_hinge.abs() < ROUNDING, "{about_hinge}");
}

#[test]
fn a_push_gives_the_car_and_the_pendulum_their_momenta() {
    let [_, v] = difference("MountainCar", &[-0.5, 0.0], 0.01)[..] else { unreachable!() };
    assert!((v - 0.01).abs() < ROUNDING, "{v}");
    // The moment of inertia is 1/3 kg m²: a rod of 1 kg and 1 m that turns about its end.
    let [_, omega] = difference("Pendulum", &[0.3, 0.2], 0.4)[..] else { unreachable!() };
    assert!((omega / 3.0 - 0.4).abs() < ROUNDING, "{omega}");
}

#[test]
fn a_push_turns_the_first_link_of_the_acrobot() {
    let impulse = 0.01;
    let difference = difference("Acrobot", &[0.0; 4], impulse);
    // At rest and hanging down, the momenta follow from the mass matrix [d1, d2; d2, d3].
    let (d1, d2, d3) = (1.0 * 0.25 + (1.0 + 0.25 + 1.0) + 2.0, 0.25 + 0.5 + 1.0, 0.25 + 1.0);
    let (first, second) = (difference[2], difference[3]);
    let momenta = [d1 * first + d2 * second, d2 * first + d3 * second];
    // Gravity removes a part of the momentum while the links turn, for 0.2 s.
    assert!((momenta[0] - impulse).abs() < 0.1 * impulse && momenta[1].abs() < 0.1 * impulse, "{momenta:?}");
}

/// Returns the x coordinate of the centre of mass of all bodies, m, and their mass, kg.
fn centre_of_mass(walker: &Walker) -> (f64, f64) {
    let mut saved = Vec::new();
    walker.save(&mut saved);
    let model = walker.inspect(|simulation| simulation.model().try_clone()).unwrap().unwrap();
    let mut simulation = Simulation::new(model).unwrap();
    let n_state = simulation.model().n_state();
    simulation.set_state(&saved[1..][..n_state]).unwrap();
    simulation.kinematics().unwrap();
    let masses = simulation.model().body_mass().to_vec();
    let mass: f64 = masses.iter().sum();
    let moment: f64 = masses.iter().enumerate().map(|(body, mass)| mass * simulation.xipos(body)[0]).sum();
    (moment / mass, mass)
}

#[test]
fn a_push_gives_the_hopper_its_momentum() {
    const IMPULSE: f64 = 2.0;
    let in_the_air = || {
        let mut walker = hopper::hopper().unwrap();
        walker.reset_to(&[0.0, 5.0, 0.0, -0.5, -0.5, 0.1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        walker
    };
    let (mut pushed, mut alone, mut after) = (in_the_air(), in_the_air(), in_the_air());
    let expected: Vec<_> = (0..4).map(|_| step(&mut alone, None)).collect();
    step(&mut pushed, Some(IMPULSE));
    let (before, mass) = centre_of_mass(&pushed);
    // This thread's simulation then steps another hopper, on which the force must not act.
    assert_eq!((0..4).map(|_| step(&mut after, None)).collect::<Vec<_>>(), expected);
    step(&mut pushed, None);
    let momentum = mass * ((centre_of_mass(&pushed).0 - before) / hopper::SPEC.control_timestep - 1.0);
    // The robot moved at 1 m/s before. Its dampers act only between its bodies. The tolerance is 1 %, because MuJoCo
    // integrates joints and not momenta.
    assert!((momentum - IMPULSE).abs() < 0.01 * IMPULSE, "{momentum}");
}

#[test]
fn a_push_gives_the_body_of_a_folder_its_momentum() {
    const IMPULSE: f64 = 0.5;
    let cart = CART.replace(" damping=\"0.5\"", "").replace(" damping=\"0.1\"", "");
    let task = TASK.replace("reset =", "push = { body = \"pole\", axes = \"x\" }\nreset =");
    let folder = folder(&[("task.toml", &task), ("cart.xml", &cart)]);
    let spec = load(folder.path());
    assert_eq!(
        spec.push.map(|push| (push.description, push.axes)),
        Some(("impulse of a push on pole along x", &[0][..]))
    );
    let upright = || {
        let mut environment = make(spec);
        environment.reset_to(&[0.0; 4]);
        environment
    };
    let (mut alone, mut pushed, mut after) = (upright(), upright(), upright());
    let expected = step(alone.as_mut(), None);
    let state = step(pushed.as_mut(), Some(IMPULSE));
    assert_eq!(step(after.as_mut(), None), expected, "the same thread's simulation steps another cart");
    // The saved state is: diverged or not, time, two positions, two velocities. The pole's centre of mass is 0.4 m
    // above the hinge.
    let (angle, cart_velocity, angular_velocity) = (state[3], state[4], state[5]);
    let momentum = 2.0 * cart_velocity + 0.5 * (cart_velocity + 0.4 * angle.cos() * angular_velocity);
    assert!((momentum - IMPULSE).abs() < 0.01 * IMPULSE, "{momentum}");
    assert!(angular_velocity > 0.0, "it acts on the pole, not on the cart");
}

#[test]
fn the_first_body_that_moves_is_pushed_on_the_ground() {
    let folder = folder(&[("task.toml", TASK), ("cart.xml", CART)]);
    let push = load(folder.path()).push.unwrap();
    assert_eq!((push.description, push.axes), ("impulse of a push on cart along x and y", &[0, 1][..]));
}
