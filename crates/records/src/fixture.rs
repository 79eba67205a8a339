//! Example records for tests.
#![allow(dead_code, reason = "each crate that includes this file uses only some of its functions")]

use perturb_protocol::Version;
use perturb_records::success::{Criterion, Side};
use perturb_records::{
    Axis, Ending, EpisodeRecord, ExternalEvaluation, ExternalPolicy, Heatmap, HeatmapPoint, PolicyMetadata,
    RecordedParameter, RecordedTest, Records, RecordsMetadata,
};
use perturb_settings::Observe;

/// Returns an episode of a test on `set`, in the environment with the index `index`. The episode has one requested
/// parameter. The episode's length and achieved value are `steps`.
pub fn episode(set: &str, index: u32, requested: f64, steps: u32, success: bool) -> EpisodeRecord {
    EpisodeRecord {
        set: set.into(),
        seed: 7,
        environment_index: index,
        episode_index: 0,
        requested: vec![requested],
        applied: vec![requested],
        model_hash: String::new(),
        episode_return: f64::from(steps),
        length: steps,
        success,
        ending: Ending::Terminated,
        achieved: Some(f64::from(steps)),
        also_achieved: None,
    }
}

/// Returns the heatmap of a policy on Pendulum, over mass and length. `figures` computes the mean return and the
/// success rate, in %, for a mass and a length.
pub fn heatmap(grid: usize, figures: impl Fn(f64, f64) -> (f64, f64)) -> Heatmap {
    let axis = |name: &str, unit: &str| Axis {
        name: name.into(),
        unit: unit.into(),
        default: 1.0,
        low: 0.5,
        high: 1.5,
        random: vec![(0.75, 1.25)],
        extreme: vec![(0.5, 0.75), (1.25, 1.5)],
    };
    let axes = [axis("mass", "kg"), axis("length", "m")];
    let point = |index: usize| {
        let (x, y) = (axes[0].value(index % grid, grid), axes[1].value(index / grid, grid));
        let (mean_return, success_percent) = figures(x, y);
        HeatmapPoint { x, y, mean_return, success_percent }
    };
    let points = (0..grid * grid).map(point).collect();
    let environment = "Pendulum".into();
    Heatmap { environment, base: Version::D, fixed: Default::default(), grid, episodes: 20, points, axes }
}

/// Returns an agent in `environment` with one policy for each element of `trained_on`. Each policy has tests of ten
/// episodes on the versions D, R and E. `steps` has the length of the first episode of each of these tests. Each
/// further episode of a test is one step longer. An episode of at least 195 steps is a success.
pub fn assessed(agent: &str, environment: &str, trained_on: &[Option<Version>], steps: [u32; 3]) -> ExternalEvaluation {
    let criterion = |threshold| Criterion {
        quantity: "steps".into(),
        unit: "1".into(),
        side: Side::AtLeast,
        threshold,
        most: Some(200.0),
    };
    let policy = |&trained_on: &Option<Version>| {
        let parameter = RecordedParameter { name: "length".into(), unit: "m".into(), applied: "length".into() };
        let mut records = Records::new(RecordsMetadata {
            environment: environment.into(),
            revision: 1,
            parameters: vec![parameter],
            applied: vec!["length".into()],
            policy: format!("{agent} 01234567"),
            episodes_per_trial: 1,
            success: Some(criterion(195.0)),
            text_success: Some(criterion(195.0)),
            code_success: Some(criterion(100.0)),
            also: None,
            tests: Vec::new(),
        });
        for (version, steps) in Version::ALL.into_iter().zip(steps) {
            let set = version.to_string();
            let one = |index: u32| episode(&set, index, f64::from(index), steps + index, steps + index >= 195);
            records.add(RecordedTest { set: version.into(), seed: 7, axes: None }, (0..10).map(one).collect());
        }
        let (timesteps, observe, deterministic) = (Some(100_000), Observe::State, Some(false));
        ExternalPolicy::new(
            PolicyMetadata { trained_on, timesteps, seed: 1, episodes: 10, observe, deterministic },
            records,
        )
    };
    let policies = trained_on.iter().map(policy).collect();
    ExternalEvaluation::new("mine".into(), agent.into(), policies)
        .expect("one environment, each trained on something else")
}
