//! A step without the search for nearby geoms gives the same bytes as MuJoCo's own step.

use crate::states::state;
use perturb_mujoco::{Error, Model, Simulation, Warning};

const HOPPER: &str = include_str!("../../../../models/hopper.xml");
const HALF_CHEETAH: &str = include_str!("../../../../models/half_cheetah.xml");

/// A crate with a lid that slides over a kerb into the corner of two planes. Crate and lid can touch all of them.
const CORNER: &str = r#"
<mujoco>
  <size njmax="300" nconmax="60" nstack="60000"/>
  <worldbody>
    <geom type="plane" size="5 5 1" contype="0" margin="0.01" gap="0.004" priority="3" friction="0.4 0.1 0.02" condim="6"/>
    <geom type="plane" size="5 5 1" contype="0" pos="1 0 0" euler="0 -90 0" solref="0.03 1" solimp="0.8 0.9 0.002"/>
    <geom name="kerb" type="box" pos="0.5 0 0" size=".05 1 .02" contype="0"/>
    <body name="crate" pos="0 0 0.2">
      <freejoint/>
      <geom name="crate" type="box" size=".1 .1 .1" conaffinity="0" priority="1" friction="0.9 0.05 0.01"/>
      <body name="lid" pos="0 0 0.12">
        <joint name="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 -.1 0 .2 .1 0" size=".02" conaffinity="0" priority="2" condim="4"/>
        <geom type="sphere" pos=".25 0 0" size=".04" conaffinity="0" priority="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>"#;

fn simulation(xml: &str) -> Simulation {
    Simulation::new(Model::from_xml(xml).unwrap()).unwrap()
}

/// Steps two simulations of a model, one with and one without the search. Changes the friction now and then, and
/// compares the states. Returns the number of contacts.
fn compare(xml: &str, speed: f64) -> usize {
    let (mut own, mut mujoco) = (simulation(xml), simulation(xml));
    let mut touched = 0;
    for turn in 0..3000 {
        for simulation in [&mut own, &mut mujoco] {
            if turn % 500 == 0 {
                let friction = 0.3 + 0.2 * f64::from(turn / 500);
                simulation.geom_friction_mut().iter_mut().for_each(|coefficient| *coefficient *= friction);
                simulation.reset().unwrap();
                simulation.qvel_mut()[0] = speed;
            }
            let ctrl = f64::from((turn / 7 * 37 % 11) - 5) / 5.0;
            simulation
                .ctrl_mut()
                .iter_mut()
                .zip([1.0, -1.0].into_iter().cycle())
                .for_each(|(to, sign)| *to = sign * ctrl);
        }
        own.step_without_search().unwrap();
        mujoco.step().unwrap();
        assert_eq!(state(&own), state(&mujoco), "turn {turn}");
        assert_eq!(own.contacts().collect::<Vec<_>>(), mujoco.contacts().collect::<Vec<_>>(), "turn {turn}");
        touched += own.contacts().len();
    }
    touched
}

#[test]
fn robots_step_to_the_same_bytes() {
    for xml in [HOPPER, HALF_CHEETAH] {
        assert!(simulation(xml).has_pairs());
        assert!(compare(xml, 1.0) > 1000);
    }
}

#[test]
fn contacts_with_the_world_come_in_mujocos_order() {
    assert!(simulation(CORNER).has_pairs());
    assert!(compare(CORNER, 4.0) > 1000);
}

#[test]
fn what_needs_the_search_has_it() {
    let corner = |from: &str, to: &str| {
        assert!(CORNER.contains(from), "{from}");
        CORNER.replace(from, to)
    };
    for xml in [
        corner(r#"size=".04" conaffinity="0" priority="1""#, r#"size=".04" conaffinity="0" priority="0""#), // contacts mix both geoms' parameters
        corner(
            r#"condim="6"/>"#,
            r#"condim="6"/><body pos="0.5 1 0"><geom type="box" size=".05 1 .02" contype="0"/></body>"#,
        ),
        corner(r#"condim="6"/>"#, r#"condim="6"/><body pos="0.8 0 .2"><freejoint/><geom size=".1"/></body>"#),
        corner("<worldbody>", r#"<option integrator="RK4"/><worldbody>"#),
        corner("<worldbody>", r#"<option><flag energy="enable"/></option><worldbody>"#),
        corner("<actuator>", r#"<contact><exclude body1="crate" body2="world"/></contact><actuator>"#),
    ] {
        assert!(!simulation(&xml).has_pairs(), "{xml}");
        compare(&xml, 4.0);
    }
}

#[test]
fn a_bad_state_is_divergence() {
    for bad in [f64::NAN, f64::INFINITY, 1.1e10, -1.1e10] {
        for (put, warning) in [
            (Simulation::qpos_mut as fn(&mut Simulation) -> &mut [f64], Warning::BadPosition),
            (Simulation::qvel_mut, Warning::BadVelocity),
        ] {
            let mut hopper = simulation(HOPPER);
            put(&mut hopper)[5] = bad;
            let mut mujoco = simulation(HOPPER);
            put(&mut mujoco)[5] = bad;
            assert_eq!(hopper.step_without_search(), Err(Error::Diverged { warning }), "{bad}");
            assert_eq!(mujoco.step(), Err(Error::Diverged { warning }), "{bad}");
        }
    }
}
