//! Misuse and interruption of the programs: their messages, exit status and remaining files.

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use insta::assert_snapshot;
use rstest::rstest;
use tempfile::TempDir;

use crate::common::{child_server, ended, kill, stderr, wait_for, wait_for_server};

/// A plan with two cells that are long enough to be interrupted.
const PLAN: &str = "environments = ['CartPole']\nversions = ['D']\nruns = 2\ntest_episodes = 12
settings = { episodes = 100000 }\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\n";

/// A working directory with its own folder for temporary files.
struct Place(TempDir);

impl Place {
    fn new() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        std::fs::create_dir(directory.path().join("tmp")).expect("a folder");
        let place = Self(directory);
        for (name, content) in [
            ("plan.toml", PLAN),
            ("wrong.toml", &PLAN.replace("CartPole", "CartPol")),
            ("runs.toml", &PLAN.replace("runs = 2", "runs = 1e4")),
            ("bad.toml", "environment = 'CartPole\n"),
            ("file", ""),
        ] {
            std::fs::write(place.path(name), content).expect("written");
        }
        std::fs::create_dir(place.path("an experiment")).expect("a folder");
        std::fs::write(place.path("an experiment/plan.toml"), PLAN).expect("written");
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Returns a command that runs `perturb` or `perturb-server` in this directory. The first word is the program.
    fn command(&self, words: &[&str]) -> Command {
        let perturb = Path::new(env!("CARGO_BIN_EXE_perturb"));
        let mut command = Command::new(perturb.with_file_name(words[0]));
        command.args(&words[1..]).current_dir(self.0.path()).env("TMPDIR", self.path("tmp"));
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn output(&self, words: &[&str]) -> Output {
        self.command(words).output().expect("it runs")
    }

    fn start(&self, words: &[&str]) -> Child {
        self.command(words).spawn().expect("started")
    }

    /// Returns all paths in the directory, without the contents of checkpoints.
    fn files(&self) -> BTreeSet<String> {
        fn list(folder: &Path, root: &Path, files: &mut BTreeSet<String>) {
            for entry in std::fs::read_dir(folder).expect("a list") {
                let path = entry.expect("an entry").path();
                files.insert(path.strip_prefix(root).expect("in here").display().to_string());
                if path.is_dir() && !path.ends_with("checkpoint") {
                    list(&path, root, files);
                }
            }
        }
        let mut files = BTreeSet::new();
        list(self.0.path(), self.0.path(), &mut files);
        files
    }

    /// Runs a command. Returns its messages, its exit status and its new files.
    fn told(&self, words: &[&str]) -> String {
        let before = self.files();
        let output = self.output(words);
        let status = output.status.code().expect("it ends by itself");
        let new: Vec<String> = self.files().difference(&before).cloned().collect();
        let remains = if new.is_empty() { "nothing".into() } else { new.join(", ") };
        format!("$ {}\n{}status {status}, remains: {remains}\n\n", words.join(" "), stderr(&output))
    }
}

/// Starts a server that answers every client with something that perturb does not understand.
fn babbling() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = listener.local_addr().expect("an address").to_string();
    std::thread::spawn(move || {
        for mut stream in listener.incoming().map_while(Result::ok) {
            let _ = stream.read(&mut [0; 64]);
            let _ = stream.write_all(b"HTTP/1.0 400 Bad request\r\n\r\n");
        }
    });
    address
}

#[test]
fn each_misuse_is_refused_with_a_remedy_and_leaves_nothing() {
    let place = Place::new();
    let trained = place.output(&["perturb", "train", "--env", "CartPole", "--episodes", "5", "--out", "run"]);
    assert!(trained.status.success(), "{}", stderr(&trained));
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let taken = format!("tcp://{}", listener.local_addr().expect("an address"));
    let babbling = babbling();
    let train = ["perturb", "train", "--env", "CartPole", "--out", "new"];
    let with = |more: &[&'static str]| [&train[..], more].concat();
    let wrong = [
        vec!["perturb", "trian"],
        vec!["perturb", "train", "--out", "new"],
        vec!["perturb", "train", "--env", "cartpol", "--out", "new"],
        vec!["perturb", "train", "--env", "perturb/CartPole-v0", "--out", "new"],
        with(&["--set", "learning_rat=1e-3"]),
        with(&["--set", "epsilon=0.1"]),
        with(&["--set", "n_steps=1e4"]),
        with(&["--algorithm", "pppo"]),
        with(&["--algorithm", "rl2-ppo", "--architecture", "ff"]),
        with(&["--version", "X"]),
        with(&["--version", "D", "--set", "version=R"]),
        with(&["--episodes", "1e4"]),
        with(&["--episodes", "-5"]),
        with(&["--episodes", "99999999999999999999"]),
        with(&["--workers", "5000"]),
        with(&["--extend", "5"]),
        with(&["--config", "bad.toml"]),
        with(&["--config", "missing.toml"]),
        with(&["--parameters", "lenght=0.5"]),
        vec!["perturb", "train", "--env", "CartPole", "--out", "run"],
        vec!["perturb", "train", "--env", "CartPole", "--out", "run", "--overwrite", "--set", "n_minibatches=3"],
        vec!["perturb", "train", "--env", "Pong", "--out", "run", "--overwrite"],
        vec!["perturb", "train", "--env", "CartPole", "--out", "file"],
        vec!["perturb", "train", "--env", "CartPole", "--out", "file/run"],
        vec!["perturb", "train", "--resume", "missing"],
        vec!["perturb", "evaluate", "--checkpoint", "missing"],
        vec!["perturb", "evaluate", "--checkpoint", "run", "--json", "missing/result.json"],
        vec!["perturb", "evaluate", "--checkpoint", "run", "--records", "file/records.parquet"],
        vec!["perturb", "evaluate", "--checkpoint", "run", "--json", "tmp"],
        vec!["perturb", "ls", "--json", "tmp"],
        vec!["perturb", "rescore", "--json", "run"],
        vec!["perturb", "demo", "--out", "run"],
        vec!["perturb", "demo", "--env", "hoper", "--out", "new"],
        vec!["perturb", "evaluate", "--checkpoint", "run", "--success", "step=3"],
        vec!["perturb", "heatmap", "--checkpoint", "run", "--x", "lenght", "--y", "MASS"],
        vec!["perturb", "evaluate", "--checkpoint", "run", "--contexts", "missing.csv"],
        vec!["perturb", "heatmap", "--checkpoint", "run", "--out", "missing/heatmap"],
        vec!["perturb", "heatmap", "missing"],
        vec!["perturb", "video", "--checkpoint", "run", "--out", "missing/a.gif"],
        vec!["perturb", "plan", "bad.toml"],
        vec!["perturb", "plan", "missing.toml"],
        vec!["perturb", "plan", "wrong.toml", "--measure", "0"],
        vec!["perturb", "plan", "runs.toml"],
        vec!["perturb", "plan", "plan.toml", "--timings-from", "missing"],
        vec!["perturb", "run", "wrong.toml", "--out", "out"],
        vec!["perturb", "run", "plan.toml", "--out", "out", "--html", "missing/page.html"],
        vec!["perturb", "run", "plan.toml", "--out", "out", "--html", "out/missing/page.html"],
        vec!["perturb", "run", "plan.toml", "--out", "out", "--html", "out"],
        vec!["perturb", "run", "plan.toml", "--out", "out", "--html", "out/report"],
        vec!["perturb", "run", "plan.toml", "--out", "out", "--html", "out/plan.toml"],
        vec!["perturb", "run", "plan.toml", "--out", "out", "--json", "missing/lines.jsonl"],
        vec!["perturb", "run", "plan.toml", "--out", "run"],
        vec!["perturb", "run", "plan.toml", "--out", "file"],
        vec!["perturb", "run", "plan.toml", "--out", "file/run"],
        vec!["perturb", "run", "nowhere.toml", "--out", "out"],
        vec!["perturb", "train", "--env", "CartPole", "--out", "an experiment"],
        vec!["perturb", "report", "missing"],
        vec!["perturb", "audit", "missing"],
        vec!["perturb", "rescore", "missing.parquet"],
        vec!["perturb", "rescore", "plan.toml"],
        vec!["perturb", "ls", "missing"],
        vec!["perturb", "serve", "missing"],
        vec!["perturb", "serve", "file"],
        vec!["perturb", "serve", ".", "--address", taken.trim_start_matches("tcp://")],
        vec!["perturb", "serve", ".", "--address", "example.org:80"],
        vec!["perturb", "serve", ".", "--address", "192.0.2.1:8420"],
        vec!["perturb", "serve", ".", "--server", "nowhere"],
        vec!["perturb", "man", "missing"],
        vec!["perturb", "envs", "--server", "127.0.0.1"],
        vec!["perturb", "envs", "--server", "127.0.0.1:1"],
        vec!["perturb", "envs", "--server", "unix:/nowhere.sock"],
        vec!["perturb", "envs", "--server", &babbling],
        vec!["perturb", "envs", "--server", "127.0.0.1:1", "--workers", "2"],
        vec!["perturb-server", "--listen", &taken],
        vec!["perturb-server", "--listen", "unix:/missing/folder/socket"],
        vec!["perturb-server", "--workers", "0"],
        vec!["perturb-server", "--config", "bad.toml"],
    ];
    let said: String = wrong.iter().map(|words| place.told(words)).collect();
    assert!(place.path("run/checkpoint/checkpoint.json").exists(), "refusals delete nothing");
    let names = [(taken.as_str(), "tcp://TAKEN"), (&taken[6..], "127.0.0.1:TAKEN"), (&babbling, "127.0.0.1:BABBLING")];
    assert_snapshot!(names.iter().fold(said, |said, (long, name)| said.replace(long, name)));
}

/// Checks Ctrl-C during a command: the last message and the remaining files, with all numbers replaced by N.
#[rstest]
#[case::train(
    "perturb train --env CartPole --episodes 1000000 --out run",
    "run/progress.csv",
    "stopped by signal N after N of N episodes; to go on with the training: perturb train --resume run",
    "run, run/checkpoint, run/config.toml, run/events.out.tfevents.N.perturb, run/lock, run/monitor.csv, run/progress.csv"
)]
#[case::run(
    "perturb run plan.toml --out out",
    "out/plan.toml",
    "stopped by signal N; resume with: perturb run plan.toml --out out",
    "out, out/cells, out/plan.toml"
)]
#[case::plan(
    "perturb plan plan.toml --measure 60",
    "tmp",
    "perturb: stopped by signal N while measuring; the measurement is discarded",
    ""
)]
#[case::evaluate(
    "perturb evaluate --checkpoint short --episodes 1000000 --json new.json --records new.parquet",
    "tmp",
    "perturb: stopped before all episodes were tested",
    ""
)]
#[case::demo(
    "perturb demo --env CartPole --episodes 1000000 --out demo",
    "demo/trained-on-R/progress.csv",
    "stopped by signal N; finished parts are kept in demo",
    "demo, demo/trained-on-D, demo/trained-on-R"
)]
#[case::heatmap(
    "perturb heatmap --checkpoint short --grid 100 --episodes 1000 --out new",
    "tmp",
    "perturb: stopped before all episodes were tested",
    ""
)]
#[case::video(
    "perturb video --checkpoint short --episodes 10000 --out new.gif",
    "tmp",
    "perturb: stopped before all episodes were tested",
    ""
)]
fn ctrl_c_ends_soon_and_leaves_nothing_temporary(
    #[case] words: &str,
    #[case] begun: &str,
    #[case] said: &str,
    #[case] remains: &str,
) {
    let place = Place::new();
    if words.contains("short") {
        place.output(&["perturb", "train", "--env", "CartPole", "--episodes", "5", "--out", "short"]);
    }
    let before = place.files();
    let child = place.start(&words.split(' ').collect::<Vec<_>>());
    // With `tmp`, a command has begun when its private server runs and the server's folder exists. Otherwise `begun` is
    // a file that the command writes.
    let has_begun = || match begun {
        "tmp" => {
            child_server(child.id()).is_some() && place.path("tmp").read_dir().is_ok_and(|mut tmp| tmp.next().is_some())
        }
        file => place.path(file).exists(),
    };
    wait_for("a beginning", has_begun);
    std::thread::sleep(std::time::Duration::from_millis(300));
    kill("-INT", child.id());
    let output = ended(child);
    assert_eq!(output.status.code(), Some(130), "{}", stderr(&output));
    let words = stderr(&output);
    let last = words.lines().last().unwrap_or_default();
    let last = without_numbers(last);
    // On a busy machine the signal may come before the server listens.
    let is_early = begun == "tmp" && last.starts_with("perturb: stopped by signal N while ");
    assert!(last == said || is_early, "{words}");
    let left: Vec<String> = place.files().difference(&before).cloned().collect();
    let whole = |name: &&String| name.matches('/').count() < 2;
    assert_eq!(without_numbers(&left.iter().filter(whole).cloned().collect::<Vec<_>>().join(", ")), remains);
    assert_eq!(temporary(&place), Vec::<String>::new());
}

fn without_numbers(text: &str) -> String {
    let digits = |c: char| c.is_ascii_digit();
    text.split(digits).filter(|part| !part.is_empty()).collect::<Vec<_>>().join("N")
}

/// Returns the contents of the folder for temporary files.
fn temporary(place: &Place) -> Vec<String> {
    place.files().into_iter().filter(|file| file.starts_with("tmp/")).collect()
}

#[test]
fn a_second_ctrl_c_and_sigkill_leave_no_temporary_folder() {
    let place = Place::new();
    for signals in [&["-INT", "-INT"][..], &["-KILL"]] {
        let child = place.start(&["perturb", "train", "--env", "CartPole", "--episodes", "1000000", "--out", "run"]);
        wait_for("a training", || place.path("run/progress.csv").exists());
        assert_eq!(temporary(&place).len(), 2, "a folder with a socket");
        signals.iter().for_each(|signal| kill(signal, child.id()));
        ended(child);
        wait_for("the end of the server", || temporary(&place).is_empty());
        std::fs::remove_dir_all(place.path("run")).expect("removed");
    }
}

#[test]
fn a_lost_server_is_reported_with_the_resume_command() {
    let place = Place::new();
    let address = format!("unix:{}", place.path("socket").display());
    let mut server = place.command(&["perturb-server", "--listen", &address, "--log", "error"]);
    let mut server = server.stdout(Stdio::null()).spawn().expect("a server");
    wait_for_server(&place.path("socket"));
    // With --quiet no progress line can precede the expected message on a slow machine.
    let train = ["perturb", "-q", "train", "--env", "CartPole", "--episodes", "1000000", "--out", "my run"];
    let words = [&train[..], &["--server", &address, "--server-wait", "0"]].concat();
    let child = place.start(&words);
    wait_for("a checkpoint", || place.path("my run/checkpoint/checkpoint.json").exists());
    server.kill().and_then(|()| server.wait()).expect("killed");
    let output = ended(child);
    assert_eq!(output.status.code(), Some(1));
    let said = stderr(&output);
    assert!(said.starts_with(&format!("perturb: lost the server at {address} ")), "{said}");
    assert!(said.contains("; the checkpoint after ") && !said.contains("h2") && !said.contains("transport"), "{said}");
    let again = format!("perturb train --resume 'my run' --server {address} --server-wait 0");
    let command = format!("episodes is kept in my run; to go on with the training: {again}\n");
    assert!(said.ends_with(&command), "{said}");
}

#[test]
fn quiet_prints_nothing_and_json_goes_to_stdout() {
    let place = Place::new();
    let trained = place.output(&["perturb", "-q", "train", "--env", "cart_pole", "--episodes", "5", "--out", "run"]);
    assert!(trained.status.success() && trained.stderr.is_empty(), "{}", stderr(&trained));
    let tested = place.output(&[
        "perturb",
        "evaluate",
        "--checkpoint",
        "run",
        "--versions",
        "d",
        "--episodes",
        "5",
        "--json",
        "-",
    ]);
    let value: serde_json::Value = serde_json::from_slice(&tested.stdout).expect("JSON");
    assert_eq!((&value["environment"], &value["results"]["D"]["episodes"]), (&"CartPole".into(), &5.into()));
    let refused = place.output(&["perturb", "-q", "evaluate", "--checkpoint", "missing"]);
    assert!(refused.status.code() == Some(2) && !refused.stderr.is_empty(), "an error is said nevertheless");

    // Commands with --json write the result to standard output or to a file.
    let printed = |words: &str| -> serde_json::Value {
        let output = place.output(&words.split(' ').collect::<Vec<_>>());
        assert!(output.status.success(), "{words}: {}", stderr(&output));
        serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{words}: {error}"))
    };
    let training = printed("perturb train --resume run --extend 5 --json -");
    assert_eq!((&training["run"], &training["finished"]), (&"run".into(), &true.into()), "{training:#}");
    assert!(training["training_episodes"].as_u64() >= Some(5) && training["last_100"]["mean_return"].is_number());
    assert_eq!(printed("perturb train --resume run --json")["finished"], true);
    assert_eq!(printed("perturb ls run --json")[0]["unit"], "episodes");
    assert!(printed("perturb envs --json -")["environments"].is_array());
    assert_eq!(printed("perturb plan plan.toml --cells --json -").as_array().map(Vec::len), Some(2));
    let short = std::fs::read_to_string(place.path("plan.toml")).expect("a plan").replace("100000", "5");
    std::fs::write(place.path("plan.toml"), short).expect("written");
    let ran = place.output(&["perturb", "run", "plan.toml", "--out", "out", "--json", "lines.jsonl"]);
    assert!(ran.status.success() && ran.stdout.is_empty(), "{}", stderr(&ran));
    let lines = std::fs::read_to_string(place.path("lines.jsonl")).expect("lines");
    assert!(lines.lines().all(|line| line.starts_with("{\"cell\":")), "{lines}");
    assert_eq!(lines.matches("\"event\":\"done\"").count(), 2, "{lines}");
}

#[test]
fn a_full_standard_error_does_not_end_a_training() {
    let place = Place::new();
    let mut command =
        place.command(&["perturb", "-vv", "train", "--env", "CartPole", "--episodes", "5", "--out", "run"]);
    let full = std::fs::File::options().write(true).open("/dev/full").expect("a device");
    let status = command.stderr(full).status().expect("it runs");
    assert!(status.success() && place.path("run/checkpoint/checkpoint.json").exists(), "{status}");
}
