//! Makes heatmaps: tests a policy on a grid of two parameters.

use perturb_files::interrupt::StopFlag;
use perturb_protocol::disturbance::is_disturbance;
use perturb_protocol::proto;
use perturb_records::{Axis, Heatmap, HeatmapOptions, MAX_POINTS, Records};
use perturb_settings::sets::{Contexts, TestSet};

use super::error::TestError;
use super::test::{TestOptions, Tester};
use crate::checkpoint::Checkpoint;
use crate::client::Servers;

/// The reason why a heatmap cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HeatmapError {
    /// The environment has no such parameter, or both axes name the same one.
    #[error("`{name}` cannot be an axis: expected two of {}'s parameters {}", environment, parameters.join(", "))]
    Parameter {
        /// The given name.
        name: String,
        /// The environment's name.
        environment: String,
        /// The names of the parameters that can be axes.
        parameters: Vec<String>,
    },
    /// The episodes were recorded with another policy.
    #[error(
        "the episodes were recorded with the policy {recorded}, the checkpoint is {got}: pass the checkpoint these episodes \
         were recorded with"
    )]
    Policy {
        /// The identifier of the recorded policy.
        recorded: String,
        /// The identifier of the checkpoint's policy.
        got: String,
    },
    /// A parameter is an axis and also has a fixed value.
    #[error("{name} is an axis and has a value, too: leave it out of --parameters")]
    Fixed {
        /// The parameter's name.
        name: String,
    },
    /// The recorded episodes are not from a heatmap over these two parameters.
    #[error(
        "the recorded episodes are not those of a heatmap over these two parameters: pass the original --x and --y"
    )]
    NotOfAxes,
    /// The test of the policy failed.
    #[error(transparent)]
    Test(#[from] TestError),
}

/// Tests `checkpoint` at every point of a grid over two parameters. Returns the heatmap and the recorded episodes.
///
/// An axis covers the ranges of R and E. All other parameters are fixed by `options`, or drawn from its base version.
/// Each point of the grid is an environment with its own random numbers. Calls `report` with the number of episodes
/// done so far.
///
/// # Errors
/// [`HeatmapError`] for invalid options, or if the test fails.
pub fn heatmap(
    servers: &Servers,
    checkpoint: &Checkpoint,
    options: &HeatmapOptions,
    stop: &StopFlag,
    report: &mut dyn FnMut(u64),
) -> Result<(Heatmap, Records), HeatmapError> {
    let grid = options.grid.clamp(1, MAX_POINTS);
    let episodes = HeatmapOptions { grid, ..options.clone() }.total_episodes().map_err(TestError::Value)?;
    let test = TestOptions { episodes, seed: options.seed, selects: false, success: None };
    let tester = Tester::new(servers, checkpoint, test)?;
    let axes = axes(tester.environment(), &options.parameters)?;
    if let Some(axis) = axes.iter().find(|axis| options.fixed.contains_key(&axis.name)) {
        return Err(HeatmapError::Fixed { name: axis.name.clone() });
    }
    let contexts = Contexts::Listed(Heatmap::contexts(&axes, grid, &options.fixed));
    let set = TestSet { name: Heatmap::SET.into(), version: options.base, contexts };
    let records = tester.test(&[set], stop, &mut |_, done| report(done))?;
    let heatmap = Heatmap::from_records(&records, axes).ok_or(HeatmapError::NotOfAxes)?;
    Ok((heatmap, records))
}

/// Computes the heatmap of a recorded test again, without playing. `environment` provides the ranges of the axes.
///
/// # Errors
/// [`HeatmapError`] if `parameters` cannot be axes, if the episodes were recorded with another policy or are not from a
/// heatmap over `parameters`, or if the environment has changed since the training.
pub fn heatmap_again(
    environment: &proto::Environment,
    checkpoint: &Checkpoint,
    records: &Records,
    parameters: &[String; 2],
) -> Result<Heatmap, HeatmapError> {
    let got = checkpoint.id().map_err(TestError::Unnamed)?;
    if got != records.about.policy {
        return Err(HeatmapError::Policy { recorded: records.about.policy.clone(), got });
    }
    checkpoint.state.check_unchanged(environment).map_err(TestError::from)?;
    let axes = axes(environment, parameters)?;
    Heatmap::from_records(records, axes).ok_or(HeatmapError::NotOfAxes)
}

/// Returns the axes of two parameters. Returns an error if they are equal, unknown or disturbances.
fn axes(environment: &proto::Environment, names: &[String; 2]) -> Result<[Axis; 2], HeatmapError> {
    // Disturbances cannot be axes, because they have no range in R and E.
    let ranged = environment.parameters.iter().filter(|parameter| !is_disturbance(&parameter.name));
    let find = |name: &String| ranged.clone().find(|parameter| parameter.name == *name);
    let refuse = |name: &String| HeatmapError::Parameter {
        name: name.clone(),
        environment: environment.name.clone(),
        parameters: ranged.clone().map(|parameter| parameter.name.clone()).collect(),
    };
    let [x, y] = names;
    if x == y {
        return Err(refuse(y));
    }
    Ok([Axis::new(find(x).ok_or_else(|| refuse(x))?), Axis::new(find(y).ok_or_else(|| refuse(y))?)])
}
