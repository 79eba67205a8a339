//! Arguments of the commands that test, film and check trained policies.

use std::path::PathBuf;

use clap::Args;
use perturb_protocol::{Version, names};
use perturb_records::MAX_POINTS;
use perturb_records::success::Rule;
use perturb_settings::ValueError;
use perturb_settings::sets::Assignment;

use super::{JsonArgs, PlayArgs, ServerArgs, WaitArgs, at_least_one, natural, within};
use crate::video::PIXELS;

/// Parses a success rule. The names `text` and `code` may be written in any case.
pub(super) fn success_rule(text: &str) -> Result<Rule, ValueError> {
    let known = ["text", "code"];
    names::find(text.trim(), known.into_iter()).map_or(text, |index| known[index]).parse()
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb evaluate --checkpoint runs/mine
  perturb evaluate --checkpoint runs/mine --versions E --episodes 200 --json -
  perturb evaluate --checkpoint runs/mine --parameters length=0.1..2.0/20 --by length --records long.parquet")]
pub struct EvaluateArgs {
    /// The --out folder of a training, its checkpoint folder, a policy file (.safetensors), the folder of a cell, or a
    /// policy's name: the id of a cell in results/ of the working directory, or in the folder that PERTURB_RESULTS
    /// names.
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Versions to test on, separated by commas [default: D,R,E; none with --parameters or --contexts].
    #[arg(long, value_delimiter = ',')]
    pub versions: Vec<Version>,
    #[command(flatten)]
    pub set: SetArgs,
    /// Rule that decides about success: `text` for the rule of the paper's text, `code` for that of its published code,
    /// or another threshold for the quantity of these rules, e.g. steps=90. `perturb envs` lists both rules [default:
    /// text].
    #[arg(long, value_name = "text|code|QUANTITY=NUMBER", value_parser = success_rule)]
    pub success: Option<Rule>,
    /// Write every test episode to this Parquet file. `perturb audit` replays the episodes, `perturb rescore` applies
    /// other thresholds, and pandas and polars read the file.
    #[arg(long, value_name = "FILE")]
    pub records: Option<PathBuf>,
    /// Number of test episodes on each version or set. A grid or a list has at least one episode in each context. For a
    /// policy trained with RL² it is the number of trials, and only the last episode of each trial counts.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = at_least_one::<u64>)]
    pub episodes: u64,
    /// Random seed of the tests. Tests and trainings never draw the same environments, even with the same seed
    /// [default: the training's seed].
    #[arg(long, value_name = "N", value_parser = natural::<u64>)]
    pub seed: Option<u64>,
    /// Test with the episodes that select configurations in experiments with selection = "clean". No other test uses
    /// these episodes.
    #[arg(long)]
    pub selection_episodes: bool,
    /// Also print success for each value of this parameter, the lowest success rate first. `context` prints it for each
    /// context of a grid or a list. The range of a drawn parameter is divided into about ten equal parts.
    #[arg(long, value_name = "PARAMETER|context")]
    pub by: Option<String>,
    #[command(flatten)]
    pub json: JsonArgs,
    #[command(flatten)]
    pub play: PlayArgs,
}

/// Custom sets of parameters to test on, in addition to the versions.
#[derive(Args, Clone, Debug)]
pub struct SetArgs {
    /// Parameters to test on: a value, intervals to draw from, or the points of a grid, e.g. length=0.3..0.4,0.8..0.9
    /// mass=0.1, or length=0.1..1.0/10 mass=0.1,0.2. All combinations of a grid's points are tested.
    #[arg(long, value_name = "PARAMETER=VALUES", num_args = 1..)]
    pub parameters: Vec<Assignment>,
    /// A list of parameters to test on: a CSV file whose header names parameters, with a row for each context.
    #[arg(long, value_name = "FILE", conflicts_with = "parameters")]
    pub contexts: Option<PathBuf>,
    /// Version from which all parameters are drawn that --parameters or --contexts do not name.
    #[arg(long, value_name = "VERSION", default_value = "D")]
    pub base_version: Version,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb audit runs/quick                           # 30 episodes of each policy, spread over all of its tests
  perturb audit long.parquet --checkpoint runs/long --all
  perturb audit results                              # all tests of the stored policies beside a results table
  perturb audit runs/quick --ledger ledger.jsonl     # replays nothing: checks the training environments")]
pub struct AuditArgs {
    /// Recorded tests: the --out folder of `perturb run`, the folder of a cell, the --records file of `perturb
    /// evaluate`, or a folder that `Assessment.save` wrote in Python. DIR can also be a table of `perturb export
    /// --policies`, the folder of the table, or a policy that was exported with the table. For a table or an exported
    /// policy, --episodes has no effect: all test episodes are replayed, and their checksums are compared with those in
    /// the table.
    pub dir: PathBuf,
    /// Tested policy of a records file: the --out folder of its training, its checkpoint folder, the folder of its
    /// cell, or a policy's name in results/ of the working directory or in the folder that PERTURB_RESULTS names. For
    /// an assessment, give the checkpoints of all its policies that perturb trained.
    #[arg(long, value_name = "DIR", num_args = 1..)]
    pub checkpoint: Vec<PathBuf>,
    /// Number of episodes of each policy to replay, evenly spread over the recorded ones.
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = at_least_one::<usize>)]
    pub episodes: usize,
    /// Replay all recorded episodes.
    #[arg(long, conflicts_with = "episodes")]
    pub all: bool,
    /// Check the ledgers of all servers that the trainings used (`perturb-server --ledger`), and replay nothing. The
    /// ledgers prove that a training drew only from its stated set, and played no test episode and no other test set.
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["episodes", "all"])]
    pub ledger: Vec<PathBuf>,
    /// Digests that the ledgers must contain. A server logs its ledger's digest when it ends, and an audit prints it. A
    /// digest proves that no earlier line of the ledger was changed.
    #[arg(long, value_name = "DIGEST", num_args = 1.., requires = "ledger")]
    pub head: Vec<String>,
    #[command(flatten)]
    pub json: JsonArgs,
    #[command(flatten)]
    pub server: ServerArgs,
    #[command(flatten)]
    pub wait: WaitArgs,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb rescore long.parquet                       # the --records of perturb evaluate
  perturb rescore long.parquet --success text code steps=85
  perturb rescore long.parquet --by length           # where it fails, the worst first")]
pub struct RescoreArgs {
    /// The folder of a cell of `perturb run`, or the --records file of `perturb evaluate`.
    pub file: PathBuf,
    /// Success rules to apply to the recorded episodes, e.g. --success text code steps=85 [default: the rule of the
    /// test].
    #[arg(long, value_name = "text|code|QUANTITY=NUMBER", num_args = 1.., value_parser = success_rule)]
    pub success: Vec<Rule>,
    /// Also print success for each value of this parameter, the lowest success rate first. `context` prints it for each
    /// context of a grid or a list. The range of a drawn parameter is divided into about ten equal parts.
    #[arg(long, value_name = "PARAMETER|context")]
    pub by: Option<String>,
    #[command(flatten)]
    pub json: JsonArgs,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb heatmap --checkpoint runs/on-d runs/on-r --out d-and-r
  perturb heatmap runs/quick")]
pub struct HeatmapArgs {
    /// The --out folder of `perturb run`. Every policy that was selected in one of its runs is tested. The results go
    /// to DIR/heatmaps/, and existing results are kept. Pictures of the means over runs go to DIR/report/.
    #[arg(
        value_name = "DIR",
        required_unless_present = "checkpoint",
        conflicts_with_all = ["checkpoint", "parameters", "records"]
    )]
    pub dir: Option<PathBuf>,
    /// Policies of one environment. Each is the --out folder of a training, a checkpoint folder, the folder of a cell, or
    /// a policy's name in results/ of the working directory or in the folder that PERTURB_RESULTS names. The picture has
    /// a panel for each method and training set, with the mean over its policies.
    #[arg(long, value_name = "DIR", num_args = 1..)]
    pub checkpoint: Vec<PathBuf>,
    /// Test only the policies of the first N runs. Existing heatmaps of other runs are still drawn [default: all runs].
    #[arg(long, value_name = "N", conflicts_with = "checkpoint", value_parser = at_least_one::<u32>)]
    pub runs: Option<u32>,
    /// Parameter along the x axis, e.g. force; `perturb envs` lists them. Environments of DIR without this parameter
    /// are left out [default: chosen by the environment].
    #[arg(long, value_name = "PARAMETER", requires = "y")]
    pub x: Option<String>,
    /// Parameter along the y axis, e.g. mass.
    #[arg(long, value_name = "PARAMETER", requires = "x")]
    pub y: Option<String>,
    /// Version of all other parameters. On D each has its default; on R and E they are drawn for each episode.
    #[arg(long, value_name = "VERSION", default_value = "D")]
    pub base_version: Version,
    /// Values of other parameters, e.g. force=7 [default: those of --base-version].
    #[arg(long, value_name = "PARAMETER=VALUE", num_args = 1.., requires = "checkpoint")]
    pub parameters: Vec<Assignment>,
    /// Draw the heatmap from the .parquet files of an earlier call, one for each --checkpoint, without testing again.
    #[arg(
        long,
        value_name = "FILE",
        num_args = 1..,
        requires = "checkpoint",
        conflicts_with_all = ["grid", "episodes", "seed", "parameters", "base_version"]
    )]
    pub records: Vec<PathBuf>,
    /// Number of points along each axis, at most 100.
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = |text: &str| within(text, 1..=MAX_POINTS))]
    pub grid: usize,
    /// Number of episodes of each policy at each point.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = at_least_one::<u64>)]
    pub episodes: u64,
    /// Random seed of the tests [default: each training's seed].
    #[arg(long, value_name = "N", value_parser = natural::<u64>)]
    pub seed: Option<u64>,
    /// With --checkpoint, path of the files without the extensions .csv, .svg, .png and .parquet [default: in the
    /// working directory, named after environment, algorithm, architecture, version, seed and parameters]. With DIR, a
    /// folder for pictures and new heatmaps, e.g. if DIR belongs to another user [default: DIR/report and
    /// DIR/heatmaps].
    #[arg(long, value_name = "PATH")]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub play: PlayArgs,
}

#[derive(Args, Debug)]
#[command(after_help = "Example:
  perturb video --checkpoint runs/mine --version E --episodes 3 --out mine.gif
  perturb video --checkpoint runs/mine --version D,E --episodes 4 --out sheet.png")]
pub struct VideoArgs {
    /// The --out folder of a training, its checkpoint folder, the folder of a cell, or a policy's name: the id of a
    /// cell in results/ of the working directory, or in the folder that PERTURB_RESULTS names.
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Versions of the environment's parameters, separated by commas. A film shows them one after the other, and a
    /// contact sheet shows them side by side.
    #[arg(long, value_delimiter = ',', default_value = "D")]
    pub version: Vec<Version>,
    /// Parameters that replace those of the version: a value, or intervals to draw from, e.g. length=0.8..0.9 mass=0.1.
    #[arg(long, value_name = "PARAMETER=VALUES", num_args = 1..)]
    pub parameters: Vec<Assignment>,
    /// Number of episodes on each version. With RL², each episode of a trial counts as one.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = at_least_one::<u64>)]
    pub episodes: u64,
    /// File to write. Its name ends in .gif, in .mp4, which needs ffmpeg, or in .png for a contact sheet: one picture
    /// with some moments of each episode in a row.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Random seed. With the same seed, `evaluate --episodes 1` tests the first episode (with RL², the last episode of
    /// the first trial) [default: the training's seed].
    #[arg(long, value_name = "N", value_parser = natural::<u64>)]
    pub seed: Option<u64>,
    /// Width of the pictures, 240 to 2048 pixels [default: 480, in a contact sheet 240].
    #[arg(long, value_name = "PIXELS", value_parser = |text: &str| within(text, PIXELS))]
    pub width: Option<u32>,
    /// Height of the pictures without the text below them, 240 to 2048 pixels [default: the width].
    #[arg(long, value_name = "PIXELS", value_parser = |text: &str| within(text, PIXELS))]
    pub height: Option<u32>,
    /// Steps shown per second, 0.1 to 1000 [default: real time].
    #[arg(long, value_name = "N", value_parser = |text: &str| within(text, 0.1..=1000.0))]
    pub fps: Option<f64>,
    #[command(flatten)]
    pub server: ServerArgs,
}
