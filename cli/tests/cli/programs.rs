//! Progress output of long commands, help texts, and other output for users.

use std::path::Path;
use std::process::{Command, Output, Stdio};

use perturb_files::Lock;
use perturb_learner::checkpoint::Checkpoint;
use tempfile::TempDir;

use crate::common::{perturb, read, stderr};

fn folder() -> TempDir {
    tempfile::tempdir().expect("a directory")
}

/// Runs `perturb` in `folder`.
fn run(folder: &Path, arguments: &[&str]) -> Output {
    let output = perturb(arguments).current_dir(folder).output().expect("perturb runs");
    assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
    output
}

fn printed(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).expect("text")
}

/// Runs a command on a terminal of 80 columns.
fn on_a_terminal(folder: &Path, command: &str) -> String {
    let path = Path::new(env!("CARGO_BIN_EXE_perturb")).parent().expect("a folder").display().to_string();
    let command = format!("stty cols 80 rows 24; PATH={path}:$PATH; {command}");
    let output = Command::new("script")
        .args(["-qec", &command, "/dev/null"])
        .env("TERM", "xterm")
        .current_dir(folder)
        .stdin(Stdio::null())
        .output()
        .expect("script, of Debian's bsdutils");
    String::from_utf8(output.stdout).expect("text")
}

/// Returns everything that was drawn on a terminal as rows of 80 columns, without control sequences.
fn lines(drawn: &str) -> Vec<String> {
    let mut text = String::new();
    let mut rest = drawn.chars();
    while let Some(c) = rest.next() {
        match c {
            '\u{1b}' => drop(rest.by_ref().find(char::is_ascii_alphabetic)),
            '\r' => text.push('\n'),
            c => text.push(c),
        }
    }
    let rows = text.lines().flat_map(|line| {
        let letters: Vec<char> = line.chars().collect();
        letters.chunks(80).map(String::from_iter).collect::<Vec<String>>()
    });
    rows.map(|row| row.trim_end().to_owned()).filter(|row| !row.is_empty()).collect()
}

/// Returns the final contents of a terminal.
fn screen(drawn: &str) -> Vec<String> {
    let mut rows = vec![Vec::new()];
    let mut row = 0_usize;
    let mut column = 0_usize;
    let mut rest = drawn.chars();
    while let Some(c) = rest.next() {
        match c {
            '\r' => column = 0,
            '\n' => row += 1,
            '\u{1b}' => {
                let mut words = String::new();
                for c in rest.by_ref() {
                    words.push(c);
                    if c.is_ascii_alphabetic() {
                        break;
                    }
                }
                let count = words.trim_matches(|c: char| !c.is_ascii_digit()).parse().unwrap_or(1);
                match words.chars().last() {
                    Some('A') => row = row.saturating_sub(count),
                    Some('B') => row += count,
                    Some('K') => rows[row].clear(),
                    _ => {}
                }
            }
            c => {
                if column == 80 {
                    (row, column) = (row + 1, 0);
                    rows.resize(rows.len().max(row + 1), Vec::new());
                }
                let line: &mut Vec<char> = &mut rows[row];
                line.resize(line.len().max(column + 1), ' ');
                line[column] = c;
                column += 1;
            }
        }
        rows.resize(rows.len().max(row + 1), Vec::new());
    }
    rows.iter().map(|row| row.iter().collect::<String>().trim_end().to_owned()).filter(|row| !row.is_empty()).collect()
}

#[test]
fn a_bar_fits_80_columns_and_shows_the_remaining_time() {
    let folder = folder();
    let train =
        "perturb train --env CartPole --version R+E --algorithm a2c --observe parameters --episodes 6000 --out run";
    let drawn = on_a_terminal(folder.path(), train);
    let left = screen(&drawn);
    assert!(!left.iter().any(|row| row.contains(['█', '░'])), "nothing is left of the bar: {left:#?}");
    let drawn = lines(&drawn);
    // The bar fills its row, and the figures begin in the next row.
    let bars = drawn.windows(2).filter(|rows| rows[0].contains('█') && rows[1].contains("/6 000 episodes, "));
    let mut count = 0;
    for rows in bars {
        assert!(rows[0].starts_with("CartPole R+E a2c ff (sees parameters) ") && rows[0].ends_with(" %"), "{rows:?}");
        assert!(rows[1].starts_with(|c: char| c.is_ascii_digit()), "{rows:?}");
        count += 1;
    }
    assert!(count > 4, "{drawn:#?}");
    assert!(drawn.iter().any(|row| row.contains(" s left, success ")), "{drawn:#?}");
}

#[test]
fn a_private_servers_log_appears_above_the_bar() {
    let folder = folder();
    let server = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cli/fixtures/talking_server.sh");
    let program = Path::new(env!("CARGO_BIN_EXE_perturb")).with_file_name("perturb-server");
    let drawn = on_a_terminal(
        folder.path(),
        &format!(
            "PERTURB_SERVER={} TALKING_PROGRAM={} perturb train --env CartPole --algorithm a2c --episodes 10000 --out run",
            server.display(),
            program.display()
        ),
    );
    assert!(drawn.contains('█'), "{drawn}");
    let left = screen(&drawn);
    let said: Vec<_> = left.iter().filter(|row| row.contains("word")).collect();
    assert!(said.len() > 2 && said.iter().all(|row| **row == "a word of the server's"), "{left:#?}");
    assert!(!left.iter().any(|row| row.contains(['█', '░'])), "nothing is left of the bar: {left:#?}");
}

#[test]
fn a_run_shows_cells_in_work_and_success_rates() {
    let folder = folder();
    let plan =
        "environments = ['CartPole', 'Pendulum']\nversions = ['D']\ntest_versions = ['D', 'E']\ntest_episodes = 5
        settings = { episodes = 600 }\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']\n[[algorithm]]\nname = 'ppo'
        architectures = ['ff']";
    std::fs::write(folder.path().join("plan.toml"), plan).expect("written");
    let drawn = lines(&on_a_terminal(folder.path(), "perturb run plan.toml --out out --jobs 1"));
    let has = |part: &str| drawn.iter().any(|line| line.contains(part));
    assert!(has("measuring the duration of cells that begin later: 2 groups"), "{drawn:#?}");
    assert!(has("/4 cells, ") && has("  Pendulum") && has(" of training"), "{drawn:#?}");
    assert!(has("  done: CartPole a2c ff, trained on D: D ") && has(" left"), "{drawn:#?}");
    let ending = &drawn[drawn.len() - 5..];
    for (line, kind) in ending.iter().zip(["CartPole a2c", "CartPole ppo", "Pendulum a2c", "Pendulum ppo"]) {
        assert!(line.starts_with(&format!("{kind} ff, trained on D: D ")) && line.ends_with(" % (1 cell)"), "{line}");
    }
    assert_eq!(ending[4], "all 4 cells are done; perturb report out");
}

#[test]
fn runs_get_a_default_folder_and_are_listed() {
    let folder = folder();
    let train = ["train", "--env", "CartPole", "--algorithm", "a2c", "--episodes", "30"];
    let output = run(folder.path(), &train);
    let name = std::fs::read_dir(folder.path().join("runs")).expect("runs").next().expect("one").expect("an entry");
    let name = name.file_name().into_string().expect("a name");
    let time = name.strip_prefix("CartPole-a2c-").expect("environment and algorithm");
    assert!(time.len() == "20261123-065500".len() && time.starts_with("20"), "{name}");
    assert!(printed(&output).ends_with(&format!("test it: perturb evaluate --checkpoint runs/{name}\n")));

    run(folder.path(), &[&train[..], &["--out", "runs/group/b"]].concat());
    let plan = "environments = ['CartPole']\nversions = ['D', 'R']\ntest_versions = ['D']\ntest_episodes = 5
        settings = { episodes = 20 }\n[[algorithm]]\nname = 'random'\narchitectures = ['ff']";
    std::fs::write(folder.path().join("plan.toml"), plan).expect("written");
    run(folder.path(), &["run", "plan.toml", "--out", "runs/study", "--cell", "0"]);
    let lock = Lock::try_take(&folder.path().join("runs/group/b")).expect("a folder").expect("a lock");
    let listed: serde_json::Value =
        serde_json::from_slice(&run(folder.path(), &["ls", "--json"]).stdout).expect("JSON");
    let of = |index: usize, key: &str| listed[index][key].clone();
    let path = format!("runs/{name}");
    for (index, path, unit, budget, state) in [
        (0, path.as_str(), "episodes", 30, "finished"),
        (1, "runs/group/b", "episodes", 30, "in work"),
        (2, "runs/study", "cells", 2, "broken off"),
    ] {
        assert_eq!([of(index, "path"), of(index, "unit"), of(index, "state")], [path, unit, state], "{listed:#}");
        assert_eq!(of(index, "budget"), budget);
    }
    assert_eq!((of(1, "what"), of(2, "done")), ("CartPole D a2c ff".into(), 1.into()));
    assert!(of(0, "success_percent").is_number() && of(2, "success_percent").is_number(), "{listed:#}");
    drop(lock);
    let table = printed(&run(folder.path(), &["ls"]));
    assert!(table.contains("runs/group/b") && table.contains(" of 30 episodes"), "{table}");
    // The list is too wide for a terminal of 80 columns.
    let listed = lines(&on_a_terminal(folder.path(), "perturb ls"));
    let listed: Vec<String> = listed.into_iter().filter(|line| !line.is_empty()).collect();
    assert_eq!(listed.len(), 7, "{listed:#?}");
    assert!(listed[6].starts_with("success: a training's last 100 episodes"), "{listed:#?}");
    assert_eq!(listed[0], format!("runs/{name}"));
    assert!(listed[1].starts_with("  CartPole D a2c ff, ") && listed[1].ends_with(" %, finished"), "{listed:#?}");
}

#[test]
fn an_extended_training_equals_one_of_the_larger_budget() {
    let folder = folder();
    let train =
        ["train", "--env", "CartPole", "--version", "R", "--set", "checkpoint_interval=10", "--set", "num_envs=2"];
    let of =
        |out: &str, episodes: &str| run(folder.path(), &[&train[..], &["--out", out, "--episodes", episodes]].concat());
    let checkpoint = |out: &str| Checkpoint::load(&folder.path().join(out)).expect("a checkpoint");
    of("part", "40");
    let done = checkpoint("part").state.counters.episodes;
    let output = run(folder.path(), &["train", "--resume", "part", "--extend", "20"]);
    let budget = done + 20; // `done` may be more than 40
    assert!(stderr(&output).contains(&format!(" of {budget} episodes, the new budget")), "{}", stderr(&output));
    of("whole", &budget.to_string());
    assert_eq!(checkpoint("part"), checkpoint("whole"));
    let config = |out: &str| read(&folder.path().join(out), "config.toml");
    assert_eq!(config("part"), config("whole"));
    let again = run(folder.path(), &["train", "--resume", "part"]);
    assert!(stderr(&again).contains("; extend it with --extend EPISODES"), "{}", stderr(&again));
}

#[test]
fn the_demo_compares_with_the_paper() {
    let folder = folder();
    let arguments = ["demo", "--env", "cartpole", "--episodes", "20", "--test-episodes", "20", "--out", "demo"];
    let text = printed(&run(folder.path(), &arguments));
    for part in ["trained on D", "trained on R", "tested on E", "Extrapolation", "15 000", "86.2 ± 12.6", "heatmap.png"]
    {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
    let config = read(folder.path(), "demo/trained-on-R/config.toml");
    assert!(config.contains("version = \"R\"") && config.contains("learning_rate = 0.003"), "{config}");
    let picture = std::fs::read(folder.path().join("demo/heatmap.png")).expect("a picture");
    assert!(picture.starts_with(b"\x89PNG"));
    // After twenty training episodes no policy balances the pole, so the demo has a failure to film.
    assert!(text.contains("failure.gif") && folder.path().join("demo/failure.gif").exists(), "{text}");
}

#[test]
fn shells_and_man_know_every_command() {
    let folder = folder();
    for shell in ["bash", "zsh", "fish"] {
        let script = printed(&run(folder.path(), &["completions", shell]));
        assert!(["evaluate", "heatmap", "episodes-per-trial", "epopt-ppo"].iter().all(|word| script.contains(word)));
    }
    run(folder.path(), &["man", "."]);
    assert!(read(folder.path(), "perturb.1").contains("Exit status"));
    assert!(read(folder.path(), "perturb-train.1").contains("perturb train \\-\\-resume runs/mine"));
}
