//! Compiles the protocol's Rust types and client, and finds out which commit is built.

use std::error::Error;
use std::process::Command;

const PROTO: &str = "../proto/perturb/v1/perturb.proto";
/// Names the commit where there is no repository to ask, e.g. in a container.
const VARIABLE: &str = "PERTURB_COMMIT";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed={PROTO}");
    let descriptors = protox::compile(["perturb/v1/perturb.proto"], ["../proto"])?;
    tonic_prost_build::configure().bytes(".").build_server(false).compile_fds(descriptors)?;

    println!("cargo:rerun-if-env-changed={VARIABLE}");
    let commit = std::env::var(VARIABLE).ok().or_else(described).unwrap_or_else(|| "unknown commit".into());
    println!("cargo:rustc-env={VARIABLE}={commit}");
    Ok(())
}

/// What the program is made of.
const SOURCES: [&str; 5] = ["src", "data", "Cargo.toml", "../Cargo.lock", "../proto"];

/// The commit that is checked out, with "-dirty" if the learner's files differ from it.
fn described() -> Option<String> {
    let log = git(&["rev-parse", "--git-path", "logs/HEAD"])?; // grows with every commit and checkout
    for path in [log.as_str()].iter().chain(&SOURCES) {
        println!("cargo:rerun-if-changed={path}");
    }
    let commit = git(&["rev-parse", "--short=12", "HEAD"])?;
    let status = ["status", "--porcelain", "--untracked-files=no", "--"];
    let changed = git(&[&status[..], &SOURCES].concat())?;
    Some(if changed.is_empty() { commit } else { format!("{commit}-dirty") })
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
    Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
}
