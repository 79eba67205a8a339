//! Interrupted trainings give the same bytes after they are resumed.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Child;
use std::time::Duration;

use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::{Checkpoint, ResumeState};
use perturb_learner::client::{ClientError, ClientSession, OpenOptions, Servers, StepReply};
use perturb_learner::evaluation::{TestOptions, Tester};
use perturb_learner::training::{RunDirectory, TrainOutcome, resume, train};
use perturb_protocol::Version;

use crate::common::{
    addresses, child_server, config, ended, kill, perturb, read, refusal, run, server, stderr, wait_for,
};
use insta::assert_snapshot;
use serde_json::Value;
use tempfile::TempDir;

/// Settings of trainings with A2C, PPO, EPOpt and RL², both architectures, discrete and continuous actions, and MuJoCo.
/// Rollouts end within episodes, except with EPOpt. Checkpoints are frequent. If `log_interval` is above 1, some of
/// them fall between two lines of progress.csv.
const RUNS: [&str; 9] = [
    "environment = 'CartPole'\nversion = 'E'\nalgorithm = 'a2c'\nepisodes = 90\nnum_envs = 5\nn_steps = 5\nlog_interval = 3\n\
     checkpoint_interval = 7",
    "environment = 'CartPole'\nversion = 'R'\nepisodes = 60\nnum_envs = 4\nn_steps = 32\nn_epochs = 2\n\
     n_minibatches = 4\nlog_interval = 2\ncheckpoint_interval = 7",
    "environment = 'CartPole'\nversion = 'R'\narchitecture = 'rc'\nepisodes = 18\nnum_envs = 4\nn_steps = 15\n\
     n_epochs = 2\nn_minibatches = 2\nlog_interval = 2\ncheckpoint_interval = 4",
    "environment = 'CartPole'\narchitecture = 'rc'\nalgorithm = 'a2c'\nepisodes = 15\nnum_envs = 3\nn_steps = 7\n\
     log_interval = 4\ncheckpoint_interval = 2",
    "environment = 'CartPole'\nversion = 'R'\nalgorithm = 'epopt-ppo'\nepisodes = 30\nnum_envs = 3\n\
     episodes_per_iteration = 5\nepsilon = 0.4\nfull_iterations = 2\nn_epochs = 2\nlog_interval = 2\n\
     checkpoint_interval = 3",
    "environment = 'CartPole'\nversion = 'E'\nalgorithm = 'rl2-a2c'\nepisodes = 20\nnum_envs = 3\nn_steps = 11\n\
     log_interval = 4\ncheckpoint_interval = 3",
    "environment = 'Pendulum'\nversion = 'R'\nalgorithm = 'rl2-ppo'\nepisodes = 9\nepisodes_per_trial = 3\n\
     num_envs = 3\nn_steps = 70\nn_epochs = 2\nkl_coef = 0.2\ncheckpoint_interval = 1",
    "environment = 'Pendulum'\nversion = 'E'\nepisodes = 9\nnum_envs = 3\nn_steps = 70\nn_epochs = 2\n\
     n_minibatches = 3\ncheckpoint_interval = 1",
    "environment = 'Hopper'\nversion = 'R'\nepisodes = 15\nnum_envs = 3\nn_steps = 9\nn_epochs = 2\n\
     checkpoint_interval = 3",
];

/// Copies a directory in its present state, which is the state after a kill -9.
fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("a directory");
    for entry in fs::read_dir(from).expect("a list") {
        let entry = entry.expect("an entry");
        let target = to.join(entry.file_name());
        match entry.path() {
            path if path.is_dir() => copy(&path, &target),
            path => drop(fs::copy(path, target).expect("a copy")),
        }
    }
}

fn bytes(path: &Path) -> Vec<u8> {
    fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Returns the sorted names in a directory.
fn names(directory: &Path) -> Vec<String> {
    let entries = fs::read_dir(directory).expect("a list");
    let mut names: Vec<String> =
        entries.map(|entry| entry.expect("an entry").file_name().into_string().expect("a name")).collect();
    names.sort();
    names
}

/// Returns the rows of a log without its header, and without the columns of times.
fn cells(run: &Path, name: &str) -> Vec<Vec<String>> {
    let text = read(run, name);
    let mut lines = text.lines().filter(|line| !line.starts_with('#')).map(|line| line.split(','));
    let header: Vec<&str> = lines.next().expect("a header").collect();
    let counts = ["time/iterations", "time/total_timesteps"];
    let kept: Vec<bool> = header
        .iter()
        .map(|column| *column != "t" && (!column.starts_with("time/") || counts.contains(column)))
        .collect();
    assert!(kept.iter().filter(|kept| !**kept).count() <= 5, "most columns are compared");
    let keep = |line: std::str::Split<'_, char>| {
        let cells: Vec<&str> = line.collect();
        assert_eq!(cells.len(), header.len(), "a whole line of {name}: {cells:?}");
        cells.iter().zip(&kept).filter(|(_, kept)| **kept).map(|(cell, _)| (*cell).to_owned()).collect()
    };
    lines.map(keep).collect()
}

fn events(run: &Path) -> PathBuf {
    let name = names(run).into_iter().find(|name| name.starts_with("events.out")).expect("TensorBoard events");
    run.join(name)
}

/// Checks that two runs have equal checkpoints, with the same bytes of weights and state, and logs that differ only in
/// times.
#[track_caller]
fn assert_same(got: &Path, expected: &Path) {
    assert_eq!(Checkpoint::load(got).expect("a checkpoint"), Checkpoint::load(expected).expect("a checkpoint"));
    let folder = got.join("checkpoint");
    let expected_folder = expected.join("checkpoint");
    let files = names(&expected_folder);
    assert_eq!(names(&folder), files, "weights and state with their checksums, nothing else");
    assert_eq!(files.len(), 3);
    for file in &files[1..] {
        assert!(bytes(&folder.join(file)) == bytes(&expected_folder.join(file)), "{file}");
    }
    for name in ["monitor.csv", "progress.csv"] {
        let got = cells(got, name);
        let expected = cells(expected, name);
        assert_eq!(got.len(), expected.len(), "lines of {name}");
        got.iter().zip(&expected).for_each(|(got, expected)| assert_eq!(got, expected, "{name}"));
    }
    assert_eq!(bytes(&events(got)).len(), bytes(&events(expected)).len(), "a time has as many bytes as another");
}

/// Resumes the run in `path` until its end.
fn go_on(servers: &Servers, path: &Path) -> Result<TrainOutcome, String> {
    let (directory, checkpoint, state) = RunDirectory::resume(path).map_err(|error| format!("{error:#}"))?;
    let outcome = resume(servers, &directory, (checkpoint, state), 1, &StopFlag::default(), |_| {});
    outcome.map_err(|error| format!("{error:#}"))
}

fn servers_of(number: usize) -> (Vec<perturb_learner::client::PrivateServer>, Servers) {
    let local: Vec<_> = (0..number).map(|i| server(1 + i % 2)).collect();
    let servers = Servers::connect(&addresses(&local)).expect("connections");
    (local, servers)
}

/// Returns an unfinished run in the state after a kill.
fn broken_off() -> TempDir {
    let (_server, servers) = servers_of(1);
    let out = tempfile::tempdir().expect("a directory");
    let copied = tempfile::tempdir().expect("a directory");
    let directory = RunDirectory::choose(out.path(), false).expect("an empty directory");
    let mut done = false;
    train(&servers, &config(RUNS[1]), &directory, 1, &StopFlag::default(), |progress| {
        if progress.episodes > 30 && !done {
            copy(out.path(), copied.path());
            done = true;
        }
    })
    .expect("a training");
    assert!(done);
    copied
}

#[test]
fn snapshots_restore_a_batch_on_any_number_of_servers() {
    let ((_one, one), (_two, two)) = (servers_of(1), servers_of(2));
    for (environment, width) in [("CartPole", 0), ("Hopper", 3)] {
        let n = 5;
        let options = OpenOptions {
            environment: environment.into(),
            version: Version::E,
            parameters: Default::default(),
            contexts: Vec::new(),
            num_envs: n,
            seed: 3,
            episodes_per_trial: 1,
            observe: Default::default(),
        };
        let open = |servers| {
            let mut observations = Vec::new();
            (ClientSession::open(servers, &options, &mut observations).expect("a session"), observations)
        };
        let actions = |step: usize| -> Vec<u8> {
            match width {
                0 => (0..n).flat_map(|i| ((step * i) as i32 % 2).to_le_bytes()).collect(),
                _ => (0..n * width).flat_map(|i| ((step * 7 + i) as f32).sin().to_le_bytes()).collect(),
            }
        };
        let steps = |session: &mut ClientSession<'_>, range: std::ops::Range<usize>| {
            let step = |step| {
                let mut reply = StepReply::default();
                session.step(&actions(step), &mut reply).expect("a step");
                (reply.observations, reply.rewards, reply.terminated, reply.ended)
            };
            range.map(step).collect::<Vec<_>>()
        };
        let (mut first, _) = open(&one);
        let before = steps(&mut first, 0..100);
        let snapshots = first.snapshot(0..n).expect("snapshots");
        assert_eq!(snapshots.len(), n);
        let expected = steps(&mut first, 100..300);
        assert!(expected.iter().any(|(.., ended)| !ended.is_empty()), "{environment}: new episodes are drawn");

        for servers in [&one, &two] {
            let (mut other, _) = open(servers);
            let observations = other.restore(0..n, &snapshots).expect("the environments are back");
            assert_eq!(observations, before[99].0);
            assert_eq!(other.snapshot(0..n).expect("snapshots"), snapshots);
            assert_eq!(steps(&mut other, 100..300), expected);
            let error = other.restore(0..n, &snapshots[1..]).expect_err("one is missing");
            assert!(matches!(error, ClientError::Snapshots { got: 4, expected: 5 }), "{error}");
        }
        let wrong = OpenOptions { environment: "Pendulum".into(), ..options.clone() };
        let mut observations = Vec::new();
        let mut other = ClientSession::open(&two, &wrong, &mut observations).expect("a session");
        let error = other.restore(0..n, &snapshots).expect_err("of another environment").to_string();
        assert!(error.contains("refused to restore snapshots") && error.contains(environment), "{error}");
    }
}

/// Copies of the directory simulate a kill in every iteration of the run, before the iteration's checkpoint if it
/// writes one.
#[test]
fn a_run_goes_on_from_any_iteration_to_the_same_bytes() {
    let ((_one, one), (_two, two)) = (servers_of(1), servers_of(2));
    for text in RUNS {
        let out = tempfile::tempdir().expect("a directory");
        let kills = tempfile::tempdir().expect("a directory");
        let directory = RunDirectory::choose(out.path(), false).expect("an empty directory");
        let outcome = train(&one, &config(text), &directory, 1, &StopFlag::default(), |progress| {
            copy(out.path(), &kills.path().join(progress.iterations.to_string()));
        });
        let iterations = outcome.expect("a training").progress.iterations;
        assert!(iterations >= 6, "{iterations}: {text}");
        let error = go_on(&one, &kills.path().join("1")).expect_err("there was no checkpoint yet");
        assert!(error.contains("ended before its first checkpoint, so there is nothing to resume"), "{error}");
        assert!(error.contains("--overwrite"), "{error}");
        // The second copy, the last copy, and two in between.
        for iteration in [2, iterations / 3, iterations / 2 + 1, iterations] {
            let killed = kills.path().join(iteration.to_string());
            let servers = if iteration.is_multiple_of(2) { &one } else { &two };
            if killed.join("done").exists() {
                continue; // this copy was resumed already
            }
            let outcome = go_on(servers, &killed).unwrap_or_else(|error| panic!("{iteration}: {error}"));
            assert_eq!(outcome.progress.iterations, iterations);
            assert_same(&killed, out.path());
            fs::write(killed.join("done"), "").expect("a mark");
        }
    }
}

#[test]
fn a_run_that_was_stopped_goes_on_to_the_same_bytes() {
    let (_server, servers) = servers_of(1);
    let text = RUNS[0];
    let (whole, _) = run(&servers, text);
    let out = tempfile::tempdir().expect("a directory");
    let directory = RunDirectory::choose(out.path(), false).expect("an empty directory");
    let stop = StopFlag::default();
    let outcome = train(&servers, &config(text), &directory, 1, &stop, |progress| {
        if progress.iterations == 16 {
            stop.raise(15); // the stop saves a checkpoint and logs a line of progress.csv that is not due
        }
    })
    .expect("a training");
    assert_eq!((outcome.signal, outcome.progress.iterations), (Some(15), 16));
    assert_eq!(cells(out.path(), "progress.csv").last().expect("a line")[0], "16", "the last figures are logged");
    drop(directory);
    let resumed = go_on(&servers, out.path()).expect("a training");
    assert_same(out.path(), whole.path());
    assert_eq!(resumed.checkpoint, Checkpoint::load(whole.path()).expect("a checkpoint"));
}

/// The fixture is a checkpoint of format 1 that perturb 0.1.0 wrote. Its policy was trained in CartPole of revision 0.
#[test]
fn old_formats_load_and_other_revisions_are_refused() {
    let (_server, servers) = servers_of(1);
    let out = tempfile::tempdir().expect("a directory");
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cli/fixtures/format_1"), out.path());
    let (checkpoint, state) = ResumeState::load(out.path()).expect("a checkpoint");
    assert_eq!((checkpoint.state.counters.episodes, checkpoint.state.config.settings.name()), (21, "a2c"));
    let last = state.history.recent.last().expect("an episode");
    assert_eq!((state.history.recent.len(), state.collector.snapshots.len()), (21, 2));
    assert_eq!((last.episode_return, last.length, last.success), (21.0, 21.0, 0.0));

    let options = TestOptions { episodes: 3, seed: 1, selects: false, success: None };
    let error = Tester::new(&servers, &checkpoint, options.clone()).err().expect("another revision").to_string();
    let revisions = "trained in CartPole with revision 0, but the server has 1";
    let advice = "test with the version of perturb that trained it, or train again";
    assert_eq!(error, format!("the checkpoint was {revisions}: {advice}"));
    let error = go_on(&servers, out.path()).expect_err("another revision");
    let advice = "resume with the version of perturb-server that it began with, or train again";
    assert_eq!(error, format!("the run was {revisions}; {advice}"));

    // With the present revision in its document, the checkpoint can be tested.
    edit(out.path(), "/environment_spec/revision", 1.into());
    let checkpoint = Checkpoint::load(out.path()).expect("a checkpoint");
    let tester = Tester::new(&servers, &checkpoint, options).expect("the environment is the same");
    tester.test(&[Version::D.into()], &StopFlag::default(), &mut |_, _| {}).expect("a test");
}

/// Returns the number of episodes of the checkpoint on disk.
fn episodes(run: &Path) -> u64 {
    Checkpoint::load(run).map_or(0, |checkpoint| checkpoint.state.counters.episodes)
}

/// Kills the learner `delay` after it has written a checkpoint with this number of episodes.
fn kill_after(mut child: Child, run: &Path, at_least: u64, delay: Duration) {
    wait_for("a checkpoint", || episodes(run) >= at_least);
    std::thread::sleep(delay);
    child.kill().expect("kill -9");
    let output = ended(child);
    assert_eq!(output.status.code(), None, "it ended before it was killed: {}", stderr(&output));
}

/// Checks that monitor.csv has only whole lines. Other programs read it as soon as a run was killed.
#[track_caller]
fn has_whole_lines(run: &Path) {
    let text = fs::read_to_string(run.join("monitor.csv")).expect("a file");
    let (_, table) = text.strip_suffix('\n').and_then(|text| text.split_once('\n')).expect(&text);
    let commas = |line: &str| line.matches(',').count();
    assert!(table.lines().all(|line| commas(line) == commas(table.lines().next().unwrap_or_default())), "{text}");
}

#[test]
fn a_learner_killed_repeatedly_gives_the_same_bytes() {
    let (local, servers) = servers_of(2);
    let both = addresses(&local).iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
    for (text, budget) in RUNS.into_iter().zip([300, 160, 18, 18, 36, 27]) {
        let common = format!("episodes = {budget}\ncheckpoint_interval = {}\n", budget / 9);
        let own = text.lines().filter(|line| !line.starts_with("episodes =") && !line.starts_with("checkpoint"));
        let text = common + &own.collect::<Vec<_>>().join("\n");
        let (whole, _) = run(&servers, &text);
        let out = tempfile::tempdir().expect("a directory");
        let settings = out.path().join("settings.toml");
        fs::write(&settings, &text).expect("a file");
        let path = out.path().join("run");
        let path_text = path.to_str().expect("a path");
        let settings = settings.to_str().expect("a path");

        let child = perturb(&["train", "--config", settings, "--out", path_text]).spawn().expect("perturb");
        kill_after(child, &path, budget / 6, Duration::ZERO);
        has_whole_lines(&path);
        // A kill while a checkpoint is written can leave such files.
        for stray in
            [".tmp-checkpoint.json", "resume-00999999-0badf00d.safetensors", "weights-00999999-0badf00d.safetensors"]
        {
            fs::write(path.join("checkpoint").join(stray), "half a file").expect("a file");
        }
        let resume = ["train", "--resume", path_text];
        let child = perturb(&[&resume[..], &["--server", &both]].concat()).spawn().expect("perturb");
        kill_after(child, &path, budget / 3, Duration::from_millis(7));
        has_whole_lines(&path);
        let output = perturb(&[&resume[..], &["--workers", "2"]].concat()).output().expect("perturb runs");
        assert!(output.status.success(), "{}", stderr(&output));
        assert!(stderr(&output).contains(&format!("of {budget} episodes")), "{}", stderr(&output));
        assert_same(&path, whole.path());
    }
}

#[test]
fn a_training_that_lost_its_server_says_how_to_go_on() {
    let out = tempfile::tempdir().expect("a directory");
    let path = out.path().to_str().expect("a path");
    let settings =
        ["--set", "checkpoint_interval=20", "--set", "episodes=400", "--set", "n_epochs=2", "--server-wait", "0"];
    let child =
        perturb(&[&["train", "--env", "CartPole", "--out", path][..], &settings].concat()).spawn().expect("perturb");
    wait_for("a checkpoint", || episodes(out.path()) >= 40);
    kill("-KILL", child_server(child.id()).expect("a private server"));
    let output = ended(child);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let kept = episodes(out.path());
    let expected = format!(
        "the checkpoint after {kept} episodes is kept in {path}; to go on with the training: perturb train --resume {path} \
         --server-wait 0"
    );
    assert!(stderr(&output).contains(&expected), "{}", stderr(&output));

    let output = perturb(&["train", "--resume", path]).output().expect("perturb runs");
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).contains(&format!("resuming after {kept} of 400 episodes")), "{}", stderr(&output));
    let (_servers, servers) = servers_of(1);
    let text = "environment = 'CartPole'\ncheckpoint_interval = 20\nepisodes = 400\nn_epochs = 2";
    assert_same(out.path(), run(&servers, text).0.path());
}

#[test]
fn numbers_that_are_not_finite_leave_the_last_checkpoint() {
    let (_server, servers) = servers_of(1);
    let out = tempfile::tempdir().expect("a directory");
    let directory = RunDirectory::choose(out.path(), false).expect("an empty directory");
    let text = "environment = 'Pendulum'\nepisodes = 400\nnum_envs = 2\nlearning_rate = 1e30\nn_epochs = 1\n\
                max_grad_norm = 1e30\nnormalize_advantage = false";
    let error = train(&servers, &config(text), &directory, 1, &StopFlag::default(), |_| {}).expect_err("NaN");
    let error = format!("{error:#}");
    assert!(error.contains("; the checkpoint after 0 episodes is kept in"), "{error}");
    assert!(error.contains("resumed, it would fail with the same numbers"), "{error}");
    let saved = Checkpoint::load(out.path()).expect("a checkpoint");
    assert_eq!(saved.state.counters.iterations, 1, "the one that was there before");
}

/// Changes a value in the checkpoint's document. Removes the checksum, which files of earlier versions do not have.
fn edit(run: &Path, pointer: &str, value: Value) {
    let path = run.join("checkpoint/checkpoint.json");
    let mut document: Value = serde_json::from_slice(&bytes(&path)).expect("JSON");
    *document.pointer_mut(pointer).expect("a value") = value;
    document["format_version"] = 2.into();
    document.as_object_mut().expect("entries").remove("crc32c");
    fs::write(path, document.to_string()).expect("a file");
}

/// Returns the file of the checkpoint whose name begins with `prefix`.
fn file(run: &Path, prefix: &str) -> PathBuf {
    let folder = run.join("checkpoint");
    folder.join(names(&folder).into_iter().find(|name| name.starts_with(prefix)).expect("a file"))
}

fn flip_a_bit(path: &Path) {
    let mut content = bytes(path);
    let middle = content.len() / 2;
    content[middle] ^= 1;
    fs::write(path, content).expect("a file");
}

/// The name of a damage, and the function that causes it.
type Damage = (&'static str, fn(&Path));

/// Damages after which a run cannot be resumed.
const DAMAGES: &[Damage] = &[
    ("another revision of the environment", |run| edit(run, "/environment_spec/revision", 77.into())),
    ("another model", |run| edit(run, "/environment_spec/model_hash", "abc".into())),
    ("more environments", |run| edit(run, "/config/num_envs", 6.into())),
    ("another discount", |run| edit(run, "/config/gamma", 0.5.into())),
    ("no environments", |run| edit(run, "/config/num_envs", 0.into())),
    ("another algorithm", |run| edit(run, "/config/algorithm", "rl2-ppo".into())),
    ("no random stream of the optimiser", |run| edit(run, "/resume/algorithm/rng", Value::Null)),
    ("an invalid history", |run| edit(run, "/resume/history", 5.into())),
    ("no state for resuming", |run| {
        edit(run, "/resume", Value::Null);
        Checkpoint::load(run).expect("it can be tested");
    }),
    ("a digit of the statistics", |run| {
        let path = run.join("checkpoint/checkpoint.json");
        let text = String::from_utf8(bytes(&path)).expect("text");
        let at = text.find("\"mean\": [").expect("statistics");
        let digit = at + text[at..].find(['1', '2', '3', '4', '5', '6', '7', '8']).expect("a digit");
        let other = (text.as_bytes()[digit] + 1) as char;
        fs::write(path, format!("{}{other}{}", &text[..digit], &text[digit + 1..])).expect("a file");
    }),
    ("a bit of the state", |run| flip_a_bit(&file(run, "resume-"))),
    ("a bit of the weights", |run| flip_a_bit(&file(run, "weights-"))),
    ("no state", |run| fs::remove_file(file(run, "resume-")).expect("a file")),
    ("no weights", |run| fs::remove_file(file(run, "weights-")).expect("a file")),
    ("half a log", |run| {
        let path = run.join("monitor.csv");
        fs::write(&path, &bytes(&path)[..200]).expect("a file");
    }),
    ("no log", |run| fs::remove_file(run.join("progress.csv")).expect("a file")),
    ("no checkpoint", |run| fs::remove_dir_all(run.join("checkpoint")).expect("a folder")),
    ("nothing at all", |run| {
        fs::remove_dir_all(run).expect("a folder");
        fs::create_dir(run).expect("a folder");
    }),
];

#[test]
fn a_run_that_cannot_be_resumed_says_why_and_is_not_changed() {
    let (_server, servers) = servers_of(1);
    let base = broken_off();
    let mut said = String::new();
    for (damage, to) in DAMAGES {
        let out = tempfile::tempdir().expect("a directory");
        copy(base.path(), out.path());
        to(out.path());
        let monitor = fs::read(out.path().join("monitor.csv")).unwrap_or_default();
        let mut error = go_on(&servers, out.path()).expect_err(damage);
        error = error.replace(&out.path().display().to_string(), "RUN");
        for name in names(&base.path().join("checkpoint")) {
            // File names contain the number of iterations and a checksum, so the snapshot has only their beginnings.
            error = error.replace(&name, name.split_once('-').map_or(&name, |(kind, _)| kind));
        }
        // The length of the log depends on the times in it, so it is replaced, too.
        let length = error.find("but had ").map(|start| start + "but had ".len());
        let digits = |start: usize| error[start..].chars().take_while(char::is_ascii_digit).count();
        if let Some((start, digits)) = length.map(|start| (start, digits(start))) {
            error.replace_range(start..start + digits, "N");
        }
        said += &format!("{damage}\n{error}\n\n");
        assert_eq!(fs::read(out.path().join("monitor.csv")).unwrap_or_default(), monitor, "{damage}");
    }
    assert_snapshot!(said);
    go_on(&servers, base.path()).expect("untouched, it goes on");
}

#[test]
fn other_folders_than_a_run_are_not_resumed() {
    let base = broken_off();
    let error = |name: &str| {
        let error = RunDirectory::resume(&base.path().join(name)).expect_err("no run");
        format!("{error:#}").replace(&base.path().display().to_string(), "RUN")
    };
    let inside = "RUN/checkpoint is the checkpoint in a run; give the run's directory, which holds it";
    assert_eq!(error("checkpoint"), inside);
    let nowhere = "--resume RUN/nowhere: there is no such directory; give the --out of a training";
    assert_eq!(error("nowhere"), nowhere);
}

#[test]
fn the_program_resumes_what_is_left_to_do_and_nobody_else_does() {
    let base = broken_off();
    let run = base.path().to_str().expect("a path");
    let refused = |arguments: &[&str]| refusal(arguments, &[(run, "RUN")]);
    let mut said = [
        &["train", "--resume", run, "--out", run][..],
        &["train", "--resume", run, "--set", "seed=2"],
        &["train", "--resume", run, "--server", "unix:/tmp/x", "--workers", "1"],
    ]
    .map(refused)
    .concat();
    let held = RunDirectory::resume(base.path()).expect("a run");
    said += &refused(&["train", "--resume", run]);
    said += &refused(&["train", "--env", "CartPole", "--out", run, "--overwrite"]);
    assert_snapshot!(said);
    drop(held);

    for finished in [false, true] {
        let output = perturb(&["train", "--resume", run]).output().expect("perturb runs");
        assert!(output.status.success(), "{}", stderr(&output));
        assert_eq!(stderr(&output).contains("is finished"), finished, "{}", stderr(&output));
        let expected = format!("trained policy: {run}/checkpoint\ntest it: perturb evaluate --checkpoint {run}\n");
        assert_eq!(String::from_utf8_lossy(&output.stdout), expected);
    }
}
