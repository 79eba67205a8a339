//! Conversion of test sets between Python and Rust: versions, drawn parameters, grids, and lists of contexts.

use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;

use perturb_experiment::Plan;
use perturb_files as files;
use perturb_protocol::{Distribution, Interval, Version};
use perturb_records::{Axis, Heatmap, MAX_POINTS};
use perturb_settings::sets::{Assignment, Contexts, TestSet, set_of, set_of_csv};
use pyo3::exceptions::PyOSError;
use pyo3::prelude::*;

use crate::failure::{INVALID, failure};
use crate::requests::IntervalsByName;

/// A test set as a Python tuple: its name, its version, the intervals that replace those of the version, and the
/// contexts of a grid or a list.
pub type Set = (String, String, IntervalsByName, Option<Vec<BTreeMap<String, f64>>>);

/// Makes a test set from the values of each parameter in the syntax of experiment files. If a parameter has points, the
/// set is a grid. Otherwise its parameters are drawn.
#[pyfunction]
pub fn make_set(name: &str, version: &str, values: Vec<(String, String)>) -> PyResult<Set> {
    let assignments = values.into_iter().map(|(parameter, values)| format!("{parameter}={values}").parse());
    let assignments = assignments.collect::<Result<Vec<Assignment>, _>>().map_err(|error| invalid(&error))?;
    set_of(name, parse(version)?, assignments).map(|set| to_python(&set)).map_err(|error| invalid(&error))
}

/// Reads a test set from a CSV file with one context per row.
#[pyfunction]
pub fn read_csv_set(name: &str, version: &str, path: PathBuf) -> PyResult<Set> {
    let text = files::read(&path).map_err(|error| PyOSError::new_err(error.to_string()))?;
    set_of_csv(name, parse(version)?, &text).map(|set| to_python(&set)).map_err(|error| invalid(&error))
}

/// Reads the test sets of an experiment file.
#[pyfunction]
pub fn read_sets(path: PathBuf) -> PyResult<Vec<Set>> {
    let sets = Plan::own_sets(&path).map_err(|error| invalid(&error))?;
    Ok(sets.iter().map(to_python).collect())
}

/// Returns the contexts of a heatmap over two parameters. `axes` has the name, the lowest and the highest value of each
/// parameter, `points` the number of points along each axis, and `fixed` the values of other parameters.
#[pyfunction]
pub fn heatmap_contexts(
    axes: [(String, f64, f64); 2],
    points: usize,
    fixed: BTreeMap<String, f64>,
) -> Vec<BTreeMap<String, f64>> {
    let axis = |(name, low, high)| Axis {
        name,
        low,
        high,
        unit: String::new(),
        default: low,
        random: Vec::new(),
        extreme: Vec::new(),
    };
    Heatmap::contexts(&axes.map(axis), points.min(MAX_POINTS), &fixed)
}

/// Converts a test set to a Python tuple.
pub fn to_python(set: &TestSet) -> Set {
    let intervals = |values: &Distribution| values.intervals().iter().map(|it| (it.low, it.high)).collect();
    let drawn = set.drawn().iter().map(|(name, values)| (name.clone(), intervals(values))).collect();
    let contexts = match &set.contexts {
        Contexts::Drawn(_) => None,
        Contexts::Listed(contexts) => Some(contexts.clone()),
    };
    (set.name.clone(), set.version.to_string(), drawn, contexts)
}

/// Converts a Python tuple to a test set.
pub fn from_python((name, version, drawn, contexts): Set) -> PyResult<TestSet> {
    let version = parse(&version)?;
    let contexts = match contexts {
        Some(listed) if listed.is_empty() => {
            return Err(failure(INVALID, 0, format!("{name} has no contexts; expected at least one")));
        }
        Some(listed) => {
            if let Some(value) = listed.iter().flat_map(BTreeMap::values).find(|value| !value.is_finite()) {
                let words = format!("a context of {name} has the value {value}; expected a number");
                return Err(failure(INVALID, 0, words));
            }
            Contexts::Listed(listed)
        }
        None => Contexts::Drawn(parameters(drawn)?),
    };
    Ok(TestSet { name, version, contexts })
}

fn parameters(drawn: IntervalsByName) -> PyResult<BTreeMap<String, Distribution>> {
    let distribution = |(name, intervals): (String, Vec<(f64, f64)>)| {
        let intervals: Vec<Interval> = intervals.into_iter().map(|(low, high)| Interval::new(low, high)).collect();
        let values = Distribution::union(&intervals);
        let values = values.map_err(|error| failure(INVALID, 0, format!("the parameter {name}: {error}")))?;
        Ok((name, values))
    };
    HashMap::into_iter(drawn).map(distribution).collect()
}

fn parse(version: &str) -> PyResult<Version> {
    version.parse().map_err(|error| invalid(&error))
}

fn invalid(error: &dyn std::error::Error) -> PyErr {
    failure(INVALID, 0, error.to_string())
}
