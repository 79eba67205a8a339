//! Experiment files and their expansion to cells.
//!
//! A cell is one training and its tests. Cells are the product of environments, algorithms, architectures, grid, training
//! versions and runs, in this order, the last one varying fastest. All cells of a run have the same seed, so that two of
//! them differ in nothing but what the file says. With `selection = "clean"` these are tuning cells. The configurations that
//! they select are trained again with other seeds.

mod expansion;
mod file;
mod groups;
mod sets;
mod tasks;

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use perturb_protocol::{names, proto};
use serde::{Deserialize, Serialize};

use file::File;
pub use groups::Grouping;
use perturb_files::{self as files, AnyError, FileError};
use perturb_records::TrainedOn;
use perturb_records::success::{Criterion, Rule};
use perturb_settings::sets::{Contexts, TestSet, check as check_parameters};
use perturb_settings::{Method, TrainConfig, ValueError, require};
use sets::ReadBeside;

/// The content of an experiment file, with its cells.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The text of the file. Paths of `tasks` were made absolute, so that a copy elsewhere names the same folders.
    pub text: String,
    /// The heading of reports; empty if the file has none.
    pub title: String,
    /// The date as written in the file; empty if the file has none.
    pub date: String,
    /// The files in the same folder that its sets name, with their content.
    pub beside: BTreeMap<String, Vec<u8>>,
    /// The folders of tasks that private servers also serve, absolute.
    pub tasks: Vec<PathBuf>,
    /// The requested revisions of environments, as in `perturb/CartPole-v1`. Environments that are not listed may have any
    /// revision.
    pub revisions: BTreeMap<String, u32>,
    /// The rule that selects configurations.
    pub selection: Selection,
    /// Number of reported repetitions, each with another seed.
    pub runs: u32,
    /// Number of earlier repetitions, with separate seeds, that select configurations; 0 if the reported tests select.
    pub tuning_runs: u32,
    /// All cells that are known before the run: the tuning cells, if there are any. A cell's index is its position in this
    /// list.
    pub cells: Vec<Cell>,
    /// Cells that are appended to `cells` when their configuration is selected, see [`Plan::with_selected_cells`].
    pub candidates: Vec<Cell>,
}

/// The rule that selects one of several configurations for a report.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Selection {
    /// The paper's rule: the reported tests select.
    #[default]
    Paper,
    /// Separate selection episodes of trainings on tuning seeds select. The selected configurations are trained again on
    /// other seeds, and tested on other episodes.
    Clean,
}

impl Selection {
    /// The names in files and options.
    pub const NAMES: [&'static str; 2] = ["paper", "clean"];
}

impl std::fmt::Display for Selection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(Self::NAMES[*self as usize])
    }
}

impl std::str::FromStr for Selection {
    type Err = ValueError;

    fn from_str(text: &str) -> Result<Self, ValueError> {
        let known =
            [Selection::Paper, Selection::Clean].into_iter().find(|rule| names::is_spelled(text, &rule.to_string()));
        known.ok_or_else(|| ValueError::new("selection", format!("`{text}`"), "\"paper\" or \"clean\""))
    }
}

/// The name of the selecting test in results and records. It is used for nothing else.
pub const SELECTION_TEST: &str = "selection";

/// A training and its tests.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// The index in the plan, from 0.
    pub index: usize,
    /// The cell's name: environment, algorithm, architecture, training version, configuration and seed. It depends on
    /// nothing else in the plan, so a cell keeps its results when others are added.
    pub id: String,
    /// A hash of the settings without environment, version and seed, in eight hexadecimal digits.
    pub configuration: String,
    /// The run, from 1. Tuning cells have separate runs.
    pub run: u32,
    /// For a cell that is trained after the selection, the configuration of the tuning cells that select it. `None` for a
    /// cell of the grid.
    pub tuned_as: Option<String>,
    /// The name of the plan's set of parameters on which it is trained; `None` if it is trained on a version.
    pub set: Option<String>,
    /// The configuration of the training.
    pub config: TrainConfig,
    /// The tests of the policy.
    pub tests: Tests,
}

/// The tests of a policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tests {
    /// Episodes of each test.
    pub episodes: u64,
    /// The test sets: versions in the order D, R, E, R+E, then the plan's own sets in the plan's order.
    pub sets: Vec<TestSet>,
    /// Episodes of the separate selecting test on the training distribution; `None` if the reported tests select.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selection: Option<u64>,
    /// Numbers of training episodes after which the intermediate policy is tested too, ascending and below the budget.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub marks: Vec<u64>,
    /// The success rule; `None` for the environment's own rule.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub success: Option<Rule>,
}

/// The amounts of work in a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Counts {
    /// Algorithms with their architectures and settings, whatever the environment.
    pub configurations: usize,
    /// Trainings of one run.
    pub trainings: usize,
    /// Pairs of a training and a test in one run.
    pub pairs: usize,
    /// Train/test pairs of all runs.
    pub all_pairs: usize,
    /// The number of repetitions.
    pub runs: u32,
}

/// Why an experiment file was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// The file cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// The file is not TOML, or has an invalid value.
    #[error("{path}: {reason}")]
    Refused {
        /// The path as it was given.
        path: String,
        /// The table, the key and the accepted values.
        reason: AnyError,
    },
}

impl Plan {
    /// Returns an empty plan, for reports without an experiment.
    pub fn without_cells() -> Self {
        let (selection, cells, candidates) = (Selection::Paper, Vec::new(), Vec::new());
        let (text, beside, tasks, revisions) = (String::new(), BTreeMap::new(), Vec::new(), BTreeMap::new());
        let (title, date) = Default::default();
        Self { text, title, date, beside, tasks, revisions, selection, runs: 0, tuning_runs: 0, cells, candidates }
    }

    /// Reads and expands the file at `path`.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub fn load(path: &Path) -> Result<Self, PlanError> {
        Self::parse(&path.display().to_string(), files::read_toml(path)?)
    }

    /// Returns the sets of the file at `path`.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub fn own_sets(path: &Path) -> Result<Vec<TestSet>, PlanError> {
        let refused = |reason: AnyError| PlanError::Refused { path: path.display().to_string(), reason };
        let text = files::read_toml(path)?;
        let file: File = toml::from_str(&text).map_err(|error| refused(words(&error).into()))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let sets = sets::read(&file.sets, &|name| sets::content(name, folder), &mut BTreeMap::new())
            .map_err(|error| refused(error.into()))?;
        Ok(sets.into_values().filter(|set| set.plain().is_none()).collect())
    }

    /// Returns the names and contents of the plan's files: `plan.toml` and the files that its sets name.
    pub fn files(&self) -> impl Iterator<Item = (&str, &[u8])> {
        let beside = self.beside.iter().map(|(name, content)| (name.as_str(), content.as_slice()));
        beside.chain([("plan.toml", self.text.as_bytes())]) // last: it names the others
    }

    /// Expands `text`, which `path` names in errors.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub fn parse(path: &str, text: String) -> Result<Self, PlanError> {
        let folder = Path::new(path).parent().unwrap_or(Path::new(""));
        Self::parse_with(path, text, folder, &|name| sets::content(name, folder))
    }

    /// Expands `text`, which `path` names in errors. Folders of tasks are relative to `folder`, and `beside` reads the
    /// files that the plan names.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub(crate) fn parse_with(
        path: &str,
        text: String,
        folder: &Path,
        beside: &ReadBeside<'_>,
    ) -> Result<Self, PlanError> {
        Self::expand(text, folder, beside).map_err(|reason| PlanError::Refused { path: path.to_owned(), reason })
    }

    fn expand(text: String, folder: &Path, read_beside: &ReadBeside<'_>) -> Result<Self, AnyError> {
        let mut file: File = toml::from_str(&text).map_err(|error| words(&error))?;
        let revisions = file.spell()?;
        file.check()?;
        let mut beside = BTreeMap::new();
        let (text, tasks) = tasks::resolve(text, &file.tasks, folder)?;
        let sets = sets::read(&file.sets, read_beside, &mut beside)?;
        let (cells, candidates) = expansion::expand(&file, &sets)?;
        let (selection, runs, tuning_runs) = (file.selection, file.runs, file.tuning_runs());
        let title = file.title.unwrap_or_default();
        let date = file.date.map(|date| date.to_string()).unwrap_or_default();
        Ok(Self { selection, runs, tuning_runs, cells, candidates, title, date, beside, tasks, text, revisions })
    }

    /// Checks that `environment` has the revision, the parameters and the quantities of success rules that the plan's cells
    /// name for it.
    ///
    /// # Errors
    /// [`ValueError`] for the first of these that it does not have.
    pub fn check(&self, environment: &proto::Environment) -> Result<(), ValueError> {
        if let Some(asked) = self.revisions.get(&environment.name) {
            let (name, served) = (&environment.name, environment.revision);
            let got = format!("perturb/{name}-v{asked}");
            require(
                *asked == served,
                "an environment",
                got,
                format!("the server's perturb/{name}-v{served}, or {name}"),
            )?;
        }
        let (text, code) = (Criterion::from_environment(environment), Criterion::from_environment_code(environment));
        for cell in self.cells.iter().filter(|cell| cell.config.common.environment == environment.name) {
            let trained = cell.set.as_deref().unwrap_or_default();
            check_parameters(trained, &cell.config.common.parameters, environment)?;
            cell.tests.sets.iter().try_for_each(|set| set.check(environment))?;
            if let Some(rule) = &cell.tests.success {
                rule.criterion(text.as_ref(), code.as_ref())?;
            }
        }
        Ok(())
    }

    /// Returns the amounts of work, without the cells that are trained after the selection.
    pub fn counts(&self) -> Counts {
        let of_grid = || self.cells.iter().filter(|cell| cell.tuned_as.is_none());
        let first = of_grid().filter(|cell| cell.run == 1);
        let configurations: BTreeSet<_> = first.clone().map(|cell| (cell.method(), &cell.configuration)).collect();
        Counts {
            configurations: configurations.len(),
            trainings: first.clone().count(),
            pairs: first.map(|cell| cell.tests.sets.len()).sum(),
            all_pairs: of_grid().map(|cell| cell.tests.sets.len()).sum(),
            runs: if self.selection == Selection::Clean { self.tuning_runs } else { self.runs },
        }
    }

    /// Returns the plan with another selection rule for the same results. With the paper's rule, its tuning cells are
    /// reported.
    ///
    /// # Errors
    /// [`ValueError`] for `clean` if the plan has no tuning cells.
    pub fn with_rule(self, rule: Selection) -> Result<Self, ValueError> {
        match (self.selection, rule) {
            (Selection::Clean, Selection::Paper) => {
                let runs = self.tuning_runs;
                Ok(Self { selection: rule, runs, tuning_runs: 0, candidates: Vec::new(), ..self })
            }
            (known, rule) => {
                let expected = "\"paper\": the plan has no tuning cells; write selection = \"clean\" in its file";
                require(known == rule, "selection", rule, expected).map(|()| self)
            }
        }
    }

    /// Returns the cell or candidate with this id or index.
    pub fn find(&self, name: &str) -> Option<&Cell> {
        let all = || self.cells.iter().chain(&self.candidates);
        let by_index = |index: usize| all().find(|cell| cell.index == index);
        all().find(|cell| cell.id == name).or_else(|| name.parse().ok().and_then(by_index))
    }

    /// Returns the environments in the plan's order.
    pub fn environments(&self) -> Vec<&str> {
        distinct(self.cells.iter().map(|cell| cell.config.common.environment.as_str()))
    }

    /// Returns the methods in the plan's order.
    pub fn methods(&self) -> Vec<Method> {
        distinct(self.cells.iter().map(Cell::method))
    }

    /// Returns whether a selection is needed: whether a method has several configurations with the same training
    /// distribution.
    pub fn selects(&self) -> bool {
        let place = |cell: &&Cell| (cell.config.common.environment.clone(), cell.method(), cell.config.common.version);
        let places = distinct(self.cells.iter().map(|cell| place(&cell))).len();
        distinct(self.cells.iter().map(|cell| (place(&cell), &cell.configuration))).len() > places
    }
}

impl Cell {
    /// Returns the training distribution.
    pub fn trained_on(&self) -> TrainedOn<'_> {
        self.set.as_deref().map_or(TrainedOn::Version(self.config.common.version), TrainedOn::Set)
    }

    /// Describes the cell without settings and run: "CartPole ppo ff, trained on R".
    pub fn described(&self) -> String {
        format!("{} {}, trained on {}", self.config.common.environment, self.method(), self.trained_on())
    }

    /// Returns the separate selecting test and its number of episodes; `None` if the reported tests select.
    pub fn selection_test(&self) -> Option<(TestSet, u64)> {
        let parameters = Contexts::Drawn(self.config.common.parameters.clone());
        let set = TestSet { name: SELECTION_TEST.into(), version: self.config.common.version, contexts: parameters };
        self.tests.selection.map(|episodes| (set, episodes))
    }

    /// Returns the method.
    pub fn method(&self) -> Method {
        self.config.method()
    }
}

/// Returns the elements of `items` without repetitions, in order.
pub fn distinct<T: Eq + std::hash::Hash + Clone>(items: impl Iterator<Item = T>) -> Vec<T> {
    let mut seen = HashSet::new();
    items.filter(|item| seen.insert(item.clone())).collect()
}

/// Describes an error in a file in words for users, with the key that was probably meant.
fn words(error: &toml::de::Error) -> String {
    let whole = "expected a whole number that is not negative, in digits";
    let text = ["expected u32", "expected u64"]
        .iter()
        .fold(error.to_string().trim().to_owned(), |text, word| text.replace(word, whole));
    const UNKNOWN_KEY: &str = "unknown field `";
    let Some((before, names)) = text.split_once(UNKNOWN_KEY) else { return text };
    let Some((key, known)) = names.split_once('`') else { return text };
    let hint = names::did_you_mean(key, known.split('`').skip(1).step_by(2)); // between them stand commas
    format!("{before}{UNKNOWN_KEY}{key}`{hint}{known}")
}

#[cfg(test)]
mod tests;
