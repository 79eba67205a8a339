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
    /// Say what an experiment file asks for, and what it costs.
    Plan(PlanArgs),
    /// Do all trainings and tests of an experiment file; called again, it goes on.
    Run(RunArgs),
    /// Make tables of an experiment's results, beside the paper's.
    Report(ReportArgs),
    /// Draw the training curves of an experiment.
    Curves(CurvesArgs),
    /// Draw how a trained policy does over two parameters.
    Heatmap(HeatmapArgs),
    /// Film a trained policy.
    Video(VideoArgs),
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
    /// Episodes to test on each version; of a policy trained with RL² trials, of each of which the last episode counts.
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

#[derive(Args, Debug)]
pub(super) struct PlanArgs {
    /// An experiment file, e.g. experiments/paper.toml.
    #[arg(value_name = "FILE")]
    pub(super) file: PathBuf,
    /// List the cells with their indices and ids.
    #[arg(long)]
    pub(super) cells: bool,
    /// Seconds that each measured training takes; 0 measures nothing and gives no estimate.
    #[arg(long, value_name = "SECONDS", default_value_t = 3)]
    pub(super) measure: u64,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

#[derive(Args, Debug)]
pub(super) struct RunArgs {
    /// An experiment file, e.g. experiments/quick.toml.
    #[arg(value_name = "PLAN")]
    pub(super) plan: PathBuf,
    /// Directory of the results; what is done there already is kept.
    #[arg(long, value_name = "DIR")]
    pub(super) out: PathBuf,
    /// Trainings at a time [default: one a core].
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    pub(super) jobs: Option<usize>,
    /// Try cells again that have failed.
    #[arg(long)]
    pub(super) retry_failed: bool,
    /// Do this cell only, by its index or id, in this process.
    #[arg(long, value_name = "K", conflicts_with = "jobs")]
    pub(super) cell: Option<String>,
    /// With --cell: stop when standard input is closed, and show no progress.
    #[arg(long)]
    pub(super) exit_with_stdin: bool,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

#[derive(Args, Debug)]
pub(super) struct ReportArgs {
    /// The --out of `perturb run`; tables go to its folder report/.
    #[arg(value_name = "DIR")]
    pub(super) dir: PathBuf,
    /// Also write everything, with training curves, as one HTML page that needs nothing else.
    #[arg(long, value_name = "FILE")]
    pub(super) html: Option<PathBuf>,
}

#[derive(Args, Debug)]
pub(super) struct CurvesArgs {
    /// The --out of `perturb run`.
    #[arg(value_name = "DIR")]
    pub(super) dir: PathBuf,
    /// Where the pictures go [default: DIR/report].
    #[arg(long, value_name = "DIR")]
    pub(super) out: Option<PathBuf>,
}

#[derive(Args, Debug)]
pub(super) struct HeatmapArgs {
    /// The --out of a training, or the checkpoint folder in it.
    #[arg(long, value_name = "DIR")]
    pub(super) checkpoint: PathBuf,
    /// The parameter along x, e.g. force; `perturb envs` lists them.
    #[arg(long, value_name = "PARAMETER")]
    pub(super) x: String,
    /// The parameter along y, e.g. mass.
    #[arg(long, value_name = "PARAMETER")]
    pub(super) y: String,
    /// Points along each axis, at most 100.
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = points)]
    pub(super) grid: usize,
    /// Episodes at each point.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) episodes: u64,
    /// Fixes the tests' randomness [default: the training's seed].
    #[arg(long, value_name = "N")]
    pub(super) seed: Option<u64>,
    /// The files without their endings .csv, .svg, .png [default: heatmap-X-Y in --checkpoint].
    #[arg(long, value_name = "PATH")]
    pub(super) out: Option<PathBuf>,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

#[derive(Args, Debug)]
pub(super) struct VideoArgs {
    /// The --out of a training, or the checkpoint folder in it.
    #[arg(long, value_name = "DIR")]
    pub(super) checkpoint: PathBuf,
    /// Where the environment's parameters come from.
    #[arg(long, default_value = "D", ignore_case = true)]
    pub(super) version: Version,
    /// Episodes to play; of a policy trained with RL² all episodes of a trial are shown, one after the other.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) episodes: u64,
    /// The video; its name ends in .mp4, for which ffmpeg must be installed, or in .gif, which needs nothing.
    #[arg(long, value_name = "FILE")]
    pub(super) out: PathBuf,
    /// Fixes all randomness; with the same number, `evaluate --episodes 1` tests the first episode [default: the
    /// training's seed].
    #[arg(long, value_name = "N")]
    pub(super) seed: Option<u64>,
    /// Width of the pictures, 240 to 2048 pixels.
    #[arg(long, value_name = "PIXELS", default_value_t = 480, value_parser = pixels)]
    pub(super) width: u32,
    /// Height of the pictures, 240 to 2048 pixels; the text below them comes in addition.
    #[arg(long, value_name = "PIXELS", default_value_t = 480, value_parser = pixels)]
    pub(super) height: u32,
    /// Steps shown in a second, 0.1 to 1000 [default: as many as the environment simulates in one: real time].
    #[arg(long, value_name = "N", value_parser = frames_per_second)]
    pub(super) fps: Option<f64>,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

fn pixels(text: &str) -> Result<u32, String> {
    let (least, most) = (crate::video::SMALLEST, crate::video::LARGEST);
    let number = text.parse().ok().filter(|number| (least..=most).contains(number));
    number.ok_or_else(|| format!("expected {least} to {most}"))
}

fn frames_per_second(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (0.1..=1000.0).contains(number));
    number.ok_or_else(|| "expected 0.1 to 1000".into())
}

fn points(text: &str) -> Result<usize, String> {
    let most = crate::experiment::MOST_POINTS;
    text.parse().ok().filter(|number| (1..=most).contains(number)).ok_or_else(|| format!("expected 1 to {most}"))
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
