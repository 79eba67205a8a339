//! One simulation can serve many states and edited models in turn, and earlier computations do not affect later ones.

use perturb_mujoco::{ElementKind, Error, Model, Simulation, Warning};

/// A block that slides and tips on the floor, with a flywheel that a motor turns. Euler's method integrates the
/// flywheel's damping implicitly.
const BLOCK: &str = r#"
<mujoco>
  <option solver="Newton"/>
  <size njmax="100" nconmax="25" nstack="20000"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body name="block" pos="0 0 0.2">
      <freejoint/>
      <geom name="block" type="box" size=".1 .1 .1"/>
      <body name="wheel" pos="0 0 0.2">
        <joint name="axle" axis="1 0 0" damping="0.1"/>
        <geom type="capsule" fromto="0 -.2 0 0 .2 0" size=".02"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="axle"/></actuator>
</mujoco>"#;

fn simulation() -> Simulation {
    Simulation::new(Model::from_xml(BLOCK).unwrap()).unwrap()
}

pub(crate) fn state(simulation: &Simulation) -> Vec<f64> {
    let mut state = vec![f64::NAN; simulation.model().n_state()];
    simulation.state(&mut state);
    state
}

fn constants(simulation: &Simulation) -> Vec<f64> {
    let mut constants = vec![f64::NAN; simulation.model().n_constants()];
    simulation.constants(&mut constants);
    constants
}

/// Edits mass, inertia and friction, differently for each `number`.
fn edit(simulation: &mut Simulation, number: usize) {
    let block = simulation.model().id(ElementKind::Body, "block").unwrap();
    let scale = 1.0 + number as f64;
    simulation.body_mass_mut()[block] *= scale;
    simulation.body_inertia_mut()[3 * block..][..3].iter_mut().for_each(|moment| *moment *= scale);
    simulation.geom_friction_mut().iter_mut().for_each(|coefficient| *coefficient /= scale);
    simulation.set_const().unwrap();
    simulation.reset().unwrap();
}

/// Throws the block, differently for each `number`.
fn throw(simulation: &mut Simulation, number: usize) {
    let number = number as f64;
    simulation.qvel_mut()[..6].copy_from_slice(&[3.0, 0.5 * number, 0.0, 0.0, 1.0 + number, 2.0]);
    simulation.ctrl_mut()[0] = number - 1.0;
}

#[test]
fn states_in_one_simulation_evolve_as_each_alone() {
    const N: usize = 4;
    let mut alone: Vec<Simulation> = (0..N).map(|_| simulation()).collect();
    let mut shared = simulation();
    let mut states = Vec::new();
    for (number, simulation) in alone.iter_mut().enumerate() {
        edit(simulation, number);
        throw(simulation, number);
        states.push((constants(simulation), state(simulation)));
    }
    let mut touched = 0;
    for turn in 0..2000 {
        let number = ((turn * 2_654_435_761) >> 9) % N; // a pseudo-random order
        let (constants, own) = &mut states[number];
        shared.set_constants(constants);
        shared.set_state(own).unwrap();
        for _ in 0..=turn % 3 {
            shared.step().unwrap();
            touched += shared.contacts().len();
            alone[number].step1().unwrap();
            alone[number].step2().unwrap();
        }
        *own = state(&shared);
        assert_eq!(*own, state(&alone[number]), "number {number} in turn {turn}");
        // A divergence or an edit between two states must have no effect.
        if turn % 5 == 0 {
            shared.qvel_mut()[0] = f64::NAN;
            assert_eq!(shared.step(), Err(Error::Diverged { warning: Warning::BadVelocity }));
        }
        if turn % 7 == 0 {
            edit(&mut shared, turn);
        }
    }
    assert!(touched > 1000, "{touched}");
    assert!(states.iter().all(|(_, state)| state[0] > 0.5), "all had their turns");
}

#[test]
fn constants_are_all_that_edits_change() {
    let (mut edited, mut other) = (simulation(), simulation());
    let pristine = edited.model().float_arrays();
    edit(&mut other, 5);
    edit(&mut edited, 2);
    assert_ne!(edited.model().float_arrays(), pristine);
    other.set_constants(&constants(&edited));
    assert_eq!(other.model().float_arrays(), edited.model().float_arrays());
}

#[test]
fn motion_is_step1_without_contacts() {
    let (mut whole, mut part) = (simulation(), simulation());
    let bodies = whole.model().n_body();
    for (number, simulation) in [&mut whole, &mut part].into_iter().enumerate() {
        throw(simulation, 1);
        for _ in 0..150 {
            simulation.step().unwrap();
        }
        if number == 0 { simulation.step1().unwrap() } else { simulation.motion().unwrap() }
    }
    assert!(whole.contacts().len() > 0);
    for body in 0..bodies {
        assert_eq!(part.xpos(body), whole.xpos(body));
        assert_eq!(part.xipos(body), whole.xipos(body));
        assert_eq!(part.xmat(body), whole.xmat(body));
        assert_eq!(part.body_velocity(body), whole.body_velocity(body));
    }
    for (spoil, warning) in [
        (Simulation::qpos_mut as fn(&mut Simulation) -> &mut [f64], Warning::BadPosition),
        (Simulation::qvel_mut, Warning::BadVelocity),
    ] {
        let before = state(&part);
        spoil(&mut part)[0] = f64::INFINITY;
        assert_eq!(part.motion(), Err(Error::Diverged { warning }));
        part.set_state(&before).unwrap();
        part.motion().unwrap();
    }
}

#[test]
fn a_simulation_takes_over_models_of_the_same_sizes() {
    let models = ["\".02\"", "\".05\""].map(|radius| Model::from_xml(&BLOCK.replace("\".02\"", radius)).unwrap());
    let run = |simulation: &mut Simulation| {
        (0..100).for_each(|_| simulation.step().unwrap());
        state(simulation)
    };
    let mut used = simulation();
    throw(&mut used, 2);
    run(&mut used);
    let alone = models.each_ref().map(|model| {
        let mut fresh = Simulation::new(model.try_clone().unwrap()).unwrap();
        throw(&mut fresh, 1);
        let start = state(&fresh);
        (start, run(&mut fresh))
    });
    assert_ne!(alone[0].1, alone[1].1);
    for i in [1, 0, 1] {
        used.set_model(&models[i]).unwrap();
        used.set_state(&alone[i].0).unwrap();
        assert_eq!(run(&mut used), alone[i].1);
    }
}

#[test]
#[should_panic(expected = "the model has other sizes")]
fn a_model_of_other_sizes_is_refused() {
    let other = Model::from_xml(&BLOCK.replace("<geom type=\"plane\" size=\"5 5 1\"/>", "")).unwrap();
    let _ = simulation().set_model(&other);
}
