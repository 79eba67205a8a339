//! What can be typed to test, film and judge what was trained.

use std::path::PathBuf;

use clap::Args;
use perturb_protocol::{Version, names};
use perturb_records::MOST_POINTS;
use perturb_records::success::Rule;
use perturb_settings::ValueError;
use perturb_settings::sets::Assignment;

use super::{JsonArgs, PlayArgs, ServerArgs, WaitArgs, at_least_one, natural, within};
use crate::video::PIXELS;

/// A rule of success, whose name may be spelled in any way.
fn success_rule(text: &str) -> Result<Rule, ValueError> {
    let known = ["text", "code"];
    names::find(text.trim(), known.into_iter()).map_or(text, |place| known[place]).parse()
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb evaluate --checkpoint runs/mine
  perturb evaluate --checkpoint runs/mine --versions E --episodes 200 --json -
  perturb evaluate --checkpoint runs/mine --parameters length=0.1..2.0/20 --records long.parquet")]
pub struct EvaluateArgs {
    /// The --out of a training, the checkpoint folder in it, the folder of a cell, or the name of a policy: the id of a cell
    /// in results/ of the working directory, or in the folder that PERTURB_RESULTS names.
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Versions to test on, separated by commas [default: D,R,E; none with --parameters or --contexts].
    #[arg(long, value_delimiter = ',')]
    pub versions: Vec<Version>,
    #[command(flatten)]
    pub set: SetArgs,
    /// What decides about success: the rule of the paper's text, that of its published code, or a threshold of one's own for
    /// what either compares, e.g. steps=90; `perturb envs` tells them [default: text].
    #[arg(long, value_name = "text|code|QUANTITY=NUMBER", value_parser = success_rule)]
    pub success: Option<Rule>,
    /// Keep every test episode in this file, as Parquet: `perturb audit` plays them again, `perturb rates` judges them by
    /// other thresholds, pandas and polars read it.
    #[arg(long, value_name = "FILE")]
    pub records: Option<PathBuf>,
    /// Episodes to test on each version or set; a grid or a list has at least one in each of its contexts. Of a policy
    /// trained with RL² trials, of each of which the last episode counts.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = at_least_one::<u64>)]
    pub episodes: u64,
    /// Fixes the tests' randomness; its environments differ from those of any training, also with the same number
    /// [default: the training's seed].
    #[arg(long, value_name = "N", value_parser = natural::<u64>)]
    pub seed: Option<u64>,
    /// Test with the episodes that select a configuration where an experiment file has selection = "clean"; no other test
    /// has them.
    #[arg(long)]
    pub selection: bool,
    #[command(flatten)]
    pub json: JsonArgs,
    #[command(flatten)]
    pub play: PlayArgs,
}

/// Parameters beside those of the versions.
#[derive(Args, Clone, Debug)]
pub struct SetArgs {
    /// Parameters of your own: a value, intervals to draw from, or the points of a grid, of which all combinations are
    /// taken; e.g. length=0.3..0.4,0.8..0.9 mass=0.1, or length=0.1..1.0/10 mass=0.1,0.2.
    #[arg(long, value_name = "PARAMETER=VALUES", num_args = 1..)]
    pub parameters: Vec<Assignment>,
    /// A list of parameters of your own: a CSV file whose header names them, a row for each context.
    #[arg(long, value_name = "FILE", conflicts_with = "parameters")]
    pub contexts: Option<PathBuf>,
    /// The version that parameters come from which these do not name.
    #[arg(long, value_name = "VERSION", default_value = "D")]
    pub base: Version,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb audit runs/quick                           # of each policy 30 episodes, spread over all of its tests
  perturb audit long.parquet --checkpoint runs/long --all
  perturb audit runs/quick --ledger ledger.jsonl     # plays nothing: which environments trained what")]
pub struct AuditArgs {
    /// The --out of `perturb run`, the folder of one of its cells, the --records of `perturb evaluate`, or a folder of
    /// `Assessment.save` in Python.
    pub dir: PathBuf,
    /// The checkpoint that was tested, for a file of records: the --out of its training, the checkpoint folder in it, the
    /// folder of its cell, or a name in results/ of the working directory, or in the folder that PERTURB_RESULTS names; for
    /// the folder of an assessment those of all its policies that are perturb's.
    #[arg(long, value_name = "DIR", num_args = 1..)]
    pub checkpoint: Vec<PathBuf>,
    /// Episodes to play again of each policy, evenly spread over those that are recorded.
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = at_least_one::<usize>)]
    pub episodes: usize,
    /// Play all recorded episodes again.
    #[arg(long, conflicts_with = "episodes")]
    pub all: bool,
    /// Play nothing, but prove by ledgers, those of all servers that trained (`perturb-server --ledger`), that the trainings
    /// drew from what they say, and never from what was tested: no episode of a test, and no other test set.
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["episodes", "all"])]
    pub ledger: Vec<PathBuf>,
    /// Digests that must be those of lines in the ledgers: what a server logged at its end, or an earlier audit printed,
    /// proves that nothing before was changed.
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
  perturb rates long.parquet                         # the --records of perturb evaluate
  perturb rates long.parquet --success text code steps=85")]
pub struct RatesArgs {
    /// The folder of a cell of `perturb run`, or the --records of `perturb evaluate`.
    pub file: PathBuf,
    /// Rules of success to judge the recorded episodes by, e.g. --success text code steps=85 [default: the one that they were
    /// tested with].
    #[arg(long, value_name = "text|code|QUANTITY=NUMBER", num_args = 1.., value_parser = success_rule)]
    pub success: Vec<Rule>,
    #[command(flatten)]
    pub json: JsonArgs,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb heatmap --checkpoint runs/on-d runs/on-r --out d-beside-r
  perturb heatmap runs/quick")]
pub struct HeatmapArgs {
    /// The --out of `perturb run`: every policy that was selected in one of its runs. What they do goes to its folder
    /// heatmaps/, where what is there is kept; pictures of the means over runs go to report/.
    #[arg(
        value_name = "DIR",
        required_unless_present = "checkpoint",
        conflicts_with_all = ["checkpoint", "parameters", "records", "out"]
    )]
    pub dir: Option<PathBuf>,
    /// Policies instead, of one environment: the --out of each training, the checkpoint folder in it, the folder of a cell, or
    /// a name in results/ of the working directory, or in the folder that PERTURB_RESULTS names. The picture shows the mean
    /// over those of a method that were trained on the same, side by side with others.
    #[arg(long, value_name = "DIR", num_args = 1..)]
    pub checkpoint: Vec<PathBuf>,
    /// Test the policies of the first N runs only, and draw what is there of the others [default: of all runs].
    #[arg(long, value_name = "N", conflicts_with = "checkpoint", value_parser = at_least_one::<u32>)]
    pub runs: Option<u32>,
    /// The parameter along x, e.g. force; `perturb envs` lists them. Environments of DIR that lack one are left out
    /// [default: the environment's usual two].
    #[arg(long, value_name = "PARAMETER", requires = "y")]
    pub x: Option<String>,
    /// The parameter along y, e.g. mass.
    #[arg(long, value_name = "PARAMETER", requires = "x")]
    pub y: Option<String>,
    /// The version that other parameters come from: D, where each has its default, or R or E, of which they are drawn for
    /// each episode.
    #[arg(long, value_name = "VERSION", default_value = "D")]
    pub base: Version,
    /// Values of other parameters, e.g. force=7 [default: those of --base].
    #[arg(long, value_name = "PARAMETER=VALUE", num_args = 1.., requires = "checkpoint")]
    pub parameters: Vec<Assignment>,
    /// Make the heatmap again from the files .parquet that an earlier one left, one for each --checkpoint, without playing.
    #[arg(
        long,
        value_name = "FILE",
        num_args = 1..,
        requires = "checkpoint",
        conflicts_with_all = ["grid", "episodes", "seed", "parameters", "base"]
    )]
    pub records: Vec<PathBuf>,
    /// Points along each axis, at most 100.
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = |text: &str| within(text, 1..=MOST_POINTS))]
    pub grid: usize,
    /// Episodes of each policy at each point.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = at_least_one::<u64>)]
    pub episodes: u64,
    /// Fixes the tests' randomness [default: each training's seed].
    #[arg(long, value_name = "N", value_parser = natural::<u64>)]
    pub seed: Option<u64>,
    /// The files without their endings .csv, .svg, .png, .parquet [default: in the working directory, named after
    /// environment, algorithm, architecture, version, seed and parameters].
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
    /// The --out of a training, the checkpoint folder in it, the folder of a cell, or the name of a policy: the id of a cell
    /// in results/ of the working directory, or in the folder that PERTURB_RESULTS names.
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Where the environment's parameters come from; of several, separated by commas, one after the other, in a contact
    /// sheet side by side.
    #[arg(long, value_delimiter = ',', default_value = "D")]
    pub version: Vec<Version>,
    /// Parameters in place of the version's: a value, or intervals to draw from, e.g. length=0.8..0.9 mass=0.1.
    #[arg(long, value_name = "PARAMETER=VALUES", num_args = 1..)]
    pub parameters: Vec<Assignment>,
    /// Episodes to play on each version; of a policy trained with RL² all episodes of a trial are shown, one after the other.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = at_least_one::<u64>)]
    pub episodes: u64,
    /// The video; its name ends in .mp4, for which ffmpeg must be installed, in .gif, or in .png for a contact sheet: one
    /// picture, with some moments of each episode in a row.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Fixes all randomness; with the same number, `evaluate --episodes 1` tests the first episode [default: the
    /// training's seed].
    #[arg(long, value_name = "N", value_parser = natural::<u64>)]
    pub seed: Option<u64>,
    /// Width of the pictures, 240 to 2048 pixels [default: 480, in a contact sheet 240].
    #[arg(long, value_name = "PIXELS", value_parser = |text: &str| within(text, PIXELS))]
    pub width: Option<u32>,
    /// Height of the pictures, 240 to 2048 pixels; the text below them comes in addition [default: as wide].
    #[arg(long, value_name = "PIXELS", value_parser = |text: &str| within(text, PIXELS))]
    pub height: Option<u32>,
    /// Steps shown in a second, 0.1 to 1000 [default: as many as the environment simulates in one: real time].
    #[arg(long, value_name = "N", value_parser = |text: &str| within(text, 0.1..=1000.0))]
    pub fps: Option<f64>,
    #[command(flatten)]
    pub server: ServerArgs,
}
