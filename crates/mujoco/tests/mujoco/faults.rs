//! MuJoCo's failures are reported as errors, and never end the process.

use perturb_mujoco::{Error, Model, Simulation, Warning};
use std::{sync::Barrier, thread};

/// Boxes that fall onto the floor. MuJoCo's stack is large enough while they fall, but too small for the contacts of
/// the impact.
const SMALL_STACK: &str = r#"
<mujoco>
  <option solver="Newton"/>
  <size njmax="200" nconmax="50" nstack="500"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.2"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
    <body pos="1 0 0.2"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
</mujoco>"#;

const PENDULUM: &str = r#"
<mujoco>
  <worldbody>
    <body name="rod">
      <joint name="hinge" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -1" size=".05"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>"#;

fn simulation(xml: &str) -> Simulation {
    Simulation::new(Model::from_xml(xml).unwrap()).unwrap()
}

/// Steps until an error occurs, for at most one simulated second.
fn fall(simulation: &mut Simulation) -> Result<(), Error> {
    for _ in 0..500 {
        simulation.step1()?;
        simulation.step2()?;
    }
    Ok(())
}

#[test]
fn fatal_errors_in_several_threads_are_returned() {
    const THREADS: usize = 4;
    let model = Model::from_xml(SMALL_STACK).unwrap();
    let barrier = Barrier::new(THREADS);
    thread::scope(|scope| {
        for _ in 0..THREADS {
            scope.spawn(|| {
                for _ in 0..50 {
                    barrier.wait();
                    let mut simulation = Simulation::new(model.try_clone().unwrap()).unwrap();
                    let error = fall(&mut simulation).unwrap_err();
                    assert!(
                        matches!(&error, Error::Fatal { message } if message.contains("Stack overflow")),
                        "{error}"
                    );
                    assert!(simulation.time() > 0.0, "the error comes at the impact");
                    assert!(simulation.is_poisoned());
                    let state = vec![0.0; model.n_state()];
                    for refused in [
                        simulation.step1(),
                        simulation.step2(),
                        simulation.step(),
                        simulation.motion(),
                        simulation.forward(),
                        simulation.reset(),
                        simulation.set_state(&state),
                        simulation.set_const(),
                    ] {
                        assert_eq!(refused, Err(Error::Poisoned));
                    }
                }
            });
        }
    });
}

#[test]
fn a_bad_state_is_divergence_until_the_next_reset() {
    let not_a_number = |simulation: &mut Simulation| simulation.qpos_mut()[0] = f64::NAN;
    let infinite = |simulation: &mut Simulation| simulation.qvel_mut()[0] = f64::INFINITY;
    type Spoil = fn(&mut Simulation);
    let cases: [(Spoil, Warning); 2] = [(not_a_number, Warning::BadPosition), (infinite, Warning::BadVelocity)];
    for (spoil, warning) in cases {
        let mut simulation = simulation(PENDULUM);
        simulation.step1().unwrap();
        simulation.step2().unwrap();
        spoil(&mut simulation);
        assert_eq!(simulation.step1(), Err(Error::Diverged { warning }));
        assert_eq!(simulation.warnings(warning), 1);
        assert_eq!(simulation.step2(), Err(Error::Diverged { warning }));
        simulation.reset().unwrap();
        assert_eq!(simulation.warnings(warning), 0);
        assert_eq!(simulation.step1(), Ok(()));
    }
}

#[test]
fn a_bad_control_is_divergence() {
    let mut simulation = simulation(PENDULUM);
    simulation.step1().unwrap();
    simulation.ctrl_mut()[0] = f64::NAN;
    assert_eq!(simulation.step2(), Err(Error::Diverged { warning: Warning::BadControl }));
}

#[test]
fn forward_notices_a_bad_state() {
    let mut simulation = simulation(PENDULUM);
    simulation.qpos_mut()[0] = f64::NAN;
    assert_eq!(simulation.forward(), Err(Error::Diverged { warning: Warning::BadPosition }));
}

#[test]
fn a_wrong_model_is_refused_with_mujocos_reason() {
    let reason = |xml: &str| match Model::from_xml(xml) {
        Err(Error::Compile { reason }) => reason,
        other => panic!("{other:?}"),
    };
    assert!(reason("<mujoco><worldbody><body><geom/></body></worldbody></mujoco>").contains("size"));
    assert!(reason("<mujoco><wheel/></mujoco>").contains("wheel"));
    assert!(!reason("no xml").is_empty());
    assert!(!reason("").is_empty());
    // With such a small stack, the engine already raises a fatal error while the compiler runs.
    assert!(reason(&SMALL_STACK.replace("500", "1")).contains("Stack overflow"));
}

#[test]
fn names_that_do_not_exist_are_refused() {
    use perturb_mujoco::ElementKind;
    let model = Model::from_xml(PENDULUM).unwrap();
    assert_eq!(model.id(ElementKind::Body, "rod"), Ok(1));
    assert_eq!(model.id(ElementKind::Joint, "hinge"), Ok(0));
    assert_eq!(model.id(ElementKind::Actuator, "motor"), Ok(0));
    for name in ["rope", "", "ro\0d"] {
        assert_eq!(model.id(ElementKind::Body, name), Err(Error::UnknownName { kind: "body", name: name.to_owned() }));
    }
}

#[test]
fn no_log_file_appears() {
    let mut simulation = simulation(PENDULUM);
    simulation.qpos_mut()[0] = f64::NAN;
    assert!(simulation.step1().is_err());
    assert!(!std::path::Path::new("MUJOCO_LOG.TXT").exists());
}
