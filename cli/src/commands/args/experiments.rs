//! What can be typed to plan, run and report an experiment.

use std::path::PathBuf;

use clap::Args;
use perturb_experiment::scheduler::slurm::TimeLimit;
use perturb_experiment::{Grouping, Selection};

use super::{JsonArgs, ServerArgs, WaitArgs, at_least_one, natural};

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb plan experiments/quick.toml                # measures for some seconds what it costs
  perturb plan experiments/paper.toml --measure 0    # only says what it asks for
  perturb plan experiments/quick.toml --missing runs/quick")]
pub struct PlanArgs {
    /// An experiment file, e.g. experiments/paper.toml.
    pub file: PathBuf,
    /// List the cells with their indices and ids, which --json has then.
    #[arg(long)]
    pub cells: bool,
    /// List the cells that have neither a result in this folder nor failed there, and nothing else; --json has these then.
    #[arg(long, value_name = "DIR", conflicts_with = "cells")]
    pub missing: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArgs,
    /// Seconds that each group of trainings is measured; 0 measures nothing.
    #[arg(long, value_name = "SECONDS", default_value_t = 3, value_parser = natural::<u64>)]
    pub measure: u64,
    /// Estimate from what cells took that are done in this folder, where there are any of the same environment and
    /// method, e.g. a random tenth.
    #[arg(long, value_name = "DIR")]
    pub from: Option<PathBuf>,
    /// The --jobs of the run [default: one a core].
    #[arg(long, value_name = "N", value_parser = at_least_one::<usize>)]
    pub jobs: Option<usize>,
    /// The --group of the run.
    #[arg(long, value_name = "N", default_value_t = Grouping::USUAL, value_parser = at_least_one::<usize>)]
    pub group: usize,
    #[command(flatten)]
    pub server: ServerArgs,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb run experiments/quick.toml --out runs/quick
  perturb run experiments/paper.toml --out /shared/paper --engine slurm --time 8:00:00")]
pub struct RunArgs {
    /// An experiment file, e.g. experiments/quick.toml.
    pub plan: PathBuf,
    /// Directory of the results; what is done there already is kept.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Processes at a time, each of which does a group of cells [default: one a core; with --engine, one in each of its
    /// jobs].
    #[arg(long, value_name = "N", value_parser = at_least_one::<usize>)]
    pub jobs: Option<usize>,
    /// The most cells of one environment and architecture that a process does together; 1 for each by itself. It changes
    /// no result.
    #[arg(long, value_name = "N", default_value_t = Grouping::USUAL, value_parser = at_least_one::<usize>)]
    pub group: usize,
    /// Try cells again that have failed.
    #[arg(long)]
    pub retry_failed: bool,
    /// Do these cells only, by index or id, separated by commas. A plan.toml that is in DIR stays as it is.
    #[arg(long, value_name = "K", value_delimiter = ',')]
    pub cell: Vec<String>,
    /// When nothing is left to do, also write the report, as `perturb report DIR --html FILE` does.
    #[arg(long, value_name = "FILE", conflicts_with = "cell")]
    pub html: Option<PathBuf>,
    /// Write what happens to each cell to this file, as JSON lines; `-`, or no name, prints them.
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-", conflicts_with = "engine")]
    pub json: Option<PathBuf>,
    /// Do the cells that a line of standard input names; stop when standard input is closed.
    #[arg(long, hide = true, requires = "server",
        conflicts_with_all = ["cell", "jobs", "group", "engine", "retry_failed", "html"])]
    pub worker: bool,
    #[command(flatten)]
    pub engine: EngineArgs,
    #[command(flatten)]
    pub server: ServerArgs,
    #[command(flatten)]
    pub wait: WaitArgs,
}

/// Who schedules a run past one machine.
#[derive(Args, Debug)]
pub struct EngineArgs {
    /// Submit the cells as jobs of this engine, watch them, and submit again what it lost. DIR and this program must be
    /// at the same place on all its machines. --jobs and --workers are those of each of its jobs.
    #[arg(long, value_name = "NAME", ignore_case = true, conflicts_with = "cell")]
    pub engine: Option<Engine>,
    /// Slurm's partition [default: Slurm's].
    #[arg(long, value_name = "NAME", requires = "engine")]
    pub partition: Option<String>,
    /// How long a job may take: minutes, or another of Slurm's forms, e.g. 1-12:00:00 [default: the partition's].
    #[arg(long, value_name = "TIME", requires = "engine")]
    pub time: Option<TimeLimit>,
    /// Jobs that may run at a time [default: as many as there is room for].
    #[arg(long, value_name = "N", requires = "engine", value_parser = at_least_one::<u32>)]
    pub array_limit: Option<u32>,
    /// Cells that a job does, of one environment and architecture [default: as many as take some minutes].
    #[arg(long, value_name = "N", requires = "engine", value_parser = at_least_one::<usize>)]
    pub cells_per_job: Option<usize>,
}

/// A scheduler of jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Engine {
    /// Slurm, with its commands sbatch, squeue and scontrol.
    Slurm,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb report runs/quick
  perturb report runs/quick --html quick.html        # one page with everything
  perturb report runs/quick assessed/mine --out report")]
pub struct ReportArgs {
    /// The --out of `perturb run`, folders of `Assessment.save` in Python, or one of the former and any number of the latter,
    /// whose agents then stand in the same tables and pictures.
    #[arg(required = true, value_name = "DIR")]
    pub dirs: Vec<PathBuf>,
    /// Where tables and pictures go [default: the folder report/ in that of the experiment; needed with assessments].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// The rule by which configurations are selected [default: the plan's]. Of a plan with selection = "clean", `paper`
    /// reports its tuning cells as the paper would; tables go to report/paper/.
    #[arg(long, value_name = "RULE")]
    pub selection: Option<Selection>,
    /// Also write everything, with training curves and the heatmaps of `perturb heatmap`, as one HTML page that needs
    /// nothing else.
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb curves runs/quick
  perturb curves runs/quick --out pictures")]
pub struct CurvesArgs {
    /// The --out of `perturb run`.
    pub dir: PathBuf,
    /// Where the pictures go [default: DIR/report].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}
