//! The published results of Packer et al. (2018), arXiv:1810.12282.

use perturb_settings::{Method, Observe, Preset};
use serde::Deserialize;

use crate::scenarios::Metric;
use crate::statistics::Summary;

/// All numbers of the paper's tables, as CSV.
const TABLE: &str = include_str!("../data/paper_results.csv");
/// The paper's environments, by their names in the catalogue.
pub const ENVIRONMENTS: [&str; 6] = ["CartPole", "MountainCar", "Acrobot", "Pendulum", "HalfCheetah", "Hopper"];
/// Environments for which perturb uses another physics engine than the paper. Their numbers cannot be compared with the
/// paper's.
const OTHER_ENGINE: [&str; 2] = ["HalfCheetah", "Hopper"];
const RUNS: usize = 5;

/// Returns whether results in an environment can be compared with the paper's.
pub fn is_comparable(environment: &str) -> bool {
    !OTHER_ENGINE.contains(&environment)
}

#[derive(Deserialize)]
struct Record {
    environment: String,
    algorithm: String,
    architecture: String,
    episodes_per_trial: Option<u32>,
    metric: Metric,
    mean_percent: f64,
    std_percent: f64,
}

impl Record {
    fn is_of(&self, environment: &str, method: &Method) -> bool {
        self.environment == environment
            && self.algorithm.eq_ignore_ascii_case(&method.algorithm)
            && self.architecture.eq_ignore_ascii_case(&method.architecture)
            && self.episodes_per_trial == method.episodes_per_trial
            && !method.observe.sees_parameters()
            && !method.external
    }
}

/// Returns the paper's number for a method in an environment; `None` if the paper has none. For the average over all
/// six environments, pass "Average" as `environment`.
pub fn number(environment: &str, method: &Method, metric: Metric) -> Option<Summary> {
    let record = records().find(|record| record.metric == metric && record.is_of(environment, method))?;
    Some(Summary { mean: record.mean_percent, std: Some(record.std_percent), runs: RUNS })
}

/// Returns the methods for which the paper has numbers in `environment`, in the paper's order.
pub fn methods(environment: &str) -> Vec<Method> {
    let mut methods = Vec::new();
    for record in records().filter(|record| record.environment == environment) {
        let method = Method {
            algorithm: record.algorithm.to_lowercase(),
            architecture: record.architecture.to_lowercase(),
            episodes_per_trial: record.episodes_per_trial,
            preset: Preset::default(),
            observe: Observe::default(),
            external: false,
        };
        if !methods.contains(&method) {
            methods.push(method);
        }
    }
    methods
}

/// Returns the paper's average of a metric over `environments`. For all six environments this is the published average,
/// otherwise the mean of the published numbers. Returns `None` if a number is missing.
pub fn average(environments: &[&str], method: &Method, metric: Metric) -> Option<Summary> {
    let means: Option<Vec<f64>> = environments.iter().map(|name| Some(number(name, method, metric)?.mean)).collect();
    let means = means?;
    if means.len() == ENVIRONMENTS.len() {
        return number("Average", method, metric);
    }
    Some(Summary { mean: means.iter().sum::<f64>() / means.len() as f64, std: None, runs: RUNS })
}

fn records() -> impl Iterator<Item = Record> {
    csv::Reader::from_reader(TABLE.as_bytes()).into_deserialize().filter_map(Result::ok) // the test reads every line
}

#[cfg(test)]
mod tests {
    use super::*;

    fn method(algorithm: &str, architecture: &str, episodes_per_trial: Option<u32>) -> Method {
        Method {
            algorithm: algorithm.into(),
            architecture: architecture.into(),
            episodes_per_trial,
            preset: Preset::Perturb,
            observe: Observe::State,
            external: false,
        }
    }

    #[test]
    fn every_line_is_read() {
        let records: Result<Vec<Record>, _> = csv::Reader::from_reader(TABLE.as_bytes()).deserialize().collect();
        assert_eq!(records.unwrap().len(), TABLE.lines().count() - 1);
    }

    #[test]
    fn a_number_is_found_by_environment_method_and_metric() {
        let ppo = method("ppo", "ff", None);
        let shown = |metric| number("CartPole", &ppo, metric).unwrap().to_string();
        assert_eq!(Metric::ALL.map(shown), ["100.0 ± 0.0", "100.0 ± 0.0", "86.2 ± 12.6"]);
        assert_eq!(number("CartPole", &method("ppo", "transformer", None), Metric::Default), None);
        assert_eq!(
            number("CartPole", &Method { observe: Observe::Parameters, ..ppo }, Metric::Default),
            None,
            "the paper's PPO did not see the parameters"
        );
        assert_eq!(number("Pendulum", &method("rl2-a2c", "rc", None), Metric::Default), None, "RL² has a trial length");
        let with = |trials| number("Average", &method("rl2-a2c", "rc", Some(trials)), Metric::Default).unwrap().mean;
        assert_eq!([1, 2, 5].map(with), [66.83, 45.79, 41.08]);
    }

    #[test]
    fn every_method_of_an_environment_has_its_three_numbers() {
        for environment in ENVIRONMENTS {
            let methods = methods(environment);
            assert_eq!(methods.len(), 14, "{methods:?}");
            for (method, metric) in methods.iter().flat_map(|method| Metric::ALL.map(|metric| (method, metric))) {
                assert!(number(environment, method, metric).is_some(), "{environment} {method} {metric}");
            }
        }
        assert_eq!(methods("Ant"), []);
    }

    #[test]
    fn an_average_is_over_the_same_environments() {
        let a2c = method("a2c", "ff", None);
        let two = average(&["CartPole", "MountainCar"], &a2c, Metric::Default).unwrap();
        assert!((two.mean - (100.0 + 79.78) / 2.0).abs() < 1e-9 && two.std.is_none());
        assert_eq!(average(&ENVIRONMENTS, &a2c, Metric::Default), number("Average", &a2c, Metric::Default));
        assert_eq!(average(&["CartPole", "Ant"], &a2c, Metric::Default), None);
    }

    /// The paper's averages equal the means of its tables of the environments, to the published two decimals.
    #[test]
    fn the_published_averages_are_those_of_the_environments() {
        let averages: Vec<Record> = records().filter(|record| record.environment == "Average").collect();
        assert_eq!(averages.len(), 42);
        for Record { algorithm, architecture, episodes_per_trial, metric, mean_percent, .. } in averages {
            let (preset, observe) = (Preset::Paper, Observe::State);
            let method = Method { algorithm, architecture, episodes_per_trial, preset, observe, external: false };
            let means = ENVIRONMENTS.map(|environment| number(environment, &method, metric).unwrap().mean);
            let mean = means.iter().sum::<f64>() / means.len() as f64;
            // Both numbers are rounded to 0.01, so each may be off by 0.005. The rest of the tolerance is for
            // binary rounding.
            assert!((mean - mean_percent).abs() < 0.0101, "{method} {metric}: {mean} is not {mean_percent}");
        }
    }
}
