//! The command line: `perturb envs | train | evaluate | demo | plan | run | report | curves |
//! heatmap | video | audit | rates`.
//!
//! Results go to standard output, everything else to standard error. Exit status: 0 done, 1 failed (of `audit`: an
//! episode came out otherwise, too), 2 wrong usage, 128 + the signal's number if Ctrl-C or SIGTERM ended it.

mod args;
mod audit;
mod cells;
mod demo;
mod display;
mod envs;
mod error;
mod evaluate;
mod heatmap;
mod plan;
mod rates;
mod report;
mod run;
mod sets;
mod single_thread;
mod slurm;
mod train;
mod video;

use std::io::IsTerminal;
use std::process::ExitCode;

use clap::Parser;

use args::{Cli, Command, PlayArgs, ServerArgs};
use error::{CommandError, Result};
use perturb_learner::client::{ActAt, Servers};
use perturb_study::{Folder, Plan};

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn"));
    let colours = std::io::stderr().is_terminal(); // a worker's is a file
    tracing_subscriber::fmt().with_env_filter(filter).with_ansi(colours).with_writer(std::io::stderr).init();
    if matches!(cli.command, Command::Train(_) | Command::Demo(_) | Command::Plan(_) | Command::Run(_)) {
        // An experiment's results must not depend on what a cluster's profile exports.
        single_thread::ensure(matches!(cli.command, Command::Run(_)));
    }
    let done = |()| ExitCode::SUCCESS;
    let result = match cli.command {
        Command::Envs(args) => envs::run(&args).map(done),
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
    };
    result.unwrap_or_else(|error| fail(&error))
}

fn fail(error: &CommandError) -> ExitCode {
    if error.is_closed_pipe() {
        return ExitCode::SUCCESS;
    }
    eprintln!("perturb: {error}");
    error.signal().map_or(ExitCode::from(if error.is_usage() { 2 } else { 1 }), signal_code)
}

/// The exit status of a command that this signal ended.
fn signal_code(number: i32) -> ExitCode {
    ExitCode::from(u8::try_from(128 + number).unwrap_or(1))
}

/// The servers that were named, or one of our own.
fn servers(args: &ServerArgs) -> Result<Servers> {
    if args.server.is_empty() {
        return Ok(Servers::local(args.workers)?);
    }
    refuse_workers(args)?;
    Ok(Servers::connect(&args.server)?)
}

/// The same, for those that play.
fn playing_servers(args: &PlayArgs) -> Result<Servers> {
    let act = if args.act == "client" { ActAt::Client } else { ActAt::Server };
    Ok(servers(&args.server)?.with_act(act))
}

/// The plan of an experiment, with all cells that are known.
fn plan_in(folder: &Folder) -> Result<Plan> {
    Ok(Plan::load(&folder.require_plan()?)?.in_folder(folder)?)
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
