//! Arrays of models and simulations by name.

use perturb_mujoco::{DataField, ElementKind, Flags, Index, Model, ModelField, Simulation};

const ARM: &str = r#"
<mujoco>
  <option gravity="0 0 -9.8" wind="1 2 3" density="1.2" viscosity="0.5"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" range="-90 45" limited="true" damping="0.3" armature="0.1" stiffness="2" frictionloss="0.4"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -.5" size=".05" friction="0.7 0.1 0.2"/>
      <site name="elbow" pos="0 0 -.5"/>
      <body name="ball" pos="0 0 -.7"><joint type="ball"/><geom type="sphere" size=".1" mass="2"/></body>
    </body>
    <body name="box" pos="1 0 .05"><freejoint name="box"/><geom name="box" type="box" size=".1 .1 .1"/></body>
  </worldbody>
  <tendon><fixed name="string" stiffness="3" damping="0.2"><joint joint="shoulder" coef="1"/></fixed></tendon>
  <actuator><motor name="motor" joint="shoulder" gear="50" ctrllimited="true" ctrlrange="-2 3"/><position joint="shoulder" kp="7"/></actuator>
  <sensor><jointpos name="angle" joint="shoulder"/><framepos name="place" objtype="site" objname="elbow"/></sensor>
  <keyframe><key name="raised" qpos="0.1 1 0 0 0 1 0 1 1 0 0 0"/></keyframe>
</mujoco>"#;

fn simulation() -> Simulation {
    Simulation::new(Model::from_xml(ARM).unwrap()).unwrap()
}

#[test]
fn fields_are_the_numbers_of_the_text() {
    let simulation = simulation();
    let model = simulation.model();
    assert_eq!(model.field(ModelField::Gravity), [0.0, 0.0, -9.8]);
    assert_eq!(model.field(ModelField::Wind), [1.0, 2.0, 3.0]);
    assert_eq!((model.field(ModelField::Density), model.field(ModelField::Viscosity)), (&[1.2][..], &[0.5][..]));
    assert_eq!(model.field(ModelField::DofDamping)[0], 0.3);
    assert_eq!(model.field(ModelField::DofArmature)[0], 0.1);
    assert_eq!(model.field(ModelField::DofFrictionLoss)[0], 0.4);
    assert_eq!(model.field(ModelField::JointStiffness), [2.0, 0.0, 0.0]);
    assert_eq!(model.field(ModelField::ActuatorGear)[..6], [50.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!((model.field(ModelField::ActuatorGain)[10], model.field(ModelField::ActuatorBias)[11]), (7.0, -7.0));
    assert_eq!(model.field(ModelField::ActuatorControlRange)[..2], [-2.0, 3.0]);
    assert_eq!(
        (model.field(ModelField::TendonStiffness), model.field(ModelField::TendonDamping)),
        (&[3.0][..], &[0.2][..])
    );
    let upper = model.id(ElementKind::Geom, "upper").unwrap();
    assert_eq!(model.field(ModelField::GeomFriction)[3 * upper..][..3], [0.7, 0.1, 0.2]);
    let range = &model.field(ModelField::JointRange)[..2];
    assert!((range[0] + 90f64.to_radians()).abs() < 1e-12 && (range[1] - 45f64.to_radians()).abs() < 1e-12);
    assert_eq!(model.field(ModelField::KeyPositions), [0.1, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    assert_eq!(model.field(ModelField::BodyMass), model.body_mass());
}

#[test]
fn elements_have_names_and_types() {
    let simulation = simulation();
    let model = simulation.model();
    let names: Vec<_> = (0..5).map(|id| model.name(ElementKind::Body, id)).collect();
    assert_eq!(names, [Some("world"), Some("upper"), Some("ball"), Some("box"), None]);
    assert_eq!(model.name(ElementKind::Joint, 1), None, "it has no name");
    assert_eq!(model.name(ElementKind::Keyframe, 0), Some("raised"));
    assert_eq!(model.name(ElementKind::Tendon, 0), Some("string"));
    assert_eq!(
        (model.count(ElementKind::Site), model.count(ElementKind::Sensor), model.count(ElementKind::Pair)),
        (1, 2, 0)
    );
    assert_eq!(model.index_array(Index::JointType), [3, 1, 0]);
    assert_eq!(model.index_array(Index::SensorDimension), [1, 3]);
    assert_eq!(model.flags(Flags::JointLimited), [1, 0, 0]);
    assert_eq!(model.flags(Flags::ActuatorControlLimited), [1, 0]);
}

#[test]
fn readings_are_what_a_forward_computes() {
    let mut simulation = simulation();
    simulation.qpos_mut()[0] = 0.5;
    simulation.ctrl_mut()[0] = 1.0;
    simulation.forward().unwrap();
    assert_eq!(simulation.reading(DataField::Sensors)[0], 0.5);
    assert_eq!(simulation.reading(DataField::Sensors)[1..], *simulation.reading(DataField::SitePositions));
    assert_eq!(simulation.reading(DataField::Positions), simulation.qpos());
    assert_eq!(simulation.reading(DataField::ActuatorForces)[0], 1.0);
    assert_eq!(simulation.reading(DataField::BodyPositions)[3..6], simulation.xpos(1));
}

#[test]
fn external_forces_are_computed_when_asked_for() {
    let mut simulation = simulation();
    for _ in 0..1500 {
        simulation.step().unwrap();
    }
    assert!(simulation.reading(DataField::BodyExternalForces).iter().all(|&force| force == 0.0));
    simulation.external_forces().unwrap();
    let up = simulation.reading(DataField::BodyExternalForces)[6 * 3 + 5];
    // Wind of 3 m/s in air of viscosity 0.5 lifts the box by its drag, about 6 π 0.1 m · 0.5 · 3 m/s = 2.8 N.
    assert!((up - (8.0 * 9.8 - 2.8)).abs() < 0.5, "the floor carries the box of 8 kg: {up} N");
    simulation.clear_external_forces();
    assert!(simulation.reading(DataField::BodyExternalForces).iter().all(|&force| force == 0.0));
}

#[test]
fn fields_of_one_simulation_can_be_given_to_another() {
    let (mut edited, mut other) = (simulation(), simulation());
    let fields = [
        &[ModelField::BodyMass, ModelField::DofArmature, ModelField::Gravity, ModelField::ActuatorGear][..],
        &ModelField::DERIVED,
    ]
    .concat();
    edited.field_mut(ModelField::BodyMass)[1] *= 2.0;
    edited.field_mut(ModelField::DofArmature)[0] = 5.0;
    edited.field_mut(ModelField::Gravity)[2] = -3.0;
    edited.field_mut(ModelField::ActuatorGear)[0] = 9.0;
    edited.set_const().unwrap();
    assert_ne!(edited.model().float_arrays(), other.model().float_arrays());
    let mut values = vec![f64::NAN; edited.model().n_fields(&fields)];
    edited.fields(&fields, &mut values);
    other.set_fields(&fields, &values);
    other.reset().unwrap();
    edited.reset().unwrap();
    assert_eq!(edited.model().float_arrays(), other.model().float_arrays());
    assert_eq!(other.model().field(ModelField::Gravity), [0.0, 0.0, -3.0]);
}
