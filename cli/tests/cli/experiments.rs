//! Experiments with real worker processes and servers.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use perturb_learner::client::PrivateServer;
use perturb_study::{CellResult, CellState, Counts, Folder, Plan};
use tempfile::TempDir;

/// How long anything may take that must not hang.
const LIMIT: Duration = Duration::from_secs(120);

/// Eight cells of a second or so.
const PLAN: &str = "
environments = ['CartPole', 'Pendulum']
versions = ['D', 'E']
test_versions = ['D', 'R']
test_episodes = 12
settings = { episodes = 40, num_envs = 4 }

[[algorithm]]
name = 'a2c'
architectures = ['ff']
grid = { learning_rate = [7e-3, 7e-4] }
";

struct Experiment {
    directory: TempDir,
    plan: Plan,
}

impl Experiment {
    fn new(text: &str) -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        std::fs::write(directory.path().join("file.toml"), text).expect("written");
        let plan = Plan::parse("file.toml", text.into()).unwrap_or_else(|error| panic!("{error}"));
        Self { directory, plan }
    }

    fn out(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    fn command(&self, name: &str, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
        command.arg("run").arg(self.directory.path().join("file.toml")).arg("--out").arg(self.out(name));
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn run(&self, name: &str, arguments: &[&str]) -> Output {
        let child = self.command(name, arguments).spawn().expect("started");
        child.wait_with_output().expect("ended")
    }

    /// The bytes of all results.
    fn results(&self, name: &str) -> BTreeMap<String, Vec<u8>> {
        let folder = Folder::new(&self.out(name));
        let read = |id: &str| std::fs::read(folder.cell(id).path().join("result.json")).ok();
        self.plan.cells.iter().filter_map(|cell| Some((cell.id.clone(), read(&cell.id)?))).collect()
    }

    fn cell_result(&self, name: &str, index: usize) -> Box<CellResult> {
        match Folder::new(&self.out(name)).state(&self.plan.cells[index]) {
            Ok(CellState::Done(result)) => result,
            other => panic!("cell {index} is {other:?}"),
        }
    }

    /// How often a training was begun.
    fn attempts(&self, name: &str) -> Vec<usize> {
        let folder = Folder::new(&self.out(name));
        let log = |id: &str| std::fs::read_to_string(folder.cell(id).log()).unwrap_or_default();
        self.plan.cells.iter().map(|cell| log(&cell.id).lines().filter(|line| *line == "training").count()).collect()
    }
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[track_caller]
fn succeeded(output: &Output) {
    assert!(output.status.success(), "{}: {}", output.status, stderr(output));
}

fn wait_for(what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < LIMIT, "{what} did not happen within {LIMIT:?}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn signal(signal: &str, id: u32) {
    assert!(Command::new("kill").args([signal, &id.to_string()]).status().expect("kill").success());
}

/// The processes that `parent` started.
fn children(parent: u32) -> Vec<u32> {
    let list = std::fs::read_to_string(format!("/proc/{parent}/task/{parent}/children")).unwrap_or_default();
    list.split_whitespace().filter_map(|id| id.parse().ok()).collect()
}

/// Whether a process runs; one that has ended and waits for its parent does not.
fn is_running(id: u32) -> bool {
    std::fs::read_to_string(format!("/proc/{id}/stat")).is_ok_and(|stat| !stat.contains(") Z "))
}

/// Kills a run with -9, and waits until all that it started has ended.
fn kill_all(mut child: Child) {
    let started = children(child.id());
    assert!(!started.is_empty());
    signal("-KILL", child.id());
    child.wait().expect("ended");
    wait_for("the end of what the run started", || !started.iter().any(|&id| is_running(id)));
}

#[test]
fn results_depend_neither_on_jobs_nor_on_kills() {
    let experiment = Experiment::new(PLAN);
    let cells = experiment.plan.cells.len();
    succeeded(&experiment.run("whole", &["--jobs", "1"]));
    let whole = experiment.results("whole");
    assert_eq!(whole.len(), cells);
    assert_eq!(experiment.attempts("whole"), vec![1; cells]);

    for done in [1, 2, 4] {
        let child = experiment.command("killed", &["--jobs", "2"]).spawn().expect("started");
        wait_for("a few results", || experiment.results("killed").len() >= done);
        kill_all(child);
        assert!(experiment.results("killed").len() < cells, "killed before the end");
    }
    succeeded(&experiment.run("killed", &["--jobs", "3"]));
    assert_eq!(experiment.results("killed"), whole);
    let folder = Folder::new(&experiment.out("killed"));
    let unfinished = |id: &str| {
        let entries = std::fs::read_dir(folder.cell(id).path()).expect("a folder");
        entries
            .filter(|entry| entry.as_ref().is_ok_and(|entry| entry.file_name().to_string_lossy().starts_with(".tmp")))
    };
    assert!(experiment.plan.cells.iter().all(|cell| unfinished(&cell.id).count() == 0));
}

#[test]
fn a_result_says_what_was_done_and_how_to_do_it_again() {
    let experiment = Experiment::new(PLAN);
    succeeded(&experiment.run("out", &["--cell", "3"]));
    let result = experiment.cell_result("out", 3);
    let cell = &experiment.plan.cells[3];
    assert_eq!(result.id, cell.id);
    assert_eq!(result.training.settings, cell.config.table());
    assert_eq!((result.training.run, result.training.seed), (1, 1));
    assert!(result.training.counters.episodes >= 40);
    assert_eq!(result.results.values().map(|test| test.episodes).collect::<Vec<_>>(), [12, 12]);
    assert!(result.commit.starts_with(env!("CARGO_PKG_VERSION")) && result.commit.len() > 10, "{}", result.commit);

    let (train, evaluate) = result.command.split_once(" && ").expect("two commands");
    let out = experiment.out("again");
    let json = experiment.out("again.json");
    for (command, more) in [(train, &[][..]), (evaluate, &["--json", json.to_str().expect("a path")][..])] {
        let arguments: Vec<&str> = command
            .split(' ')
            .skip(1)
            .map(|word| if word == "RUN" { out.to_str().expect("a path") } else { word })
            .collect();
        let output = Command::new(env!("CARGO_BIN_EXE_perturb")).args(&arguments).args(more).output().expect("ended");
        succeeded(&output);
    }
    let again: serde_json::Value = serde_json::from_slice(&std::fs::read(json).expect("written")).expect("JSON");
    assert_eq!(again["results"], serde_json::to_value(&result.results).expect("JSON"));
}

#[test]
fn two_runs_on_one_folder_share_the_cells() {
    let experiment = Experiment::new(PLAN);
    let runs: Vec<Child> =
        (0..2).map(|_| experiment.command("out", &["--jobs", "2"]).spawn().expect("started")).collect();
    for run in runs {
        succeeded(&run.wait_with_output().expect("ended"));
    }
    let cells = experiment.plan.cells.len();
    assert_eq!(experiment.results("out").len(), cells);
    assert_eq!(experiment.attempts("out"), vec![1; cells]);
}

#[test]
fn a_failed_cell_is_recorded_with_its_reason_and_the_others_are_done() {
    let experiment = Experiment::new(&PLAN.replace("7e-3, 7e-4", "1e38, 7e-4"));
    let output = experiment.run("out", &["--jobs", "2"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("4 of 8 cells failed") && stderr(&output).contains("--retry-failed"));
    assert_eq!(experiment.results("out").len(), 4);
    let failed =
        experiment.plan.cells.iter().find(|cell| cell.config.table()["learning_rate"].as_float() == Some(1e38));
    let failed = failed.expect("a cell");
    let out = experiment.out("out").display().to_string();
    let Ok(CellState::Failed(failure)) = Folder::new(&experiment.out("out")).state(failed) else { panic!() };
    assert!(
        failure.reason.contains("lower the learning rate") && !failure.reason.contains(&*out),
        "{}",
        failure.reason
    );

    let attempts = experiment.attempts("out");
    assert_eq!(experiment.run("out", &[]).status.code(), Some(1));
    assert_eq!(experiment.attempts("out"), attempts, "not tried again");
    assert_eq!(experiment.run("out", &["--retry-failed"]).status.code(), Some(1));
    assert_eq!(experiment.attempts("out")[failed.index], 2 * attempts[failed.index]);
}

/// What two runs that try again at once find failed: each failing cell is tried again once, by one of them.
#[test]
fn two_runs_that_try_again_at_once_try_each_cell_once() {
    let experiment = Experiment::new(&PLAN.replace("7e-3, 7e-4", "1e38, 2e38"));
    let cells = experiment.plan.cells.len();
    assert_eq!(experiment.run("out", &["--jobs", "2"]).status.code(), Some(1));
    assert_eq!(experiment.attempts("out"), vec![1; cells]);
    let folder = Folder::new(&experiment.out("out"));
    let held: Vec<_> = experiment.plan.cells.iter().map(|cell| folder.cell(&cell.id).try_lock()).collect();
    let runs: Vec<Child> = (0..2)
        .map(|_| experiment.command("out", &["--jobs", "2", "--retry-failed"]).spawn().expect("started"))
        .collect();
    // Both have seen the failures: each has started a worker for the first cell, which found it locked.
    let log = folder.cell(&experiment.plan.cells[0].id).log();
    let busy = || std::fs::read_to_string(&log).map_or(0, |text| text.matches("another process works on").count());
    wait_for("two runs", || busy() >= 2);
    drop(held);
    for run in runs {
        let output = run.wait_with_output().expect("ended");
        assert!(output.status.code() == Some(1) && stderr(&output).contains("8 of 8 cells failed"), "{output:?}");
    }
    assert_eq!(experiment.attempts("out"), vec![2; cells]);
}

#[test]
fn a_result_names_the_program_that_began_its_training_if_it_is_another() {
    let experiment = Experiment::new(&PLAN.replace("episodes = 40", "episodes = 1000, checkpoint_interval = 200"));
    let id = &experiment.plan.cells[0].id;
    let document =
        |name: &str| Folder::new(&experiment.out(name)).cell(id).training().join("checkpoint/checkpoint.json");
    let child = experiment.command("same", &["--cell", "0"]).spawn().expect("started");
    wait_for("a checkpoint", || document("same").exists());
    kill_all(child);
    assert!(experiment.results("same").is_empty(), "killed before the end");
    let copied = Command::new("cp").arg("-a").args([experiment.out("same"), experiment.out("other")]).status();
    assert!(copied.expect("cp").success());
    let text = std::fs::read_to_string(document("other")).expect("a checkpoint");
    assert_eq!(text.matches(perturb_study::VERSION).count(), 1, "{text}");
    std::fs::write(document("other"), text.replace(perturb_study::VERSION, "0.0.9 (abc)")).expect("written");

    for name in ["same", "other", "whole"] {
        succeeded(&experiment.run(name, &["--cell", "0"]));
    }
    assert_eq!(experiment.results("same"), experiment.results("whole"), "as if it had not been broken off");
    assert!(!String::from_utf8_lossy(&experiment.results("whole")[id]).contains("earlier_commits"));
    let other = experiment.cell_result("other", 0);
    assert_eq!(other.earlier_commits, ["0.0.9 (abc)"]);
    let whole = experiment.cell_result("whole", 0);
    assert_eq!(CellResult { earlier_commits: Vec::new(), ..*other }, *whole);
}

#[test]
fn a_signal_stops_the_workers_and_the_same_command_goes_on() {
    let experiment = Experiment::new(&PLAN.replace("episodes = 40", "episodes = 100"));
    for (name, code) in [("-INT", 130), ("-TERM", 143)] {
        let begun: usize = experiment.attempts("out").iter().sum();
        let child = experiment.command("out", &["--jobs", "2"]).spawn().expect("started");
        let id = child.id();
        wait_for("trainings", || experiment.attempts("out").iter().sum::<usize>() > begun);
        let started = children(id);
        signal(name, id);
        let output = child.wait_with_output().expect("ended");
        assert_eq!(output.status.code(), Some(code), "{}", stderr(&output));
        assert!(stderr(&output).contains("the same command goes on"));
        wait_for("the end of what the run started", || !started.iter().any(|&id| is_running(id)));
    }
    succeeded(&experiment.run("out", &[]));
    assert_eq!(experiment.results("out").len(), experiment.plan.cells.len());
}

#[test]
fn a_lost_server_is_no_cells_failure() {
    let experiment = Experiment::new(&PLAN.replace("episodes = 40", "episodes = 100000"));
    let options = Some(1);
    let server = PrivateServer::start(options).unwrap_or_else(|error| panic!("{error}"));
    let address = server.address().to_string();
    let child = experiment.command("out", &["--jobs", "2", "--server", &address]).spawn().expect("started");
    let progress = experiment.out("out/cells").join(&experiment.plan.cells[0].id).join("training/progress.csv");
    wait_for("a training", || progress.exists());
    signal("-KILL", server.process_id());
    let output = child.wait_with_output().expect("ended");
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("cannot go on without a server"), "{}", stderr(&output));
    let folder = Folder::new(&experiment.out("out"));
    assert!(experiment.plan.cells.iter().all(|cell| !folder.cell(&cell.id).is_settled(true)));

    let one = experiment.run("out", &["--cell", "0", "--server", &address]);
    assert_eq!(one.status.code(), Some(69), "{}", stderr(&one));
}

#[test]
fn a_cell_that_somebody_works_on_is_left_alone() {
    let experiment = Experiment::new(PLAN);
    let place = Folder::new(&experiment.out("out")).cell(&experiment.plan.cells[0].id);
    let lock = place.try_lock().expect("a file").expect("a lock");
    let output = experiment.run("out", &["--cell", "0"]);
    assert_eq!(output.status.code(), Some(75), "{}", stderr(&output));
    drop(lock);
    succeeded(&experiment.run("out", &["--cell", &experiment.plan.cells[0].id]));
    assert_eq!(experiment.results("out").len(), 1);
}

#[test]
fn a_wrong_command_is_refused_before_anything_is_done() {
    let experiment = Experiment::new(&PLAN.replace("'Pendulum'", "'Pendulums'"));
    let output = experiment.run("out", &[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("no environment `Pendulums`"), "{}", stderr(&output));
    assert!(!experiment.out("out").exists());
    let output = experiment.run("out", &["--cell", "8"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("give an index from 0 to 7"), "{}", stderr(&output));
    let wrong: [&[&str]; 7] = [
        &["--cell", "1,2", "--exit-with-stdin"],
        &["--cell", "1,8"],
        &["--leave-plan"],
        &["--time", "5"],
        &["--engine", "slurm", "--time", "5m"],
        &["--engine", "slurm", "--cells-per-job", "1001"],
        &["--engine", "slurm", "--cell", "1"],
    ];
    for arguments in wrong {
        let output = experiment.run("out", arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", stderr(&output));
    }
    assert!(!experiment.out("out").exists());
}

#[test]
fn several_cells_are_done_and_the_missing_ones_listed() {
    let experiment = Experiment::new(PLAN);
    let ids: Vec<&str> = experiment.plan.cells.iter().map(|cell| cell.id.as_str()).collect();
    let plan = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
        command
            .arg("plan")
            .arg(experiment.out("file.toml"))
            .args(arguments)
            .arg("--missing")
            .arg(experiment.out("out"));
        let output = command.output().expect("ended");
        succeeded(&output);
        String::from_utf8(output.stdout).expect("text")
    };
    assert_eq!(plan(&[]).lines().count(), 8);
    succeeded(&experiment.run("out", &["--cell", &format!("1,{}", ids[3]), "--jobs", "2"]));
    let results = experiment.results("out");
    assert!(results.len() == 2 && results.contains_key(ids[1]) && results.contains_key(ids[3]));
    let mut attempts = [0; 8];
    (attempts[1], attempts[3]) = (1, 1);
    assert_eq!(experiment.attempts("out"), attempts, "in worker processes");
    let lines = plan(&[]);
    let first: Vec<String> = lines.lines().take(2).map(|line| line.trim().replace("  ", " ")).collect();
    assert_eq!(first, [format!("0 {}", ids[0]), format!("2 {}", ids[2])]);
    let listed: serde_json::Value = serde_json::from_str(&plan(&["--json"])).expect("JSON");
    assert_eq!(listed.as_array().map(Vec::len), Some(6));
    assert_eq!(listed[1], serde_json::json!({ "index": 2, "id": ids[2] }));

    // The folder's plan stays if it is told to.
    let kept = || std::fs::read_to_string(experiment.out("out/plan.toml")).expect("a plan");
    let before = kept();
    std::fs::write(experiment.out("file.toml"), format!("{PLAN}\n# extended")).expect("written");
    succeeded(&experiment.run("out", &["--cell", "0", "--leave-plan", "--jobs", "1"]));
    assert_eq!(kept(), before);
    succeeded(&experiment.run("out", &["--cell", "0"]));
    assert_ne!(kept(), before);
}

fn shipped(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../experiments").join(name)
}

#[test]
fn the_shipped_files_ask_for_what_they_say() {
    let paper = Plan::load(&shipped("paper.toml")).unwrap_or_else(|error| panic!("{error}")).counts();
    let expected = Counts { configurations: 183, trainings: 3_294, pairs: 9_882, all_pairs: 49_410, runs: 5 };
    assert_eq!(paper, expected);
    for (name, configurations, trainings) in
        [("quick.toml", 3, 18), ("classic.toml", 4, 24), ("locomotion.toml", 2, 12), ("rl2-n.toml", 189, 3402)]
    {
        let counts = Plan::load(&shipped(name)).unwrap_or_else(|error| panic!("{error}")).counts();
        assert_eq!((counts.configurations, counts.trainings), (configurations, trainings), "{name}");
    }
}

#[test]
fn plan_prints_the_papers_counts_and_an_estimate_from_measurements() {
    let perturb = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_perturb")).args(arguments).output().expect("ended");
        succeeded(&output);
        String::from_utf8(output.stdout).expect("text")
    };
    let paper = shipped("paper.toml").display().to_string();
    let counts = "183 configurations, 3 294 trainings, 9 882 train/test pairs, 49 410 with 5 runs\n";
    assert_eq!(perturb(&["plan", &paper, "--measure", "0"]), counts);

    let experiment = Experiment::new(PLAN);
    let file = experiment.out("file.toml").display().to_string();
    let text = perturb(&["plan", &file, "--cells", "--measure", "1"]);
    for cell in &experiment.plan.cells {
        assert!(text.contains(&format!("{:>6} {}\n", cell.index, cell.id)), "{text}");
    }
    assert!(text.contains("2 configurations, 8 trainings, 16 train/test pairs, 16 with 1 run"), "{text}");
    // 40 episodes of 200 steps in each of 8 trainings, 12 in each of 16 tests.
    assert!(text.contains("6.40e4 steps of training, 3.84e4 of testing"), "{text}");
    assert!(text.contains("measured: 2 trainings") && text.contains("which takes"), "{text}");
}

#[test]
fn a_report_is_the_same_however_often_the_run_was_broken_off() {
    let experiment = Experiment::new(&PLAN.replace("test_versions = ['D', 'R']", "test_versions = ['D', 'E']"));
    let report = |name: &str| {
        let page = experiment.out("page.html");
        let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
        command.arg("report").arg(experiment.out(name)).arg("--html").arg(&page);
        let output = command.output().expect("ended");
        succeeded(&output);
        let mut files = BTreeMap::from([("text".to_owned(), output.stdout)]);
        for entry in std::fs::read_dir(experiment.out(name).join("report")).expect("a folder") {
            let entry = entry.expect("an entry");
            files.insert(entry.file_name().to_string_lossy().into_owned(), std::fs::read(entry.path()).expect("read"));
        }
        files.insert("page".into(), std::fs::read(page).expect("a page"));
        files
    };
    succeeded(&experiment.run("whole", &["--jobs", "1"]));
    let child = experiment.command("killed", &["--jobs", "2"]).spawn().expect("started");
    wait_for("a result", || !experiment.results("killed").is_empty());
    kill_all(child);
    let partial = report("killed");
    let text = String::from_utf8_lossy(&partial["text"]).into_owned();
    assert!(text.contains("are missing.") && text.matches("missing").count() > 5, "{text}");
    succeeded(&experiment.run("killed", &["--jobs", "2"]));
    let (whole, killed) = (report("whole"), report("killed"));
    assert_eq!(whole.keys().collect::<Vec<_>>(), killed.keys().collect::<Vec<_>>());
    for (name, content) in &whole {
        assert!(*content == killed[name], "{name} differs");
    }

    let page = String::from_utf8_lossy(&whole["page"]).into_owned();
    assert!(page.matches("<svg").count() == 4 && page.matches("<table").count() == 7, "every picture and table");
    assert!(!page.contains("<script") && !page.contains("src=") && !page.contains("@import"), "it needs nothing else");
    let links: Vec<&str> = page.split("href=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    let inside = |link: &&str| link.strip_prefix('#').is_some_and(|id| page.contains(&format!(" id=\"{id}\"")));
    assert!(links.len() > 10 && links[0] == "data:," && links[1..].iter().all(inside), "{links:?}");
    let metrics = String::from_utf8_lossy(&whole["metrics.csv"]).into_owned();
    // Nothing was trained on R: Interpolation and Extrapolation are empty, not 0.
    assert!(metrics.lines().any(|line| line == "CartPole,a2c,ff,,Interpolation,0,,,100,0,"), "{metrics}");
}

#[test]
fn a_run_writes_its_report_when_nothing_is_left_to_do() {
    let experiment = Experiment::new(&PLAN.replace("7e-3, 7e-4", "1e38, 7e-4"));
    let (page, again) = (experiment.out("pages/page.html"), experiment.out("again.html"));
    let output = experiment.run("out", &["--html", page.to_str().expect("a path")]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    assert!(stderr(&output).contains("4 of 8 cells failed") && stderr(&output).contains("the report is in"));
    let table = experiment.out("out/report/metrics.csv");
    let written = [&page, &table].map(|path| std::fs::read(path).expect("a file"));
    assert!(String::from_utf8_lossy(&written[0]).contains("</html>"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
    succeeded(&command.arg("report").arg(experiment.out("out")).arg("--html").arg(&again).output().expect("ended"));
    assert!([&again, &table].map(|path| std::fs::read(path).expect("a file")) == written, "the same report");
    let names = std::fs::read_dir(experiment.out("pages")).expect("a folder").count();
    assert_eq!(names, 1, "nothing temporary stays");
}

#[test]
fn a_heatmap_is_drawn_of_two_parameters_and_others_are_refused() {
    let experiment = Experiment::new(PLAN);
    succeeded(&experiment.run("out", &["--cell", "0"]));
    let training = Folder::new(&experiment.out("out")).cell(&experiment.plan.cells[0].id).training();
    let elsewhere = tempfile::tempdir().expect("a directory");
    let draw = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
        command.args(["heatmap", "--grid", "3", "--episodes", "2", "--checkpoint"]).arg(&training).args(arguments);
        command.current_dir(elsewhere.path()).output().expect("ended")
    };
    let names = |directory: &Path| -> BTreeSet<String> {
        let entries = std::fs::read_dir(directory).expect("a folder");
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect()
    };
    let before = names(&training);
    let output = draw(&["--x", "force", "--y", "length"]);
    succeeded(&output);
    let files = ["csv", "png", "svg"].map(|ending| format!("CartPole-a2c-ff-D-s1-force-length.{ending}"));
    assert_eq!(names(elsewhere.path()), BTreeSet::from(files), "in the working directory");
    assert_eq!(names(&training), before, "and nothing in the training's folder");
    let read = |ending: &str| {
        std::fs::read(elsewhere.path().join(format!("CartPole-a2c-ff-D-s1-force-length{ending}"))).expect("a file")
    };
    let table = String::from_utf8(read(".csv")).expect("text");
    let rows: Vec<Vec<f64>> = table
        .lines()
        .skip(1)
        .map(|line| line.split(',').map(|field| field.parse().expect("a number")).collect())
        .collect();
    assert_eq!(table.lines().next(), Some("force,length,mean_return,success_percent"));
    assert_eq!(rows.len(), 9);
    // E's force is 1 … 20: three parts, whose middles are 4.17, 10.5 and 16.83.
    assert!((rows[0][0] - (1.0 + 19.0 / 6.0)).abs() < 1e-12 && rows[1][0] == 10.5 && rows[3][0] == rows[0][0]);
    assert!(rows.iter().all(|row| row[2] >= 1.0), "a step pays 1");
    assert!(String::from_utf8(read(".svg")).expect("text").starts_with("<svg") && read(".png").starts_with(b"\x89PNG"));
    assert_eq!(draw(&["--x", "force", "--y", "length"]).status.code(), Some(0));
    assert_eq!(String::from_utf8(read(".csv")).expect("text"), table, "the same again");

    for (x, y) in [("force", "force"), ("force", "colour")] {
        let output = draw(&["--x", x, "--y", y]);
        assert_eq!(output.status.code(), Some(1));
        let message = stderr(&output);
        assert!(
            message.contains(&format!("`{y}` cannot be an axis")) && message.contains("force, length, mass"),
            "{message}"
        );
    }
    succeeded(&draw(&["--out", "usual"]));
    let table = std::fs::read_to_string(elsewhere.path().join("usual.csv")).expect("a table");
    assert!(table.starts_with("length,mass,"), "CartPole's usual parameters: {table}");
    assert_eq!(draw(&["--x", "force"]).status.code(), Some(2), "one parameter is not enough");
}

#[test]
fn heatmaps_of_an_experiment_are_made_once_and_are_in_its_report() {
    let experiment = Experiment::new(&PLAN.replace("['D', 'R']", "['D', 'E']"));
    succeeded(&experiment.run("out", &["--jobs", "2"]));
    let out = experiment.out("out");
    let heatmaps = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
        command.arg("heatmap").arg(&out).args(["--grid", "2", "--episodes", "1"]).args(arguments);
        let output = command.output().expect("ended");
        succeeded(&output);
        (String::from_utf8_lossy(&output.stdout).lines().count(), stderr(&output).matches("is there already").count())
    };
    let page = |name: &str| {
        let path = experiment.out(name);
        let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
        succeeded(&command.arg("report").arg(&out).arg("--html").arg(&path).output().expect("ended"));
        std::fs::read_to_string(path).expect("a page")
    };
    let embedded = |page: &str| page.matches("<img ").count();
    let without = page("without.html");
    assert_eq!(embedded(&without), 0);
    assert!(without.contains("not there: 4 of 4. <code>perturb heatmap DIR</code> makes them"));

    // Two environments, trained on D and on E; the better of two configurations.
    assert_eq!(heatmaps(&[]), (4, 0));
    assert_eq!(heatmaps(&[]), (0, 4), "made once");
    let with = page("with.html");
    assert_eq!(embedded(&with), 4);
    assert!(!with.contains("not there") && !with.contains("src=\"http") && !with.contains("<script"));
    assert_eq!(with, page("again.html"), "the same folder, the same bytes");
    let files = || -> BTreeMap<PathBuf, Vec<u8>> {
        let entries = std::fs::read_dir(out.join("heatmaps")).expect("a folder");
        let paths = entries.map(|entry| entry.expect("an entry").path());
        paths.map(|path| (path.clone(), std::fs::read(path).expect("read"))).collect()
    };
    let first = files();
    assert_eq!(first.len(), 16, "three files and a record of each");

    // Half a picture does not count, nor one of a result that has been replaced.
    let (damaged, _) =
        first.iter().find(|(path, _)| path.extension().is_some_and(|ending| ending == "png")).expect("one");
    std::fs::write(damaged, b"\x89PNG").expect("written");
    assert_eq!(embedded(&page("damaged.html")), 3);
    assert_eq!(heatmaps(&[]), (1, 3));
    assert_eq!(files(), first, "the same bytes again");
    let id = damaged.file_stem().expect("a name").to_string_lossy().into_owned();
    let result = Folder::new(&out).cell(&id).path().join("result.json");
    let text = std::fs::read_to_string(&result).expect("a result");
    std::fs::write(&result, text.replace("\"command\": \"perturb", "\"command\": \"/bin/perturb")).expect("written");
    let outdated = page("outdated.html");
    assert!(embedded(&outdated) == 3 && outdated.contains("the heatmap is of an earlier result"));
    assert_eq!(heatmaps(&["--seed", "2"]), (4, 0), "other settings, other heatmaps");

    // Without the checkpoint that a result came from there is none, and the others are made.
    std::fs::remove_dir_all(Folder::new(&out).cell(&id).training()).expect("deleted");
    let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
    let output = command.arg("heatmap").arg(&out).args(["--grid", "2", "--episodes", "1"]).output().expect("ended");
    assert_eq!(output.status.code(), Some(1));
    assert!(
        stderr(&output).contains("holds no checkpoint") && stderr(&output).contains("1 of 4 heatmaps"),
        "{output:?}"
    );
    assert_eq!(String::from_utf8_lossy(&output.stdout).lines().count(), 3);

    let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
    let both = command.arg("heatmap").arg(&out).args(["--x", "force", "--y", "mass"]).output().expect("ended");
    assert_eq!(both.status.code(), Some(2), "an experiment has its environments' usual parameters");
}

#[test]
fn curves_of_two_learners_are_drawn_and_written() {
    let plan = "environments = ['CartPole']\nversions = ['D']\ntest_versions = ['D']\ntest_episodes = 4
        settings = { episodes = 40, num_envs = 4 }
        [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
    let experiment = Experiment::new(plan);
    succeeded(&experiment.run("out", &["--jobs", "2"]));
    let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
    let output = command.arg("curves").arg(experiment.out("out")).output().expect("ended");
    succeeded(&output);
    let report = experiment.out("out").join("report");
    for quantity in ["return", "success"] {
        let read = |ending: &str| {
            let name = format!("CartPole-{quantity}.{ending}");
            std::fs::read(report.join(&name)).unwrap_or_else(|error| panic!("{name}: {error}"))
        };
        let picture = String::from_utf8(read("svg")).expect("text");
        assert!(picture.starts_with("<svg") && picture.contains("a2c") && picture.contains("ppo"));
        assert!(read("png").starts_with(b"\x89PNG"));
    }
    let table = std::fs::read_to_string(report.join("curves.csv")).expect("a table");
    let lines_of = |name: &str| table.lines().filter(|line| line.contains(name)).count();
    assert!(lines_of("a2c") >= 2 && lines_of("a2c") == lines_of("ppo"), "{table}");
}
