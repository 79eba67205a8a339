//! What the paper reports.

use std::fmt;

use serde::Deserialize;

/// Every published cell of Packer et al. (2018), arXiv:1810.12282.
const TABLE: &str = include_str!("../data/paper_results.csv");

/// Mean and standard deviation over the paper's five runs, %.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    /// Mean, %.
    pub mean: f64,
    /// Standard deviation, %.
    pub std: f64,
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&format!("{:.1} ± {:.1}", self.mean, self.std))
    }
}

/// A row of the paper's tables: one environment, one algorithm, one architecture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Trained and tested on D.
    pub default: Cell,
    /// Trained and tested on R.
    pub interpolation: Cell,
    /// The geometric mean of DR, DE and RE.
    pub extrapolation: Cell,
}

#[derive(Deserialize)]
struct Record {
    environment: String,
    algorithm: String,
    architecture: String,
    episodes_per_trial: Option<u32>,
    metric: String,
    mean_percent: f64,
    std_percent: f64,
}

/// The row of `environment` (e.g. "CartPole"), `algorithm` and `architecture` (e.g. "ppo", "ff"; upper or lower case);
/// `None` if the paper has none. Only algorithms without trials are looked up.
pub fn row(environment: &str, algorithm: &str, architecture: &str) -> Option<Row> {
    row_with_trials(environment, algorithm, architecture, None)
}

/// The same for algorithms whose trials have so many episodes. The environment "Average" is the mean of all six.
pub fn row_with_trials(
    environment: &str,
    algorithm: &str,
    architecture: &str,
    episodes_per_trial: Option<u32>,
) -> Option<Row> {
    let records: Vec<Record> = records()
        .filter(|record| {
            record.environment == environment
                && record.algorithm.eq_ignore_ascii_case(algorithm)
                && record.architecture.eq_ignore_ascii_case(architecture)
                && record.episodes_per_trial == episodes_per_trial
        })
        .collect();
    let cell = |metric: &str| {
        let record = records.iter().find(|record| record.metric == metric)?;
        Some(Cell { mean: record.mean_percent, std: record.std_percent })
    };
    Some(Row {
        default: cell("default")?,
        interpolation: cell("interpolation")?,
        extrapolation: cell("extrapolation")?,
    })
}

/// Algorithm, architecture and episodes in a trial of each row of `environment`.
pub fn rows_of(environment: &str) -> Vec<(String, String, Option<u32>)> {
    let mut rows: Vec<_> = records()
        .filter(|record| record.environment == environment)
        .map(|record| (record.algorithm, record.architecture, record.episodes_per_trial))
        .collect();
    rows.dedup(); // a row's metrics stand together
    rows
}

fn records() -> impl Iterator<Item = Record> {
    csv::Reader::from_reader(TABLE.as_bytes()).into_deserialize().filter_map(Result::ok) // the test reads every line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_is_read() {
        let records: Result<Vec<Record>, _> = csv::Reader::from_reader(TABLE.as_bytes()).deserialize().collect();
        assert_eq!(records.unwrap().len(), TABLE.lines().count() - 1);
    }

    #[test]
    fn a_row_is_found_by_its_names() {
        let row = row("CartPole", "ppo", "ff").unwrap();
        assert_eq!(row.default, Cell { mean: 100.0, std: 0.0 });
        assert_eq!(row.extrapolation.to_string(), "86.2 ± 12.6");
        assert_eq!(super::row("CartPole", "ppo", "transformer"), None);
        assert_eq!(super::row("Pendulum", "rl2-a2c", "rc"), None, "it has trials");
        let with = |trials| row_with_trials("Average", "rl2-a2c", "rc", Some(trials)).unwrap().default.mean;
        assert_eq!([1, 2, 5].map(with), [66.83, 45.79, 41.08]);
        assert_eq!(rows_of("Hopper").len(), 14);
    }
}
