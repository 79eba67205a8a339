//! How a policy does over two parameters.

use serde::{Deserialize, Serialize};

use crate::checkpoint::{Checkpoint, EnvironmentSummary, State};
use crate::client::{OpenOptions, Servers, Session};
use crate::config::Wrapper;
use crate::evaluation::{TestError, Version, check_unchanged, environment_seed, mean, play};
use crate::interrupt::StopFlag;
use crate::proto::{self, Interval};

/// The most points along an axis: all environments run together.
pub const MOST_POINTS: usize = 100;

/// What to test.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeatmapOptions {
    /// Names of the two parameters, along x and along y.
    pub parameters: [String; 2],
    /// Points along each axis, 1 … 100.
    pub grid: usize,
    /// Episodes at each point, at least 1.
    pub episodes: u64,
    /// Fixes all randomness.
    pub seed: u64,
}

/// A parameter as an axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// The parameter.
    pub name: String,
    /// Its unit; "1" if dimensionless.
    pub unit: String,
    /// The lowest value of R and E.
    pub low: f64,
    /// The highest value of R and E.
    pub high: f64,
    /// R, as pairs of low and high.
    pub random: Vec<(f64, f64)>,
    /// E, likewise.
    pub extreme: Vec<(f64, f64)>,
}

/// A policy's figures over two parameters; the others have their defaults.
#[derive(Clone, Debug, PartialEq)]
pub struct Heatmap {
    /// The environment.
    pub environment: String,
    /// What was tested, e.g. "a2c ff, trained on D with seed 1".
    pub policy: String,
    /// x and y.
    pub axes: [Axis; 2],
    /// G, points along each axis.
    pub grid: usize,
    /// Episodes at each point.
    pub episodes: u64,
    /// `[G, G]` mean undiscounted returns, by y, then x, in ascending order.
    pub returns: Vec<f64>,
    /// `[G, G]` success rates, %.
    pub success: Vec<f64>,
}

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

/// The two parameters, along x and along y, over which an environment's heatmaps are unless others are asked for; `None`
/// for an environment that is not known here.
///
/// Those of MountainCar and Pendulum are the paper's; of CartPole it says that a light and long pole would be the
/// difficult one. Those of the robots are a heavier torso on a more slippery floor.
pub fn default_axes(environment: &str) -> Option<[&'static str; 2]> {
    Some(match environment {
        "CartPole" | "Acrobot" => ["length", "mass"],
        "MountainCar" => ["force", "mass"],
        "Pendulum" => ["mass", "length"],
        "HalfCheetah" | "Hopper" => ["density", "friction"],
        _ => return None,
    })
}

impl Axis {
    /// The value of the `index`th of `grid` points, which stand in the middle of equal parts.
    pub fn value(&self, index: usize, grid: usize) -> f64 {
        self.low + (self.high - self.low) * (index as f64 + 0.5) / grid as f64
    }

    fn of(parameter: &proto::Parameter) -> Self {
        let pairs = |distribution: &Option<proto::Distribution>| -> Vec<(f64, f64)> {
            let intervals = distribution.iter().flat_map(|distribution| &distribution.intervals);
            intervals.map(|Interval { low, high }| (*low, *high)).collect()
        };
        let (random, extreme) = (pairs(&parameter.random), pairs(&parameter.extreme));
        let all = || random.iter().chain(&extreme);
        Self {
            name: parameter.name.clone(),
            unit: parameter.unit.clone(),
            low: all().map(|pair| pair.0).fold(f64::INFINITY, f64::min),
            high: all().map(|pair| pair.1).fold(f64::NEG_INFINITY, f64::max),
            random,
            extreme,
        }
    }
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

/// The figures as CSV: a line a point.
///
/// # Errors
/// [`csv::Error`], which writing to memory does not give.
pub fn heatmap_csv(heatmap: &Heatmap) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let [x, y] = &heatmap.axes;
    writer.write_record([x.name.as_str(), y.name.as_str(), "mean_return", "success_percent"])?;
    for (slot, (episode_return, success)) in heatmap.returns.iter().zip(&heatmap.success).enumerate() {
        let (column, row) = (slot % heatmap.grid, slot / heatmap.grid);
        let point = [x.value(column, heatmap.grid), y.value(row, heatmap.grid), *episode_return, *success];
        writer.write_record(point.map(|number| number.to_string()))?;
    }
    writer.into_inner().map_err(|error| error.into_error().into())
}
