//! Custom parameter sets, from the experiment file to the report and to replayed episodes.

use std::path::Path;
use std::process::Output;
use std::sync::OnceLock;
use std::thread::{self, JoinHandle};

use perturb::config::{Arguments, Config};
use perturb::env::{Action, Catalogue, Environment, EnvironmentSpec, Error, PhiloxStream, Transition};
use perturb::scene::Scene;
use perturb::server::{net::listener::Listener, security::Security};
use perturb::tasks::cart_pole;
use perturb_experiment::{CellResult, CellState, ExperimentFolder, Plan};
use perturb_records::{FILE, Records};
use tempfile::TempDir;
use tokio::sync::oneshot;

use super::common::{addresses, perturb, server, stderr};

const PLAN: &str = "
environments = ['CartPole']
versions = ['D', 'long_poles']
test_versions = ['E', 'long_poles', 'corners', 'rows']
test_episodes = 12
settings = { episodes = 30, num_envs = 4 }

[sets.long_poles]
length = '0.7..0.8,0.9..1.0'
mass = 0.2

[sets.corners]
version = 'R'
length = '0.1..1.0/2'
mass = '0.05,0.5'

[sets.rows]
file = 'rows.csv'

[success]
CartPole = 'steps=15'

[[algorithm]]
name = 'ppo'
architectures = ['ff']
";

/// An experiment in a temporary folder.
fn experiment() -> TempDir {
    let directory = tempfile::tempdir().expect("a directory");
    std::fs::write(directory.path().join("plan.toml"), PLAN).expect("written");
    std::fs::write(directory.path().join("rows.csv"), "length,force\n0.3,5\n0.6,15\n").expect("written");
    directory
}

fn run(directory: &Path, arguments: &[&str]) -> Output {
    let plan = directory.join("plan.toml");
    let out = directory.join("out");
    let mut command = perturb(&["run"]);
    command.arg(plan).arg("--out").arg(out).args(arguments);
    command.output().expect("ended")
}

fn audit(path: &Path, arguments: &[&str]) -> Output {
    let mut command = perturb(&["audit"]);
    command.arg(path).args(arguments);
    command.output().expect("ended")
}

#[track_caller]
fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{}: {}", output.status, stderr(output));
    String::from_utf8(output.stdout.clone()).expect("UTF-8")
}

fn results(directory: &Path) -> Vec<CellResult> {
    let folder = ExperimentFolder::new(&directory.join("out"));
    let plan = Plan::load(&folder.plan_path()).expect("the folder's copy can be read, with the files that it names");
    let result = |cell| match folder.state(cell) {
        Ok(CellState::Done(result)) => *result,
        other => panic!("{other:?}"),
    };
    plan.cells.iter().map(result).collect()
}

#[test]
fn episodes_of_sets_replay_on_one_and_two_servers() {
    let directory = experiment();
    stdout(&run(directory.path(), &["--jobs", "2"]));
    let out = directory.path().join("out");
    let results = results(directory.path());
    assert_eq!(
        results.iter().map(|result| result.training.set.as_deref()).collect::<Vec<_>>(),
        [None, Some("long_poles")]
    );
    for result in &results {
        let records = Records::read(&out.join("cells").join(&result.id).join(FILE)).expect("recorded");
        let sets: Vec<&str> = records.about.tests.iter().map(|test| test.set.name.as_str()).collect();
        assert_eq!(sets, ["E", "long_poles", "corners", "rows"]);
        for set in sets {
            assert_eq!(records.result(set, None), result.results[set], "figures follow from the episodes");
        }
        assert_eq!(result.agreement, Some(records.agreement()));
        assert_eq!(records.agreement().episodes, 48);
        parameters_are_those_of_the_sets(&records);
    }
    let same = "96 of 96 episodes of 2 policies have the same bytes\n";
    assert_eq!(stdout(&audit(&out, &["--all"])), same);
    let servers = [server(1), server(2)];
    let two: Vec<String> = addresses(&servers).iter().map(ToString::to_string).collect();
    assert_eq!(stdout(&audit(&out, &["--all", "--server", &two.join(",")])), same);
    assert!(stdout(&audit(&out, &["--episodes", "5"])).starts_with("10 of 10 episodes"));
    let report = stdout(&perturb(&["report", out.to_str().unwrap()]).output().unwrap());
    assert!(report.contains("96 of 96 test episodes"), "requested against applied in a line: {report}");
    for set in ["long_poles", "corners", "rows"] {
        assert!(report.contains(set), "{set}: {report}");
    }
}

fn parameters_are_those_of_the_sets(records: &Records) {
    let place = |name: &str| records.about.parameters.iter().position(|known| known.name == name).expect("known");
    let force = place("force");
    let length = place("length");
    let mass = place("mass");
    for episode in records.episodes_on("long_poles") {
        let value = episode.requested[length];
        assert!((0.7..=0.8).contains(&value) || (0.9..=1.0).contains(&value), "{value}");
        assert_eq!((episode.requested[force], episode.requested[mass]), (10.0, 0.2));
    }
    for (set, at, expected) in [
        ("corners", [length, mass], [[0.1, 0.05], [1.0, 0.05], [0.1, 0.5], [1.0, 0.5]].as_slice()),
        ("rows", [length, force], &[[0.3, 5.0], [0.6, 15.0]]),
    ] {
        for context in expected {
            let count =
                records.episodes_on(set).filter(|episode| at.map(|place| episode.requested[place]) == *context).count();
            assert_eq!(count, 12 / expected.len(), "{set} {context:?}");
        }
    }
}

#[test]
fn a_different_replay_is_reported_as_failure() {
    let directory = experiment();
    stdout(&run(directory.path(), &["--cell", "0"]));
    let folder = ExperimentFolder::new(&directory.path().join("out"));
    let plan = Plan::load(&folder.plan_path()).expect("a plan");
    let cell = folder.cell(&plan.cells[0].id).path().to_owned();
    let mut records = Records::read(&cell.join(FILE)).expect("recorded");
    records.episodes[7].episode_return += 1.0;
    records.write(&cell.join(FILE)).expect("written");
    let output = audit(&cell, &["--all"]);
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}{}", stderr(&output));
    assert!(
        said.contains("return was") && said.ends_with("47 of 48 episodes of 1 policy have the same bytes\n"),
        "{said}"
    );
    let output = audit(&cell, &["--all", "--json"]);
    assert_eq!(output.status.code(), Some(1));
    let told: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON and nothing else");
    assert_eq!((&told["episodes"], &told["same"]), (&48.into(), &47.into()));
    let different = told["policies"][0]["different"].as_array().expect("sentences");
    assert!(different.len() == 1 && said.contains(different[0].as_str().expect("a sentence")), "{told}");
}

#[test]
fn sets_are_tested_rescored_and_replayed() {
    let directory = tempfile::tempdir().expect("a directory");
    let [training, records] = ["training", "records"].map(|name| directory.path().join(name).display().to_string());
    let parameters = ["--parameters", "length=0.75..1.25,1.5", "mass=1"];
    let refused = perturb(&["train", "--env", "Acrobot", "--out", &training]).args(parameters).output().unwrap();
    assert_eq!(refused.status.code(), Some(2), "a fixed value stands alone: {}", stderr(&refused));
    let train = ["train", "--env", "Acrobot", "--preset", "paper", "--episodes", "4", "--out", &training];
    stdout(&perturb(&train).args(["--parameters", "length=0.75..1.25", "mass=1"]).output().unwrap());
    let evaluate =
        ["evaluate", "--checkpoint", &training, "--episodes", "12", "--records", &records, "--success", "code"];
    let config = std::fs::read_to_string(directory.path().join("training/config.toml")).expect("written");
    assert!(config.contains("preset = \"paper\"\n") && config.contains("num_envs = 1\n"), "{config}");
    let tested = stdout(&perturb(&evaluate).args(["--parameters", "length=0.75..1.25"]).output().unwrap());
    assert!(tested.contains("Acrobot ppo ff (paper)") && tested.contains("success: steps at most 90"), "{tested}");
    let rates = perturb(&["rescore", &records, "--success", "text", "code", "steps=500"]).output().unwrap();
    let text = stdout(&rates);
    for line in ["steps at most 80", "steps at most 90", "steps at most 500"] {
        assert!(text.contains(line), "{text}");
    }
    // The old name of the command still works.
    let rates = perturb(&["rates", &records, "--success", "text", "code", "--json"]).output().unwrap();
    assert!(stderr(&rates).contains("`perturb rates` is called `perturb rescore` now"), "{}", stderr(&rates));
    let told: serde_json::Value = serde_json::from_slice(&rates.stdout).expect("JSON and nothing else");
    let rates = told["rates"].as_array().expect("a rate for each set and rule");
    let rules: Vec<_> = rates.iter().map(|rate| rate["success"]["threshold"].as_f64().expect("a number")).collect();
    assert_eq!(rules, [80.0, 90.0]);
    assert!(rates.iter().all(|rate| rate["set"].is_string() && rate["result"]["episodes"] == 12), "{told}");
    let same = stdout(&audit(records.as_ref(), &["--all", "--checkpoint", &training]));
    assert_eq!(same, "12 of 12 episodes of 1 policy have the same bytes\n");
}

#[test]
fn trainings_on_contexts_end_and_are_replayed() {
    let directory = experiment();
    let plan = PLAN.replace("versions = ['D', 'long_poles']", "versions = ['rows', 'corners']");
    std::fs::write(directory.path().join("plan.toml"), plan).expect("written");
    stdout(&run(directory.path(), &[]));
    let out = directory.path().join("out");
    assert_eq!(stdout(&audit(&out, &["--all"])), "96 of 96 episodes of 2 policies have the same bytes\n");
    let results = results(directory.path());
    assert_eq!(
        results.iter().filter_map(|result| result.training.set.as_deref()).collect::<Vec<_>>(),
        ["rows", "corners"]
    );
    assert!(results[0].command.contains(" --contexts CONTEXTS "), "{}", results[0].command);

    // A training that was interrupted draws the same contexts.
    let [whole, halves] = ["whole", "halves"].map(|name| directory.path().join(name).display().to_string());
    let rows = directory.path().join("rows.csv").display().to_string();
    let train = ["train", "--env", "CartPole", "--contexts", &rows, "--set", "n_steps=16", "--episodes"];
    stdout(&perturb(&[&train[..], &["60", "--out", &whole]].concat()).output().unwrap());
    stdout(&perturb(&[&train[..], &["20", "--out", &halves]].concat()).output().unwrap());
    stdout(&perturb(&["train", "--resume", &halves, "--extend", "40"]).output().unwrap());
    let drawn = |run: &str| {
        let log = std::fs::read_to_string(Path::new(run).join("monitor.csv")).expect("a log");
        let lines = log.lines().skip(2).map(|line| line.split(',').skip(5).collect::<Vec<_>>().join(","));
        lines.take(60).collect::<Vec<_>>()
    };
    let lines = drawn(&whole);
    assert_eq!(lines, drawn(&halves));
    for values in [",5,0.3,0.1,", ",15,0.6,0.1,"] {
        let count = lines.iter().filter(|line| line.contains(values)).count();
        assert!(count > 15, "{count} of {lines:?}");
    }
}

#[test]
fn disturbed_episodes_are_recorded_and_replayed() {
    let directory = experiment();
    let late = "[sets.late]\naction_delay = '0..2'\nsensor_noise = '0.01..0.1'\npush = 0.5\npush_interval = 5\nchange_at = '0..9'\nchanged_length = '0.8..1'\n\n[sets.grid]\nsensor_delay = '0..2/3'\n";
    let plan = PLAN
        .replace("versions = ['D', 'long_poles']", "versions = ['D', 'late']")
        .replace("test_versions = ['E', 'long_poles', 'corners', 'rows']", "test_versions = ['D', 'late', 'grid']")
        .replace("[sets.long_poles]", &format!("{late}\n[sets.long_poles]"));
    std::fs::write(directory.path().join("plan.toml"), plan).expect("written");
    stdout(&run(directory.path(), &[]));
    let out = directory.path().join("out");
    assert_eq!(stdout(&audit(&out, &["--all"])), "72 of 72 episodes of 2 policies have the same bytes\n");
    for result in results(directory.path()) {
        assert_eq!(
            result.agreement.as_ref().unwrap().largest.as_ref().map(|difference| difference.relative),
            Some(0.0)
        );
        let records = Records::read(&ExperimentFolder::new(&out).cell(&result.id).path().join(FILE)).expect("recorded");
        let place = |name: &str| records.about.parameters.iter().position(|parameter| parameter.name == name).unwrap();
        let values = |set: &str, name: &str| {
            let place = place(name);
            records.episodes_on(set).map(|episode| episode.requested[place]).collect::<Vec<_>>()
        };
        assert!(values("D", "action_delay").iter().all(|delay| *delay == 0.0));
        assert!(values("late", "action_delay").iter().all(|delay| [0.0, 1.0, 2.0].contains(delay)));
        assert!(values("late", "sensor_noise").iter().all(|noise| (0.01..0.1).contains(noise)));
        assert_eq!(values("grid", "sensor_delay").iter().sum::<f64>(), 12.0, "each delay in as many episodes");
    }
    let refused = perturb(&["train", "--env", "CartPole", "--parameters", "action_dely=2"]).output().unwrap();
    let expected = "one of force, length, mass, or a disturbance: action_delay, action_hold, push, push_interval, \
                    sensor_delay, sensor_noise, sensor_dropout, change_at, change_every, change_probability, changed_force, \
                    changed_length, changed_mass (did you mean `action_delay`?)";
    assert!(stderr(&refused).contains(expected), "{}", stderr(&refused));
}

/// Pendulum has two success rules. The rule in the paper's text counts the successive steps near upright at the end of
/// an episode. The rule in the paper's published code counts the most successive steps near upright anywhere in an
/// episode. The choice of the rule must not change the episodes of a test.
#[test]
fn rules_with_different_quantities_test_equal_episodes() {
    let directory = tempfile::tempdir().expect("a directory");
    let [training, text, code] =
        ["training", "text", "code"].map(|name| directory.path().join(name).display().to_string());
    stdout(&perturb(&["train", "--env", "Pendulum", "--episodes", "4", "--out", &training]).output().unwrap());
    let evaluate = ["evaluate", "--checkpoint", &training, "--versions", "D", "--episodes", "12"];
    let [by_text, by_code] = [("text", &text), ("code", &code)].map(|(rule, records)| {
        stdout(&perturb(&evaluate).args(["--records", records, "--success", rule]).output().unwrap());
        let same = stdout(&audit(records.as_ref(), &["--all", "--checkpoint", &training]));
        assert_eq!(same, "12 of 12 episodes of 1 policy have the same bytes\n");
        Records::read(records.as_ref()).expect("recorded").episodes
    });
    let of_text: Vec<_> = by_text.iter().map(|episode| (episode.achieved, episode.also_achieved)).collect();
    let of_code: Vec<_> = by_code.iter().map(|episode| (episode.also_achieved, episode.achieved)).collect();
    assert_eq!(of_text, of_code);
    assert!(of_text.iter().any(|(last, longest)| last < longest), "some fell from near upright: {of_text:?}");
    let rates = |records: &String| {
        let rules = ["--success", "text", "code", "steps=1", "steps_in_a_row=5"];
        stdout(&perturb(&["rescore", records]).args(rules).output().unwrap())
    };
    assert_eq!(rates(&text), rates(&code));
}

#[test]
fn unknown_parameters_are_refused_at_the_start() {
    let directory = experiment();
    for (from, to, part) in [
        ("mass = 0.2", "size = 0.2", "`size`, but must be one of force, length, mass"),
        ("mass = 0.2", "mass = -1", "mass of CartPole is -1, but must be within"),
        ("steps=15", "metres=15", "metres=15, but must be a threshold for steps"),
        ("steps=15", "steps=201", "at most 200, the step limit"),
        ("CartPole = 'steps", "CartPool = 'steps", "`CartPool`, but must be one of CartPole"),
        ("length = '0.7..0.8,0.9..1.0'\nmass = 0.2", "version = 'R'", "without parameters"),
        ("test_versions = ['E'", "test_versions = ['X'", "`X`"),
        ("rows.csv", "../rows.csv", "not the name of a .csv file"),
    ] {
        std::fs::write(directory.path().join("plan.toml"), PLAN.replace(from, to)).expect("written");
        let output = run(directory.path(), &[]);
        assert!(stderr(&output).contains(part), "{to}: {}", stderr(&output));
        assert!(!directory.path().join("out").exists(), "{to}: nothing was begun");
    }
}

/// A faulty CartPole, in which setting the mass has no effect.
struct Stuck(Box<dyn Environment>);

impl Stuck {
    fn spec() -> &'static EnvironmentSpec {
        static SPEC: OnceLock<EnvironmentSpec> = OnceLock::new();
        SPEC.get_or_init(|| EnvironmentSpec {
            make: &|| Ok(Box::new(Stuck((cart_pole::SPEC.make)()?)) as Box<dyn Environment>),
            ..cart_pole::SPEC
        })
    }
}

impl Environment for Stuck {
    fn spec(&self) -> &'static EnvironmentSpec {
        Self::spec()
    }

    fn set_parameters(&mut self, values: &[f64]) {
        self.0.set_parameters(&[values[0], values[1], 0.1]);
    }

    fn applied(&self, out: &mut [f64]) {
        self.0.applied(out);
    }

    fn reset(&mut self, stream: &mut PhiloxStream) {
        self.0.reset(stream);
    }

    fn reset_to(&mut self, state: &[f64]) {
        self.0.reset_to(state);
    }

    fn observe(&self, out: &mut [f32]) {
        self.0.observe(out);
    }

    fn scene(&self) -> Option<Scene> {
        self.0.scene()
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        self.0.step(action, reward_terms)
    }

    fn save(&self, out: &mut Vec<f64>) {
        self.0.save(out);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        self.0.load(state)
    }
}

/// A server in a thread of this process, with a catalogue for tests.
struct InThread {
    address: String,
    shutdown: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl InThread {
    fn start(catalogue: Catalogue) -> Self {
        let (tell, address) = oneshot::channel();
        let (shutdown, end) = oneshot::channel();
        let thread = thread::spawn(move || {
            let config = Config { workers: 2, ..Config::load(&Arguments::default()).expect("settings") };
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
            runtime.block_on(async {
                let any = "tcp://127.0.0.1:0".to_owned().try_into().expect("an address");
                let listener = Listener::bind(&any, config.socket_mode).await.expect("a free port");
                tell.send(listener.address().expect("bound").to_string()).expect("heard");
                let stop = async { drop(end.await) };
                let guards = Security::default();
                perturb::server::run(vec![listener], None, &config, &guards, catalogue, stop).await.expect("served");
            });
        });
        let address = address.blocking_recv().expect("it listens");
        Self { address, shutdown: Some(shutdown), thread: Some(thread) }
    }
}

impl Drop for InThread {
    fn drop(&mut self) {
        drop(self.shutdown.take());
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

#[test]
fn an_ineffective_parameter_edit_stops_a_training() {
    let directory = tempfile::tempdir().expect("a directory");
    let server = InThread::start(Catalogue::default().with(Stuck::spec()).expect("a free name"));
    let out = directory.path().join("out").display().to_string();
    let train = ["train", "--env", "CartPole", "--version", "R", "--episodes", "20", "--out", &out];
    let output = perturb(&train).args(["--server", &server.address]).output().expect("ended");
    assert_eq!(output.status.code(), Some(1));
    let message = stderr(&output);
    assert!(message.contains("the parameter mass was requested as") && message.contains("ran with 0.1"), "{message}");
}

#[test]
fn the_base_version_of_a_set_belongs_to_its_cells() {
    let plan = |version: &str| {
        let text = format!(
            "environments = ['CartPole']\nversions = ['long']\ntest_versions = ['D']\n[sets.long]\nversion = '{version}'\n\
             length = '0.3..0.4'\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']"
        );
        Plan::parse("test", text).expect("a plan").cells.remove(0).id
    };
    assert_ne!(plan("D"), plan("R"));
}

#[test]
fn an_edit_that_does_not_take_effect_stops_a_cell() {
    let directory = experiment();
    let server = InThread::start(Catalogue::default().with(Stuck::spec()).expect("a free name"));
    let output = run(directory.path(), &["--jobs", "1", "--server", &server.address]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let folder = ExperimentFolder::new(&directory.path().join("out"));
    let plan = Plan::load(&folder.plan_path()).expect("a plan");
    for cell in &plan.cells {
        let Ok(CellState::Failed(failure)) = folder.state(cell) else { panic!("{} has not failed", cell.id) };
        let part = "the parameter mass was requested as ";
        assert!(failure.reason.contains(part) && failure.reason.contains("the physics ran with 0.1"), "{failure:?}");
        assert!(!folder.cell(&cell.id).path().join("result.json").exists());
    }
}
