//! Tests that invalid folders are refused, with the right message, file, line and exit status.

use super::{CART, TASK, folder};
use crate::common::server;
use std::{fs, os::unix::fs::symlink, path::Path};

/// A change that makes a valid folder invalid.
type Spoil = fn(&Path);

fn replace(path: &Path, file: &str, old: &str, new: &str) {
    let path = path.join(file);
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(old), "{old} is in {file}");
    fs::write(path, text.replacen(old, new, 1)).unwrap();
}

/// The name of each invalid folder, and the change that makes it invalid.
#[rustfmt::skip]
const WRONG: &[(&str, Spoil)] = &[
    ("no file", |f| fs::remove_file(f.join("task.toml")).unwrap()),
    ("no model", |f| fs::remove_file(f.join("cart.xml")).unwrap()),
    ("not TOML", |f| replace(f, "task.toml", "step_limit = 100", "step_limit = = 100")),
    ("not UTF-8", |f| fs::write(f.join("task.toml"), b"format = 1\nname = \"\xff\"\n").unwrap()),
    ("another format", |f| replace(f, "task.toml", "format = 1", "format = 2")),
    ("unknown key", |f| replace(f, "task.toml", "step_limit", "steps_limit")),
    ("missing key", |f| replace(f, "task.toml", "frame_skip = 2\n", "")),
    ("wrong type", |f| replace(f, "task.toml", "frame_skip = 2", "frame_skip = \"2\"")),
    ("out of range", |f| replace(f, "task.toml", "frame_skip = 2", "frame_skip = 5000")),
    ("built-in name", |f| replace(f, "task.toml", "\"CartAndPole\"", "\"cart_pole\"")),
    ("bad name", |f| replace(f, "task.toml", "\"CartAndPole\"", "\"cart and pole\"")),
    ("no sentence", |f| replace(f, "task.toml", "Balance a pole on a cart.", "Balance")),
    ("unknown joint", |f| replace(f, "task.toml", "joint = \"hinge\", get", "joint = \"hing\", get")),
    ("unknown reading", |f| replace(f, "task.toml", "get = \"velocity\"", "get = \"speed\"")),
    ("two subjects", |f| replace(f, "task.toml", "{ joint = \"*\", get = \"velocity\" }", "{ joint = \"*\", body = \"cart\", get = \"velocity\" }")),
    ("wrong term key", |f| replace(f, "task.toml", "weight = -0.1", "wieght = -0.1")),
    ("two kinds of term", |f| replace(f, "task.toml", "healthy = 1.0", "healthy = 1.0, constant = 1.0")),
    ("two terms of a name", |f| replace(f, "task.toml", "\"control\"", "\"alive\"")),
    ("empty range", |f| replace(f, "task.toml", "above = -0.5, below = 0.5", "above = 0.5, below = -0.5")),
    ("no success", |f| replace(f, "task.toml", "success", "#")),
    ("no comparison", |f| replace(f, "task.toml", ", at_least = 100", "")),
    ("random beyond bounds", |f| replace(f, "task.toml", "bounds = [0.1, 5.0]", "bounds = [0.5, 5.0]")),
    ("extreme apart from random", |f| replace(f, "task.toml", "[[0.2, 0.4], [0.6, 1.0]]", "[[0.2, 0.3], [0.6, 1.0]]")),
    ("default outside of random", |f| replace(f, "task.toml", "random = [0.4, 0.6]\nextreme = [[0.2, 0.4]", "random = [0.55, 0.6]\nextreme = [[0.2, 0.55]")),
    ("unknown disturbance", |f| replace(f, "task.toml", "reset =", "disturbances = { action_dely = { random = [0, 2], extreme = [[0, 0], [2, 3]] } }\nreset =")),
    ("disturbance of no whole number", |f| replace(f, "task.toml", "reset =", "disturbances = { action_delay = { random = [0, 1.2], extreme = [[0, 0], [1.2, 1.8]] } }\nreset =")),
    ("disturbance beyond bounds", |f| replace(f, "task.toml", "reset =", "disturbances = { action_hold = { random = [0, 0.5], extreme = [[0, 0], [0.5, 2.0]] } }\nreset =")),
    ("disturbance in every R", |f| replace(f, "task.toml", "reset =", "disturbances = { action_delay = { random = [1, 2], extreme = [[0, 1], [2, 3]] } }\nreset =")),
    ("push on nothing", |f| replace(f, "task.toml", "reset =", "push = { body = \"pol\" }\nreset =")),
    ("push on the world", |f| replace(f, "task.toml", "reset =", "push = { body = \"world\" }\nreset =")),
    ("push along an axis twice", |f| replace(f, "task.toml", "reset =", "push = { axes = [\"x\", \"x\"] }\nreset =")),
    ("negative mass", |f| replace(f, "task.toml", "bounds = [0.1, 5.0]", "bounds = [-0.1, 5.0]")),
    ("unknown field", |f| replace(f, "task.toml", "field = \"mass\"", "field = \"weight\"")),
    ("different targets", |f| replace(f, "task.toml", "body = \"pole\"", "body = [\"pole\", \"cart\"]")),
    ("masked friction", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]\nbounds = [0.1", "geom = \"pole\", field = \"friction\", by = \"set\" }]\ndefault = 0.5\nbounds = [0.1")),
    ("friction without contact", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "geom = \"cart\", field = \"friction\", by = \"set\" }]\ndefault = 0.5")),
    ("torsion with condim 3", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "geom = \"pole\", field = \"friction_torsion\", by = \"set\" }]\ndefault = 0.5")),
    ("wind without air", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "option = \"wind\", axis = \"x\", by = \"set\" }]\ndefault = 0.5")),
    ("range of a free hinge", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "joint = \"hinge\", field = \"range\", end = \"upper\", by = \"set\" }]\ndefault = 0.5")),
    ("scale of zero", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "joint = \"hinge\", field = \"stiffness\", by = \"scale\" }]\ndefault = 0.5")),
    ("switched off", |f| { replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "option = \"gravity\", axis = \"x\", by = \"set\" }]\ndefault = 0.5"); replace(f, "cart.xml", "<option timestep=\"0.01\"/>", "<option timestep=\"0.01\"><flag gravity=\"disable\"/></option>") }),
    ("length of a box", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"cart\", field = \"length\", by = \"scale\" }]\ndefault = 0.5")),
    ("size by set", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"pole\", field = \"size\", by = \"set\" }]\ndefault = 0.5")),
    ("radius of a box", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "geom = \"cart\", field = \"radius\", by = \"set\" }]\ndefault = 0.5")),
    ("position without an axis", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"pole\", field = \"position\", by = \"set\" }]\ndefault = 0.5")),
    ("scaled twice", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"pole\", field = \"length\", by = \"scale\" }, { body = \"pole\", field = \"size\", by = \"scale\" }]\ndefault = 0.5")),
    ("moved twice", |f| { replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"cart\", field = \"size\", by = \"scale\" }, { body = \"pole\", field = \"position\", axis = \"z\", by = \"scale\" }]\ndefault = 0.5"); replace(f, "cart.xml", "name=\"pole\" pos=\"0 0 0\"", "name=\"pole\" pos=\"0 0 0.1\"") }),
    ("no position", |f| replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"pole\", field = \"position\", axis = \"z\", by = \"scale\" }]\ndefault = 0.5")),
    ("negative length", |f| { replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"pole\", field = \"length\", by = \"set\" }]\ndefault = 0.5"); replace(f, "task.toml", "bounds = [0.1, 5.0]", "bounds = [0.0, 5.0]") }),
    ("too small to be compiled", |f| { replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "geom = \"pole\", field = \"radius\", by = \"set\" }]\ndefault = 0.5"); replace(f, "task.toml", "bounds = [0.1, 5.0]", "bounds = [1e-9, 5.0]") }),
    ("length with inertial", |f| { replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"pole\", field = \"length\", by = \"set\" }]\ndefault = 0.5"); replace(f, "cart.xml", "<joint name=\"hinge\"", "<inertial pos=\"0 0 0.4\" mass=\"1\" diaginertia=\"0.1 0.1 0.1\"/><joint name=\"hinge\"") }),
    ("radius without effect", |f| { replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "geom = \"pole\", field = \"radius\", by = \"set\" }]\ndefault = 0.5"); replace(f, "cart.xml", "<joint name=\"hinge\"", "<inertial pos=\"0 0 0.4\" mass=\"1\" diaginertia=\"0.1 0.1 0.1\"/><joint name=\"hinge\""); replace(f, "cart.xml", "friction=\"0.9 0.1 0.1\"", "contype=\"0\" conaffinity=\"0\"") }),
    ("length with a constraint", |f| { replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"pole\", field = \"length\", by = \"set\" }]\ndefault = 0.5"); replace(f, "cart.xml", "<actuator>", "<equality><connect body1=\"pole\" anchor=\"0 0 0.8\"/></equality><actuator>") }),
    ("global coordinates", |f| { replace(f, "task.toml", "body = \"pole\", field = \"mass\", by = \"set\" }]", "body = \"pole\", field = \"length\", by = \"set\" }]\ndefault = 0.5"); replace(f, "cart.xml", "<option ", "<compiler coordinate=\"global\"/><option ") }),
    ("newer MJCF", |f| replace(f, "cart.xml", "name=\"hinge\"", "name=\"hinge\" actuatorfrcrange=\"-1 1\"")),
    ("not XML", |f| replace(f, "cart.xml", "</worldbody>", "</world>")),
    ("URDF", |f| fs::write(f.join("cart.xml"), "<robot name=\"cart\"/>").unwrap()),
    ("no range of control", |f| replace(f, "cart.xml", " ctrllimited=\"true\" ctrlrange=\"-1 1\"", "")),
    ("no actuators", |f| replace(f, "cart.xml", "<actuator><motor name=\"push\" joint=\"rail\" gear=\"20\" ctrllimited=\"true\" ctrlrange=\"-1 1\"/></actuator>", "")),
    ("many actuators", |f| replace(f, "cart.xml", "<actuator>", &format!("<actuator>{}", "<motor joint=\"rail\" ctrllimited=\"true\" ctrlrange=\"-1 1\"/>".repeat(2048)))),
    ("name of a changed value", |f| replace(f, "task.toml", "extreme = [[0.2, 0.4], [0.6, 1.0]]", "extreme = [[0.2, 0.4], [0.6, 1.0]]\n[[applied]]\nname = \"changed_pole_mass\"\nbody = \"pole\"\nfield = \"mass\"")),
    ("include outside", |f| replace(f, "cart.xml", "<worldbody>", "<include file=\"/etc/passwd\"/><worldbody>")),
    ("include of a parent", |f| replace(f, "cart.xml", "<worldbody>", "<include file=\"../../etc/passwd\"/><worldbody>")),
    ("link outside", |f| { symlink("/etc/passwd", f.join("more.xml")).unwrap(); replace(f, "cart.xml", "<worldbody>", "<include file=\"more.xml\"/><worldbody>") }),
    ("included twice", |f| { fs::write(f.join("more.xml"), "<x/>").unwrap(); replace(f, "cart.xml", "<worldbody>", "<include file=\"more.xml\"/><include file=\"more.xml\"/><worldbody>") }),
    ("timestep 0", |f| replace(f, "cart.xml", "timestep=\"0.01\"", "timestep=\"0\"")),
    ("infinite position", |f| replace(f, "cart.xml", "<body name=\"pole\" pos=\"0 0 0\">", "<body name=\"pole\" pos=\"inf 0 0\">")),
    ("large simulation", |f| replace(f, "cart.xml", "nstack=\"20000\"", "nstack=\"20000000\"")),
];

#[test]
fn wrong_folders_are_refused_with_a_sentence() {
    let mut told = String::new();
    for (name, spoil) in WRONG {
        let folder = folder(&[("task.toml", TASK), ("cart.xml", CART)]);
        spoil(folder.path());
        let output = server::command().args(["--check", "--task"]).arg(folder.path()).output().unwrap();
        let errors = String::from_utf8(output.stderr).unwrap();
        let errors = errors.replace(folder.path().to_str().unwrap(), "FOLDER");
        assert!(output.stdout.is_empty(), "{name}: {}", String::from_utf8_lossy(&output.stdout));
        told += &format!("# {name}: exit status {}\n{errors}", output.status.code().unwrap());
    }
    insta::assert_snapshot!("wrong_folders", told);
}

#[test]
fn windows_line_ends_and_a_byte_order_mark_are_accepted() {
    let windows = |text: &str| format!("\u{feff}{}", text.replace('\n', "\r\n"));
    let folder = folder(&[("task.toml", &windows(TASK)), ("cart.xml", &windows(CART))]);
    super::load(folder.path());
}

#[test]
fn a_server_does_not_start_with_a_wrong_folder() {
    let folder = folder(&[("task.toml", TASK)]);
    let output =
        server::command().args(["--listen", "tcp://127.0.0.1:0", "--task"]).arg(folder.path()).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(errors.contains("cart.xml") && output.stdout.is_empty(), "{errors}");
}

#[test]
fn two_folders_of_one_name_are_refused() {
    let [a, b] = ["CartAndPole", "cart_AndPole"]
        .map(|name| folder(&[("task.toml", &TASK.replace("CartAndPole", name)), ("cart.xml", CART)]));
    let output =
        server::command().args(["--check", "--task"]).arg(a.path()).arg("--task").arg(b.path()).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let errors = String::from_utf8(output.stderr).unwrap();
    let words = "this server already has an environment \"CartAndPole\"; give \"cart_AndPole\" another name";
    assert!(errors.contains(words), "{errors}");
}

#[test]
fn the_schema_has_the_keys_of_the_parser() {
    let schema = perturb::tasks::folder::SCHEMA;
    let parsed: serde_json::Value = serde_json::from_str(schema).unwrap();
    let output = server::command().arg("--task-schema").output().unwrap();
    assert_eq!(String::from_utf8(output.stdout).unwrap(), schema);
    // An unknown key is refused with a list of the known keys.
    let told = |old: &str, new: &str| {
        let task = TASK.replacen(old, new, 1);
        let folder = folder(&[("task.toml", &task), ("cart.xml", CART)]);
        let error = perturb::tasks::folder::load(folder.path()).unwrap_err().to_string();
        let known = error.rsplit_once("there are ").unwrap().1.split(", ").map(str::to_owned);
        known.collect::<std::collections::BTreeSet<String>>()
    };
    let keys = |pointer: &str| -> std::collections::BTreeSet<String> {
        parsed.pointer(pointer).unwrap().as_object().unwrap().keys().cloned().collect()
    };
    for (pointer, old, new) in [
        ("/properties", "step_limit", "zzz"),
        ("/$defs/reading/properties", "{ joint = \"*\", get", "{ zzz = \"*\", get"),
        ("/$defs/range/properties", "above", "zzz"),
        ("/$defs/term/properties", "weight", "zzz"),
        ("/$defs/success/properties", "steps = true", "zzz = true"),
        ("/$defs/reset/properties", "reset = { position", "reset = { zzz"),
        ("/$defs/parameter/properties", "unit", "zzz"),
        ("/$defs/edit/properties", "by = \"set\"", "zzz = \"set\""),
        ("/$defs/picture/properties", "reset =", "picture = { zzz = 1 }\nreset ="),
        ("/$defs/actions/properties", "reset =", "actions = { zzz = 1 }\nreset ="),
        ("/$defs/push/properties", "reset =", "push = { zzz = 1 }\nreset ="),
        ("/$defs/sets/properties", "reset =", "disturbances = { action_delay = { zzz = 1 } }\nreset ="),
        ("/$defs/applied/properties", "reset =", "applied = [{ zzz = 1 }]\nreset ="),
    ] {
        assert_eq!(told(old, new), keys(pointer), "{pointer}");
    }
}
