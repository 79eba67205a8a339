//! Gymnasium's eleven MuJoCo tasks: the task files of the Python package, with the models of the package gymnasium,
//! give Gymnasium's observations, rewards and ends of episodes.

use super::folder;
use crate::common::server::{self, Server, Session, doubles, floats, open};
use perturb::proto::{AutoresetMode, Open, Reset, Version};
use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

/// The environment variable with the folder of the package gymnasium's MJCF files. `make test` installs the package and
/// sets it.
const ASSETS: &str = "PERTURB_TEST_GYMNASIUM_ASSETS";
/// The recorded episodes, written by golden.py.
const GOLDEN: &[u8] = include_bytes!("../data/gymnasium_mujoco.bin");
/// The relative tolerance of rewards. Rewards are sent as f32, and NumPy adds their terms in another order.
const REWARD_TOLERANCE: f64 = 1e-6;

/// The names of tasks in the recorded data, and the names of their files.
const TASKS: [(&str, &str); 11] = [
    ("hopper", "hopper_v5"),
    ("half_cheetah", "half_cheetah_v5"),
    ("walker2d", "walker2d_v5"),
    ("ant", "ant_v5"),
    ("humanoid", "humanoid_v5"),
    ("humanoidstandup", "humanoid_standup_v5"),
    ("swimmer", "swimmer_v5"),
    ("reacher", "reacher_v5"),
    ("pusher", "pusher_v5"),
    ("inverted_pendulum", "inverted_pendulum_v5"),
    ("inverted_double_pendulum", "inverted_double_pendulum_v5"),
];

/// Returns the folder of the package's models, or `None` if the package is not installed. In CI it must be installed.
pub fn assets() -> Option<PathBuf> {
    match std::env::var_os(ASSETS) {
        Some(folder) => Some(folder.into()),
        None if std::env::var_os("CI").is_some() => {
            panic!("{ASSETS} is not set; run `make test`, which installs the package gymnasium and sets it")
        }
        None => {
            eprintln!("not run: the test needs the package gymnasium. `make test` installs it and sets {ASSETS}.");
            None
        }
    }
}

/// Makes a temporary folder for each task.
pub fn folders(assets: &Path) -> Vec<(&'static str, tempfile::TempDir)> {
    let files = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/src/perturb/task_files");
    let folder = |(name, file): (&'static str, &str)| {
        let task = fs::read_to_string(files.join(format!("{file}.toml"))).unwrap();
        let model = task.lines().find_map(|line| line.strip_prefix("model = \"")?.strip_suffix('"')).unwrap();
        let mjcf = fs::read_to_string(assets.join(model))
            .unwrap_or_else(|error| panic!("{ASSETS}: {}: {error}", assets.join(model).display()));
        (name, folder(&[("task.toml", &task), (model, &mjcf)]))
    };
    TASKS.into_iter().map(folder).collect()
}

/// A recorded episode.
pub struct Golden {
    pub task: String,
    pub seed: u16,
    /// The initial state: positions, then velocities.
    pub state: Vec<f64>,
    /// The actions, `[T, A]`.
    pub actions: Vec<Vec<f32>>,
    /// The observations, `[T + 1, O]`.
    pub observations: Vec<Vec<f32>>,
    pub rewards: Vec<f64>,
    pub terminated: Vec<bool>,
}

/// Reads the recorded episodes.
pub fn golden() -> Vec<Golden> {
    let mut rest = GOLDEN;
    let mut episodes = Vec::new();
    while !rest.is_empty() {
        let mut take = |n: usize| rest.split_off(..n).unwrap();
        let mut short = || u16::from_le_bytes(take(2).try_into().unwrap());
        let (length, seed) = (short(), short());
        let task = String::from_utf8(take(length.into()).to_vec()).unwrap();
        let mut short = || usize::from(u16::from_le_bytes(take(2).try_into().unwrap()));
        let [q, v, a, o, t] = std::array::from_fn(|_| short());
        let doubles =
            |bytes: &[u8]| -> Vec<f64> { bytes.as_chunks::<8>().0.iter().map(|x| f64::from_le_bytes(*x)).collect() };
        let state = doubles(take(8 * (q + v)));
        let rows = |bytes: &[u8], width: usize| floats(bytes).chunks(width).map(<[f32]>::to_vec).collect();
        let actions = rows(take(4 * t * a), a);
        let observations = rows(take(4 * (t + 1) * o), o);
        let rewards = doubles(take(8 * t));
        let terminated = take(t).iter().map(|&flag| flag == 1).collect();
        episodes.push(Golden { task, seed, state, actions, observations, rewards, terminated });
    }
    episodes
}

#[tokio::test]
async fn eleven_tasks_are_those_of_gymnasium() {
    let Some(assets) = assets() else { return };
    let folders = folders(&assets);
    let flags: Vec<&str> = folders.iter().flat_map(|(_, folder)| ["--task", folder.path().to_str().unwrap()]).collect();
    let server = Server::start(&flags);
    let served = server::catalogue(server.tcp()).await;
    let golden = golden();
    assert_eq!(golden.len(), 3 * TASKS.len());
    for Golden { task, seed, state, actions, observations, rewards, terminated } in golden {
        let (i, _) = folders.iter().enumerate().find(|(_, (name, _))| *name == task).unwrap();
        let environment = &served[served.len() - TASKS.len() + i];
        let about = format!("{} ({task}), seed {seed}", environment.name);
        let open = Open {
            version: Version::Default.into(),
            autoreset_mode: AutoresetMode::Disabled.into(),
            ..open(&environment.name, 1, seed.into())
        };
        let (mut session, _) = Session::open(server.tcp(), open).await;
        let reset = session.ask(Reset { states: doubles(&state), ..Reset::default() }).await;
        assert_eq!(bits(&floats(&reset.observations)), bits(&observations[0]), "{about}: the first observation");
        for (t, action) in actions.iter().enumerate() {
            let step = session.step(action.iter().flat_map(|a| a.to_le_bytes()).collect::<Vec<u8>>().into()).await;
            let observed = floats(&step.observations);
            let differing = observed.iter().zip(&observations[t + 1]).position(|(a, b)| a.to_bits() != b.to_bits());
            if let Some(i) = differing {
                let name = &environment.observation[i].name;
                panic!("{about}: step {t}: {name} is {}, not {}", observed[i], observations[t + 1][i]);
            }
            let (reward, expected) = (f64::from(floats(&step.rewards)[0]), rewards[t]);
            let difference = (reward - expected).abs();
            assert!(
                difference <= REWARD_TOLERANCE * expected.abs().max(1e-3),
                "{about}: step {t}: {reward}, not {expected}"
            );
            assert_eq!(step.terminated[0] == 1, terminated[t], "{about}: step {t}");
        }
    }
}

/// Returns the bits of numbers, so that 0 and -0 differ, and NaN equals itself.
fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|x| x.to_bits()).collect()
}

#[test]
fn check_describes_all_eleven_without_a_warning() {
    let Some(assets) = assets() else { return };
    for (name, folder) in folders(&assets) {
        let mut command: Command = server::command();
        let output = command.args(["--check", "--task"]).arg(folder.path()).output().unwrap();
        let (text, errors) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8_lossy(&output.stderr));
        assert!(output.status.success(), "{name}: {errors}");
        assert!(text.contains("observation") && text.contains("steps per second"), "{name}: {text}");
        assert!(!text.contains("warning"), "{name}: every parameter has an effect: {text}");
    }
}

/// Scales all masses of an MJCF text: densities and masses of geoms. A geom without a density and a mass, own or
/// default, has MuJoCo's density of 1000 kg/m³.
fn with_scaled_masses(mjcf: &str, factor: f64) -> String {
    let given = ["density", "mass"];
    let names_mass = |tag: &str| given.iter().any(|name| tag.contains(&format!(" {name}=\"")));
    let is_geom = |tag: &str| tag.split_whitespace().next() == Some("geom");
    let defaults = mjcf.rsplit_once("</default>").map_or("", |(defaults, _)| defaults);
    let has_default = defaults.split('<').any(|tag| is_geom(tag) && names_mass(tag));
    let scaled = |tag: &str| {
        if !is_geom(tag) {
            return tag.to_owned();
        }
        if !names_mass(tag) && !has_default {
            return tag.replacen("geom", &format!("geom density=\"{}\"", 1000.0 * factor), 1);
        }
        given.iter().fold(tag.to_owned(), |tag, name| {
            let mark = format!(" {name}=\"");
            let Some((before, rest)) = tag.split_once(&mark) else { return tag };
            let (own, after) = rest.split_once('"').unwrap();
            format!("{before}{mark}{}\"{after}", factor * own.parse::<f64>().unwrap())
        })
    };
    mjcf.split('<').map(scaled).collect::<Vec<_>>().join("<")
}

/// Multiplies the numbers of an attribute in all elements of a kind. Returns `None` if that changes nothing.
fn scaled(mjcf: &str, element: &str, key: &str, factor: f64) -> Option<String> {
    let mark = format!(" {key}=");
    let part = |part: &str| {
        let at = part.find(&mark).filter(|_| part.starts_with(&format!("{element} ")));
        let Some(start) = at.map(|at| at + mark.len() + 1) else { return part.to_owned() };
        let end = start + part[start..].find(['"', '\'']).unwrap();
        let scale = |number: &str| (factor * number.parse::<f64>().unwrap()).to_string();
        let numbers: Vec<String> = part[start..end].split_whitespace().map(scale).collect();
        format!("{}{}{}", &part[..start], numbers.join(" "), &part[end..])
    };
    let text = mjcf.split('<').map(part).collect::<Vec<_>>().join("<");
    (text != mjcf).then_some(text)
}

/// Returns the MJCF text that corresponds to an edit of the compiled model. Frictions are left out, because the tasks'
/// texts write them in too many ways. The tests in edits.rs cover frictions.
fn recompiled(mjcf: &str, edit: &str) -> Option<String> {
    let option = |attribute: &str| {
        let (before, after) = mjcf.split_once("<option ")?;
        let name = attribute.split('=').next()?;
        (!after.split('>').next()?.contains(name)).then(|| format!("{before}<option {attribute} {after}"))
    };
    match edit {
        "mass" => Some(with_scaled_masses(mjcf, 0.8)),
        "gravity" => option("gravity=\"0 0 -6.5\""),
        "density" => option("density=\"700\""),
        "viscosity" => option("viscosity=\"0.7\""),
        "gear" => scaled(mjcf, "motor", "gear", 1.5),
        "damping" | "armature" | "stiffness" => scaled(mjcf, "joint", edit, 1.5),
        _ => None,
    }
}

#[test]
fn edits_of_gymnasiums_models_are_recompiled_texts() {
    use perturb::env::Action;
    let Some(assets) = assets() else { return };
    let mut compared = 0;
    for (name, edited_folder) in folders(&assets) {
        let task = fs::read_to_string(edited_folder.path().join("task.toml")).unwrap();
        let (model, _) = task.split_once("model = \"").unwrap().1.split_once('"').unwrap();
        let mjcf = fs::read_to_string(edited_folder.path().join(model)).unwrap();
        // This attribute would undo the scaling of masses.
        let mjcf = mjcf.replace(" settotalmass=\"14\"", "");
        let task = task.split("[[parameter]]").next().unwrap().lines().filter(|line| !line.starts_with("heatmap"));
        let task: String = task.flat_map(|line| [line, "\n"]).collect();
        for (edit, toml, value) in [
            ("gravity", "option = \"gravity\", axis = \"z\", by = \"set\", factor = -1.0", 6.5),
            ("density", "option = \"density\", by = \"set\"", 700.0),
            ("viscosity", "option = \"viscosity\", by = \"set\"", 0.7),
            ("gear", "actuator = \"*\", field = \"gear\", by = \"scale\"", 1.5),
            ("damping", "joint = \"*\", field = \"damping\", by = \"scale\"", 1.5),
            ("armature", "joint = \"*\", field = \"armature\", by = \"scale\"", 1.5),
            ("stiffness", "joint = \"*\", field = \"stiffness\", by = \"scale\"", 1.5),
            ("mass", "body = \"*\", field = \"mass\", by = \"scale\"", 0.8),
        ] {
            let Some(text) = recompiled(&mjcf, edit) else { continue };
            // A mass of 0 is invalid.
            let low = if edit == "mass" { 0.1 } else { 0.0 };
            let parameter = format!(
                "[[parameter]]\nname = \"edited\"\ndescription = \"x\"\nedit = [{{ {toml} }}]\nbounds = [{low:?}, 5000.0]\n\
                 random = [{low:?}, 1000.0]\nextreme = [[{low:?}, {low:?}], [1000.0, 5000.0]]\n"
            );
            let edited = super::load(folder(&[("task.toml", &format!("{task}\n{parameter}")), (model, &mjcf)]).path());
            let fresh = super::load(folder(&[("task.toml", &task), (model, &text)]).path());
            let mut states = [edited, fresh].map(|spec| (spec.make)().unwrap()).map(|mut environment| {
                let spec = environment.spec();
                if !spec.parameters.is_empty() {
                    environment.set_parameters(&[value]);
                }
                environment.reset(&mut perturb::env::PhiloxStream::new(
                    3,
                    0,
                    perturb::env::DrawPurpose::InitialState,
                    0,
                ));
                let mut stream = perturb::env::PhiloxStream::new(3, 1, perturb::env::DrawPurpose::InitialState, 0);
                let perturb::env::ActionSpec::Continuous(channels) = spec.action else { panic!() };
                let mut saved = Vec::new();
                for _ in 0..50 {
                    let action: Vec<f32> = channels.iter().map(|c| stream.uniform(c.low, c.high) as f32).collect();
                    environment.step(Action::Continuous(&action), &mut vec![0.0; spec.reward_terms.len()]);
                    environment.save(&mut saved);
                }
                saved
            });
            let (fresh, edited) = (states[1].split_off(0), states[0].split_off(0));
            let difference = |(a, b): (&f64, &f64)| (a - b).abs() / a.abs().max(1.0);
            let differences = edited.iter().zip(&fresh).map(difference);
            let largest = differences.fold(0.0, f64::max);
            // Rounding differs: the compiler multiplies volumes by scaled densities, and the edit scales rounded
            // masses. Contacts amplify the difference.
            let tolerance = if edit == "mass" { 1e-6 } else { 0.0 };
            assert!(largest <= tolerance, "{name}: {edit}: {largest:e} after at least 100 timesteps");
            compared += 1;
        }
    }
    assert!(compared >= 65, "{compared} edits of eleven models");
}
