//! Build script that finds the commit that is built. Every package whose program prints the commit uses this script.

use std::error::Error;
use std::path::Path;
use std::process::Command;

/// Environment variable with the commit, for builds without a repository, e.g. in a container.
const VARIABLE: &str = "PERTURB_COMMIT";
/// Files and folders from which the programs are built, relative to the repository's root.
const SOURCES: [&str; 9] = ["Cargo.lock", "cli", "crates", "learner", "models", "proto", "recurrent", "serve", "src"];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-env-changed={VARIABLE}");
    let commit = std::env::var(VARIABLE).ok().or_else(git_description).unwrap_or_else(|| "unknown commit".into());
    println!("cargo:rustc-env={VARIABLE}={commit}");
    Ok(())
}

/// Returns the commit that is checked out, with "-dirty" if the programs' files differ from it.
fn git_description() -> Option<String> {
    let top = git(".", &["rev-parse", "--show-toplevel"])?;
    let log = git(&top, &["rev-parse", "--git-path", "logs/HEAD"])?; // changes with every commit and checkout
    for path in [log.as_str()].iter().chain(&SOURCES).map(|path| Path::new(&top).join(path)) {
        if path.exists() {
            println!("cargo:rerun-if-changed={}", path.display());
        }
    }
    let commit = git(&top, &["rev-parse", "--short=12", "HEAD"])?;
    let status = ["status", "--porcelain", "--untracked-files=no", "--"];
    let changed = git(&top, &[&status[..], &SOURCES].concat())?;
    Some(if changed.is_empty() { commit } else { format!("{commit}-dirty") })
}

fn git(directory: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").current_dir(directory).args(arguments).output().ok()?;
    let output = Some(output).filter(|output| output.status.success())?;
    Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
}
