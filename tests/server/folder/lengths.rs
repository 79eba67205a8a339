//! Lengths and sizes: an edited model equals, to the bit, the model that MuJoCo compiles from a text with other
//! numbers.

use super::{CART, TASK, folder, gymnasium, load};
use crate::common::UPPER_LENGTH;
use perturb::env::{Action, DrawPurpose, Environment, EnvironmentSpec, PhiloxStream};
use perturb_mujoco::{Model, Simulation};
use std::{fs, path::Path};

const STEPS: usize = 100;

/// Returns the TOML text of a parameter with these edits.
fn parameter(name: &str, edit: &str, (low, default, high): (f64, f64, f64)) -> String {
    format!(
        "\n[[parameter]]\nname = \"{name}\"\ndescription = \"a length\"\nedit = [{edit}]\ndefault = {default:?}\nbounds = \
         [{low:?}, {high:?}]\nrandom = [{default:?}, {default:?}]\nextreme = [[{low:?}, {default:?}], [{default:?}, {high:?}]]\n"
    )
}

/// Returns the values of all parameters: those in `given`, and otherwise the defaults.
fn values(spec: &EnvironmentSpec, given: &[(&str, f64)]) -> Vec<f64> {
    let value = |name: &str| given.iter().find(|(known, _)| *known == name).map(|(_, value)| *value);
    spec.parameters.iter().map(|parameter| value(parameter.name).unwrap_or(parameter.default)).collect()
}

/// Steps the environment and the model of `mjcf` from the same state with the same random actions. Asserts that all
/// numbers of the state are equal after each step.
fn assert_is(environment: &mut dyn Environment, mjcf: &str, about: &str) {
    let spec = environment.spec();
    let mut bare = Simulation::new(Model::from_xml(mjcf).unwrap()).unwrap();
    let n = bare.model().n_state();
    let n_substeps = (spec.control_timestep / bare.model().timestep()).round() as usize;
    let physics = |environment: &dyn Environment| {
        let mut saved = Vec::new();
        environment.save(&mut saved);
        saved[1..=n].to_vec()
    };
    let mut stream = PhiloxStream::new(4, 0, DrawPurpose::InitialState, 0);
    environment.reset(&mut stream);
    bare.set_state(&physics(environment)).unwrap();
    let n_actions = bare.model().n_u();
    for step in 0..STEPS {
        let action: Vec<f32> = (0..n_actions).map(|_| stream.uniform(-1.0, 1.0) as f32).collect();
        let transition = environment.step(Action::Continuous(&action), &mut vec![0.0; spec.reward_terms.len()]);
        assert!(!transition.diverged, "{about}: step {step}");
        for (ctrl, &a) in bare.ctrl_mut().iter_mut().zip(&action) {
            *ctrl = a.into();
        }
        for _ in 0..n_substeps {
            bare.step().unwrap();
        }
        let mut expected = vec![0.0; n];
        bare.state(&mut expected);
        let bits = |numbers: &[f64]| numbers.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&physics(environment)), bits(&expected), "{about}: step {step}");
    }
}

/// Replaces numbers in a text. Asserts that each number occurs the given number of times.
fn replaced(text: &str, changes: &[(&str, String, usize)]) -> String {
    changes.iter().fold(text.to_owned(), |text, (old, new, times)| {
        assert_eq!(text.matches(old).count(), *times, "{old}");
        text.replace(old, new)
    })
}

/// Loads a task with additional parameters.
fn with_parameters(task: &str, model: (&str, &str), name: &str, parameters: &[String]) -> Box<dyn Environment> {
    let own = task.split("name = \"").nth(1).and_then(|rest| rest.split('"').next()).unwrap();
    let task = task.replacen(&format!("name = \"{own}\""), &format!("name = \"{name}\""), 1) + &parameters.concat();
    (load(folder(&[("task.toml", &task), model]).path()).make)().unwrap()
}

fn gymnasium_files(assets: &Path, task: &str, model: &str) -> (String, String) {
    let files = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/src/perturb/task_files");
    (fs::read_to_string(files.join(format!("{task}.toml"))).unwrap(), fs::read_to_string(assets.join(model)).unwrap())
}

#[test]
fn lengths_of_walker2d_are_those_of_an_edited_text() {
    let Some(assets) = gymnasium::assets() else { return };
    let (task, mjcf) = gymnasium_files(&assets, "walker2d_v5", "walker2d_v5.xml");
    let parameters = [
        parameter(
            "thigh",
            "{ body = [\"thigh\", \"thigh_left\"], field = \"length\", by = \"scale\" }",
            (0.5, 1.0, 2.0),
        ),
        parameter("leg", "{ body = [\"leg\", \"leg_left\"], field = \"length\", by = \"scale\" }", (0.5, 1.0, 2.0)),
        parameter(
            "foot",
            "{ geom = [\"foot_geom\", \"foot_left_geom\"], field = \"radius\", by = \"set\" }",
            (0.02, 0.06, 0.2),
        ),
        parameter("lift", "{ body = \"torso\", field = \"position\", axis = \"z\", by = \"add\" }", (-0.5, 0.0, 0.5)),
    ];
    let mut environment = with_parameters(&task, ("walker2d_v5.xml", &mjcf), "LongWalker", &parameters);
    let spec = environment.spec();
    for (thigh, leg, foot, lift) in [
        (1.25, 1.0, 0.06, 0.1),
        (1.0, 0.8, 0.06, 0.0),
        (0.9, 1.3, 0.05, 0.2),
        (1.0, 1.0, 0.06, 0.0),
        (1.1, 1.1, 0.08, 0.1),
    ] {
        environment.set_parameters(&values(spec, &[("thigh", thigh), ("leg", leg), ("foot", foot), ("lift", lift)]));
        // The leg's frame is in the middle of the leg, and its anchor is 0.25 m above.
        let knee = if (thigh, leg) == (1.0, 1.0) {
            -0.700_000_000_000_000_1
        } else {
            (-0.700_000_000_000_000_1 + 0.25) * thigh - 0.25 * leg
        };
        let ankle = if leg == 1.0 { -0.35 } else { (-0.35 + 0.1) * leg - 0.1 };
        let edited = replaced(
            &mjcf,
            &[
                ("pos=\"0 0 -0.22500000000000009\"", format!("pos=\"0 0 {}\"", -0.225_000_000_000_000_1 * thigh), 2),
                ("0.22500000000000003\"", format!("{}\"", 0.225_000_000_000_000_03 * thigh), 2),
                ("-0.70000000000000007\"", format!("{knee}\""), 2),
                ("pos=\"0 0 0.25\"", format!("pos=\"0 0 {}\"", 0.25 * leg), 2),
                ("0.040000000000000001 0.25\"", format!("0.040000000000000001 {}\"", 0.25 * leg), 2),
                ("-0.34999999999999998\"", format!("{ankle}\""), 2),
                ("0.059999999999999998 0.1", format!("{foot} 0.1"), 2),
                ("name=\"torso\" pos=\"0 0 1.25\"", format!("name=\"torso\" pos=\"0 0 {}\"", 1.25 + lift), 1),
            ],
        );
        assert_is(environment.as_mut(), &edited, &format!("thigh {thigh}, leg {leg}, foot {foot}, lift {lift}"));
    }
}

#[test]
fn lengths_of_ant_are_those_of_an_edited_text() {
    let Some(assets) = gymnasium::assets() else { return };
    let (task, mjcf) = gymnasium_files(&assets, "ant_v5", "ant.xml");
    let parameters = [
        parameter("legs", "{ body = \"aux_?\", field = \"length\", by = \"scale\" }", (0.5, 1.0, 2.0)),
        parameter("torso", "{ body = \"torso\", field = \"size\", by = \"scale\" }", (0.5, 1.0, 2.0)),
    ];
    let mut environment = with_parameters(&task, ("ant.xml", &mjcf), "LongAnt", &parameters);
    let spec = environment.spec();
    for (legs, torso) in [(1.3, 1.0), (1.0, 1.2), (0.75, 0.9), (1.0, 1.0)] {
        environment.set_parameters(&values(spec, &[("legs", legs), ("torso", torso)]));
        let mut edited =
            replaced(&mjcf, &[("pos=\"0 0 0\" size=\"0.25\"", format!("pos=\"0 0 0\" size=\"{}\"", 0.25 * torso), 1)]);
        for (geom, x, y) in
            [("left_leg", 1.0, 1.0), ("right_leg", -1.0, 1.0), ("back_leg", -1.0, -1.0), ("rightback_leg", 1.0, -1.0)]
        {
            let (x, y): (f64, f64) = (0.2 * x, 0.2 * y);
            let end = format!("{} {}", x * legs, y * legs);
            edited = replaced(
                &edited,
                &[
                    (
                        &format!("fromto=\"0.0 0.0 0.0 {x} {y} 0.0\" name=\"{geom}_geom\""),
                        format!("fromto=\"0 0 0 {end} 0\" name=\"{geom}_geom\""),
                        1,
                    ),
                    (&format!("<body pos=\"{x} {y} 0\">"), format!("<body pos=\"{end} 0\">"), 1),
                ],
            );
        }
        assert_is(environment.as_mut(), &edited, &format!("legs {legs}, torso {torso}"));
    }
}

#[test]
fn lengths_of_the_arm_are_those_of_an_edited_text() {
    let files = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/tasks/reaching_arm");
    let [task, mjcf] = ["task.toml", "arm.xml"].map(|file| fs::read_to_string(files.join(file)).unwrap());
    // Removes the task's other parameters, which set the mass of the lower arm.
    let task = task.split("[[parameter]]").next().unwrap();
    let lower = parameter("lower", "{ body = \"lower\", field = \"size\", by = \"scale\" }", (0.5, 1.0, 2.0));
    let mut environment = with_parameters(task, ("arm.xml", &mjcf), "ScaledArm", &[UPPER_LENGTH.to_owned(), lower]);
    let spec = environment.spec();
    for (upper, lower) in [(0.42, 1.0), (0.35, 1.3), (0.3, 0.8), (0.35, 1.0)] {
        environment.set_parameters(&values(spec, &[("upper_length", upper), ("lower", lower)]));
        let elbow = 0.35 * (upper / 0.35);
        let edited = replaced(
            &mjcf,
            &[
                ("fromto=\"0 0 0 0.35 0 0\"", format!("fromto=\"0 0 0 {elbow} 0 0\""), 1),
                ("name=\"lower\" pos=\"0.35 0 0\"", format!("name=\"lower\" pos=\"{elbow} 0 0\""), 1),
                (
                    "fromto=\"0 0 0 0.3 0 0\" size=\"0.03\"",
                    format!("fromto=\"0 0 0 {} 0 0\" size=\"{}\"", 0.3 * lower, 0.03 * lower),
                    1,
                ),
                (
                    "pos=\"0.33 0 0\" size=\"0.02\"",
                    format!("pos=\"{} 0 0\" size=\"{}\"", 0.33 * lower, 0.02 * lower),
                    1,
                ),
            ],
        );
        assert_is(environment.as_mut(), &edited, &format!("upper {upper}, lower {lower}"));
    }
}

/// Loads a cart task with lengths and a mass as parameters, under this name.
fn cart(name: &str) -> Box<dyn Environment> {
    let parameters = [
        parameter("length", "{ body = \"pole\", field = \"length\", by = \"set\" }", (0.000_1, 0.8, 2.0)),
        parameter("radius", "{ geom = \"pole\", field = \"radius\", by = \"set\" }", (0.000_1, 0.04, 0.2)),
        parameter("height", "{ body = \"cart\", field = \"position\", axis = \"z\", by = \"add\" }", (-0.5, 0.0, 0.5)),
    ];
    let model = CART.replace(" mass=\"0.5\"", "");
    let task = TASK.replace(
        "body = \"pole\", field = \"mass\", by = \"set\"",
        "body = \"pole\", field = \"mass\", by = \"scale\"",
    );
    let task = task
        .replace("bounds = [0.1, 5.0]", "default = 1.0\nbounds = [0.1, 5.0]")
        .replace("[0.4, 0.6]\n", "[0.4, 1.6]\n");
    let task = task.replace("[0.6, 1.0]]", "[1.6, 2.0]]");
    with_parameters(&task, ("cart.xml", &model), name, &parameters)
}

fn applied(environment: &dyn Environment) -> Vec<f64> {
    let mut applied = vec![f64::NAN; environment.spec().applied.len()];
    environment.applied(&mut applied);
    applied
}

fn trajectory(environment: &mut dyn Environment) -> Vec<u64> {
    let mut stream = PhiloxStream::new(4, 0, DrawPurpose::InitialState, 0);
    environment.reset(&mut stream);
    let mut states = Vec::new();
    for step in 0..20_i16 {
        environment.step(Action::Continuous(&[f32::from(step % 3) - 1.0]), &mut [0.0; 2]);
        environment.save(&mut states);
    }
    states.iter().map(|x| x.to_bits()).collect()
}

#[test]
fn lengths_are_read_back_from_the_compiled_model() {
    let mut environment = cart("ReadBackCart");
    for values in [[1.0, 0.8, 0.04, 0.0], [1.5, 1.1, 0.05, 0.2], [0.5, 0.3, 0.04, -0.3], [1.0, 0.8, 0.04, 0.0]] {
        environment.set_parameters(&values);
        for (read, value) in applied(environment.as_ref()).into_iter().zip(values) {
            assert!((read - value).abs() <= 1e-14, "{read} for {value}");
        }
    }
}

#[test]
fn environments_of_other_lengths_take_turns_unseen() {
    let lengths = [0.8, 0.5, 1.2, 0.8, 0.5];
    let alone = lengths.map(|length| {
        let mut environment = cart(&format!("Alone{}", (length * 10.0) as u32));
        environment.set_parameters(&[1.2, length, 0.04, 0.0]);
        trajectory(environment.as_mut())
    });
    assert_ne!(alone[0], alone[1]);
    assert_eq!(alone[1], alone[4]);
    let spec = cart("Together").spec();
    let mut together = lengths.map(|_| (spec.make)().unwrap());
    for (environment, length) in together.iter_mut().zip(lengths) {
        environment.set_parameters(&[1.2, length, 0.04, 0.0]);
    }
    // Runs twice, because models from the cache must equal freshly compiled models.
    for _ in 0..2 {
        let found: Vec<Vec<u64>> = together.iter_mut().map(|environment| trajectory(environment.as_mut())).collect();
        assert_eq!(found, alone);
    }
}

#[test]
fn an_impossible_model_is_divergence_and_told_by_the_receipt() {
    let mut environment = cart("ImpossibleCart");
    let defaults = applied(environment.as_ref());
    for before in [0.7, 0.3] {
        environment.set_parameters(&[1.0, before, 0.04, 0.0]);
        // Each value alone is possible. Together they give the pole less than MuJoCo's minimum inertia.
        environment.set_parameters(&[1.5, 0.000_1, 0.000_1, 0.0]);
        environment.reset(&mut PhiloxStream::new(4, 0, DrawPurpose::InitialState, 0));
        assert!(environment.scene().is_none());
        assert!(environment.step(Action::Continuous(&[0.0]), &mut [0.0; 2]).diverged);
        assert_eq!(applied(environment.as_ref()), defaults, "after a pole of {before} m");
    }
    environment.set_parameters(&[1.0, 0.8, 0.04, 0.0]);
    environment.reset(&mut PhiloxStream::new(4, 0, DrawPurpose::InitialState, 0));
    assert!(!environment.step(Action::Continuous(&[0.0]), &mut [0.0; 2]).diverged);
}

#[test]
fn a_free_body_is_reset_where_its_model_has_it() {
    let model = CART.replace(
        "<joint name=\"rail\" type=\"slide\" axis=\"1 0 0\" damping=\"0.5\" limited=\"true\" range=\"-2 2\"/>",
        "<freejoint name=\"rail\"/>",
    );
    let lift =
        parameter("lift", "{ body = \"cart\", field = \"position\", axis = \"z\", by = \"add\" }", (-0.5, 0.0, 0.5));
    let mut environment = with_parameters(TASK, ("cart.xml", &model), "FreeCart", &[lift]);
    let mut height = |lift: f64| {
        environment.set_parameters(&[0.5, lift]);
        environment.reset(&mut PhiloxStream::new(4, 0, DrawPurpose::InitialState, 0));
        let mut observation = vec![0.0; environment.spec().observation.len()];
        environment.observe(&mut observation);
        observation[2]
    };
    let own = height(0.0);
    assert!((height(0.25) - own - 0.25).abs() < 1e-6);
}

#[test]
fn geoms_that_only_pictures_show_change_no_byte() {
    let shown = r#"<geom type="mesh" mesh="shell" contype="0" conaffinity="0" pos="0 0 0.1"/><inertial pos="0 0 0.4" mass="0.5" diaginertia="0.04 0.04 0.01"/>"#;
    let shell = "<asset><mesh name=\"shell\" vertex=\"0 0 0 0.1 0 0 0 0.1 0 0 0 0.1\"/></asset>";
    let model = CART.replace("<worldbody>", &format!("{shell}<worldbody>"));
    let model = model.replace("<joint name=\"hinge\"", &format!("{shown}<joint name=\"hinge\""));
    let size = parameter("size", "{ body = \"pole\", field = \"size\", by = \"scale\" }", (0.5, 1.0, 2.0));
    let mut environment = with_parameters(TASK, ("cart.xml", &model), "CartWithShell", &[size]);
    for scale in [1.0, 1.25] {
        environment.set_parameters(&[0.5, scale]);
        let edited = replaced(
            &model,
            &[
                ("0 0 0 0 0 0.8\" size=\"0.04\"", format!("0 0 0 0 0 {}\" size=\"{}\"", 0.8 * scale, 0.04 * scale), 1),
                ("name=\"tip\" pos=\"0 0 0.8\"", format!("name=\"tip\" pos=\"0 0 {}\"", 0.8 * scale), 1),
                ("inertial pos=\"0 0 0.4\"", format!("inertial pos=\"0 0 {}\"", 0.4 * scale), 1),
                ("0.04 0.04 0.01", format!("{0} {0} {1}", 0.04 * (scale * scale), 0.01 * (scale * scale)), 1),
            ],
        );
        assert_eq!(Model::from_xml(&edited).unwrap().n_geom(), 4, "the mesh is there");
        assert_is(environment.as_mut(), &edited, &format!("a size of {scale}"));
    }
}

#[test]
fn rangefinders_measure_geoms_that_only_pictures_show() {
    let shell = "<asset><mesh name=\"shell\" vertex=\"0 0 0 1 0 0 0 1 0 0 0 1\"/></asset>";
    let shown = r#"<geom type="mesh" mesh="shell" contype="0" conaffinity="0"/><inertial pos="0 0 0.4" mass="0.5" diaginertia="0.04 0.04 0.01"/>"#;
    let model = CART
        .replace("<worldbody>", &format!("{shell}<worldbody><site name=\"high\" pos=\"0.3 0.3 3\" zaxis=\"0 0 -1\"/>"))
        .replace("<joint name=\"hinge\"", &format!("{shown}<joint name=\"hinge\""))
        .replace("</mujoco>", "<sensor><rangefinder name=\"range\" site=\"high\"/></sensor></mujoco>");
    let task = TASK.replace("observation = [", "observation = [{ sensor = \"range\" }, ");
    let size = parameter("size", "{ body = \"pole\", field = \"size\", by = \"scale\" }", (0.5, 1.0, 2.0));
    let range = |name: &str, parameters: &[String]| {
        let mut environment = with_parameters(&task, ("cart.xml", &model), name, parameters);
        environment.reset(&mut PhiloxStream::new(4, 0, DrawPurpose::InitialState, 0));
        let mut observation = vec![0.0; environment.spec().observation.len()];
        environment.observe(&mut observation);
        observation[0]
    };
    let plain = range("CartWithRangefinder", &[]);
    assert!((2.4..2.8).contains(&plain), "the ray ends at the mesh after {plain} m");
    assert_eq!(range("CartWithRangefinderAndSize", &[size]), plain);
}
