//! What can be typed.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::client::Address;
use crate::config::{AlgorithmName, Architecture};
use crate::evaluation::Version;

/// Trains policies over environment servers and tests whether they still work when the physics changes.
#[derive(Debug, Parser)]
#[command(name = "perturb", version)]
pub(super) struct Cli {
    #[command(subcommand)]
    pub(super) command: Command,
}

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// List the environments with their parameters.
    Envs(EnvsArgs),
    /// Train a policy.
    Train(Box<TrainArgs>),
    /// Test a trained policy.
    Evaluate(EvaluateArgs),
    /// Train and test on CartPole in a few minutes, and print the result beside the paper's.
    Demo(DemoArgs),
}

/// Where environments run.
#[derive(Args, Clone, Debug)]
pub(super) struct ServerArgs {
    /// Running servers, separated by commas: unix:/path, host:port, http://host:port or tcp://host:port. Without this,
    /// perturb starts a server of its own and ends it afterwards.
    #[arg(long, value_name = "ADDRESS", value_delimiter = ',')]
    pub(super) server: Vec<Address>,
    /// Physics threads of the server that perturb starts itself [default: one a core].
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    pub(super) workers: Option<usize>,
}

#[derive(Args, Debug)]
pub(super) struct EnvsArgs {
    #[command(flatten)]
    pub(super) server: ServerArgs,
    /// Print JSON.
    #[arg(long)]
    pub(super) json: bool,
}

/// Flags beat --set, which beats --config, which beats the algorithm's defaults.
#[derive(Args, Debug)]
pub(super) struct TrainArgs {
    /// The environment's name; `perturb envs` lists them.
    #[arg(long, value_name = "NAME")]
    pub(super) env: Option<String>,
    /// Where its parameters come from [default: D].
    #[arg(long, ignore_case = true)]
    pub(super) version: Option<Version>,
    /// What learns [default: ppo].
    #[arg(long)]
    pub(super) algorithm: Option<AlgorithmName>,
    /// What acts [default: ff; with RL², which has no other, rc].
    #[arg(long)]
    pub(super) architecture: Option<Architecture>,
    /// RL² only: episodes in a trial [default: 2].
    #[arg(long, value_name = "N")]
    pub(super) episodes_per_trial: Option<u64>,
    /// Episodes to train for; EPOpt counts those that it learns from [default: 15000].
    #[arg(long, value_name = "N")]
    pub(super) episodes: Option<u64>,
    /// Fixes all randomness [default: 1].
    #[arg(long, value_name = "N")]
    pub(super) seed: Option<u64>,
    /// Directory for the checkpoint and the logs.
    #[arg(long, value_name = "DIR", required_unless_present = "resume")]
    pub(super) out: Option<PathBuf>,
    /// Delete the run that is in --out already.
    #[arg(long)]
    pub(super) overwrite: bool,
    /// A TOML file of settings, e.g. the config.toml of an earlier run.
    #[arg(long, value_name = "FILE")]
    pub(super) config: Option<PathBuf>,
    /// A setting, e.g. learning_rate=3e-4; repeatable.
    #[arg(long, value_name = "KEY=VALUE")]
    pub(super) set: Vec<String>,
    /// Go on with the run in this directory from its last checkpoint, exactly as if it had not been broken off. Its
    /// settings are those that it began with.
    #[arg(
        long,
        value_name = "DIR",
        conflicts_with_all = [
            "env", "version", "algorithm", "architecture", "episodes_per_trial", "episodes", "seed", "out",
            "overwrite", "config", "set"
        ]
    )]
    pub(super) resume: Option<PathBuf>,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

#[derive(Args, Debug)]
pub(super) struct EvaluateArgs {
    /// The --out of a training, or the checkpoint folder in it.
    #[arg(long, value_name = "DIR")]
    pub(super) checkpoint: PathBuf,
    /// Versions to test on, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "D,R,E", ignore_case = true)]
    pub(super) versions: Vec<Version>,
    /// Episodes to test on each version.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) episodes: u64,
    /// Fixes the tests' randomness; its environments differ from those of any training, also with the same number
    /// [default: the training's seed].
    #[arg(long, value_name = "N")]
    pub(super) seed: Option<u64>,
    /// Also write the result to a file, as JSON.
    #[arg(long, value_name = "FILE")]
    pub(super) json: Option<PathBuf>,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

#[derive(Args, Debug)]
pub(super) struct DemoArgs {
    /// Episodes of each of the three trainings.
    #[arg(long, value_name = "N", default_value_t = super::demo::EPISODES, value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) episodes: u64,
    /// Episodes of each of the nine tests.
    #[arg(long, value_name = "N", default_value_t = super::demo::TEST_EPISODES, value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) test_episodes: u64,
    /// Fixes all randomness.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(super) seed: u64,
    /// Keep the three runs here; without this they are deleted at the end.
    #[arg(long, value_name = "DIR")]
    pub(super) out: Option<PathBuf>,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

fn at_least_one(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(0) | Err(_) => Err("expected a whole number, at least 1".into()),
        Ok(number) => Ok(number),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn a_run_is_resumed_with_its_own_settings_only() {
        let cli = Cli::command();
        let train = cli.find_subcommand("train").unwrap();
        let of = |name: &str| train.get_arguments().find(|argument| argument.get_id() == name).unwrap();
        let refused: Vec<&str> =
            train.get_arg_conflicts_with(of("resume")).iter().map(|argument| argument.get_id().as_str()).collect();
        for argument in train.get_arguments().map(|argument| argument.get_id().as_str()) {
            let accepted = ["resume", "server", "workers", "help"].contains(&argument);
            assert_ne!(refused.contains(&argument), accepted, "--{argument}");
        }
    }
}
