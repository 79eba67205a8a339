//! An experiment file, and the cells that it expands to.
//!
//! A cell is one training and its tests. Cells are the product of environments, algorithms, architectures, grid,
//! training versions and runs, in this order, the last one varying fastest. All cells of a run have the same seed, so
//! that two of them differ in nothing but what the file says.

mod expansion;
mod file;
mod groups;
mod sets;

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::Path;

use perturb_protocol::proto;
use serde::{Deserialize, Serialize};

use crate::files::{self, FileError};
use crate::sets::{TestSet, check as check_parameters};
use crate::settings::TrainConfig;
use crate::success::{Criterion, Rule};
use crate::value_error::ValueError;
use crate::{AnyError, Method, Version};
use file::File;
pub use groups::Grouping;

/// Everything that an experiment file asks for.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The file, as it was written.
    pub text: String,
    /// The files beside it that its sets name, with their content.
    pub beside: BTreeMap<String, Vec<u8>>,
    /// How often the whole is repeated, each time with another seed.
    pub runs: u32,
    /// All cells; a cell's index is its place here.
    pub cells: Vec<Cell>,
}

/// One training and its tests.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Its place in the plan, from 0.
    pub index: usize,
    /// Its name: environment, algorithm, architecture, training version, configuration and seed. It depends on nothing
    /// else in the plan, so that a cell keeps its results when others are added.
    pub id: String,
    /// Names the settings, without environment, version and seed, in eight hexadecimal digits.
    pub configuration: String,
    /// Which run it belongs to, from 1.
    pub run: u32,
    /// The name of the plan's own set of parameters, if it is trained on one.
    pub set: Option<String>,
    /// What is trained.
    pub config: TrainConfig,
    /// How it is tested.
    pub tests: Tests,
}

/// How a trained policy is tested.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tests {
    /// Episodes of each test.
    pub episodes: u64,
    /// On what: versions in the order D, R, E, then the plan's own sets in theirs.
    pub sets: Vec<TestSet>,
    /// What decides about success; `None` for the environment's own rule.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub success: Option<Rule>,
}

/// How much a plan asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Counts {
    /// Algorithms with their architectures and settings, whatever the environment.
    pub configurations: usize,
    /// Trainings of one run.
    pub trainings: usize,
    /// Pairs of a training and a test in one run.
    pub pairs: usize,
    /// The same in all runs.
    pub all_pairs: usize,
    /// How often the whole is repeated.
    pub runs: u32,
}

/// Why an experiment file was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// It cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// It is not TOML, or something in it cannot be.
    #[error("{path}: {reason}")]
    Refused {
        /// As it was given.
        path: String,
        /// Names the table, the key and what is accepted.
        reason: AnyError,
    },
}

impl Plan {
    /// Reads and expands the file at `path`.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub fn load(path: &Path) -> Result<Self, PlanError> {
        Self::parse(&path.display().to_string(), files::read_text(path)?)
    }

    /// The files that it consists of, by their names: `plan.toml` and those that its sets name.
    pub fn files(&self) -> impl Iterator<Item = (&str, &[u8])> {
        let beside = self.beside.iter().map(|(name, content)| (name.as_str(), content.as_slice()));
        beside.chain([("plan.toml", self.text.as_bytes())]) // last: it names the others
    }

    /// Expands `text`, which `path` names in errors.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub fn parse(path: &str, text: String) -> Result<Self, PlanError> {
        Self::expand(path, text).map_err(|reason| PlanError::Refused { path: path.to_owned(), reason })
    }

    fn expand(path: &str, text: String) -> Result<Self, AnyError> {
        let file: File = toml::from_str(&text).map_err(|error| error.to_string().trim().to_owned())?;
        file.check()?;
        let mut beside = BTreeMap::new();
        let sets = sets::read(&file.sets, Path::new(path).parent().unwrap_or(Path::new("")), &mut beside)?;
        Ok(Self { runs: file.runs, cells: expansion::expand(&file, &sets)?, beside, text })
    }

    /// Whether `environment` has the parameters and thresholds that the plan's cells name for it.
    ///
    /// # Errors
    /// [`ValueError`] for one that it does not take.
    pub fn check(&self, environment: &proto::Environment) -> Result<(), ValueError> {
        let (text, code) = (Criterion::of(environment), Criterion::of_code(environment));
        for cell in self.cells.iter().filter(|cell| cell.config.common.environment == environment.name) {
            let trained = cell.set.as_deref().unwrap_or_default();
            check_parameters(trained, &cell.config.common.parameters, environment)?;
            cell.tests.sets.iter().try_for_each(|set| set.check(environment))?;
            if let Some(rule) = &cell.tests.success {
                rule.of(text.as_ref(), code.as_ref())?;
            }
        }
        Ok(())
    }

    /// How much it asks for.
    pub fn counts(&self) -> Counts {
        let first = self.cells.iter().filter(|cell| cell.run == 1);
        let configurations: BTreeSet<_> = first.clone().map(|cell| (cell.method(), &cell.configuration)).collect();
        Counts {
            configurations: configurations.len(),
            trainings: first.clone().count(),
            pairs: first.map(|cell| cell.tests.sets.len()).sum(),
            all_pairs: self.cells.iter().map(|cell| cell.tests.sets.len()).sum(),
            runs: self.runs,
        }
    }

    /// The cell with this id, or with this index.
    pub fn find(&self, name: &str) -> Option<&Cell> {
        let by_index = || name.parse().ok().and_then(|index: usize| self.cells.get(index));
        self.cells.iter().find(|cell| cell.id == name).or_else(by_index)
    }

    /// The environments, in the plan's order.
    pub fn environments(&self) -> Vec<&str> {
        distinct(self.cells.iter().map(|cell| cell.config.common.environment.as_str()))
    }

    /// The methods, in the plan's order.
    pub fn methods(&self) -> Vec<Method> {
        distinct(self.cells.iter().map(Cell::method))
    }
}

/// What a policy is trained on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TrainedOn<'a> {
    /// D, R or E.
    Version(Version),
    /// The plan's own set of that name.
    Set(&'a str),
}

impl std::fmt::Display for TrainedOn<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            TrainedOn::Version(version) => version.fmt(f),
            TrainedOn::Set(name) => name.fmt(f),
        }
    }
}

impl Cell {
    /// Its set or version.
    pub fn trained_on(&self) -> TrainedOn<'_> {
        self.set.as_deref().map_or(TrainedOn::Version(self.config.common.version), TrainedOn::Set)
    }

    /// What trains.
    pub fn method(&self) -> Method {
        self.config.method()
    }
}

/// The elements of `items` without repetitions, in order.
pub(crate) fn distinct<T: Eq + std::hash::Hash + Clone>(items: impl Iterator<Item = T>) -> Vec<T> {
    let mut seen = HashSet::new();
    items.filter(|item| seen.insert(item.clone())).collect()
}

#[cfg(test)]
mod tests;
