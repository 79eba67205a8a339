//! The command line: `perturb envs | ls | serve | train | evaluate | demo | plan | run | report | curves |
//! heatmap | video | audit | rates | completions | man`.
//!
//! Results go to standard output, everything else to standard error. Exit status: 0 done; 1 failed (of `audit`: an
//! episode came out otherwise, too); 2 something that was given is missing or wrong, and nothing was begun; 128 + the
//! signal's number if Ctrl-C or SIGTERM ended it.

mod again;
mod args;
mod audit;
mod cells;
mod demo;
mod display;
mod envs;
mod error;
mod evaluate;
mod heatmap;
mod json;
mod ls;
mod plan;
mod rates;
mod recurrent;
mod report;
mod run;
mod serve;
mod sets;
mod shell;
mod slurm;
mod train;
mod video;

use std::io::{ErrorKind, IsTerminal};
use std::path::Path;
use std::process::ExitCode;

use args::{Cli, Command, PlayArgs, ServerArgs, WaitArgs};
use display::{BesideBar, note};
use error::{CommandError, Result};
use perturb_experiment::{Folder, Plan};
use perturb_files::interrupt::end_on_signals;
use perturb_learner::client::{ActAt, Address, PrivateServer, ServerWait, Servers};
use tracing::Level;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    let cli = Cli::of_process();
    let usual = match (cli.quiet, cli.verbose) {
        (true, _) => Targets::new().with_default(Level::ERROR),
        (_, 0) => Targets::new().with_default(Level::WARN),
        // Targets that begin so are perturb's own; others are for RUST_LOG.
        (_, 1) => Targets::new().with_default(Level::WARN).with_target("perturb", Level::DEBUG),
        _ => Targets::new().with_default(Level::WARN).with_target("perturb", Level::TRACE),
    };
    if cli.quiet {
        display::be_quiet();
    }
    let named = std::env::var("RUST_LOG").ok().and_then(|filter| filter.parse::<Targets>().ok());
    let filter = named.unwrap_or(usual);
    let no_color = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    let colours = std::io::stderr().is_terminal() && !no_color; // a worker's is a file
    let lines =
        tracing_subscriber::fmt::layer().with_ansi(colours).with_writer(|| BesideBar).log_internal_errors(false); // they would go to standard error, which is what fails, and end the program
    tracing_subscriber::registry().with(lines).with(filter).init();
    PrivateServer::have_heard(display::say);
    if matches!(cli.command, Command::Envs(_) | Command::Report(_) | Command::Curves(_) | Command::Serve(_)) {
        // They have nothing to finish; the others look at a flag.
        let _ = end_on_signals(); // without it they end as any program does
    }
    let done = |()| ExitCode::SUCCESS;
    let result = match cli.command {
        Command::Envs(args) => envs::run(&args).map(done),
        Command::Ls(args) => ls::run(&args).map(done),
        Command::Serve(args) => serve::run(&args).map(done),
        Command::Train(args) => train::run(&args),
        Command::Evaluate(args) => evaluate::run(&args).map(done),
        Command::Demo(args) => demo::run(&args),
        Command::Plan(args) => plan::run(&args).map(done),
        Command::Run(args) => run::run(&args),
        Command::Report(args) => report::run(&args).map(done),
        Command::Curves(args) => report::curves(&args).map(done),
        Command::Heatmap(args) => heatmap::run(&args).map(done),
        Command::Video(args) => video::run(&args).map(done),
        Command::Audit(args) => audit::run(&args),
        Command::Rates(args) => rates::run(&args).map(done),
        Command::Completions(args) => shell::completions(&args).map(done),
        Command::Man(args) => shell::man(&args).map(done),
    };
    result.unwrap_or_else(|error| fail(&error))
}

fn fail(error: &CommandError) -> ExitCode {
    if error.is_closed_pipe() {
        return ExitCode::SUCCESS;
    }
    display::say(format_args!("perturb: {error}"));
    error.signal().map_or(ExitCode::from(if error.is_usage() { 2 } else { 1 }), signal_code)
}

/// The exit status of a command that this signal ended.
fn signal_code(number: i32) -> ExitCode {
    ExitCode::from(u8::try_from(128 + number).unwrap_or(1))
}

/// The servers that were named, or one of our own.
fn servers(args: &ServerArgs) -> Result<Servers> {
    let servers = if args.server.is_empty() {
        Servers::local(args.workers)?
    } else {
        refuse_workers(args)?;
        Servers::connect(&args.server)?
    };
    let whose = if args.server.is_empty() { "a server of its own" } else { "a server that was named" };
    servers.addresses().iter().for_each(|address| tracing::debug!("connected to {address}, {whose}"));
    Ok(servers)
}

/// The same, for what goes on when they are lost and come back.
fn lasting_servers(args: &ServerArgs, wait: WaitArgs) -> Result<Servers> {
    Ok(servers(args)?.with_wait(ServerWait { limit: wait.time(), tell: |sentence| note(sentence) }))
}

/// The servers of `jobs` processes at a time: those that were named, which all share, or a private one for each, since
/// one thread of a server speaks to all its clients, and processes with short steps would wait for each other.
fn servers_of_jobs(args: &ServerArgs, jobs: usize) -> Result<(Vec<PrivateServer>, Vec<Address>)> {
    if !args.server.is_empty() {
        refuse_workers(args)?;
        return Ok((Vec::new(), args.server.clone()));
    }
    let workers = args.workers.unwrap_or_else(|| workers_of_each(jobs, cores()));
    let start = |_| PrivateServer::start(Some(workers));
    let servers = (0..jobs.max(1)).map(start).collect::<std::result::Result<Vec<_>, _>>()?;
    let addresses = servers.iter().map(|server| server.address().clone()).collect();
    Ok((servers, addresses))
}

/// Physics threads of each of the private servers of `jobs` processes: one a core, or fewer where all together would have
/// more than two a core. With two cores, two processes took the same time with one or two threads each, and the last
/// one, which has both cores, a quarter less with two.
fn workers_of_each(jobs: usize, cores: usize) -> usize {
    (2 * cores / jobs.max(1)).clamp(1, cores)
}

/// Servers for those that play.
fn playing_servers(args: &PlayArgs) -> Result<Servers> {
    let act = if args.act == "client" { ActAt::Client } else { ActAt::Server };
    Ok(lasting_servers(&args.server, args.wait)?.with_act(act))
}

/// The plan of an experiment, with all cells that are known.
fn plan_in(folder: &Folder) -> Result<Plan> {
    Ok(Plan::load(&folder.require_plan()?)?.in_folder(folder)?)
}

/// Refuses a file that is not there, and a folder, with what to give; a pipe will do.
fn require_file(path: &Path, remedy: &str) -> Result<()> {
    let wrong = match path.metadata() {
        Ok(metadata) if metadata.is_dir() => format!("{} is a folder", path.display()),
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            format!("there is no file {}", path.display())
        }
        _ => return Ok(()), // whoever reads it says what else is wrong
    };
    Err(CommandError::Usage(format!("{wrong}: {remedy}")))
}

/// Refuses a place for results that is a file, or below one.
fn refuse_file(out: &Path) -> Result<()> {
    let file = out.ancestors().find(|place| place.exists()).filter(|place| !place.is_dir());
    match file {
        None => Ok(()),
        Some(file) if file == out => {
            Err(CommandError::Usage(format!("--out {} is a file; give a directory", out.display())))
        }
        Some(file) => Err(CommandError::Usage(format!(
            "--out {} cannot be made, {} is a file; give another directory",
            out.display(),
            file.display()
        ))),
    }
}

/// The plan in a file that was given.
fn load_plan(path: &Path) -> Result<Plan> {
    require_file(path, "give an experiment file; docs/experiments.md says what is in one, experiments/ has some")?;
    tracing::debug!("the plan is read from {}", path.display());
    Ok(Plan::load(path)?)
}

/// One a core, if nothing is asked for.
fn threads(wanted: Option<u16>) -> usize {
    wanted.map_or_else(cores, usize::from)
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Servers that were named have their threads already.
fn refuse_workers(args: &ServerArgs) -> Result<()> {
    if args.workers.is_some() {
        let message = "--workers is for the server that perturb starts itself; give it to perturb-server instead";
        return Err(CommandError::Usage(message.into()));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[test]
    fn results_go_neither_to_a_file_nor_below_one() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        let refused = |out: &Path| refuse_file(out).map_err(|error| error.to_string());
        let named = |name: &str| folder.path().join(name);
        assert_eq!((refused(&named("new/folder")), refused(folder.path())), (Ok(()), Ok(())));
        assert!(refused(&file).unwrap_err().ends_with("file is a file; give a directory"));
        assert!(refused(&named("file/run/deep")).unwrap_err().ends_with("file is a file; give another directory"));
    }

    #[test]
    fn a_file_that_is_asked_for_is_there_and_no_folder() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        let refused = |path: &Path| require_file(path, "give one").unwrap_err().to_string();
        assert_eq!(refused(&file), format!("there is no file {}: give one", file.display()));
        assert_eq!(refused(folder.path()), format!("{} is a folder: give one", folder.path().display()));
        std::fs::write(&file, "").unwrap();
        assert!(require_file(&file, "give one").is_ok());
        assert!(refused(&file.join("below")).starts_with("there is no file "));
    }

    #[rstest]
    #[case(1, 1, 1)]
    #[case(1, 2, 2)]
    #[case(2, 2, 2)]
    #[case(3, 2, 1)]
    #[case(9, 2, 1)]
    #[case(1, 64, 64)]
    #[case(2, 64, 64)]
    #[case(64, 64, 2)]
    #[case::nothing_to_do(0, 2, 2)]
    fn private_servers_together_have_two_threads_a_core_at_most(
        #[case] jobs: usize,
        #[case] cores: usize,
        #[case] each: usize,
    ) {
        assert_eq!(workers_of_each(jobs, cores), each);
    }
}
