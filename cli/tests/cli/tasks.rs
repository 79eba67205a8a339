//! Task folders: trainings, tests, experiments and audits on private servers, and the refusal of wrong folders and of
//! changed or different models.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use perturb_experiment::{CellState, ExperimentFolder, Plan};
use perturb_learner::client::{Address, ClientError, PrivateServer, Servers};
use tempfile::TempDir;

use crate::common::{perturb, refusal, stderr};

/// A plan with four cells of about a second.
const PLAN: &str = "
tasks = ['arm', './dog']
environments = ['ReachingArm', 'Quadruped']
versions = ['D', 'R']
test_versions = ['D', 'E']
test_episodes = 8
settings = { episodes = 8, num_envs = 4 }

[[algorithm]]
name = 'ppo'
architectures = ['ff']
";

/// A folder with copies of the example tasks in `arm` and `dog`, and a plan over both in `plan.toml`.
struct Place(TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        for (example, name) in [("reaching_arm", "arm"), ("quadruped", "dog")] {
            let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/tasks").join(example);
            fs::create_dir(place.path(name)).expect("a folder");
            for file in fs::read_dir(from).expect("an example").flatten().filter(|file| file.path().is_file()) {
                fs::copy(file.path(), place.path(name).join(file.file_name())).expect("copied");
            }
        }
        fs::write(place.path("plan.toml"), PLAN).expect("written");
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }

    /// Changes a number in the model of the task `arm`.
    fn change_the_arm(&self) {
        let path = self.path("arm/arm.xml");
        let text = fs::read_to_string(&path).expect("a model");
        fs::write(path, text.replacen("damping=\"0.2\"", "damping=\"0.3\"", 1)).expect("written");
    }

    /// Runs `perturb` in this folder.
    fn run(&self, words: &[&str]) -> Output {
        perturb(words).current_dir(self.0.path()).output().expect("perturb runs")
    }

    #[track_caller]
    fn printed(&self, words: &[&str]) -> String {
        let output = self.run(words);
        assert!(output.status.success(), "{words:?}: {}", stderr(&output));
        String::from_utf8(output.stdout).expect("text")
    }

    /// Runs a command that must be refused with exit status 2, and returns its messages.
    #[track_caller]
    fn refused(&self, words: &[&str]) -> String {
        let output = self.run(words);
        assert_eq!(output.status.code(), Some(2), "{words:?}: {}", stderr(&output));
        stderr(&output)
    }

    fn train(&self) {
        let settings = ["--version", "R", "--episodes", "8", "--set", "num_envs=4", "--out", "run"];
        self.printed(&[&["train", "--task", "arm", "--env", "reaching-arm"], &settings[..]].concat());
    }
}

#[test]
fn a_task_folder_is_trained_tested_drawn_and_audited() {
    let place = Place::new();
    let listed = place.printed(&["envs", "--task", "arm", "--task", "dog"]);
    assert!(listed.contains("ReachingArm (v0)") && listed.contains("Quadruped (v0)"), "{listed}");
    place.train();
    let test = ["evaluate", "--checkpoint", "run", "--episodes", "6", "--records", "test.parquet", "--task", "arm"];
    let table = place.printed(&test);
    assert!(table.starts_with("ReachingArm ppo ff, trained on R with seed 1"), "{table}");
    let audited = place.printed(&["audit", "test.parquet", "--checkpoint", "run", "--all", "--task", "arm"]);
    assert_eq!(audited, "18 of 18 episodes of 1 policy have the same bytes\n");
    let drawn = ["heatmap", "--checkpoint", "run", "--grid", "2", "--episodes", "1", "--out", "map", "--task", "arm"];
    place.printed(&drawn);
    assert!(place.path("map.csv").is_file());
    place.printed(&["train", "--resume", "run", "--extend", "4", "--task", "arm"]);
}

#[test]
fn a_changed_folder_is_refused_for_a_trained_policy() {
    let place = Place::new();
    place.train();
    place.printed(&["evaluate", "--checkpoint", "run", "--episodes", "2", "--records", "t.parquet", "--task", "arm"]);
    place.change_the_arm();
    for words in [
        &["evaluate", "--checkpoint", "run", "--task", "arm"][..],
        &["heatmap", "--checkpoint", "run", "--grid", "2", "--episodes", "1", "--task", "arm"],
        &["video", "--checkpoint", "run", "--out", "film.png", "--task", "arm"],
        &["audit", "t.parquet", "--checkpoint", "run", "--task", "arm"],
        &["train", "--resume", "run", "--extend", "4", "--task", "arm"],
    ] {
        let output = place.run(words);
        let said = stderr(&output);
        assert!(!output.status.success() && said.contains("trained in ReachingArm with model \""), "{words:?}: {said}");
        assert!(said.contains("if the task is a folder, serve its original files"), "{words:?}: {said}");
    }
}

#[test]
fn wrong_task_folders_are_refused_with_a_remedy() {
    let place = Place::new();
    fs::create_dir(place.path("empty")).expect("a folder");
    let said = |folder: &str| place.refused(&["train", "--task", folder, "--env", "ReachingArm"]);
    let remedy = "give the folder of a task, which docs/tasks.md describes\n";
    assert_eq!(said("nowhere"), format!("perturb: --task nowhere does not exist: {remedy}"));
    assert_eq!(said("empty"), format!("perturb: --task empty has no file task.toml: {remedy}"));
    assert_eq!(said("arm/arm.xml"), format!("perturb: --task arm/arm.xml is not a folder: {remedy}"));
    let both = place.refused(&["envs", "--task", "arm", "--server", "unix:/nowhere"]);
    let expected = "--task is for a private server; give it to perturb-server instead";
    assert_eq!(both, format!("perturb: {expected}\n"));
    let task = fs::read_to_string(place.path("arm/task.toml")).expect("a task");
    fs::write(place.path("arm/task.toml"), task.replacen("step_limit", "steps_limit", 1)).expect("written");
    let said = said("arm");
    assert!(said.contains("perturb-server: --task arm: task.toml, line 6: unknown key \"steps_limit\""), "{said}");
    assert!(said.contains("perturb: perturb-server refused a task of arm, for the reason above; "), "{said}");
    let unknown = refusal(&["train", "--env", "Robot"], &[]);
    assert!(unknown.contains("; an environment of a task folder needs --task DIR, of this command or of the server\n"));
    assert!(!place.path("runs").exists(), "nothing was begun");
}

#[test]
fn servers_of_a_run_have_the_same_model() {
    let place = Place::new();
    let server = || {
        let tasks = [place.path("arm")];
        PrivateServer::start_unless(Some(1), &tasks, &|| None).unwrap_or_else(|error| panic!("{error}"))
    };
    let address = |server: &PrivateServer| server.address().clone();
    let [first, second] = [server(), server()];
    let connect = |addresses: &[Address]| Servers::connect(addresses).expect("connected");
    let addresses = [address(&first), address(&second)];
    assert_eq!(connect(&addresses).environment("reaching-arm").expect("the same").name, "ReachingArm");
    place.change_the_arm();
    let changed = server();
    let addresses = [address(&first), address(&changed)];
    let servers = connect(&addresses);
    let error = servers.environment("ReachingArm").expect_err("another model");
    assert!(
        matches!(&error, ClientError::Models { hashes, .. } if hashes[0] != hashes[1] && hashes[0].len() == 64),
        "{error}"
    );
    assert!(servers.environment("Hopper").is_ok(), "the built-in environments are the same");
    let both = addresses.map(|address| address.to_string()).join(",");
    let said = place.refused(&["train", "--env", "ReachingArm", "--server", &both]);
    assert!(said.contains("have different models of ReachingArm, with the hashes [\""), "{said}");
    assert!(said.contains("give both the same files of the task, and restart them"), "{said}");
}

#[test]
fn an_experiment_over_two_task_folders_is_reported_and_audited() {
    let place = Place::new();
    let out = place.text("out");
    place.printed(&["plan", "plan.toml", "--measure", "0"]);
    // The command runs in another directory. Task folders in a plan are relative to the plan's file.
    let run = |words: &[&str]| {
        let plan = place.text("plan.toml");
        perturb(&[&["run", &plan, "--out", &out], words].concat()).output().expect("perturb runs")
    };
    let output = run(&["--jobs", "2"]);
    assert!(output.status.success(), "{}", stderr(&output));
    let plan = Plan::load(&place.path("out/plan.toml")).expect("a copy of the plan");
    assert_eq!(plan.tasks, ["arm", "dog"].map(|name| place.path(name).canonicalize().expect("a folder")));
    let folder = ExperimentFolder::new(&place.path("out"));
    for cell in &plan.cells {
        let Ok(CellState::Done(result)) = folder.state(cell) else { panic!("{} is not done", cell.id) };
        assert_eq!(result.training.model_hash.len(), 64);
        assert!(result.command.contains(" --task TASK "), "{}", result.command);
    }
    let audited = place.printed(&["audit", &out, "--all"]);
    assert_eq!(audited, "64 of 64 episodes of 4 policies have the same bytes\n");
    let cell = format!("{out}/cells/{}", plan.cells[0].id);
    assert_eq!(place.printed(&["audit", &cell, "--all"]), "16 of 16 episodes of 1 policy have the same bytes\n");
    place.printed(&["heatmap", &out, "--grid", "2", "--episodes", "1"]);
    place.printed(&["report", &out]);

    place.change_the_arm();
    fs::remove_file(folder.cell(&plan.cells[1].id).path().join("result.json")).expect("removed");
    let output = run(&[]);
    let said = stderr(&output);
    assert!(
        said.contains("was trained in ReachingArm with the model ")
            && said.contains("or choose another folder with --out")
    );
    assert_eq!(output.status.code(), Some(2), "{said}");
    fs::remove_dir_all(place.path("dog")).expect("removed");
    let output = run(&[]);
    let said = stderr(&output);
    assert!(said.contains("dog, which has no file task.toml: bring the folder back, or give --task DIR"), "{said}");
    assert_eq!(output.status.code(), Some(2), "{said}");
}

#[test]
fn results_of_different_models_are_not_reported_together() {
    let place = Place::new();
    let words = ["run", "plan.toml", "--out", "out"];
    place.printed(&words);
    let plan = Plan::load(&place.path("plan.toml")).expect("a plan");
    let path = ExperimentFolder::new(&place.path("out")).cell(&plan.cells[0].id).path().join("result.json");
    let text = fs::read_to_string(&path).expect("a result");
    let mut result: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    result["training"]["model_hash"] = "another".into();
    // Without its checksum, a changed document is accepted.
    result.as_object_mut().expect("an object").remove("crc32c");
    fs::write(&path, result.to_string()).expect("written");
    let output = place.run(&["report", "out"]);
    let said = stderr(&output);
    assert!(!output.status.success() && said.contains("with different models, [\"another\", \""), "{said}");
}
