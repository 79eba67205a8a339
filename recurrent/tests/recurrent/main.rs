//! Tests of the program `perturb-recurrent`: only it loads libtorch, and the error is helpful if it is missing. The
//! tests need the programs `perturb` and `perturb-server`; run `cargo build --workspace --release` first.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const RECURRENT: &str = env!("CARGO_BIN_EXE_perturb-recurrent");

/// Returns the path of the program `perturb`, which must be built already: `cargo build --workspace --release`.
fn perturb() -> PathBuf {
    Path::new(RECURRENT).with_file_name("perturb")
}

fn train(program: &Path, architecture: &str, out: &Path) -> Command {
    let mut command = Command::new(program);
    let options = ["--env", "CartPole", "--algorithm", "a2c", "--episodes", "20", "--architecture", architecture];
    command.arg("train").args(options).arg("--out").arg(out);
    // The copied program finds no server in its folder, so it gets the server's path.
    command.env("PERTURB_SERVER", Path::new(RECURRENT).with_file_name("perturb-server"));
    command
}

fn run(command: &mut Command) -> Output {
    command.output().expect("it runs")
}

#[test]
fn only_one_of_the_programs_loads_libtorch() {
    let libraries = |program: &Path| {
        let output = run(Command::new("ldd").arg(program));
        String::from_utf8(output.stdout).expect("text")
    };
    assert!(libraries(Path::new(RECURRENT)).contains("libtorch_cpu"));
    let of_perturb = libraries(&perturb());
    assert!(of_perturb.contains("libc.so") && !of_perturb.contains("libtorch"), "{of_perturb}");
}

#[test]
fn missing_perturb_recurrent_is_reported_with_a_remedy() {
    let folder = tempfile::tempdir().expect("a directory");
    let alone = folder.path().join("perturb");
    fs::copy(perturb(), &alone).expect("copied");
    let trained = run(&mut train(&alone, "ff", &folder.path().join("ff")));
    assert!(trained.status.success(), "{}", stderr(&trained));

    let out = folder.path().join("rc");
    let refused = run(&mut train(&alone, "rc", &out));
    assert_eq!(refused.status.code(), Some(2));
    let said = stderr(&refused).replace(&folder.path().display().to_string(), "DIR");
    let expected = "perturb: recurrent policies are trained by the program perturb-recurrent, which cannot be started: \
                    DIR/perturb-recurrent: No such file or directory (os error 2). It needs libtorch, so `make build`, \
                    `make install` and the Python wheel leave it out. In a clone of perturb, `make recurrent` builds it \
                    with libtorch, and `make install-recurrent` installs it. Or train with --architecture ff\n";
    assert_eq!(said, expected);
    assert!(!out.exists());

    // `perturb` trains with the `perturb-recurrent` in its folder, and both programs produce the same weights. Without
    // `perturb-recurrent`, `perturb` can still test a trained policy.
    fs::copy(RECURRENT, folder.path().join("perturb-recurrent")).expect("copied");
    let (out, other) = (folder.path().join("one"), folder.path().join("other"));
    for (program, out) in [("perturb", &out), ("perturb-recurrent", &other)] {
        let trained = run(&mut train(&folder.path().join(program), "rc", out));
        assert!(trained.status.success(), "{}", stderr(&trained));
    }
    assert_eq!(weights(&out), weights(&other));
    let evaluate = |program: &Path| {
        let mut command = Command::new(program);
        command.arg("evaluate").arg("--checkpoint").arg(&out).args(["--episodes", "5"]);
        run(command.env("PERTURB_SERVER", Path::new(RECURRENT).with_file_name("perturb-server")))
    };
    fs::remove_file(folder.path().join("perturb-recurrent")).expect("removed");
    let (tested, tested_there) = (evaluate(&alone), evaluate(Path::new(RECURRENT)));
    assert!(tested.status.success(), "{}", stderr(&tested));
    assert_eq!(tested.stdout, tested_there.stdout);
}

/// Returns the bytes of the weights of the run in `out`.
fn weights(out: &Path) -> Vec<u8> {
    let is_weights = |path: &Path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("weights"));
    let files = fs::read_dir(out.join("checkpoint")).expect("a checkpoint").map(|entry| entry.expect("a file").path());
    let found: Vec<_> = files.filter(|path| is_weights(path)).collect();
    assert_eq!(found.len(), 1);
    fs::read(&found[0]).expect("read")
}

#[test]
fn programs_of_two_builds_are_refused() {
    let folder = tempfile::tempdir().expect("a directory");
    let mut command = train(Path::new(RECURRENT), "rc", &folder.path().join("run"));
    let output = run(command.env("PERTURB_STARTED_BY", "0.0.1 (other)"));
    assert_eq!(output.status.code(), Some(2));
    let said = stderr(&output);
    assert!(said.contains("perturb is 0.0.1 (other), but perturb-recurrent is "), "{said}");
    assert!(said.contains("install both from one clone with `make install-recurrent`"), "{said}");
    // The two programs need not be of the same build for tasks other than training a recurrent policy.
    let output = run(Command::new(perturb()).arg("--version").env("PERTURB_STARTED_BY", "0.0.1 (other)"));
    assert!(output.status.success());
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}
