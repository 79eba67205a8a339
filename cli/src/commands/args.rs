//! What can be typed.

use std::fmt::Display;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, Parser, Subcommand};

use perturb_learner::client::Address;
use perturb_study::scheduler::slurm::TimeLimit;
use perturb_study::sets::Assignment;
use perturb_study::settings::{Architecture, Observe, Preset, Settings};
use perturb_study::success::Rule;
use perturb_study::{Grouping, MOST_POINTS, Selection, Version};

use crate::video::PIXELS;

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
    /// Draw how trained policies do over two parameters: one policy, or those that an experiment selected.
    Heatmap(HeatmapArgs),
    /// Film a trained policy.
    Video(VideoArgs),
    /// Play recorded test episodes again and compare every byte of what came of them.
    Audit(AuditArgs),
    /// Success rates of recorded test episodes at any threshold, without playing them again.
    Rates(RatesArgs),
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

/// Where trained and tested policies play.
#[derive(Args, Clone, Debug)]
pub(super) struct PlayArgs {
    #[command(flatten)]
    pub(super) server: ServerArgs,
    /// Where actions are chosen, which changes no byte: at the server, if it can, for a whole rollout at a time; or here, at
    /// every step.
    #[arg(long, value_name = "WHERE", default_value = "server", value_parser = ["server", "client"])]
    pub(super) act: String,
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
    #[arg(long)]
    pub(super) version: Option<Version>,
    /// Parameters in place of the version's: a value, or intervals to draw from, e.g. length=0.3..0.4,0.8..0.9 mass=0.1.
    #[arg(long, value_name = "PARAMETER=VALUES", num_args = 1..)]
    pub(super) parameters: Vec<Assignment>,
    /// Whose defaults settings have: those that we recommend, or those of the paper's authors [default: perturb].
    #[arg(long, value_parser = Preset::NAMES)]
    pub(super) preset: Option<String>,
    /// What learns [default: ppo].
    #[arg(long, value_parser = Settings::names())]
    pub(super) algorithm: Option<String>,
    /// What acts [default: ff; with RL², which has no other, rc].
    #[arg(long, value_parser = Architecture::NAMES)]
    pub(super) architecture: Option<String>,
    /// What the policy sees: the environment's observation, or the parameters that the episode runs with, too [default:
    /// state].
    #[arg(long, value_parser = Observe::NAMES)]
    pub(super) observe: Option<String>,
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
    /// Threads of an update; their number changes no byte [default: one a core].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=64))]
    pub(super) threads: Option<u16>,
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
            "env", "version", "parameters", "preset", "algorithm", "architecture", "observe", "episodes_per_trial",
            "episodes", "seed", "out", "overwrite", "config", "set"
        ]
    )]
    pub(super) resume: Option<PathBuf>,
    #[command(flatten)]
    pub(super) play: PlayArgs,
}

#[derive(Args, Debug)]
pub(super) struct EvaluateArgs {
    /// The --out of a training, or the checkpoint folder in it.
    #[arg(long, value_name = "DIR")]
    pub(super) checkpoint: PathBuf,
    /// Versions to test on, separated by commas [default: D,R,E; none with --parameters or --contexts].
    #[arg(long, value_delimiter = ',')]
    pub(super) versions: Vec<Version>,
    #[command(flatten)]
    pub(super) set: SetArgs,
    /// What decides about success: the rule of the paper's text, that of its published code, or a threshold of one's own for
    /// what either compares, e.g. steps=90; `perturb envs` tells them [default: text].
    #[arg(long, value_name = "text|code|QUANTITY=NUMBER")]
    pub(super) success: Option<Rule>,
    /// Keep every test episode in this file, as Parquet: `perturb audit` plays them again, `perturb rates` judges them by
    /// other thresholds, pandas and polars read it.
    #[arg(long, value_name = "FILE")]
    pub(super) records: Option<PathBuf>,
    /// Episodes to test on each version or set; a grid or a list has at least one in each of its contexts. Of a policy
    /// trained with RL² trials, of each of which the last episode counts.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) episodes: u64,
    /// Fixes the tests' randomness; its environments differ from those of any training, also with the same number
    /// [default: the training's seed].
    #[arg(long, value_name = "N")]
    pub(super) seed: Option<u64>,
    /// Test with the episodes that select a configuration where an experiment file has selection = "clean"; no other test
    /// has them.
    #[arg(long)]
    pub(super) selection: bool,
    /// Also write the result to a file, as JSON.
    #[arg(long, value_name = "FILE")]
    pub(super) json: Option<PathBuf>,
    #[command(flatten)]
    pub(super) play: PlayArgs,
}

/// Parameters beside those of the versions.
#[derive(Args, Clone, Debug)]
pub(super) struct SetArgs {
    /// Parameters of your own: a value, intervals to draw from, or the points of a grid, of which all combinations are
    /// taken; e.g. length=0.3..0.4,0.8..0.9 mass=0.1, or length=0.1..1.0/10 mass=0.1,0.2.
    #[arg(long, value_name = "PARAMETER=VALUES", num_args = 1..)]
    pub(super) parameters: Vec<Assignment>,
    /// A list of parameters of your own: a CSV file whose header names them, a row for each context.
    #[arg(long, value_name = "FILE", conflicts_with = "parameters")]
    pub(super) contexts: Option<PathBuf>,
    /// The version that parameters come from which these do not name.
    #[arg(long, value_name = "VERSION", default_value = "D")]
    pub(super) base: Version,
}

#[derive(Args, Debug)]
pub(super) struct AuditArgs {
    /// The --out of `perturb run`, the folder of one of its cells, or the --records of `perturb evaluate`.
    pub(super) dir: PathBuf,
    /// The checkpoint that was tested, for a file of records: the --out of its training, or the checkpoint folder in it.
    #[arg(long, value_name = "DIR")]
    pub(super) checkpoint: Option<PathBuf>,
    /// Episodes to play again of each policy, evenly spread over those that are recorded.
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = at_least_one)]
    pub(super) episodes: usize,
    /// Play all recorded episodes again.
    #[arg(long, conflicts_with = "episodes")]
    pub(super) all: bool,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

#[derive(Args, Debug)]
pub(super) struct RatesArgs {
    /// The folder of a cell of `perturb run`, or the --records of `perturb evaluate`.
    pub(super) file: PathBuf,
    /// Rules of success to judge the recorded episodes by, e.g. --success text code steps=85 [default: the one that they were
    /// tested with].
    #[arg(long, value_name = "text|code|QUANTITY=NUMBER", num_args = 1..)]
    pub(super) success: Vec<Rule>,
}

#[derive(Args, Debug)]
pub(super) struct DemoArgs {
    /// Episodes of each of the three trainings.
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) episodes: u64,
    /// Episodes of each of the nine tests.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..))]
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
    pub(super) file: PathBuf,
    /// List the cells with their indices and ids.
    #[arg(long)]
    pub(super) cells: bool,
    /// List the cells that have neither a result in this folder nor failed there, and nothing else.
    #[arg(long, value_name = "DIR", conflicts_with = "cells")]
    pub(super) missing: Option<PathBuf>,
    /// List --cells or --missing as JSON, and nothing else.
    #[arg(long)]
    pub(super) json: bool,
    /// Seconds that each group of trainings is measured; 0 measures nothing.
    #[arg(long, value_name = "SECONDS", default_value_t = 3)]
    pub(super) measure: u64,
    /// Estimate from what cells took that are done in this folder, where there are any of the same environment and
    /// method, e.g. a random tenth.
    #[arg(long, value_name = "DIR")]
    pub(super) from: Option<PathBuf>,
    /// The --jobs of the run [default: one a core].
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    pub(super) jobs: Option<usize>,
    /// The --group of the run.
    #[arg(long, value_name = "N", default_value_t = Grouping::USUAL, value_parser = at_least_one)]
    pub(super) group: usize,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

#[derive(Args, Debug)]
pub(super) struct RunArgs {
    /// An experiment file, e.g. experiments/quick.toml.
    pub(super) plan: PathBuf,
    /// Directory of the results; what is done there already is kept.
    #[arg(long, value_name = "DIR")]
    pub(super) out: PathBuf,
    /// Processes at a time, each of which does a group of cells [default: one a core; with --engine, one in each of its
    /// jobs].
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    pub(super) jobs: Option<usize>,
    /// The most cells of one environment and architecture that a process does together; 1 for each by itself. It changes
    /// no result.
    #[arg(long, value_name = "N", default_value_t = Grouping::USUAL, value_parser = at_least_one)]
    pub(super) group: usize,
    /// Try cells again that have failed.
    #[arg(long)]
    pub(super) retry_failed: bool,
    /// Do these cells only, by index or id, separated by commas. A plan.toml that is in DIR stays as it is.
    #[arg(long, value_name = "K", value_delimiter = ',')]
    pub(super) cell: Vec<String>,
    /// When nothing is left to do, also write the report, as `perturb report DIR --html FILE` does.
    #[arg(long, value_name = "FILE", conflicts_with = "cell")]
    pub(super) html: Option<PathBuf>,
    /// Print what happens to each cell as JSON lines.
    #[arg(long, conflicts_with = "engine")]
    pub(super) json: bool,
    /// Do the cells that a line of standard input names; stop when standard input is closed.
    #[arg(long, hide = true, requires = "server",
        conflicts_with_all = ["cell", "jobs", "group", "engine", "retry_failed", "html"])]
    pub(super) worker: bool,
    #[command(flatten)]
    pub(super) engine: EngineArgs,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

/// Who schedules a run past one machine.
#[derive(Args, Debug)]
pub(super) struct EngineArgs {
    /// Submit the cells as jobs of this engine, watch them, and submit again what it lost. DIR and this program must be
    /// at the same place on all its machines. --jobs and --workers are those of each of its jobs.
    #[arg(long, value_name = "NAME", conflicts_with = "cell")]
    pub(super) engine: Option<Engine>,
    /// Slurm's partition [default: Slurm's].
    #[arg(long, value_name = "NAME", requires = "engine")]
    pub(super) partition: Option<String>,
    /// How long a job may take: minutes, or another of Slurm's forms, e.g. 1-12:00:00 [default: the partition's].
    #[arg(long, value_name = "TIME", requires = "engine")]
    pub(super) time: Option<TimeLimit>,
    /// Jobs that may run at a time [default: as many as there is room for].
    #[arg(long, value_name = "N", requires = "engine", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) array_limit: Option<u32>,
    /// Cells that a job does, of one environment and architecture [default: as many as take some minutes].
    #[arg(long, value_name = "N", requires = "engine", value_parser = at_least_one)]
    pub(super) cells_per_job: Option<usize>,
}

/// A scheduler of jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Engine {
    /// Slurm, with its commands sbatch, squeue and scontrol.
    Slurm,
}

#[derive(Args, Debug)]
pub(super) struct ReportArgs {
    /// The --out of `perturb run`; tables go to its folder report/.
    pub(super) dir: PathBuf,
    /// The rule by which configurations are selected [default: the plan's]. Of a plan with selection = "clean", `paper`
    /// reports its tuning cells as the paper would; tables go to report/paper/.
    #[arg(long, value_name = "RULE")]
    pub(super) selection: Option<Selection>,
    /// Also write everything, with training curves and the heatmaps of `perturb heatmap`, as one HTML page that needs
    /// nothing else.
    #[arg(long, value_name = "FILE")]
    pub(super) html: Option<PathBuf>,
}

#[derive(Args, Debug)]
pub(super) struct CurvesArgs {
    /// The --out of `perturb run`.
    pub(super) dir: PathBuf,
    /// Where the pictures go [default: DIR/report].
    #[arg(long, value_name = "DIR")]
    pub(super) out: Option<PathBuf>,
}

#[derive(Args, Debug)]
pub(super) struct HeatmapArgs {
    /// The --out of `perturb run`: every policy that was selected in one of its runs. What they do goes to its folder
    /// heatmaps/, where what is there is kept; pictures of the means over runs go to report/.
    #[arg(
        value_name = "DIR",
        required_unless_present = "checkpoint",
        conflicts_with_all = ["checkpoint", "parameters", "records", "out"]
    )]
    pub(super) dir: Option<PathBuf>,
    /// Policies instead, of one environment: the --out of each training, or the checkpoint folder in it. The picture shows
    /// the mean over those of a method that were trained on the same, side by side with others.
    #[arg(long, value_name = "DIR", num_args = 1..)]
    pub(super) checkpoint: Vec<PathBuf>,
    /// Test the policies of the first N runs only, and draw what is there of the others [default: of all runs].
    #[arg(long, value_name = "N", conflicts_with = "checkpoint", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) runs: Option<u32>,
    /// The parameter along x, e.g. force; `perturb envs` lists them. Environments of DIR that lack one are left out
    /// [default: the environment's usual two].
    #[arg(long, value_name = "PARAMETER", requires = "y")]
    pub(super) x: Option<String>,
    /// The parameter along y, e.g. mass.
    #[arg(long, value_name = "PARAMETER", requires = "x")]
    pub(super) y: Option<String>,
    /// The version that other parameters come from: D, where each has its default, or R or E, of which they are drawn for
    /// each episode.
    #[arg(long, value_name = "VERSION", default_value = "D")]
    pub(super) base: Version,
    /// Values of other parameters, e.g. force=7 [default: those of --base].
    #[arg(long, value_name = "PARAMETER=VALUE", num_args = 1.., requires = "checkpoint")]
    pub(super) parameters: Vec<Assignment>,
    /// Make the heatmap again from the files .parquet that an earlier one left, one for each --checkpoint, without playing.
    #[arg(
        long,
        value_name = "FILE",
        num_args = 1..,
        requires = "checkpoint",
        conflicts_with_all = ["grid", "episodes", "seed", "parameters", "base"]
    )]
    pub(super) records: Vec<PathBuf>,
    /// Points along each axis, at most 100.
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = |text: &str| within(text, 1..=MOST_POINTS))]
    pub(super) grid: usize,
    /// Episodes of each policy at each point.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) episodes: u64,
    /// Fixes the tests' randomness [default: each training's seed].
    #[arg(long, value_name = "N")]
    pub(super) seed: Option<u64>,
    /// The files without their endings .csv, .svg, .png, .parquet [default: in the working directory, named after
    /// environment, algorithm, architecture, version, seed and parameters].
    #[arg(long, value_name = "PATH")]
    pub(super) out: Option<PathBuf>,
    #[command(flatten)]
    pub(super) play: PlayArgs,
}

#[derive(Args, Debug)]
pub(super) struct VideoArgs {
    /// The --out of a training, or the checkpoint folder in it.
    #[arg(long, value_name = "DIR")]
    pub(super) checkpoint: PathBuf,
    /// Where the environment's parameters come from.
    #[arg(long, default_value = "D")]
    pub(super) version: Version,
    /// Parameters in place of the version's: a value, or intervals to draw from, e.g. length=0.8..0.9 mass=0.1.
    #[arg(long, value_name = "PARAMETER=VALUES", num_args = 1..)]
    pub(super) parameters: Vec<Assignment>,
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
    #[arg(long, value_name = "PIXELS", default_value_t = 480, value_parser = |text: &str| within(text, PIXELS))]
    pub(super) width: u32,
    /// Height of the pictures, 240 to 2048 pixels; the text below them comes in addition.
    #[arg(long, value_name = "PIXELS", default_value_t = 480, value_parser = |text: &str| within(text, PIXELS))]
    pub(super) height: u32,
    /// Steps shown in a second, 0.1 to 1000 [default: as many as the environment simulates in one: real time].
    #[arg(long, value_name = "N", value_parser = |text: &str| within(text, 0.1..=1000.0))]
    pub(super) fps: Option<f64>,
    #[command(flatten)]
    pub(super) server: ServerArgs,
}

fn within<T: FromStr + PartialOrd + Display>(text: &str, range: RangeInclusive<T>) -> Result<T, String> {
    let number = text.parse().ok().filter(|number| range.contains(number));
    number.ok_or_else(|| format!("expected {} to {}", range.start(), range.end()))
}

fn at_least_one(text: &str) -> Result<usize, &'static str> {
    text.parse().ok().filter(|number| *number > 0).ok_or("expected a whole number, at least 1")
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
            let accepted = ["resume", "server", "workers", "act", "threads", "help"].contains(&argument);
            assert_ne!(refused.contains(&argument), accepted, "--{argument}");
        }
    }
}
