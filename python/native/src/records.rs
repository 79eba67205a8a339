//! Recorded test episodes and what they say, for Python: the study's own records, files and figures.

use std::path::PathBuf;

use numpy::PyArray1;
use perturb_study::outcomes::{Outcomes, SHARE, bins, conditional_value_at_risk, success_within, worst_contexts};
use perturb_study::records::{self, ColumnValues};
use perturb_study::{Metric, paper};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::failure::{INVALID, failure};

/// Mean and deviation, %.
type Number = (f64, Option<f64>);

/// A part of a parameter's range: low, high, successes, episodes, and the interval of the success rate, %.
type Part = (f64, f64, u64, u64, f64, f64);

/// The recorded tests of a policy.
#[pyclass(frozen, module = "perturb._native")]
pub struct Records(pub(crate) records::Records);

#[pymethods]
impl Records {
    /// Reads a Parquet file.
    #[staticmethod]
    fn read(path: PathBuf) -> PyResult<Self> {
        records::Records::read(&path).map(Self).map_err(|error| failure(INVALID, 0, error.to_string()))
    }

    /// Writes a Parquet file, whole or not at all.
    fn write(&self, path: PathBuf) -> PyResult<()> {
        self.0.write(&path).map_err(|error| failure(INVALID, 0, error.to_string()))
    }

    /// In what was tested.
    #[getter]
    fn environment(&self) -> &str {
        &self.0.about.environment
    }

    /// The policy's name.
    #[getter]
    fn policy(&self) -> &str {
        &self.0.about.policy
    }

    /// What counted as a success.
    #[getter]
    fn success(&self) -> Option<String> {
        self.0.about.success.as_ref().map(ToString::to_string)
    }

    /// The parameters' names and units.
    #[getter]
    fn parameters(&self) -> Vec<(&str, &str)> {
        self.0.about.parameters.iter().map(|it| (it.name.as_str(), it.unit.as_str())).collect()
    }

    /// The names of the sets that were tested on, in order.
    #[getter]
    fn sets(&self) -> Vec<&str> {
        self.0.about.tests.iter().map(|test| test.set.name.as_str()).collect()
    }

    /// Arrays by the names of the file's columns; where there is no number, NaN.
    fn columns<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let columns = PyDict::new(py);
        for (name, values) in self.0.columns() {
            match values {
                ColumnValues::Text(texts) => columns.set_item(name, texts)?,
                ColumnValues::Unsigned64(numbers) => columns.set_item(name, PyArray1::from_vec(py, numbers))?,
                ColumnValues::Unsigned32(numbers) => columns.set_item(name, PyArray1::from_vec(py, numbers))?,
                ColumnValues::Flag(flags) => columns.set_item(name, PyArray1::from_vec(py, flags))?,
                ColumnValues::Number(numbers) => columns.set_item(name, PyArray1::from_vec(py, numbers))?,
                ColumnValues::Optional(numbers) => {
                    let numbers = numbers.into_iter().map(|number| number.unwrap_or(f64::NAN)).collect();
                    columns.set_item(name, PyArray1::from_vec(py, numbers))?;
                }
            }
        }
        Ok(columns)
    }

    /// The figures of the test on a set: episodes, success % and its interval, mean return and length, the mean of the worst
    /// tenth of returns, and the success rate in the worst tenth of contexts, %.
    fn result(&self, name: &str) -> (u64, f64, (f64, f64), f64, f64, f64, Option<f64>) {
        let result = self.0.result(name, None);
        let outcomes = Outcomes::of(&self.0, name);
        let [low, high] = result.success_percent_95;
        (
            result.episodes,
            result.success_percent,
            (low, high),
            result.mean_return,
            result.mean_length,
            conditional_value_at_risk(&outcomes.returns, SHARE),
            worst_contexts(&outcomes),
        )
    }

    /// Success over a parameter on a set.
    fn success_by_parameter(&self, name: &str, parameter: &str) -> PyResult<Vec<Part>> {
        let names: Vec<&str> = self.0.about.parameters.iter().map(|it| it.name.as_str()).collect();
        let Some(place) = names.iter().position(|known| *known == parameter) else {
            let words = format!("there is no parameter '{parameter}'; expected one of {}", names.join(", "));
            return Err(failure(INVALID, 0, words));
        };
        let outcomes = Outcomes::of(&self.0, name);
        let bins = bins(std::iter::once(&outcomes), place);
        let counted = success_within(&outcomes, place, &bins);
        let told = bins.iter().zip(counted).map(|(bin, counted)| {
            let [low, high] = counted.interval();
            (bin.low, bin.high, counted.successes, counted.episodes, low, high)
        });
        Ok(told.collect())
    }
}

/// The paper's three numbers, Default, Interpolation and Extrapolation, of success rates, %, by scenario, e.g. "DR".
#[pyfunction]
pub fn metrics(rates: std::collections::HashMap<String, f64>) -> (Option<f64>, Option<f64>, Option<f64>) {
    let [default, interpolation, extrapolation] =
        Metric::ALL.map(|metric| metric.of(|scenario| rates.get(&scenario.to_string()).copied()));
    (default, interpolation, extrapolation)
}

/// The paper's methods in an environment, with the mean and deviation over five runs of their three numbers, %.
#[pyfunction]
pub fn published(environment: &str) -> Vec<(String, Vec<Option<Number>>)> {
    let numbers = |method| {
        let number = |metric| paper::number(environment, &method, metric).map(|it| (it.mean, it.std));
        (method.to_string(), Metric::ALL.into_iter().map(number).collect())
    };
    paper::methods(environment).into_iter().map(numbers).collect()
}
