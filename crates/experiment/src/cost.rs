//! Estimates the time that a plan takes, from short measurements.
//!
//! The model: the time of a step is the sum of the environment's time and the method's time. So each environment is
//! measured with one method, and each method in one environment. The speeds of the other pairs of environment and
//! method are computed from the measured speeds. The number of steps depends on what the policy learns, so only an
//! upper bound is known beforehand. Durations of finished cells with the same environment and method are better
//! estimates: see [`CellDurations`](crate::CellDurations).

use std::collections::HashMap;
use std::iter::Sum;

use perturb_settings::{Method, TrainConfig, Wrapper};

use crate::plan::{Cell, Grouping, Plan, distinct};

/// Wall-clock seconds of one process per environment step, including the time of the policy. If the process runs
/// several cells together, the steps of all these cells count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Speed {
    /// Time per step in training, with rollouts and updates.
    pub training: f64,
    /// Time per step in tests, which have no updates.
    pub testing: f64,
}

/// The measured speed of a group of trainings that ran together in one process.
#[derive(Clone, Debug, PartialEq)]
pub struct Measurement {
    /// The environment's name in the catalogue.
    pub environment: String,
    /// The measured method.
    pub method: Method,
    /// The number of cells in the group.
    pub cells: usize,
    /// The measured times per step.
    pub speed: Speed,
}

/// Upper bound of the cost of one or more cells. It assumes that every episode lasts until the step limit. Seconds are
/// wall-clock time of one process; cells that run together in a process share its time.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Estimate {
    /// Steps of training, including episodes that EPOpt generates but does not learn from.
    pub training_steps: f64,
    /// Steps of tests. With RL², these are the steps of all episodes of each trial.
    pub testing_steps: f64,
    /// Process time of training, with rollouts and updates, in seconds.
    pub training_seconds: f64,
    /// Process time of tests, in seconds.
    pub testing_seconds: f64,
}

impl Estimate {
    /// Returns the seconds of training and tests together.
    pub fn seconds(&self) -> f64 {
        self.training_seconds + self.testing_seconds
    }
}

impl Sum for Estimate {
    fn sum<I: Iterator<Item = Self>>(estimates: I) -> Self {
        estimates.fold(Self::default(), |sum, cell| Self {
            training_steps: sum.training_steps + cell.training_steps,
            testing_steps: sum.testing_steps + cell.testing_steps,
            training_seconds: sum.training_seconds + cell.training_seconds,
            testing_seconds: sum.testing_seconds + cell.testing_seconds,
        })
    }
}

/// Chooses groups of cells to measure before `cells` run. `cells` are indices in the plan. Each environment is measured
/// with its first method, and each method in its first environment. A measured group is as large as a group of the run
/// would be, but only has cells of one environment and method. The cells are evenly spread over the grid, and the cell
/// in the middle of the grid comes first.
pub fn benchmark_cells<'a>(plan: &'a Plan, cells: &[usize], grouping: Grouping) -> Vec<Vec<&'a Cell>> {
    let groups = plan.groups(cells, grouping);
    let pair_at = |&cell: &usize| pair(&plan.cells[cell]);
    let mut chosen: Vec<(&str, Method)> = Vec::new();
    for pair in distinct(cells.iter().map(pair_at)) {
        if chosen.iter().all(|known| known.0 != pair.0) || chosen.iter().all(|known| known.1 != pair.1) {
            chosen.push(pair);
        }
    }
    let group_of = |wanted: &(&str, Method)| {
        let of_pair: Vec<usize> = cells.iter().copied().filter(|cell| pair_at(cell) == *wanted).collect();
        let middle = of_pair[of_pair.len() / 2];
        let together = groups.iter().find(|group| group.contains(&middle)).map_or(1, Vec::len).min(of_pair.len());
        let place = |number: usize| of_pair[(2 * number + 1) * of_pair.len() / (2 * together)];
        let mut group: Vec<&Cell> = (0..together).map(|number| &plan.cells[place(number)]).collect();
        group.rotate_left(together / 2);
        group
    };
    chosen.iter().map(group_of).collect()
}

/// Returns the environment and the method of a cell.
fn pair(cell: &Cell) -> (&str, Method) {
    (&cell.config.common.environment, cell.method())
}

/// Returns an upper bound of each cell's cost, in the plan's order. `measurements` are the measured speeds of the
/// [`benchmark_cells`], and `step_limits` the maximum steps per episode by environment.
pub fn estimates(plan: &Plan, measurements: &[Measurement], step_limits: &HashMap<&str, u32>) -> Vec<Estimate> {
    let mut speeds: HashMap<(&str, Method), Speed> = HashMap::new();
    let estimate = |cell| {
        let pair = pair(cell);
        let speed = *speeds.entry(pair.clone()).or_insert_with(|| speed_of(&pair, measurements));
        let limit = f64::from(step_limits.get(pair.0).copied().unwrap_or_default());
        let training_steps = generated_episodes(&cell.config, cell.config.common.episodes) * limit;
        let testing_steps = tested_episodes(cell) * limit;
        Estimate {
            training_steps,
            testing_steps,
            training_seconds: training_steps * speed.training,
            testing_seconds: testing_steps * speed.testing,
        }
    };
    plan.cells.iter().map(estimate).collect()
}

/// Returns the number of episodes that a training generates until `counted` of them count towards its budget. EPOpt
/// generates more episodes than it counts, because only the worst ones count. A policy that does not learn generates
/// 0.
pub fn generated_episodes(config: &TrainConfig, counted: u64) -> f64 {
    if !config.settings.learns() {
        return 0.0;
    }
    let budget = counted as f64;
    let Wrapper::Epopt(epopt) = &config.settings.wrapper else { return budget };
    let full = (epopt.full_iterations as f64 * epopt.episodes_per_iteration as f64).min(budget);
    full + (budget - full) / epopt.epsilon
}

/// Returns the number of episodes in all tests of a cell. With RL², each episode of a trial counts.
pub fn tested_episodes(cell: &Cell) -> f64 {
    let times = cell.tests.sets.len() as f64 * (1.0 + cell.tests.marks.len() as f64);
    let trials = cell.tests.episodes as f64 * times + cell.tests.selection.unwrap_or_default() as f64;
    trials * f64::from(cell.config.settings.episodes_per_trial())
}

/// Returns the speed of a pair of environment and method. If the pair was not measured, takes the method's time per
/// step in another environment, and adds the time by which this environment is slower than the other one with another
/// method. If only the environment or only the method was measured, returns that speed.
fn speed_of((environment, method): &(&str, Method), measurements: &[Measurement]) -> Speed {
    let find = |environment: &str, method: &Method| {
        measurements.iter().find(|known| known.environment == environment && known.method == *method)
    };
    if let Some(known) = find(environment, method) {
        return known.speed;
    }
    let nothing = Speed { training: 0.0, testing: 0.0 };
    let of_environment = measurements.iter().find(|known| known.environment == *environment);
    let of_method = measurements.iter().find(|known| known.method == *method);
    let (Some(of_environment), Some(of_method)) = (of_environment, of_method) else {
        return of_environment.or(of_method).map_or(nothing, |known| known.speed);
    };
    let common = find(&of_method.environment, &of_environment.method).map_or(nothing, |known| known.speed);
    let combine = |of: fn(&Speed) -> f64| {
        let (environment, method) = (of(&of_environment.speed), of(&of_method.speed));
        (environment + method - of(&common)).max(environment).max(method)
    };
    Speed { training: combine(|speed| speed.training), testing: combine(|speed| speed.testing) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan() -> Plan {
        let text = "environments = ['CartPole', 'Hopper']\nversions = ['D']\nruns = 3\ntest_episodes = 10
            settings = { episodes = 100 }\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff', 'rc']
            grid = { n_steps = [5, 10, 15] }\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']
            settings = { n_steps = 32 }";
        Plan::parse("test", text.into()).unwrap()
    }

    fn measured(environment: &str, method: &Method, training: f64) -> Measurement {
        let speed = Speed { training, testing: training / 4.0 };
        Measurement { environment: environment.into(), method: method.clone(), cells: 1, speed }
    }

    #[test]
    fn each_environment_and_each_method_is_measured_once() {
        let plan = plan();
        let all: Vec<usize> = (0..plan.cells.len()).collect();
        let chosen = |cells: &[usize], most| -> Vec<(String, Vec<i64>)> {
            let groups = benchmark_cells(&plan, cells, Grouping { max_cells: most, at_a_time: 1 });
            let steps = |cell: &&Cell| cell.config.table()["n_steps"].as_integer().unwrap_or_default();
            let name = |cell: &Cell| format!("{} {}", cell.config.common.environment, cell.method());
            groups.iter().map(|group| (name(group[0]), group.iter().map(steps).collect())).collect()
        };
        let names: Vec<String> = chosen(&all, 1).into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["CartPole a2c ff", "CartPole a2c rc", "CartPole ppo ff", "Hopper a2c ff"]);
        assert_eq!(chosen(&all, 1)[0].1, [10], "the middle of the grid");
        // CartPole with FF has nine cells of A2C and three of PPO, which form two groups of six.
        assert_eq!(chosen(&all, 6)[0].1, [10, 15, 15, 5, 5, 10], "all over the grid");
        assert_eq!(chosen(&all, 6)[2].1.len(), 3, "there are no more");
        assert_eq!(chosen(&[18, 19], 36), [("CartPole ppo ff".to_owned(), vec![32, 32])], "those that are asked for");
    }

    #[test]
    fn costs_of_environments_and_methods_add_up() {
        let plan = plan();
        let methods = plan.methods();
        let [a2c, rc, ppo] = &methods[..] else { panic!() };
        let measurements = [
            measured("CartPole", a2c, 3.0),
            measured("CartPole", rc, 11.0),
            measured("CartPole", ppo, 4.0),
            measured("Hopper", a2c, 8.0),
        ];
        let of = |environment: &str, method: &Method| speed_of(&(environment, method.clone()), &measurements).training;
        assert_eq!((of("Hopper", a2c), of("Hopper", rc), of("Hopper", ppo)), (8.0, 16.0, 9.0));
        let limits = [("Hopper", 1000), ("CartPole", 200)].into();
        let total: Estimate = estimates(&plan, &measurements, &limits).into_iter().sum();
        // There are 3 runs of 3 + 3 + 1 configurations, with 100 training episodes each.
        let steps = 3.0 * 7.0 * 100.0 * (200.0 + 1000.0);
        assert_eq!((total.training_steps, total.testing_steps), (steps, steps * 0.3));
        let cart_pole = 3.0 * 100.0 * 200.0 * (3.0 * 3.0 + 3.0 * 11.0 + 4.0);
        let hopper = 3.0 * 100.0 * 1000.0 * (3.0 * 8.0 + 3.0 * 16.0 + 9.0);
        assert!((total.training_seconds - cart_pole - hopper).abs() < 1e-6 * total.training_seconds);
        assert!((total.testing_seconds - total.training_seconds * 0.3 / 4.0).abs() < 1e-6 * total.testing_seconds);
        let cells: Vec<f64> = estimates(&plan, &measurements, &limits).iter().map(Estimate::seconds).collect();
        // The first cell is CartPole with A2C: 3 s per step in training, and a quarter of that in a test.
        assert!((cells[0] - 100.0 * 200.0 * (3.0 + 0.3 * 3.0 / 4.0)).abs() < 1e-6 * cells[0], "{}", cells[0]);
        let sum: f64 = cells.iter().sum();
        assert!(cells.len() == 2 * 21 && (sum - total.seconds()).abs() < 1e-6 * sum);
    }

    #[test]
    fn unlearned_episodes_and_whole_trials_count_as_cost() {
        let text = "environments = ['CartPole']\nversions = ['D']\ntest_versions = ['R']\ntest_episodes = 10
            settings = { episodes = 15000 }
            [[algorithm]]\nname = 'epopt-ppo'\narchitectures = ['ff']\nsettings = { epsilon = 0.1 }
            [[algorithm]]\nname = 'rl2-ppo'\narchitectures = ['rc']\nsettings = { episodes_per_trial = 5 }";
        let plan = Plan::parse("test", text.into()).unwrap();
        let estimates = estimates(&plan, &[], &[("CartPole", 1)].into());
        let steps = |cell: usize| (estimates[cell].training_steps, estimates[cell].testing_steps);
        // 100 iterations count all of their 100 episodes. Later iterations count a tenth of theirs.
        assert_eq!(steps(0), (10_000.0 + 50_000.0, 10.0));
        assert_eq!(steps(1), (15_000.0, 50.0));
    }

    #[test]
    fn a_slower_environment_is_never_estimated_faster() {
        let plan = plan();
        let methods = plan.methods();
        let [a2c, rc, ppo] = &methods[..] else { panic!() };
        let measurements =
            [measured("CartPole", a2c, 3.0), measured("CartPole", rc, 2.0), measured("Hopper", a2c, 8.0)];
        assert_eq!(speed_of(&("Hopper", rc.clone()), &measurements).training, 8.0);
        assert_eq!(speed_of(&("Hopper", ppo.clone()), &measurements).training, 8.0, "not measured at all");
    }
}
