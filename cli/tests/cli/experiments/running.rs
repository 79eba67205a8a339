//! A run finishes each of its cells exactly once, in spite of interruptions.

use std::path::{Path, PathBuf};
use std::process::{Child, Command};

use perturb_experiment::{CellResult, CellState, Counts, ExperimentFolder, Plan};
use perturb_learner::client::PrivateServer;

use super::{Experiment, PLAN, children, kill_all, succeeded};
use crate::common::{child_server, ended, is_running, kill, perturb, stderr, wait_for};

#[test]
fn results_do_not_depend_on_jobs_groups_or_kills() {
    let experiment = Experiment::new(PLAN);
    let cells = experiment.plan.cells.len();
    succeeded(&experiment.run("whole", &["--jobs", "1", "--group", "1"]));
    let whole = experiment.results("whole");
    assert_eq!(whole.len(), cells);
    assert_eq!(experiment.attempts("whole"), vec![1; cells]);

    for (done, jobs, group) in [(0, "2", "36"), (2, "2", "1"), (4, "1", "3")] {
        let child = experiment.command("killed", &["--jobs", jobs, "--group", group]).spawn().expect("started");
        let begun = || experiment.attempts("killed").iter().sum::<usize>() > 0;
        wait_for("a few results", || begun() && experiment.results("killed").len() >= done);
        kill_all(child);
        assert!(experiment.results("killed").len() < cells, "killed before the end");
    }
    succeeded(&experiment.run("killed", &["--jobs", "1"]));
    assert_eq!(experiment.results("killed"), whole);
    let folder = ExperimentFolder::new(&experiment.out("killed"));
    let unfinished = |id: &str| {
        let entries = std::fs::read_dir(folder.cell(id).path()).expect("a folder");
        entries
            .filter(|entry| entry.as_ref().is_ok_and(|entry| entry.file_name().to_string_lossy().starts_with(".tmp")))
    };
    assert!(experiment.plan.cells.iter().all(|cell| unfinished(&cell.id).count() == 0));
}

#[test]
fn a_group_finishes_although_its_process_is_killed() {
    let experiment = Experiment::new(PLAN);
    let cells = ["--cell", "0,1,2"];
    succeeded(&experiment.run("whole", &[&cells[..], &["--group", "1"]].concat()));
    let told = experiment.out("told.jsonl");
    let mut command = experiment.command("out", &[&cells[..], &["--jobs", "1", "--json"]].concat());
    let run = command.stdout(std::fs::File::create(&told).expect("a file")).spawn().expect("started");
    let worker = || children(run.id()).into_iter().find(|&id| Some(id) != child_server(run.id()));
    wait_for("a training", || experiment.attempts("out").iter().sum::<usize>() > 0);
    kill("-KILL", worker().expect("a worker"));
    succeeded(&ended(run));
    assert_eq!(experiment.results("out"), experiment.results("whole"));

    let told = std::fs::read_to_string(told).expect("lines");
    let killed = told.matches(r#""event":"killed","reason":"its process ended with signal: 9 (SIGKILL)"#).count();
    assert!((1..=3).contains(&killed), "{told}");
    let place = |cell: usize| ExperimentFolder::new(&experiment.out("out")).cell(&experiment.plan.cells[cell].id);
    let first = &experiment.plan.cells[0].id;
    let log = std::fs::read_to_string(place(2).log()).expect("a log");
    assert!(log.starts_with(&format!("runs in one process with {first}: see ../{first}/log.txt\n")), "{log}");
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
        let output = perturb(&arguments).args(more).output().expect("ended");
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
        succeeded(&ended(run));
    }
    let cells = experiment.plan.cells.len();
    assert_eq!(experiment.results("out").len(), cells);
    assert_eq!(experiment.attempts("out"), vec![1; cells]);
}

#[test]
fn a_failed_cell_has_a_reason_and_the_others_run() {
    let experiment = Experiment::new(&PLAN.replace("7e-3, 7e-4", "1e38, 7e-4"));
    let output = experiment.run("out", &["--jobs", "2"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("4 of 8 cells failed") && stderr(&output).contains("--retry-failed"));
    assert_eq!(experiment.results("out").len(), 4);
    let failed =
        experiment.plan.cells.iter().find(|cell| cell.config.table()["learning_rate"].as_float() == Some(1e38));
    let failed = failed.expect("a cell");
    let out = experiment.out("out").display().to_string();
    let Ok(CellState::Failed(failure)) = ExperimentFolder::new(&experiment.out("out")).state(failed) else { panic!() };
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

/// Two simultaneous runs with --retry-failed run each failed cell only once in total.
#[test]
fn two_simultaneous_retries_run_each_cell_once() {
    let experiment = Experiment::new(&PLAN.replace("7e-3, 7e-4", "1e38, 2e38"));
    let cells = experiment.plan.cells.len();
    assert_eq!(experiment.run("out", &["--jobs", "2"]).status.code(), Some(1));
    assert_eq!(experiment.attempts("out"), vec![1; cells]);
    let folder = ExperimentFolder::new(&experiment.out("out"));
    let held: Vec<_> = experiment.plan.cells.iter().map(|cell| folder.cell(&cell.id).try_lock()).collect();
    let told = [0, 1].map(|run| experiment.out(&format!("{run}.jsonl")));
    let run = |told: &PathBuf| {
        let mut command = experiment.command("out", &["--jobs", "2", "--retry-failed", "--json"]);
        command.stdout(std::fs::File::create(told).expect("a file")).spawn().expect("started")
    };
    let runs: Vec<Child> = told.iter().map(run).collect();
    // Wait until both runs have seen the failures, and each has started a worker that found its cell locked.
    let busy = |told: &PathBuf| std::fs::read_to_string(told).is_ok_and(|text| text.contains(r#""event":"busy""#));
    wait_for("two runs", || told.iter().all(busy));
    drop(held);
    for run in runs {
        let output = ended(run);
        assert!(output.status.code() == Some(1) && stderr(&output).contains("8 of 8 cells failed"), "{output:?}");
    }
    assert_eq!(experiment.attempts("out"), vec![2; cells]);
}

#[test]
fn a_result_names_the_program_that_began_the_training() {
    let experiment = Experiment::new(&PLAN.replace("episodes = 40", "episodes = 1000, checkpoint_interval = 200"));
    let id = &experiment.plan.cells[0].id;
    let document = |name: &str| {
        ExperimentFolder::new(&experiment.out(name)).cell(id).training().join("checkpoint/checkpoint.json")
    };
    let child = experiment.command("same", &["--cell", "0"]).spawn().expect("started");
    wait_for("a checkpoint", || document("same").exists());
    kill_all(child);
    assert!(experiment.results("same").is_empty(), "killed before the end");
    let copied = Command::new("cp").arg("-a").args([experiment.out("same"), experiment.out("other")]).status();
    assert!(copied.expect("cp").success());
    let text = std::fs::read_to_string(document("other")).expect("a checkpoint");
    assert_eq!(text.matches(perturb_experiment::VERSION).count(), 1, "{text}");
    // Earlier versions wrote no checksum.
    let mut earlier: serde_json::Value =
        serde_json::from_str(&text.replace(perturb_experiment::VERSION, "0.0.9 (abc)")).expect("JSON");
    earlier["format_version"] = 2.into();
    earlier.as_object_mut().expect("entries").remove("crc32c");
    std::fs::write(document("other"), earlier.to_string()).expect("written");

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
fn a_signal_stops_the_workers_and_the_run_resumes() {
    let experiment = Experiment::new(&PLAN.replace("episodes = 40", "episodes = 100"));
    for (name, code) in [("-INT", 130), ("-TERM", 143)] {
        let begun: usize = experiment.attempts("out").iter().sum();
        let child = experiment.command("out", &["--jobs", "2"]).spawn().expect("started");
        let id = child.id();
        wait_for("trainings", || experiment.attempts("out").iter().sum::<usize>() > begun);
        let started = children(id);
        kill(name, id);
        let output = ended(child);
        assert_eq!(output.status.code(), Some(code), "{}", stderr(&output));
        assert!(stderr(&output).contains("resume with: perturb run"));
        wait_for("the end of what the run started", || !started.iter().any(|&id| is_running(id)));
    }
    succeeded(&experiment.run("out", &[]));
    assert_eq!(experiment.results("out").len(), experiment.plan.cells.len());
}

#[test]
fn a_lost_server_is_no_cells_failure() {
    let experiment = Experiment::new(&PLAN.replace("episodes = 40", "episodes = 100000"));
    let server = PrivateServer::start(Some(1)).unwrap_or_else(|error| panic!("{error}"));
    let address = server.address().to_string();
    let mut command = experiment.command("out", &["--jobs", "2", "--server", &address, "--server-wait", "0"]);
    let child = command.spawn().expect("started");
    let progress = experiment.out("out/cells").join(&experiment.plan.cells[0].id).join("training/progress.csv");
    wait_for("a training", || progress.exists());
    kill("-KILL", server.process_id());
    let output = ended(child);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("cannot continue without a server"), "{}", stderr(&output));
    let folder = ExperimentFolder::new(&experiment.out("out"));
    assert!(experiment.plan.cells.iter().all(|cell| !folder.cell(&cell.id).is_settled(true)));

    let one = experiment.run("out", &["--cell", "0", "--server", &address]);
    assert!(one.status.code() == Some(2) && stderr(&one).contains("no server answers at"), "{}", stderr(&one));
}

#[test]
fn a_run_restarts_its_private_server_with_same_results() {
    let experiment = Experiment::new(&PLAN.replace("episodes = 40", "episodes = 1000, checkpoint_interval = 20"));
    succeeded(&experiment.run("undisturbed", &["--jobs", "2"]));
    let child = experiment.command("out", &["--jobs", "1"]).spawn().expect("started"); // one job uses one server
    let cell = experiment.out("out/cells").join(&experiment.plan.cells[0].id);
    let checkpoint = || std::fs::read(cell.join("training/checkpoint/checkpoint.json")).ok();
    let mut killed = None;
    let mut at_its_end = None;
    for _ in 0..2 {
        // The checkpoint differs once the training continues on the next server.
        wait_for("a checkpoint", || checkpoint().is_some_and(|it| at_its_end.as_ref() != Some(&it)));
        let mut server = None;
        wait_for("a private server", || {
            server = child_server(child.id()).filter(|&id| is_running(id) && Some(id) != killed);
            server.is_some()
        });
        kill("-KILL", server.expect("a private server"));
        (killed, at_its_end) = (server, Some(checkpoint().expect("a checkpoint")));
    }
    let output = ended(child);
    succeeded(&output);
    let said = stderr(&output);
    assert_eq!(said.matches("the private server ended with signal: 9 (SIGKILL); it was restarted").count(), 2);
    assert_eq!(experiment.results("out"), experiment.results("undisturbed"));
}

#[test]
fn locked_cells_are_skipped_until_the_lock_is_free() {
    let experiment = Experiment::new(PLAN);
    let place = ExperimentFolder::new(&experiment.out("out")).cell(&experiment.plan.cells[0].id);
    let lock = place.try_lock().expect("a file").expect("a lock");
    let told = experiment.out("told.jsonl");
    let mut command = experiment.command("out", &["--cell", "0", "--json"]);
    let run = command.stdout(std::fs::File::create(&told).expect("a file")).spawn().expect("started");
    let told = || std::fs::read_to_string(&told).expect("lines");
    wait_for("a worker", || told().contains(r#""event":"busy""#));
    drop(lock);
    succeeded(&ended(run));
    assert_eq!((experiment.results("out").len(), told().matches(r#""event":"done""#).count()), (1, 1));
}

#[test]
fn a_wrong_command_is_refused_at_the_start() {
    let experiment = Experiment::new(&PLAN.replace("'Pendulum'", "'Pendulums'"));
    let output = experiment.run("out", &[]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("no environment \"Pendulums\" (did you mean `Pendulum`?)"), "{}", stderr(&output));
    assert!(!experiment.out("out").exists());
    let output = experiment.run("out", &["--cell", "8"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("give an index from 0 to 7"), "{}", stderr(&output));
    let wrong: [&[&str]; 8] = [
        &["--cell", "1,8"],
        &["--worker"],
        &["--worker", "--server", "unix:/x", "--jobs", "2"],
        &["--engine", "slurm", "--json"],
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
fn named_cells_run_and_unfinished_ones_are_listed() {
    let experiment = Experiment::new(PLAN);
    let ids: Vec<&str> = experiment.plan.cells.iter().map(|cell| cell.id.as_str()).collect();
    let plan = |arguments: &[&str]| {
        let mut command = perturb(&["plan"]);
        command.arg(experiment.out("file.toml")).args(arguments).arg("--unfinished-in").arg(experiment.out("out"));
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

    // With --cell the run does not replace the plan in the folder, because its own plan may be older.
    let kept = || std::fs::read_to_string(experiment.out("out/plan.toml")).expect("a plan");
    std::fs::write(experiment.out("file.toml"), format!("{PLAN}\n# extended")).expect("written");
    for arguments in [&["--cell", "0", "--jobs", "1"][..], &["--cell", "0"]] {
        succeeded(&experiment.run("out", arguments));
        assert_eq!(kept(), PLAN);
    }
    succeeded(&experiment.run("out", &["--jobs", "2"]));
    assert_ne!(kept(), PLAN);
}

#[test]
fn a_run_tells_what_happens_to_each_cell() {
    let experiment = Experiment::new(PLAN);
    let output = experiment.run("out", &["--cell", "1,2", "--json"]);
    succeeded(&output);
    let text = String::from_utf8(output.stdout).expect("text");
    let lines: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    for cell in &experiment.plan.cells[1..=2] {
        let of_cell = lines.iter().filter(|line| line["cell"] == *cell.id);
        let mut events: Vec<&str> = of_cell.filter_map(|line| line["event"].as_str()).collect();
        events.dedup();
        assert_eq!(events, ["server", "training", "testing", "done"], "{text}");
    }
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
        [("quick.toml", 2, 6), ("classic.toml", 4, 24), ("locomotion.toml", 4, 24), ("rl2-n.toml", 189, 3402)]
    {
        let counts = Plan::load(&shipped(name)).unwrap_or_else(|error| panic!("{error}")).counts();
        assert_eq!((counts.configurations, counts.trainings), (configurations, trainings), "{name}");
    }
}

#[test]
fn plan_prints_counts_and_an_estimate() {
    let printed = |arguments: &[&str]| {
        let output = perturb(arguments).output().expect("ended");
        succeeded(&output);
        String::from_utf8(output.stdout).expect("text")
    };
    let paper = shipped("paper.toml").display().to_string();
    let counts = "183 configurations, 3 294 trainings, 9 882 train/test pairs, 49 410 with 5 runs\n\
                  16 470 cells in 468 groups of 33 to 36, 2 at a time\n";
    assert_eq!(printed(&["plan", &paper, "--measure", "0", "--jobs", "2"]), counts);

    let experiment = Experiment::new(PLAN);
    let file = experiment.out("file.toml").display().to_string();
    let text = printed(&["plan", &file, "--cells", "--measure", "1", "--jobs", "2"]);
    for cell in &experiment.plan.cells {
        assert!(text.contains(&format!("{:>6} {}\n", cell.index, cell.id)), "{text}");
    }
    assert!(text.contains("2 configurations, 8 trainings, 16 train/test pairs, 16 with 1 run"), "{text}");
    // 40 episodes of 200 steps in each of 8 trainings, 12 in each of 16 tests.
    assert!(text.contains("6.40e4 steps of training, 3.84e4 of testing"), "{text}");
    assert!(text.contains("8 cells in 4 groups of 2, 2 at a time") && text.contains("measured: 2 groups"), "{text}");
    assert!(text.contains("at most, if every episode") && text.contains(" with --jobs 2\n"), "{text}");

    // The durations of finished cells are used for other cells of the same kind.
    succeeded(&experiment.run("out", &["--cell", "0"]));
    let out = experiment.out("out").display().to_string();
    let text = printed(&["plan", &file, "--measure", "1", "--timings-from", &out]);
    let from = format!("\nby the durations of 1 finished cell of the same environment and method in {out}: 4 cells, ");
    assert!(text.contains(&from) && text.contains("measured: 1 group for"), "{text}");
    let unfinished = format!("\nunfinished in {out}, 7 cells: ");
    assert!(text.contains("until the step limit: 4 cells") && text.contains(&unfinished), "{text}");
}
