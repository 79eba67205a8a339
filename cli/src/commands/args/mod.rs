//! What can be typed.

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

pub use experiments::{CurvesArgs, Engine, PlanArgs, ReportArgs, RunArgs};
use perturb_learner::client::Address;
use perturb_protocol::names;
pub use testing::{AuditArgs, EvaluateArgs, HeatmapArgs, RatesArgs, SetArgs, VideoArgs};
pub use training::{CompletionsArgs, DemoArgs, EnvsArgs, LsArgs, ManArgs, ServeArgs, TrainArgs};

/// Trains policies over environment servers and tests whether they still work when the physics changes.
///
/// Names are spelled as one likes: `cart-pole` or `perturb/CartPole-v1` is CartPole, `r` is R. What is typed beats a file,
/// and a file the defaults. Results go to standard output, everything else to standard error.
#[derive(Debug, Parser)]
#[command(
    name = "perturb",
    version,
    after_help = "Examples:
  perturb demo                                         # what this is about, in a few minutes
  perturb train --env Hopper --version R               # then: perturb evaluate, heatmap, video
  perturb run experiments/quick.toml --out runs/quick  # a whole study; then: perturb report runs/quick
Exit status: 0 done; 1 failed; 2 something that was given is missing or wrong; 128 + a signal's number."
)]
pub struct Cli {
    /// Say nothing on standard error but warnings and errors.
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub quiet: bool,
    /// Say on standard error what perturb does; twice: all that it can say of it. RUST_LOG, e.g.
    /// warn,h2=debug, says exactly what, also of its libraries.
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub verbose: u8,
    #[command(subcommand)]
    pub command: Command,
}

impl Cli {
    /// What the process was given. A wrong command ends it with status 2.
    pub fn of_process() -> Self {
        let matches = Self::parser().get_matches();
        Self::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
    }

    /// The parser. A negative number is the value of the option before it, which then says what it takes.
    pub fn parser() -> clap::Command {
        let with_negative = |arg: Arg| match arg.get_action().takes_values() {
            true => arg.allow_negative_numbers(true),
            false => arg,
        };
        Self::command().mut_subcommands(|command| command.mut_args(with_negative))
    }
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// List the environments with their parameters.
    Envs(EnvsArgs),
    /// List the trainings and experiments in a folder: budget, result and state of each.
    Ls(LsArgs),
    /// Show the trainings and experiments in a folder as they go, on a page in the browser.
    Serve(ServeArgs),
    /// Train a policy.
    Train(Box<TrainArgs>),
    /// Test a trained policy.
    Evaluate(EvaluateArgs),
    /// Train on default and on random physics, and see in a few minutes which policy still works where it was not trained.
    Demo(DemoArgs),
    /// Say what an experiment file asks for, and what it costs.
    Plan(PlanArgs),
    /// Do all trainings and tests of an experiment file; called again, it goes on.
    Run(RunArgs),
    /// Make tables of an experiment's results, beside the paper's.
    Report(ReportArgs),
    /// Draw the training curves of an experiment.
    Curves(CurvesArgs),
    /// Draw how trained policies do over two parameters: one policy, or those that an experiment selected.
    Heatmap(HeatmapArgs),
    /// Film a trained policy.
    Video(VideoArgs),
    /// Play recorded test episodes again and compare every byte of what came of them.
    Audit(AuditArgs),
    /// Success rates of recorded test episodes at any threshold, without playing them again.
    Rates(RatesArgs),
    /// Print what lets a shell complete perturb's commands and options.
    Completions(CompletionsArgs),
    /// Write perturb's manual pages.
    Man(ManArgs),
}

/// Where what came of a command goes, for other programs.
#[derive(Args, Clone, Debug)]
pub struct JsonArgs {
    /// Also write what came of it to this file, as JSON; `-`, or no name, prints it in place of all else.
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    pub json: Option<PathBuf>,
}

/// What a server takes.
const MOST_WORKERS: usize = 1024;

/// Where environments run.
#[derive(Args, Clone, Debug)]
pub struct ServerArgs {
    /// Running servers, separated by commas: unix:/path, host:port, http://host:port or tcp://host:port, with TLS
    /// https://host:port. Without this, perturb starts a server of its own, for each process that trains, and ends it
    /// afterwards.
    #[arg(long, value_name = "ADDRESS", value_delimiter = ',')]
    pub server: Vec<Address>,
    /// Physics threads of each server that perturb starts itself [default: one a core, fewer where --jobs starts many
    /// servers; 1 in a job of Slurm].
    #[arg(long, value_name = "N", value_parser = |text: &str| within(text, 1..=MOST_WORKERS))]
    pub workers: Option<usize>,
}

/// How long servers are waited for.
#[derive(Args, Clone, Copy, Debug)]
pub struct WaitArgs {
    /// How long to wait for servers that were lost, before giving up; what was begun then goes on, to the same bytes. The
    /// server that perturb started itself it starts again; of several, those that are back will do. 0 does not wait.
    #[arg(long, value_name = "SECONDS", default_value_t = Self::USUAL, value_parser = natural::<u32>)]
    pub server_wait: u32,
}

impl WaitArgs {
    /// Unless told otherwise, s.
    pub const USUAL: u32 = 900;

    /// As a time.
    pub fn time(self) -> Duration {
        Duration::from_secs(self.server_wait.into())
    }
}

/// Where trained and tested policies play.
#[derive(Args, Clone, Debug)]
pub struct PlayArgs {
    #[command(flatten)]
    pub server: ServerArgs,
    #[command(flatten)]
    pub wait: WaitArgs,
    /// Where actions are chosen, which changes no byte: at the server, if it can, for a whole rollout at a time; or here, at
    /// every step.
    #[arg(long, value_name = "WHERE", default_value = "server", value_parser = OneOf::new(&["server", "client"]))]
    pub act: String,
}

/// A parser of one of a few names, however it is spelled; --help and completions list them.
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
        let place = value.to_str().and_then(|written| names::find(written, self.0.iter().copied()));
        let name = place.map_or(value, |place| OsStr::new(self.0[place]));
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
    whole(text, 1)
}

fn natural<T: TryFrom<u64>>(text: &str) -> Result<T, String> {
    whole(text, 0)
}

/// A whole number from `least` on that `T` can hold.
fn whole<T: TryFrom<u64>>(text: &str, least: u64) -> Result<T, String> {
    let number = text.parse::<u64>().ok().filter(|number| *number >= least);
    number.and_then(|number| T::try_from(number).ok()).ok_or_else(|| {
        if number.is_some() || (text.len() > 15 && text.bytes().all(|digit| digit.is_ascii_digit())) {
            return "expected a smaller number".to_owned();
        }
        let meant = text.parse::<f64>().ok().filter(|x| x.fract() == 0.0 && *x >= least as f64 && *x < 1e15);
        let digits = meant.map_or_else(String::new, |number| format!(", in digits: {number}"));
        format!("expected a whole number, at least {least}{digits}")
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
    fn names_are_spelled_as_one_likes() {
        let words = ["perturb", "train", "--algorithm", "EPOpt_PPO", "--architecture", "FF", "--preset", "Paper"];
        let Command::Train(train) = Cli::try_parse_from(words).unwrap().command else { panic!("another command") };
        assert_eq!(train.algorithm.as_deref(), Some("epopt-ppo"));
        assert_eq!((train.architecture.as_deref(), train.preset.as_deref()), (Some("ff"), Some("paper")));
        let refused = Cli::try_parse_from(["perturb", "train", "--algorithm", "pppo"]).unwrap_err().to_string();
        assert!(refused.contains("a similar value exists: 'ppo'"), "{refused}");
        for (rule, meant) in [("TEXT", "text"), ("Code", "code"), ("steps=9", "steps=9")] {
            let words = ["perturb", "rates", "file", "--success", rule];
            let Command::Rates(rates) = Cli::try_parse_from(words).unwrap().command else { panic!("another command") };
            assert_eq!(rates.success, [meant.parse().unwrap()]);
        }
    }

    #[test]
    fn a_run_is_resumed_with_its_own_settings_only() {
        let cli = Cli::command();
        let train = cli.find_subcommand("train").unwrap();
        let of = |name: &str| train.get_arguments().find(|argument| argument.get_id() == name).unwrap();
        let refused: Vec<&str> =
            train.get_arg_conflicts_with(of("resume")).iter().map(|argument| argument.get_id().as_str()).collect();
        for argument in train.get_arguments().map(|argument| argument.get_id().as_str()) {
            let accepted = ["resume", "extend", "json", "server", "server_wait", "workers", "act", "threads", "help"]
                .contains(&argument);
            assert_ne!(refused.contains(&argument), accepted, "--{argument}");
        }
    }
}
