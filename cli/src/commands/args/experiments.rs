//! Arguments of the commands that plan, run and report an experiment.

use std::path::PathBuf;

use clap::Args;
use perturb_experiment::scheduler::slurm::TimeLimit;
use perturb_experiment::{Grouping, Selection};

use super::{JsonArgs, ServerArgs, WaitArgs, at_least_one, natural};

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb plan experiments/quick.toml                # measures for some seconds how long it takes
  perturb plan experiments/paper.toml --measure 0    # prints only the number of trainings and tests
  perturb plan experiments/quick.toml --unfinished-in runs/quick")]
pub struct PlanArgs {
    /// An experiment file, e.g. experiments/paper.toml.
    pub file: PathBuf,
    /// List all cells with their indices and ids. With --json they are written as JSON.
    #[arg(long)]
    pub cells: bool,
    /// List only the cells that have neither a result nor a failure in this folder. With --json they are written as
    /// JSON.
    #[arg(long, value_name = "DIR", conflicts_with = "cells")]
    pub unfinished_in: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArgs,
    /// Seconds of measurement for each group of trainings; 0 measures nothing.
    #[arg(long, value_name = "SECONDS", default_value_t = 3, value_parser = natural::<u64>)]
    pub measure: u64,
    /// Estimate from the durations of the finished cells in this folder, e.g. of a random tenth of all cells. A
    /// duration applies to cells with the same environment and method. All other cells are measured.
    #[arg(long, value_name = "DIR")]
    pub timings_from: Option<PathBuf>,
    /// Value of --jobs for the planned run [default: one for each core].
    #[arg(long, value_name = "N", value_parser = at_least_one::<usize>)]
    pub jobs: Option<usize>,
    /// Value of --group for the planned run.
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
    /// Directory of the results. Cells that are finished there are not run again.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Number of simultaneous processes. Each runs a group of cells [default: one for each core; with --engine, one in
    /// each job].
    #[arg(long, value_name = "N", value_parser = at_least_one::<usize>)]
    pub jobs: Option<usize>,
    /// Maximum number of cells of a group. A process runs them together, and they have the same environment and
    /// architecture. 1 runs each cell by itself. Results do not depend on this number.
    #[arg(long, value_name = "N", default_value_t = Grouping::USUAL, value_parser = at_least_one::<usize>)]
    pub group: usize,
    /// Skip cells whose results with the same settings and tests are in this table of `perturb export`. The selection
    /// of configurations uses the results in the table.
    #[arg(long, value_name = "FILE")]
    pub done: Option<PathBuf>,
    /// Run failed cells again.
    #[arg(long)]
    pub retry_failed: bool,
    /// Run only these cells, by index or id, separated by commas. An existing plan.toml in DIR is not replaced.
    #[arg(long, value_name = "K", value_delimiter = ',')]
    pub cell: Vec<String>,
    /// Write the report to this file at the end, as `perturb report DIR --html FILE` does.
    #[arg(long, value_name = "FILE", conflicts_with = "cell")]
    pub html: Option<PathBuf>,
    /// Write the events of each cell to this file as JSON lines. `-` or no name prints them.
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-", conflicts_with = "engine")]
    pub json: Option<PathBuf>,
    /// Read one job, a JSON line with cells and a server number, from standard input, and run its cells. Stop when
    /// standard input is closed.
    #[arg(long, hide = true, requires = "server",
        conflicts_with_all = ["cell", "jobs", "group", "engine", "retry_failed", "html", "done"])]
    pub worker: bool,
    #[command(flatten)]
    pub engine: EngineArgs,
    #[command(flatten)]
    pub server: ServerArgs,
    #[command(flatten)]
    pub wait: WaitArgs,
}

/// Scheduling of a run on a cluster.
#[derive(Args, Debug)]
pub struct EngineArgs {
    /// Submit the cells as jobs to this scheduler, watch them, and resubmit lost jobs. DIR and this program must have
    /// the same paths on all machines. --jobs and --workers then apply to each job.
    #[arg(long, value_name = "NAME", ignore_case = true, conflicts_with = "cell")]
    pub engine: Option<Engine>,
    /// Partition of Slurm [default: Slurm's default].
    #[arg(long, value_name = "NAME", requires = "engine")]
    pub partition: Option<String>,
    /// Time limit of a job in minutes, or in another format of Slurm, e.g. 1-12:00:00 [default: the partition's limit].
    #[arg(long, value_name = "TIME", requires = "engine")]
    pub time: Option<TimeLimit>,
    /// Maximum number of jobs that run at the same time [default: no limit].
    #[arg(long, value_name = "N", requires = "engine", value_parser = at_least_one::<u32>)]
    pub array_limit: Option<u32>,
    /// Number of cells in a job. They have the same environment and architecture [default: as many as a job finishes in
    /// some minutes].
    #[arg(long, value_name = "N", requires = "engine", value_parser = at_least_one::<usize>)]
    pub cells_per_job: Option<usize>,
}

/// A cluster's scheduler.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Engine {
    /// Slurm, with its commands sbatch, squeue and scontrol.
    Slurm,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb export runs/quick
  perturb export runs/* --into all.parquet           # pandas, polars and DuckDB read the file
  perturb export runs/mine --into results/results.parquet --policies")]
pub struct ExportArgs {
    /// The --out folders of `perturb run`. Each becomes a study of the table.
    #[arg(required_unless_present = "csv", value_name = "DIR")]
    pub dirs: Vec<PathBuf>,
    /// Table to add the results to. Rows of the same cells are replaced, and all others are kept.
    #[arg(long, value_name = "FILE", default_value = "results.parquet")]
    pub into: PathBuf,
    /// Name of the study in the table [default: the name of DIR].
    #[arg(long, value_name = "NAME")]
    pub study: Option<String>,
    /// Also write the whole table to this file as CSV. Without FILE, or with `-`, the command prints only the CSV.
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    pub csv: Option<PathBuf>,
    /// Also copy the policies in DIR: their weights to policies/ID.safetensors beside FILE, and their test episodes to
    /// episodes/STUDY.parquet.
    #[arg(long)]
    pub policies: bool,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb report runs/quick
  perturb report runs/quick --html quick.html        # one page with everything
  perturb report runs/quick assessed/mine --out report
  perturb report results/results.parquet/classic-ff --out classic-ff")]
pub struct ReportArgs {
    /// The --out folder of `perturb run`, a study of a results table (FILE.parquet/STUDY), or folders that
    /// `Assessment.save` wrote in Python. One experiment or study and any number of assessments can be given together;
    /// tables and pictures then show all agents.
    #[arg(required = true, value_name = "DIR")]
    pub dirs: Vec<PathBuf>,
    /// Folder for tables and pictures [default: report/ in the experiment's folder; required with assessments and
    /// tables].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Rule that selects configurations [default: the plan's rule]. For a plan with selection = "clean", `paper`
    /// reports the tuning cells by the paper's rule and writes the tables to report/paper/.
    #[arg(long, value_name = "RULE")]
    pub selection: Option<Selection>,
    /// Also write everything as one HTML page without other files, with training curves and the heatmaps of `perturb
    /// heatmap`.
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb curves runs/quick
  perturb curves runs/quick --out pictures")]
pub struct CurvesArgs {
    /// The --out folder of `perturb run`.
    pub dir: PathBuf,
    /// Folder for the pictures [default: DIR/report].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}
