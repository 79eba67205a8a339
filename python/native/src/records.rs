//! The Python class of recorded test episodes, with their files and statistics. Experiments use the same
//! files and statistics.

use std::path::PathBuf;

use numpy::{PyArray1, PyReadonlyArray1};
use perturb_records::outcomes::{
    Bin, Outcomes, SHARE, SuccessCount, bins, conditional_value_at_risk, success_within, success_within_both,
    worst_contexts,
};
use perturb_records::statistics::{bootstrap, mean};
use perturb_records::success::{Criterion, Rule, Side};
use perturb_records::{ColumnValues, Metric, ResultsTable, paper};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::failure::{INVALID, failure};
use crate::sets::{Set, to_python};

/// Number of resamples of the bootstrap over episodes.
const RESAMPLES: usize = 1000;

/// The mean over runs, and the standard deviation over runs if it is known, %.
type MeanAndDeviation = (f64, Option<f64>);

/// A bin of a parameter's range: lower and upper edge, successes, episodes, and both ends of the success rate's 95 %
/// interval, %.
type BinRow = (f64, f64, u64, u64, f64, f64);

/// A cell of a grid over two parameters x and y: its range of x, its range of y, successes, episodes.
type GridRow = ((f64, f64), (f64, f64), u64, u64);

/// The statistics of a test: number of episodes, success rate (%) and its interval, mean return and its interval, mean
/// length (steps), mean of the worst tenth of returns and its interval, success rate in the worst tenth of contexts
/// (%).
type ResultRow = (u64, f64, (f64, f64), f64, (f64, f64), f64, f64, (f64, f64), Option<f64>);

/// A results table: its columns by name, and the name and experiment file of each study.
type ResultsColumns<'py> = (Bound<'py, PyDict>, Vec<(String, String)>);

/// The recorded tests of a policy.
#[pyclass(frozen, name = "Records", module = "perturb._native")]
pub struct PythonRecords(pub(crate) perturb_records::Records);

#[pymethods]
impl PythonRecords {
    /// Reads records from a Parquet file.
    #[staticmethod]
    fn read(path: PathBuf) -> PyResult<Self> {
        perturb_records::Records::read(&path).map(Self).map_err(|error| failure(INVALID, 0, error.to_string()))
    }

    /// Writes the records to a Parquet file. If an error occurs, an existing file is not changed.
    fn write(&self, path: PathBuf) -> PyResult<()> {
        self.0.write(&path).map_err(|error| failure(INVALID, 0, error.to_string()))
    }

    /// The environment that the policy was tested in.
    #[getter]
    fn environment(&self) -> &str {
        &self.0.about.environment
    }

    /// The policy's name.
    #[getter]
    fn policy(&self) -> &str {
        &self.0.about.policy
    }

    /// The success rule as a phrase. `None` if the server decided about success and stated no rule.
    #[getter]
    fn success(&self) -> Option<String> {
        self.0.about.success.as_ref().map(ToString::to_string)
    }

    /// The parameters' names and units.
    #[getter]
    fn parameters(&self) -> Vec<(&str, &str)> {
        self.0.about.parameters.iter().map(|it| (it.name.as_str(), it.unit.as_str())).collect()
    }

    /// The names of the test sets, in the order of the tests.
    #[getter]
    fn sets(&self) -> Vec<&str> {
        self.0.about.tests.iter().map(|test| test.set.name.as_str()).collect()
    }

    /// Returns the columns of the records' file, by name. Missing numbers are NaN.
    fn columns<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let columns = PyDict::new(py);
        add_columns(&columns, self.0.columns())?;
        Ok(columns)
    }

    /// Returns records of the same episodes, judged by a success rule in the syntax of `--success`.
    fn judged_by(&self, rule: &str) -> PyResult<Self> {
        let invalid = |error: perturb_settings::ValueError| failure(INVALID, 0, error.to_string());
        let rule: Rule = rule.parse().map_err(invalid)?;
        self.0.clone().judged_by(&rule).map(Self).map_err(invalid)
    }

    /// Returns records of the same episodes, judged by a threshold. `values` `[n]` has the value of `quantity` in each
    /// episode. NaN is a failure.
    fn judged(
        &self,
        quantity: String,
        at_least: bool,
        threshold: f64,
        values: PyReadonlyArray1<'_, f64>,
    ) -> PyResult<Self> {
        let side = if at_least { Side::AtLeast } else { Side::AtMost };
        let criterion = Criterion { quantity, unit: "1".into(), side, threshold, most: None };
        let judged = self.0.clone().judged_by_values(criterion, values.as_slice()?);
        judged.map(Self).map_err(|error| failure(INVALID, 0, error.to_string()))
    }

    /// Returns the test sets, in the order of the tests.
    fn tests(&self) -> Vec<Set> {
        self.0.about.tests.iter().map(|test| to_python(&test.set)).collect()
    }

    /// The success rule in the syntax of `--success`. `None` if the server decided about success and stated no rule.
    #[getter]
    fn rule(&self) -> Option<String> {
        let success = self.0.about.success.as_ref();
        success.map(|criterion| format!("{}={}", criterion.quantity, criterion.threshold))
    }

    /// Returns the statistics of the test on a set.
    fn result(&self, py: Python<'_>, name: &str) -> ResultRow {
        py.detach(|| {
            let result = self.0.result(name, None);
            let outcomes = Outcomes::new(&self.0, name);
            let statistics = |returns: &[Vec<f64>]| {
                vec![mean(returns[0].iter().copied()), conditional_value_at_risk(&returns[0], SHARE)]
            };
            let numbers =
                bootstrap(std::slice::from_ref(&outcomes.returns), RESAMPLES, 1, statistics).unwrap_or_default();
            let interval = |place: usize| {
                let [low, high] =
                    numbers.get(place).map_or([f64::NAN; 2], |it| it.interval_95.unwrap_or([it.point; 2]));
                (low, high)
            };
            let [low, high] = result.success_percent_95;
            (
                result.episodes,
                result.success_percent,
                (low, high),
                result.mean_return,
                interval(0),
                result.mean_length,
                conditional_value_at_risk(&outcomes.returns, SHARE),
                interval(1),
                worst_contexts(&outcomes),
            )
        })
    }

    /// Returns the number of each episode's context, `[n]`, for the test on a set. Contexts are numbered from 0. If the
    /// set is a list or a grid, its contexts are used. Otherwise each context is a region of the parameter space.
    fn parts(&self, name: &str) -> Vec<usize> {
        Outcomes::new(&self.0, name).parts()
    }

    /// Returns the successes in the test on a set, in each cell of a grid over two parameters. The cells are ordered by
    /// y and then x.
    fn success_by_parameters(&self, name: &str, x: &str, y: &str) -> PyResult<Vec<GridRow>> {
        let places = [self.place(x)?, self.place(y)?];
        let outcomes = Outcomes::new(&self.0, name);
        let bins = places.map(|place| bins(std::iter::once(&outcomes), place));
        let [over_x, over_y] = [&bins[0], &bins[1]];
        let counted = success_within_both(&outcomes, places, [over_x, over_y]);
        let pairs = over_y.iter().flat_map(|y| over_x.iter().map(move |x| (x, y)));
        let cell = |((x, y), counted): ((&Bin, &Bin), SuccessCount)| {
            ((x.low, x.high), (y.low, y.high), counted.successes, counted.episodes)
        };
        Ok(pairs.zip(counted).map(cell).collect())
    }

    /// Returns the successes in the test on a set, in each bin of a parameter's range.
    fn success_by_parameter(&self, name: &str, parameter: &str) -> PyResult<Vec<BinRow>> {
        let place = self.place(parameter)?;
        let outcomes = Outcomes::new(&self.0, name);
        let bins = bins(std::iter::once(&outcomes), place);
        let counted = success_within(&outcomes, place, &bins);
        let rows = bins.iter().zip(counted).map(|(bin, counted)| {
            let [low, high] = counted.interval();
            (bin.low, bin.high, counted.successes, counted.episodes, low, high)
        });
        Ok(rows.collect())
    }
}

impl PythonRecords {
    /// Returns the position of a parameter in the environment's list of parameters.
    fn place(&self, parameter: &str) -> PyResult<usize> {
        let names: Vec<&str> = self.0.about.parameters.iter().map(|it| it.name.as_str()).collect();
        names.iter().position(|known| *known == parameter).ok_or_else(|| {
            let words = format!("there is no parameter '{parameter}'; expected one of {}", names.join(", "));
            failure(INVALID, 0, words)
        })
    }
}

/// Adds columns to a Python dictionary, as arrays of numbers or lists of texts. Missing numbers are NaN, and missing
/// texts are None.
fn add_columns(dictionary: &Bound<'_, PyDict>, columns: Vec<(String, ColumnValues<'_>)>) -> PyResult<()> {
    let py = dictionary.py();
    let numbers = |name: String, numbers: Vec<f64>| dictionary.set_item(name, PyArray1::from_vec(py, numbers));
    for (name, values) in columns {
        match values {
            ColumnValues::Text(texts) => dictionary.set_item(name, texts)?,
            ColumnValues::OptionalText(texts) => dictionary.set_item(name, texts)?,
            ColumnValues::Unsigned64(values) => dictionary.set_item(name, PyArray1::from_vec(py, values))?,
            ColumnValues::Unsigned32(values) => dictionary.set_item(name, PyArray1::from_vec(py, values))?,
            ColumnValues::Flag(flags) => dictionary.set_item(name, PyArray1::from_vec(py, flags))?,
            ColumnValues::Number(values) => numbers(name, values)?,
            ColumnValues::Optional(values) => {
                numbers(name, values.into_iter().map(|number| number.unwrap_or(f64::NAN)).collect())?;
            }
            ColumnValues::OptionalUnsigned64(values) => {
                // The conversion to a float is exact up to 2^53. No count of episodes or steps is larger.
                numbers(name, values.into_iter().map(|count| count.map_or(f64::NAN, |count| count as f64)).collect())?;
            }
        }
    }
    Ok(())
}

/// Reads a results table of `perturb export`. Returns its columns by name, and the name and experiment file of each
/// study.
#[pyfunction]
pub fn read_results(py: Python<'_>, path: PathBuf) -> PyResult<ResultsColumns<'_>> {
    let table = py.detach(|| ResultsTable::read(&path)).map_err(|error| failure(INVALID, 0, error.to_string()))?;
    let columns = PyDict::new(py);
    add_columns(&columns, table.columns())?;
    let plans = table.studies.iter().map(|(study, plan)| (study.clone(), plan.plan.clone()));
    Ok((columns, plans.collect()))
}

/// Returns the 95 % Wilson interval (1927) of a success rate, 0 … 1.
#[pyfunction]
pub fn wilson(successes: u64, episodes: u64) -> (f64, f64) {
    perturb_records::statistics::wilson(successes, episodes)
}

/// Returns the metrics Default, Interpolation and Extrapolation, %. `rates` has the success rates, %, by scenario, such
/// as "DR" (trained on D, tested on R). A metric is `None` if one of its scenarios is missing.
#[pyfunction]
pub fn metrics(rates: std::collections::HashMap<String, f64>) -> (Option<f64>, Option<f64>, Option<f64>) {
    let [default, interpolation, extrapolation] =
        Metric::ALL.map(|metric| metric.value(|scenario| rates.get(&scenario.to_string()).copied()));
    (default, interpolation, extrapolation)
}

/// Returns the results that Packer et al. (2018) published for an environment. Each entry has a method's name and its
/// metrics Default, Interpolation and Extrapolation. A metric is the mean and the standard deviation over five runs, %;
/// `None` if the paper does not have it.
#[pyfunction]
pub fn published(environment: &str) -> Vec<(String, Vec<Option<MeanAndDeviation>>)> {
    let numbers = |method| {
        let number = |metric| paper::number(environment, &method, metric).map(|it| (it.mean, it.std));
        (method.to_string(), Metric::ALL.into_iter().map(number).collect())
    };
    paper::methods(environment).into_iter().map(numbers).collect()
}
