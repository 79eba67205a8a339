//! Testing a policy over two parameters.

use perturb_protocol::{Version, proto};
use perturb_study::interrupt::StopFlag;
use perturb_study::settings::Wrapper;
use perturb_study::{Axis, Heatmap, HeatmapOptions, MOST_POINTS, mean};

use super::test::{TestError, check_unchanged, environment_seed, play};
use crate::checkpoint::{Checkpoint, EnvironmentSummary, State};
use crate::client::{OpenOptions, Servers, Session};

/// Why there is no heatmap.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HeatmapError {
    /// The environment has no such parameter, or it is the same twice.
    #[error("`{name}` cannot be an axis: expected two of {}'s parameters {}", environment, parameters.join(", "))]
    Parameter {
        /// What was given.
        name: String,
        /// The environment.
        environment: String,
        /// Its parameters.
        parameters: Vec<String>,
    },
    /// The policy cannot be tested.
    #[error(transparent)]
    Test(#[from] TestError),
}

/// Tests `checkpoint` at every point of a grid over two parameters, whose range is that of R and E together. Each
/// point is an environment with random numbers of its own, so that points differ by their parameters and by chance.
/// Calls `report` with the number of episodes.
///
/// # Errors
/// [`HeatmapError`].
pub fn heatmap(
    servers: &Servers,
    checkpoint: &Checkpoint,
    options: &HeatmapOptions,
    stop: &StopFlag,
    report: &mut dyn FnMut(u64),
) -> Result<Heatmap, HeatmapError> {
    let state = &checkpoint.state;
    let grid = options.grid.clamp(1, MOST_POINTS);
    let seed = environment_seed(options.seed, Version::D);
    let open = OpenOptions {
        environment: state.environment.clone(),
        version: Version::D.to_proto(),
        num_envs: grid * grid,
        seed,
        episodes_per_trial: state.episodes_per_trial,
    };
    let mut observations = Vec::new();
    let mut session = Session::open(servers, &open, &mut observations).map_err(TestError::Client)?;
    check_unchanged(checkpoint, EnvironmentSummary::of(session.environment()))?;
    let axes = axes(session.environment(), &options.parameters)?;
    for slot in 0..grid * grid {
        let values = [slot % grid, slot / grid];
        let values: [(&str, f64); 2] = std::array::from_fn(|i| (axes[i].name.as_str(), axes[i].value(values[i], grid)));
        session.reset_with(slot, &values, seed, &mut observations).map_err(TestError::Client)?;
    }
    let quotas = vec![options.episodes; grid * grid];
    let mut by_slot: Vec<Vec<[f64; 2]>> = vec![Vec::new(); grid * grid];
    for end in play(&mut session, observations, checkpoint, &quotas, options.seed, stop, report)? {
        by_slot[end.slot].push([end.episode_return, if end.success { 100.0 } else { 0.0 }]);
    }
    let means = |column: usize| by_slot.iter().map(|ends| mean(ends.iter().map(|end| end[column]))).collect();
    Ok(Heatmap {
        environment: state.environment.clone(),
        policy: policy(state),
        axes,
        grid,
        episodes: options.episodes,
        returns: means(0),
        success: means(1),
    })
}

/// Who is tested.
fn policy(state: &State) -> String {
    let State { algorithm, architecture, train_version, seed, .. } = state;
    let trials = match algorithm.wrapper() {
        Wrapper::Rl2 => format!(" N={}", state.episodes_per_trial),
        _ => String::new(),
    };
    format!("{algorithm} {architecture}{trials}, trained on {train_version} with seed {seed}")
}

fn axes(environment: &proto::Environment, names: &[String; 2]) -> Result<[Axis; 2], HeatmapError> {
    let find = |name: &String| environment.parameters.iter().find(|parameter| parameter.name == *name);
    let refuse = |name: &String| HeatmapError::Parameter {
        name: name.clone(),
        environment: environment.name.clone(),
        parameters: environment.parameters.iter().map(|parameter| parameter.name.clone()).collect(),
    };
    let [x, y] = names;
    if x == y {
        return Err(refuse(y));
    }
    Ok([Axis::of(find(x).ok_or_else(|| refuse(x))?), Axis::of(find(y).ok_or_else(|| refuse(y))?)])
}
