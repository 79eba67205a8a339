//! Each field of `edit` changes the compiled model in the same way as compiling an edited text.

use super::{folder, load};
use perturb::env::{Action, DrawPurpose, Environment, PhiloxStream};
use rstest::rstest;

const STEPS: usize = 100;

/// A model with all elements that can be edited: sliding and rolling contacts, a declared pair, a servo of each kind, a
/// tendon, limits, air, and statistics of its own.
const MODEL: &str = r#"<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.004" gravity="0.3 0 -9.81" wind="1 0 0" density="20" viscosity="0.01"/>
  <size njmax="300" nconmax="80" nstack="100000"/>
  <statistic extent="3" center="0 0 1"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1" friction="0.4 0.005 0.0001" condim="6"/>
    <body name="ball" pos="0 1 0.1"><freejoint name="ball"/><geom name="ball" size="0.1" friction="0.6 0.03 0.004" condim="6" mass="1"/></body>
    <body name="box" pos="0 -1 0.09"><freejoint name="box"/><geom name="box" type="box" size="0.2 0.15 0.1" mass="2" friction="0.5 0.005 0.0001"/></body>
    <body name="puck" pos="1 -1 0.05"><freejoint name="puck"/><geom name="puck" type="cylinder" size="0.1 0.05" mass="1"/></body>
    <body name="upper" pos="0 0 1.2">
      <joint name="shoulder" axis="0 1 0" range="-0.4 0.5" limited="true" damping="0.3" armature="0.05" frictionloss="0.06" stiffness="1.5"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0.4 0 0" size="0.04" mass="1.1" contype="0" conaffinity="0"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.2" armature="0.03"/>
        <geom name="lower" type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="0.7" contype="0" conaffinity="0"/>
        <body name="hand" pos="0.4 0 0">
          <joint name="wrist" axis="0 1 0" damping="0.1" armature="0.01"/>
          <geom name="hand" type="box" size="0.08 0.05 0.02" mass="0.3" contype="0" conaffinity="0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <contact><pair name="slip" geom1="puck" geom2="floor" friction="0.3 0.3 0.005 0.0001 0.0001"/></contact>
  <tendon>
    <fixed name="string" stiffness="4" damping="0.7"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-0.6"/></fixed>
  </tendon>
  <actuator>
    <motor name="motor" joint="shoulder" gear="6 0 0 0 0 0" ctrllimited="true" ctrlrange="-1 1"/>
    <position name="position" joint="elbow" kp="9" ctrllimited="true" ctrlrange="-1 1" forcelimited="true" forcerange="-2 2"/>
    <velocity name="velocity" joint="wrist" kv="1.2" ctrllimited="true" ctrlrange="-3 3"/>
  </actuator>
</mujoco>
"#;

fn task(name: &str, edit: &str, (low, default, high): (f64, f64, f64)) -> String {
    format!(
        r#"format = 1
name = "{name}"
description = "A fixture."
model = "model.xml"
frame_skip = 1
step_limit = 1000
observation = [{{ joint = "*", get = "position" }}]
reward = [{{ name = "none", constant = 0.0 }}]
success = {{ description = "it went on", steps = true, at_least = 1000 }}

[[parameter]]
name = "edited"
description = "what is edited"
edit = [{edit}]
bounds = [{low:?}, {high:?}]
random = [{default:?}, {default:?}]
extreme = [[{low:?}, {default:?}], [{default:?}, {high:?}]]
"#
    )
}

fn environment(name: &str, edit: &str, bounds: (f64, f64, f64), model: &str) -> Box<dyn Environment> {
    let spec = load(folder(&[("task.toml", &task(name, edit, bounds)), ("model.xml", model)]).path());
    (spec.make)().unwrap()
}

/// Takes steps with random actions. Returns the complete state after each step. In the initial state the box slides,
/// the ball rolls and spins, and the puck slides.
fn trajectory(environment: &mut dyn Environment) -> Vec<Vec<f64>> {
    let spec = environment.spec();
    let mut state = vec![0.0; spec.state.len()];
    for (value, channel) in state.iter_mut().zip(spec.state) {
        *value = match channel.name {
            "ball_y" => 1.0,
            "ball_z" | "box_z" => 0.098,
            "box_y" | "puck_y" => -1.0,
            "puck_x" => 1.0,
            "puck_z" => 0.049,
            "ball_vx" | "box_vx" | "puck_vx" => 1.5,
            "ball_wz" => 8.0,
            "ball_wy" => 4.0,
            name if name.ends_with("_qw") => 1.0,
            "shoulder" => 0.45,
            "elbow" => -0.3,
            _ => 0.0,
        };
    }
    environment.reset_to(&state);
    let mut stream = PhiloxStream::new(4, 0, DrawPurpose::InitialState, 0);
    let mut states = Vec::new();
    for _ in 0..STEPS {
        let action: Vec<f32> = [1.0, 1.0, 3.0].map(|limit| stream.uniform(-limit, limit) as f32).into();
        assert!(!environment.step(Action::Continuous(&action), &mut [0.0]).diverged);
        let mut saved = Vec::new();
        environment.save(&mut saved);
        states.push(saved);
    }
    states
}

/// Returns the largest difference: relative for numbers above 1, otherwise absolute.
fn difference(a: &[Vec<f64>], b: &[Vec<f64>]) -> f64 {
    let each = a.iter().flatten().zip(b.iter().flatten());
    each.map(|(a, b)| (a - b).abs() / a.abs().max(1.0)).fold(0.0, f64::max)
}

/// The tolerance is 0 where the edit writes the same number as the compiler, and MuJoCo computes the rest in the same
/// way.
const EXACT: f64 = 0.0;
/// The tolerance where the compiler computes mass and inertia from a density or a scaled geom, and the edit scales both
/// by a factor.
const ROUNDED: f64 = 1e-9;

#[rstest]
#[case::mass("body = \"upper\", field = \"mass\"", ("mass=\"1.1\"", "mass=\"1.7\""), (0.5, 1.1, 3.0), 1.7, ROUNDED)]
#[case::friction("geom = \"box\", field = \"friction\"", ("friction=\"0.5 ", "friction=\"0.9 "), (0.4, 0.5, 2.0), 0.9, EXACT)]
#[case::friction_torsion(
    "geom = \"ball\", field = \"friction_torsion\"", ("0.6 0.03 0.004", "0.6 0.2 0.004"), (0.005, 0.03, 1.0), 0.2, EXACT
)]
#[case::friction_roll(
    "geom = \"ball\", field = \"friction_roll\"", ("0.6 0.03 0.004", "0.6 0.03 0.05"), (0.001, 0.004, 1.0), 0.05, EXACT
)]
#[case::pair_friction(
    "pair = \"slip\", field = \"friction\"", ("friction=\"0.3 0.3 ", "friction=\"0.8 0.8 "), (0.0, 0.3, 2.0), 0.8, EXACT
)]
#[case::damping("joint = \"shoulder\", field = \"damping\"", ("damping=\"0.3\"", "damping=\"0.9\""), (0.0, 0.3, 2.0), 0.9, EXACT)]
#[case::armature("joint = \"elbow\", field = \"armature\"", ("armature=\"0.03\"", "armature=\"0.4\""), (0.0, 0.03, 2.0), 0.4, EXACT)]
#[case::frictionloss(
    "joint = \"shoulder\", field = \"frictionloss\"", ("loss=\"0.06\"", "loss=\"0.8\""), (0.0, 0.06, 2.0), 0.8, EXACT
)]
#[case::joint_stiffness(
    "joint = \"shoulder\", field = \"stiffness\"", ("stiffness=\"1.5\"", "stiffness=\"7\""), (0.0, 1.5, 9.0), 7.0, EXACT
)]
#[case::range_upper(
    "joint = \"shoulder\", field = \"range\", end = \"upper\"", ("-0.4 0.5", "-0.4 0.1"), (0.0, 0.5, 1.0), 0.1, EXACT
)]
#[case::gear("actuator = \"motor\", field = \"gear\"", ("gear=\"6 ", "gear=\"11 "), (0.0, 6.0, 20.0), 11.0, EXACT)]
#[case::kp("actuator = \"position\", field = \"kp\"", ("kp=\"9\"", "kp=\"14\""), (0.0, 9.0, 20.0), 14.0, EXACT)]
#[case::kv("actuator = \"velocity\", field = \"kv\"", ("kv=\"1.2\"", "kv=\"0.4\""), (0.0, 1.2, 2.0), 0.4, EXACT)]
#[case::forcerange(
    "actuator = \"position\", field = \"forcerange\"", ("forcerange=\"-2 2\"", "forcerange=\"-0.5 0.5\""), (0.1, 2.0, 9.0), 0.5,
    EXACT
)]
#[case::tendon_stiffness("tendon = \"string\", field = \"stiffness\"", ("stiffness=\"4\"", "stiffness=\"9\""), (0.0, 4.0, 20.0), 9.0, EXACT)]
#[case::tendon_damping("tendon = \"string\", field = \"damping\"", ("damping=\"0.7\"", "damping=\"2\""), (0.0, 0.7, 9.0), 2.0, EXACT)]
#[case::gravity("option = \"gravity\", axis = \"x\"", ("gravity=\"0.3 ", "gravity=\"-2 "), (-9.0, 0.3, 9.0), -2.0, EXACT)]
#[case::wind("option = \"wind\", axis = \"x\"", ("wind=\"1 ", "wind=\"30 "), (-50.0, 1.0, 50.0), 30.0, EXACT)]
#[case::density("option = \"density\"", ("density=\"20\"", "density=\"90\""), (0.0, 20.0, 900.0), 90.0, EXACT)]
#[case::viscosity("option = \"viscosity\"", ("viscosity=\"0.01\"", "viscosity=\"0.2\""), (0.0, 0.01, 1.0), 0.2, EXACT)]
fn an_edit_is_a_recompiled_text(
    #[case] edit: &str,
    #[case] (old, new): (&str, &str),
    #[case] bounds: (f64, f64, f64),
    #[case] value: f64,
    #[case] tolerance: f64,
) {
    assert_eq!(MODEL.matches(old).count(), 1, "{old} names one number");
    let edit = format!("{{ {edit}, by = \"set\" }}");
    let mut edited = environment("Edited", &edit, bounds, MODEL);
    let pristine = trajectory(edited.as_mut());
    edited.set_parameters(&[value]);
    let mut applied = vec![0.0];
    edited.applied(&mut applied);
    assert_eq!(applied, [value], "it is read back");
    let edited_states = trajectory(edited.as_mut());
    assert!(difference(&pristine, &edited_states) > 1e-6, "the edit has an effect");

    let recompiled_bounds = (bounds.0, value, bounds.2);
    let mut recompiled = environment("Recompiled", &edit, recompiled_bounds, &MODEL.replace(old, new));
    let expected = trajectory(recompiled.as_mut());
    let found = difference(&edited_states, &expected);
    assert!(found <= tolerance, "after {STEPS} steps they differ by {found:e}");

    // Edits do not accumulate: after any edits, the original model comes back.
    edited.set_parameters(&[bounds.1]);
    assert_eq!(trajectory(edited.as_mut()), pristine);
}

#[rstest]
#[case::mass("body = \"*\", field = \"mass\"")]
#[case::friction("geom = [\"floor\", \"box\", \"ball\"], field = \"friction\"")]
#[case::damping("joint = [\"shoulder\", \"elbow\", \"wrist\"], field = \"damping\"")]
#[case::gear("actuator = \"motor\", field = \"gear\"")]
#[case::kp("actuator = \"position\", field = \"kp\"")]
#[case::kv("actuator = \"velocity\", field = \"kv\"")]
#[case::range("joint = \"shoulder\", field = \"range\"")]
#[case::forcerange("actuator = \"position\", field = \"forcerange\"")]
#[case::density("option = \"density\"")]
fn a_scale_of_one_is_the_pristine_model(#[case] edit: &str) {
    let edit = format!("{{ {edit}, by = \"scale\" }}");
    let mut edited = environment("Scaled", &edit, (0.1, 1.0, 10.0), MODEL);
    let pristine = trajectory(edited.as_mut());
    for value in [0.5, 3.7, 1.0] {
        edited.set_parameters(&[value]);
        let mut applied = vec![0.0];
        edited.applied(&mut applied);
        assert!((applied[0] - value).abs() <= 1e-15 * value, "{applied:?} for {value}");
        assert_eq!(trajectory(edited.as_mut()) == pristine, value == 1.0, "{value}");
    }
}

#[test]
fn additions_start_from_the_pristine_model() {
    let edit = "{ option = \"wind\", axis = \"x\", by = \"add\", factor = 2.0 }";
    let mut edited = environment("Added", edit, (-9.0, 0.0, 9.0), MODEL);
    let pristine = trajectory(edited.as_mut());
    for value in [4.0, -3.0, 0.0] {
        edited.set_parameters(&[value]);
        let mut applied = vec![9.0];
        edited.applied(&mut applied);
        assert_eq!(applied, [value]);
        assert_eq!(trajectory(edited.as_mut()) == pristine, value == 0.0, "{value}");
    }
}

#[test]
fn a_statistic_of_the_model_survives_an_edit_of_masses() {
    // The solver scales by the mean inertia, which `mj_setConst` recomputes.
    let with_mean = MODEL.replace("<statistic ", "<statistic meaninertia=\"0.02\" ");
    let edit = "{ body = \"upper\", field = \"mass\", by = \"set\" }";
    let mut edited = environment("OwnMean", edit, (0.5, 1.1, 3.0), &with_mean);
    edited.set_parameters(&[1.7]);
    let recompiled = with_mean.replace("mass=\"1.1\"", "mass=\"1.7\"");
    let mut expected = environment("OwnMeanRecompiled", edit, (0.5, 1.7, 3.0), &recompiled);
    let found = difference(&trajectory(edited.as_mut()), &trajectory(expected.as_mut()));
    assert!(found <= ROUNDED, "{found:e}");
}
