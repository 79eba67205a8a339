//! The command line: `perturb envs | ls | serve | train | evaluate | compare | demo | plan | run | export | report |
//! curves | heatmap | video | audit | rescore | completions | man`.
//!
//! Results go to standard output, everything else to standard error. Exit status: 0 for success; 1 for a failure, and
//! for an `audit` that finds a different episode; 2 if an argument or file is missing or wrong, so that the command did
//! not begin; 128 + N if signal N ended the command.

mod args;
mod audit;
mod by;
mod cells;
mod compare;
mod demo;
mod display;
mod envs;
mod error;
mod evaluate;
mod export;
mod heatmap;
mod json;
mod ls;
mod plan;
mod recurrent;
mod report;
mod rescore;
mod resume_hint;
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

use args::{Cli, CliCommand, PlayArgs, ServerArgs, WaitArgs};
use display::{AboveBar, note};
use error::{CommandError, Result};
use perturb_experiment::{ExperimentFolder, Plan};
use perturb_files::interrupt::{StopFlag, end_on_signals};
use perturb_learner::client::{ActorLocation, Address, PrivateServer, ServerWait, Servers};
use tracing::Level;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    let _ = perturb_system::ignore_sigxfsz(); // if it fails, writing beyond `ulimit -f` ends the program
    let cli = Cli::from_process(|warning| {
        // After `perturb` has replaced itself with perturb-recurrent, do not print the warning again.
        if !recurrent::is_replacement() {
            display::say(format_args!("perturb: {warning}"));
        }
    });
    let default_filter = match (cli.quiet, cli.verbose) {
        (true, _) => Targets::new().with_default(Level::ERROR),
        (_, 0) => Targets::new().with_default(Level::WARN),
        // Targets that begin with `perturb` belong to this project. RUST_LOG can select others.
        (_, 1) => Targets::new().with_default(Level::WARN).with_target("perturb", Level::DEBUG),
        _ => Targets::new().with_default(Level::WARN).with_target("perturb", Level::TRACE),
    };
    if cli.quiet {
        display::be_quiet();
    }
    let given_filter = std::env::var("RUST_LOG").ok().and_then(|filter| filter.parse::<Targets>().ok());
    let filter = given_filter.unwrap_or(default_filter);
    let no_color = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    let colours = std::io::stderr().is_terminal() && !no_color;
    let lines = tracing_subscriber::fmt::layer()
        .with_ansi(colours)
        .with_writer(|| AboveBar)
        // Internal errors of the logger mean that standard error failed. Printing them there would end the program.
        .log_internal_errors(false);
    tracing_subscriber::registry().with(lines).with(filter).init();
    PrivateServer::set_stderr_handler(display::say);
    if matches!(
        cli.command,
        CliCommand::Envs(_)
            | CliCommand::Export(_)
            | CliCommand::Report(_)
            | CliCommand::Curves(_)
            | CliCommand::Serve(_)
    ) {
        // Signals end these commands at once, because they have nothing to finish. Commands that play episodes check a
        // flag instead. In all other commands, and if the handler cannot be installed, signals have their default
        // effect, which also ends the program.
        let _ = end_on_signals();
    }
    let success = |()| ExitCode::SUCCESS;
    let result = match cli.command {
        CliCommand::Envs(args) => envs::run(&args).map(success),
        CliCommand::Ls(args) => ls::run(&args).map(success),
        CliCommand::Serve(args) => serve::run(&args).map(success),
        CliCommand::Train(args) => train::run(&args),
        CliCommand::Evaluate(args) => evaluate::run(&args).map(success),
        CliCommand::Compare(args) => compare::run(&args).map(success),
        CliCommand::Demo(args) => demo::run(&args),
        CliCommand::Plan(args) => plan::run(&args).map(success),
        CliCommand::Run(args) => run::run(&args),
        CliCommand::Export(args) => export::run(&args).map(success),
        CliCommand::Report(args) => report::run(&args).map(success),
        CliCommand::Curves(args) => report::curves(&args).map(success),
        CliCommand::Heatmap(args) => heatmap::run(&args).map(success),
        CliCommand::Video(args) => video::run(&args).map(success),
        CliCommand::Audit(args) => audit::run(&args),
        CliCommand::Rescore(args) => rescore::run(&args).map(success),
        CliCommand::Completions(args) => shell::completions(&args).map(success),
        CliCommand::Man(args) => shell::man(&args).map(success),
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

/// Returns the exit status of a command that this signal ended.
fn signal_code(number: i32) -> ExitCode {
    ExitCode::from(u8::try_from(128 + number).unwrap_or(1))
}

/// Connects to the servers of --server, or starts a private server.
fn servers(args: &ServerArgs, stop: &StopFlag) -> Result<Servers> {
    check_server_args(args)?;
    let servers = if args.server.is_empty() {
        Servers::local(args.workers, &args.task, stop)?
    } else {
        Servers::connect_until(&args.server, stop)?
    };
    let kind = if args.server.is_empty() { "a private server" } else { "a server given by --server" };
    servers.addresses().iter().for_each(|address| tracing::debug!("connected to {address}, {kind}"));
    Ok(servers)
}

/// Returns [`servers`]. If a server is lost, the learner tries to reconnect for as long as `wait` permits.
fn reconnecting_servers(args: &ServerArgs, wait: WaitArgs, stop: &StopFlag) -> Result<Servers> {
    Ok(servers(args, stop)?.with_wait(ServerWait { limit: wait.time(), tell: |sentence| note(sentence) }))
}

/// Returns the servers for `jobs` simultaneous processes. All processes share the servers of --server. Without
/// --server, each process gets a private server. A private server has a single transport thread, so processes with
/// short steps that shared it would wait for each other.
fn servers_of_jobs(args: &ServerArgs, jobs: usize, stop: &StopFlag) -> Result<(Vec<PrivateServer>, Vec<Address>)> {
    check_server_args(args)?;
    if !args.server.is_empty() {
        return Ok((Vec::new(), args.server.clone()));
    }
    let workers = args.workers.unwrap_or_else(|| workers_of_each(jobs, cores()));
    let start = |_| PrivateServer::start_unless(Some(workers), &args.task, &|| stop.signal());
    let servers = (0..jobs.max(1)).map(start).collect::<std::result::Result<Vec<_>, _>>()?;
    let addresses = servers.iter().map(|server| server.address().clone()).collect();
    Ok((servers, addresses))
}

/// Returns the number of physics threads for each of `jobs` private servers: one for each core. If all servers together
/// would then have more than two threads for each core, each server has fewer, but at least one.
///
/// The limit comes from a measurement on two cores. Two simultaneous processes took the same time with one thread each
/// and with two threads each. A process that ran alone took a quarter less time with two threads.
fn workers_of_each(jobs: usize, cores: usize) -> usize {
    (2 * cores / jobs.max(1)).clamp(1, cores)
}

/// Returns the servers for a command that plays a policy. --act sets where actions are chosen.
fn playing_servers(args: &PlayArgs, stop: &StopFlag) -> Result<Servers> {
    let act = if args.act == "client" { ActorLocation::Client } else { ActorLocation::Server };
    Ok(reconnecting_servers(&args.server, args.wait, stop)?.with_act(act))
}

/// Loads the plan in an experiment's folder, and adds the cells that its tuning has selected so far.
fn plan_in(folder: &ExperimentFolder) -> Result<Plan> {
    Ok(Plan::load(&folder.require_plan()?)?.with_selected_cells(folder)?)
}

/// Refuses servers whose models differ from those of the results in `folder`.
fn check_models(servers: &Servers, plan: &Plan, folder: &ExperimentFolder) -> Result<()> {
    plan.environments().into_iter().try_for_each(|name| Ok(folder.check_model(plan, &servers.environment(name)?)?))
}

/// Refuses a missing file, a folder, a pipe and a device, with a remedy.
fn require_file(path: &Path, remedy: &str) -> Result<()> {
    let wrong = match path.metadata() {
        Ok(metadata) if metadata.is_dir() => format!("{} is a folder", path.display()),
        Ok(metadata) if !metadata.is_file() => format!("{} is a pipe or a device, not a regular file", path.display()),
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            format!("there is no file {}", path.display())
        }
        // Reading the file will report other problems.
        _ => return Ok(()),
    };
    Err(CommandError::Usage(format!("{wrong}: {remedy}")))
}

/// Refuses a path for the folder of results if the path, or a part of it, is a file.
fn refuse_file(out: &Path) -> Result<()> {
    let file = out.ancestors().find(|path| path.exists()).filter(|path| !path.is_dir());
    match file {
        None => Ok(()),
        Some(file) if file == out => {
            Err(CommandError::Usage(format!("--out {} is a file; give a directory", out.display())))
        }
        Some(file) => Err(CommandError::Usage(format!(
            "--out {} cannot be made because {} is a file; give another directory",
            out.display(),
            file.display()
        ))),
    }
}

/// Refuses a default folder for results that cannot be written, e.g. in the experiment of another user.
fn require_default_out(folder: &Path) -> Result<()> {
    refuse_file(folder)?;
    perturb_files::require_writable_folder(folder)
        .map_err(|error| CommandError::Usage(format!("{error}; give another folder with --out")))
}

/// Loads the plan from an experiment file.
fn load_plan(path: &Path) -> Result<Plan> {
    require_file(path, "give an experiment file; docs/experiments.md describes them, and experiments/ has examples")?;
    tracing::debug!("reading the plan from {}", path.display());
    Ok(Plan::load(path)?)
}

/// Returns the number of threads for policy updates; by default one for each core.
fn threads(wanted: Option<u16>) -> usize {
    wanted.map_or_else(cores, usize::from)
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Refuses options of private servers together with --server, and folders of --task without a task.
fn check_server_args(args: &ServerArgs) -> Result<()> {
    if !args.server.is_empty() {
        let given = [(args.workers.is_some(), "--workers"), (!args.task.is_empty(), "--task")];
        return match given.iter().find(|(is_given, _)| *is_given) {
            Some((_, option)) => {
                let message = format!("{option} is for a private server; give it to perturb-server instead");
                Err(CommandError::Usage(message))
            }
            None => Ok(()),
        };
    }
    for folder in &args.task {
        let wrong = match folder.join("task.toml").is_file() {
            true => continue,
            false if folder.is_dir() => "has no file task.toml",
            false if folder.exists() => "is not a folder",
            false => "does not exist",
        };
        return Err(CommandError::Usage(format!(
            "--task {} {wrong}: give the folder of a task, which docs/tasks.md describes",
            folder.display()
        )));
    }
    Ok(())
}

/// Returns the servers' arguments with the task folders of `plan`, unless --task or --server is given.
fn with_tasks_of(args: &ServerArgs, plan: &Plan) -> Result<ServerArgs> {
    if !args.server.is_empty() || !args.task.is_empty() {
        return Ok(args.clone());
    }
    let missing = plan.tasks.iter().find(|folder| !folder.join("task.toml").is_file());
    match missing {
        None => Ok(ServerArgs { task: plan.tasks.clone(), ..args.clone() }),
        Some(folder) => Err(CommandError::Usage(format!(
            "the experiment's tasks name {}, which has no file task.toml: bring the folder back, or give --task DIR",
            folder.display()
        ))),
    }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[test]
    fn files_are_refused_as_folders_of_results() {
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
    fn missing_files_and_folders_are_refused_as_files() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        let refused = |path: &Path| require_file(path, "give one").unwrap_err().to_string();
        assert_eq!(refused(&file), format!("there is no file {}: give one", file.display()));
        assert_eq!(refused(folder.path()), format!("{} is a folder: give one", folder.path().display()));
        std::fs::write(&file, "").unwrap();
        assert!(require_file(&file, "give one").is_ok());
        assert!(refused(&file.join("below")).starts_with("there is no file "));
        assert_eq!(refused(Path::new("/dev/zero")), "/dev/zero is a pipe or a device, not a regular file: give one");
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
    fn private_servers_share_threads_or_have_one_each(#[case] jobs: usize, #[case] cores: usize, #[case] each: usize) {
        assert_eq!(workers_of_each(jobs, cores), each);
    }
}
