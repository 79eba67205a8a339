//! The command line's arguments.

mod comparing;
mod deprecated;
mod experiments;
mod testing;
mod training;

use std::ffi::OsStr;
use std::fmt::Display;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Arg, ArgAction, Args, CommandFactory, FromArgMatches, Parser, Subcommand};

pub use comparing::CompareArgs;
pub use experiments::{CurvesArgs, Engine, ExportArgs, PlanArgs, ReportArgs, RunArgs};
use perturb_learner::client::Address;
use perturb_protocol::names;
pub use testing::{AuditArgs, EvaluateArgs, HeatmapArgs, RescoreArgs, SetArgs, VideoArgs};
pub use training::{CompletionsArgs, DemoArgs, EnvsArgs, LsArgs, ManArgs, ServeArgs, TrainArgs};

/// Trains policies over environment servers and tests whether they still work when the physics changes.
///
/// Names may be spelled in any case: `cart-pole` and `perturb/CartPole-v1` are CartPole, `r` is R. Options take
/// precedence over files, and files over defaults. Results go to standard output, everything else to standard error.
#[derive(Debug, Parser)]
#[command(
    name = "perturb",
    version,
    after_help = "Examples:
  perturb demo                                         # an introduction of about a minute
  perturb train --env Hopper --version R               # then: perturb evaluate, heatmap, video
  perturb run experiments/quick.toml --out runs/quick  # an experiment; then: perturb report runs/quick
Exit status: 0 success; 1 failure; 2 an argument or file is missing or wrong; 128 + N ended by signal N."
)]
pub struct Cli {
    /// Print only warnings and errors on standard error.
    #[arg(short, long, global = true, display_order = 1000, conflicts_with = "verbose")]
    pub quiet: bool,
    /// Log to standard error. Give it twice for all details. RUST_LOG sets a filter, e.g. warn,h2=debug, which can also
    /// select dependencies.
    #[arg(short, long, global = true, display_order = 1001, action = ArgAction::Count)]
    pub verbose: u8,
    #[command(subcommand)]
    pub command: CliCommand,
}

impl Cli {
    /// Parses the process's arguments. Ends the process with status 2 if they are wrong. Calls `warn` with a sentence
    /// for each deprecated name.
    pub fn from_process(warn: impl FnMut(String)) -> Self {
        let arguments = deprecated::renamed(std::env::args_os().collect(), warn);
        let matches = Self::parser().get_matches_from(arguments);
        Self::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
    }

    /// Returns the parser. It takes a negative number after an option as the option's value and not as another option,
    /// so that the error message is about the value.
    pub fn parser() -> clap::Command {
        let with_negative = |arg: Arg| match arg.get_action().takes_values() {
            true => arg.allow_negative_numbers(true),
            false => arg,
        };
        Self::command().mut_subcommands(|command| command.mut_args(with_negative))
    }
}

#[derive(Debug, Subcommand)]
pub enum CliCommand {
    /// List the environments with their parameters.
    Envs(EnvsArgs),
    /// List the trainings, experiments and assessments in a folder with budget, result and state.
    Ls(LsArgs),
    /// Show the trainings, experiments and assessments in a folder on a live web page.
    Serve(ServeArgs),
    /// Train a policy.
    Train(Box<TrainArgs>),
    /// Test a trained policy.
    Evaluate(EvaluateArgs),
    /// Compare conditions, such as training methods, over several seeds and in the same test episodes.
    Compare(CompareArgs),
    /// Train on default and on random physics, and compare both policies on physics that they were not trained on.
    Demo(DemoArgs),
    /// Print the number of trainings and tests of an experiment file, and estimate how long they take.
    Plan(PlanArgs),
    /// Run all trainings and tests of an experiment file, or resume them.
    Run(RunArgs),
    /// Add the results of experiments to one table, a Parquet file.
    Export(ExportArgs),
    /// Make tables of an experiment's results, with the paper's results for comparison.
    Report(ReportArgs),
    /// Draw the training curves of an experiment.
    Curves(CurvesArgs),
    /// Draw the success of policies over two parameters, for given policies or for those that an experiment selected.
    Heatmap(HeatmapArgs),
    /// Film a trained policy.
    Video(VideoArgs),
    /// Replay recorded test episodes and compare every byte of the results.
    Audit(AuditArgs),
    /// Compute success rates of recorded test episodes at any threshold, without replaying them.
    Rescore(RescoreArgs),
    /// Print a shell script that completes commands and options.
    Completions(CompletionsArgs),
    /// Write perturb's manual pages.
    Man(ManArgs),
}

/// The option for JSON output.
#[derive(Args, Clone, Debug)]
pub struct JsonArgs {
    /// Also write the result to this file as JSON. Without FILE, or with `-`, the command prints only the JSON.
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    pub json: Option<PathBuf>,
}

/// Maximum number of physics threads of a server.
const MAX_WORKERS: usize = 1024;

/// The options that select or start servers.
#[derive(Args, Clone, Debug)]
pub struct ServerArgs {
    /// Addresses of running servers, separated by commas: unix:/path, host:port, http://host:port or tcp://host:port,
    /// with TLS https://host:port [default: each training process starts a private server and stops it at the end].
    #[arg(long, value_name = "ADDRESS", value_delimiter = ',')]
    pub server: Vec<Address>,
    /// Number of physics threads of each private server [default: one for each core, fewer if --jobs starts many
    /// servers; 1 in a Slurm job].
    #[arg(long, value_name = "N", value_parser = |text: &str| within(text, 1..=MAX_WORKERS))]
    pub workers: Option<usize>,
    /// Folder of a task: an MJCF model and a file task.toml. Private servers then serve the task as an environment. Can
    /// be given several times. A running server of --server needs its own option --task.
    #[arg(long, value_name = "DIR")]
    pub task: Vec<PathBuf>,
}

/// The option for the time to wait for lost servers.
#[derive(Args, Clone, Copy, Debug)]
pub struct WaitArgs {
    /// Seconds to wait for lost servers before giving up; 0 does not wait. When a server is back, the work continues
    /// with the same result. A private server is restarted. If several servers are lost, the work continues with those
    /// that are back.
    #[arg(long, value_name = "SECONDS", default_value_t = Self::DEFAULT_SECONDS, value_parser = natural::<u32>)]
    pub server_wait: u32,
}

impl WaitArgs {
    /// Default waiting time, in seconds.
    pub const DEFAULT_SECONDS: u32 = 900;

    /// Returns the waiting time.
    pub fn time(self) -> Duration {
        Duration::from_secs(self.server_wait.into())
    }
}

/// Servers that play a policy, and the place where its actions are chosen.
#[derive(Args, Clone, Debug)]
pub struct PlayArgs {
    #[command(flatten)]
    pub server: ServerArgs,
    #[command(flatten)]
    pub wait: WaitArgs,
    /// Place where actions are chosen: in the server for whole rollouts, if it supports that, or in this process at
    /// every step. Results do not depend on it.
    #[arg(long, value_name = "WHERE", default_value = "server", value_parser = OneOf::new(&["server", "client"]))]
    pub act: String,
}

/// A parser that accepts one of a few names. Case, `-` and `_` are ignored. --help and shell completions list the
/// names.
#[derive(Clone)]
struct OneOf(Vec<&'static str>);

impl OneOf {
    fn new(names: &[&'static str]) -> Self {
        Self(names.to_vec())
    }
}

impl TypedValueParser for OneOf {
    type Value = String;

    fn parse_ref(&self, command: &clap::Command, arg: Option<&Arg>, value: &OsStr) -> Result<String, clap::Error> {
        let index = value.to_str().and_then(|written| names::find(written, self.0.iter().copied()));
        let name = index.map_or(value, |index| OsStr::new(self.0[index]));
        PossibleValuesParser::new(&self.0).parse_ref(command, arg, name)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(self.0.iter().map(PossibleValue::new)))
    }
}

fn within<T: FromStr + PartialOrd + Display>(text: &str, range: RangeInclusive<T>) -> Result<T, String> {
    let number = text.parse().ok().filter(|number| range.contains(number));
    number.ok_or_else(|| format!("expected {} to {}", range.start(), range.end()))
}

fn at_least_one<T: TryFrom<u64>>(text: &str) -> Result<T, String> {
    whole_number(text, 1)
}

fn natural<T: TryFrom<u64>>(text: &str) -> Result<T, String> {
    whole_number(text, 0)
}

/// Parses a whole number that is at least `min` and fits into `T`.
fn whole_number<T: TryFrom<u64>>(text: &str, min: u64) -> Result<T, String> {
    let number = text.parse::<u64>().ok().filter(|number| *number >= min);
    number.and_then(|number| T::try_from(number).ok()).ok_or_else(|| {
        if number.is_some() || (text.len() > 15 && text.bytes().all(|digit| digit.is_ascii_digit())) {
            return "expected a smaller number".to_owned();
        }
        let meant = text.parse::<f64>().ok().filter(|x| x.fract() == 0.0 && *x >= min as f64 && *x < 1e15);
        let digits = meant.map_or_else(String::new, |number| format!(", in digits: {number}"));
        format!("expected a whole number, at least {min}{digits}")
    })
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_parser_is_sound() {
        Cli::parser().debug_assert();
    }

    #[test]
    fn names_may_be_spelled_in_any_case() {
        let words = ["perturb", "train", "--algorithm", "EPOpt_PPO", "--architecture", "FF", "--preset", "Paper"];
        let CliCommand::Train(train) = Cli::try_parse_from(words).unwrap().command else { panic!("another command") };
        assert_eq!(train.algorithm.as_deref(), Some("epopt-ppo"));
        assert_eq!((train.architecture.as_deref(), train.preset.as_deref()), (Some("ff"), Some("paper")));
        let refused = Cli::try_parse_from(["perturb", "train", "--algorithm", "pppo"]).unwrap_err().to_string();
        assert!(refused.contains("a similar value exists: 'ppo'"), "{refused}");
        for (rule, meant) in [("TEXT", "text"), ("Code", "code"), ("steps=9", "steps=9")] {
            let words = ["perturb", "rescore", "file", "--success", rule];
            let CliCommand::Rescore(rescore) = Cli::try_parse_from(words).unwrap().command else {
                panic!("another command")
            };
            assert_eq!(rescore.success, [meant.parse().unwrap()]);
        }
    }

    #[test]
    fn a_run_is_resumed_with_its_own_settings_only() {
        let cli = Cli::command();
        let train = cli.find_subcommand("train").unwrap();
        let argument = |name: &str| train.get_arguments().find(|argument| argument.get_id() == name).unwrap();
        let refused: Vec<&str> = train
            .get_arg_conflicts_with(argument("resume"))
            .iter()
            .map(|argument| argument.get_id().as_str())
            .collect();
        for argument in train.get_arguments().map(|argument| argument.get_id().as_str()) {
            let accepted =
                ["resume", "extend", "json", "server", "server_wait", "workers", "task", "act", "threads", "help"]
                    .contains(&argument);
            assert_ne!(refused.contains(&argument), accepted, "--{argument}");
        }
    }
}
