//! Arguments of `perturb compare`.

use std::path::PathBuf;

use clap::Args;
use perturb_protocol::Version;
use perturb_records::RowFilter;
use perturb_records::success::Rule;

use super::testing::success_rule;
use super::{JsonArgs, OneOf, PlayArgs, SetArgs, at_least_one, natural};

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb compare plain=runs/d1,runs/d2,runs/d3 random=runs/r1,runs/r2,runs/r3
  perturb compare runs/plain runs/random             # folders with a training for each seed
  perturb compare saved/a saved/b --score return     # folders of Assessment.save, or --records of perturb evaluate
  perturb compare results.parquet/classic-ff --by algorithm --where environment=CartPole trained_on=R seed=2..6")]
pub struct CompareArgs {
    /// Conditions, each with one policy for each training seed. A PATH is the --out folder of a training, which this
    /// command tests, or a path of recorded tests: a cell of an experiment, a --records file of `perturb evaluate`, or
    /// a folder that `Assessment.save` wrote in Python. It may also be a folder that contains several of these. NAME is
    /// by default the name of the first PATH. The policies of two conditions are compared in pairs: trainings with the
    /// same seed, or recorded tests in the order of their paths. A PATH may also be FILE.parquet or FILE.parquet/STUDY
    /// of `perturb export`: --where selects rows of the table, and --by divides them into several conditions.
    #[arg(value_name = "[NAME=]PATH[,PATH]", required = true)]
    pub conditions: Vec<String>,
    /// Score to compare: success rates, returns, or lengths of episodes in steps.
    #[arg(long, value_name = "SCORE", default_value = "success", value_parser = OneOf::new(&["success", "return", "length"]))]
    pub score: String,
    /// The condition that all others are compared with [default: all pairs of conditions are compared].
    #[arg(long, value_name = "NAME")]
    pub baseline: Option<String>,
    /// Versions to test trainings on, separated by commas [default: the versions of the recorded tests, or D,R,E
    /// without recorded tests; none with --parameters or --contexts].
    #[arg(long, value_delimiter = ',')]
    pub versions: Vec<Version>,
    /// Compare only the rows of results tables that have one of these values in a column or setting, e.g.
    /// algorithm=a2c,ppo or seed=2..6.
    #[arg(long = "where", value_name = "COLUMN=VALUES", num_args = 1..)]
    pub filters: Vec<RowFilter>,
    /// Columns or settings by which rows of results tables are divided into conditions, separated by commas.
    #[arg(long, value_name = "COLUMN", value_delimiter = ',')]
    pub by: Vec<String>,
    #[command(flatten)]
    pub set: SetArgs,
    /// Rule that decides about success, as in `perturb evaluate`.
    #[arg(long, value_name = "text|code|QUANTITY=NUMBER", value_parser = success_rule)]
    pub success: Option<Rule>,
    /// Number of episodes of each training on each version or set.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = at_least_one::<u64>)]
    pub episodes: u64,
    /// Random seed of the tests, the same for all trainings.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = natural::<u64>)]
    pub seed: u64,
    /// Write the comparison to this file as an HTML page with tables and figures.
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArgs,
    #[command(flatten)]
    pub play: PlayArgs,
}
