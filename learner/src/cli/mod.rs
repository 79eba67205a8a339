//! The command line: `perturb envs | train | evaluate | demo`.
//!
//! Results go to standard output, everything else to standard error. Exit status: 0 done, 1 failed, 2 wrong usage, 128 +
//! the signal's number if Ctrl-C or SIGTERM ended it.

mod args;
mod bar;
mod demo;
mod envs;
mod evaluate;
mod single_thread;
mod train;

use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::Parser;

use crate::client::{LocalServerOptions, Servers};
use crate::config::ConfigError;
use crate::evaluation::TestError;
use args::{Cli, Command, ServerArgs};

/// How a command ended that did not fail.
enum Ending {
    /// All was done.
    Done,
    /// It was asked to end by this signal.
    Signal(i32),
}

/// A mistake of the person who typed the command.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct UsageError(String);

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    if matches!(cli.command, Command::Train(_) | Command::Demo(_)) {
        single_thread::ensure();
    }
    let result = match cli.command {
        Command::Envs(args) => envs::run(&args),
        Command::Train(args) => train::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Demo(args) => demo::run(&args),
    };
    match result {
        Ok(Ending::Done) => ExitCode::SUCCESS,
        Ok(Ending::Signal(number)) => signal_code(number),
        Err(error) => fail(&error),
    }
}

fn fail(error: &anyhow::Error) -> ExitCode {
    if let Some(TestError::Stopped { signal }) = error.downcast_ref() {
        eprintln!("perturb: {error}");
        return signal_code(*signal);
    }
    // A closed pipe is how `perturb envs | head` ends.
    let closed = |cause: &(dyn std::error::Error + 'static)| {
        cause.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
    };
    if error.chain().any(closed) {
        return ExitCode::SUCCESS;
    }
    eprintln!("perturb: {error:#}");
    let usage = error.downcast_ref::<ConfigError>().is_some() || error.downcast_ref::<UsageError>().is_some();
    ExitCode::from(if usage { 2 } else { 1 })
}

fn signal_code(number: i32) -> ExitCode {
    ExitCode::from(u8::try_from(128 + number).unwrap_or(1))
}

/// The servers that were named, or one of our own that takes `num_envs` environments.
fn servers(args: &ServerArgs, num_envs: usize) -> Result<Servers> {
    if args.server.is_empty() {
        let options = LocalServerOptions { workers: args.workers, num_envs };
        return Servers::local(options).context("cannot start a server for this run");
    }
    if args.workers.is_some() {
        let message = "--workers is for the server that perturb starts itself; give it to perturb-server instead";
        return Err(UsageError(message.into()).into());
    }
    Ok(Servers::connect(&args.server)?)
}
