//! The kinematics of `kinematics.c` gives the same bytes as MuJoCo's.

use crate::states::state;
use perturb_mujoco::{Model, Simulation};

/// A model with many special cases: joints away from their bodies' origins, oblique axes and frames, bodies with
/// several joints or none, two kinematic trees, an explicit inertia, and geoms at the body's origin and elsewhere.
const MOBILE: &str = r#"
<mujoco>
  <size njmax="300" nconmax="60" nstack="60000"/>
  <worldbody>
    <geom type="plane" size="5 5 1" contype="0"/>
    <body name="trunk" pos="0.1 0.2 0.9" euler="10 20 30">
      <joint type="slide" axis="1 2 3"/>
      <joint type="slide" axis="0 0 1" ref="0.1"/>
      <joint type="hinge" axis="0.3 -0.4 0.5" pos="0.05 -0.02 0.01"/>
      <geom type="box" size=".1 .2 .05" conaffinity="0" priority="1"/>
      <body name="arm" pos="0.2 0 0.1" quat="0.5 -0.5 0.5 0.5">
        <joint type="hinge" axis="0 1 0" pos="0 0 -0.1" ref="25"/>
        <joint name="elbow" type="hinge" axis="1 0 0" pos="0.02 0.01 0.1"/>
        <geom type="capsule" fromto="0 0 0 .1 .2 .1" size=".03" conaffinity="0" priority="1"/>
        <geom type="sphere" pos=".1 .2 .1" size=".05" conaffinity="0" priority="2"/>
        <body name="cuff" pos="0 0 0.1">
          <inertial pos="0.01 0.02 0.03" mass="0.4" fullinertia="0.02 0.03 0.04 0.001 0.002 0.003"/>
          <geom type="ellipsoid" size=".02 .03 .04" euler="5 6 7" conaffinity="0" priority="1"/>
          <body name="hand" pos="0 0.1 0">
            <joint type="slide" axis="0 1 0" pos="0.1 0.1 0.1"/>
            <geom type="box" size=".02 .02 .02" conaffinity="0" priority="1"/>
          </body>
        </body>
      </body>
    </body>
    <body name="other" pos="-0.5 0 0.099">
      <joint type="hinge" axis="0 0 1"/>
      <geom type="sphere" size=".1" conaffinity="0" priority="1"/>
    </body>
  </worldbody>
  <actuator><velocity joint="elbow" kv="0.1"/></actuator>
</mujoco>"#;

/// A chain of `n` bodies with one hinge each. The hinges' axes alternate. Each body has one geom, centred at its centre
/// of mass.
fn chain(n: usize) -> String {
    let link = |i| {
        let axis = if i % 2 == 0 { "0 1 0" } else { "0.6 0 0.8" };
        format!(
            r#"<body pos="0.1 0 0"><joint axis="{axis}" armature="0.1" damping="1"/><geom size=".04" pos="0.05 0 0" conaffinity="0" priority="1"/>"#
        )
    };
    let (open, close) = ((0..n).map(link).collect::<String>(), "</body>".repeat(n));
    format!(
        r#"<mujoco><size nstack="900000"/><worldbody><geom type="plane" size="9 9 1" pos="0 0 -0.3" contype="0"/>
           {open}{close}</worldbody></mujoco>"#
    )
}

fn simulation(xml: &str) -> Simulation {
    Simulation::new(Model::from_xml(xml).unwrap()).unwrap()
}

/// Returns the poses and velocities of all bodies as bits, which distinguish 0 from -0.
fn bodies(simulation: &Simulation) -> Vec<u64> {
    let of = |body| {
        let places = [simulation.xpos(body), simulation.xipos(body)];
        let motion = simulation.body_velocity(body);
        let numbers = places.as_flattened().iter().chain(simulation.xmat(body)).chain(&motion);
        numbers.map(|number| number.to_bits()).collect::<Vec<u64>>()
    };
    (0..simulation.model().n_body()).flat_map(of).collect()
}

/// Steps both simulations from several poses and compares them. Returns the number of contacts.
fn compare(xml: &str) -> usize {
    let (mut own, mut mujoco) = (simulation(xml), simulation(xml));
    let mut seen = [simulation(xml), simulation(xml)];
    let mut touched = 0;
    for turn in 0_u32..2000 {
        if turn % 200 == 0 {
            for simulation in [&mut own, &mut mujoco] {
                simulation.reset().unwrap();
                let qpos = simulation.qpos_mut().iter_mut().enumerate();
                // In the first poses only one joint is displaced, so most rotations are by the angle 0.
                qpos.filter(|(i, _)| turn > 200 || turn as usize / 200 == i + 1).for_each(|(i, position)| {
                    *position += f64::from(turn) * 0.0005 * [1.0, -0.3, 0.7][i % 3];
                });
                let qvel = simulation.qvel_mut().iter_mut().zip([1.0, -2.0, 0.5].into_iter().cycle());
                qvel.for_each(|(velocity, scale)| *velocity = scale * f64::from(turn / 200) * 0.1);
            }
        }
        // Two other simulations compute the poses, each from a copy of the state, because both functions normalise the
        // quaternions in place.
        for simulation in &mut seen {
            simulation.set_state(&state(&own)).unwrap();
        }
        seen[0].motion().unwrap();
        seen[1].step1().unwrap();
        assert_eq!(bodies(&seen[0]), bodies(&seen[1]), "turn {turn}");
        own.step_without_search().unwrap();
        mujoco.step().unwrap();
        let bits = |simulation: &Simulation| state(simulation).into_iter().map(f64::to_bits).collect::<Vec<u64>>();
        assert_eq!(bits(&own), bits(&mujoco), "turn {turn}");
        assert_eq!(own.contacts().collect::<Vec<_>>(), mujoco.contacts().collect::<Vec<_>>(), "turn {turn}");
        touched += own.contacts().len();
    }
    touched
}

#[test]
fn hinges_and_slides_askew_move_to_the_same_bytes() {
    assert!(simulation(MOBILE).has_pairs());
    assert!(compare(MOBILE) > 1000);
}

#[test]
fn long_chains_do_too() {
    for n in [30, 31, 32, 33, 60] {
        assert!(simulation(&chain(n)).has_pairs());
        compare(&chain(n));
    }
}

#[test]
fn what_is_not_walked_is_mujocos() {
    let with = |from: &str, to: &str| {
        assert!(MOBILE.contains(from), "{from}");
        MOBILE.replacen(from, to, 1)
    };
    let swing = r#"<joint type="hinge" axis="0 0 1"/>"#;
    let ball = with(swing, r#"<joint type="ball"/>"#);
    // An actuator at a site needs the position of the site.
    let site = with(r#"<geom type="box" size=".02"#, r#"<site name="grip" pos=".1 0 0"/><geom type="box" size=".02"#)
        .replace(
            "<actuator>",
            r#"<actuator><general site="grip" gear="1 2 3 0 1 0" biastype="affine" biasprm="0.3 0 0"/>"#,
        );
    // A weld constraint to a mocap body needs the pose of the mocap body.
    let hand = with("<worldbody>", r#"<worldbody><body name="led" mocap="true" pos="0.1 0.2 1" quat="1 0.2 0 0"/>"#)
        .replace("<actuator>", r#"<equality><weld body1="led" body2="trunk"/></equality><actuator>"#);
    let tendon = with(swing, r#"<joint name="swing" type="hinge" axis="0 0 1"/>"#).replace(
        "<actuator>",
        r#"<tendon><fixed stiffness="3" damping="1"><joint joint="swing" coef="2"/></fixed></tendon><actuator>"#,
    );
    for xml in [ball, site, hand, tendon] {
        assert!(simulation(&xml).has_pairs(), "{xml}");
        compare(&xml);
    }
}
