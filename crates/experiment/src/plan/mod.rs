//! Experiment files and their expansion to cells.
//!
//! A cell is one training and its tests. An experiment file has a cell for every combination of environment, algorithm,
//! architecture, point of the grid, training version and run. The last of these varies fastest. All cells of a run have
//! the same seed, so that they differ only in what the file varies.
//!
//! With `selection = "clean"`, all these combinations are tuning cells: their tests serve only to select
//! configurations. Further cells then train the selected configurations again, with other seeds.

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
pub use perturb_records::SELECTION_TEST;
use perturb_records::TrainedOn;
use perturb_records::success::{Criterion, Rule};
use perturb_settings::sets::TestSet;
use perturb_settings::{Method, TrainConfig, ValueError, require};
use sets::ReadCsvFile;

/// An experiment file, expanded to cells.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The text of the file, with absolute paths in `tasks`, so that a copy of the file in another folder names the
    /// same tasks.
    pub text: String,
    /// The heading of reports; empty if the file has none.
    pub title: String,
    /// The date as written in the file; empty if the file has none.
    pub date: String,
    /// The CSV files that the parameter sets name: content by file name. They are in the folder of the experiment file.
    pub csv_files: BTreeMap<String, Vec<u8>>,
    /// Absolute paths of task folders that locally started servers also serve.
    pub tasks: Vec<PathBuf>,
    /// The requested revisions of environments, as in `perturb/CartPole-v1`. Environments that are not listed may have
    /// any revision.
    pub revisions: BTreeMap<String, u32>,
    /// The rule that selects the reported configurations.
    pub selection: Selection,
    /// Number of reported runs: repetitions with different seeds.
    pub runs: u32,
    /// Number of tuning runs, which have separate seeds and serve only to select configurations. 0 if configurations
    /// are selected by the reported tests.
    pub tuning_runs: u32,
    /// The cells to run. With `selection = "clean"` these are the tuning cells, until [`Plan::with_selected_cells`]
    /// appends the selected ones.
    pub cells: Vec<Cell>,
    /// Cells that [`Plan::with_selected_cells`] appends to `cells` if their configuration is selected.
    pub candidates: Vec<Cell>,
}

/// The rule by which a report selects one of several configurations of a method.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Selection {
    /// The paper's rule: configurations are selected by the tests that are also reported. This biases the reported
    /// results upwards.
    #[default]
    Paper,
    /// Configurations are selected by separate test episodes, in trainings with tuning seeds. The selected
    /// configurations are trained again with other seeds and tested on other episodes.
    Clean,
}

impl Selection {
    /// The names of the rules in files and options.
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

/// A cell of the experiment: one training and its tests.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// The position, from 0, in the list of [`Plan::cells`] followed by [`Plan::candidates`], as the file expands to
    /// them. Appending a selected candidate to `cells` does not change its index.
    pub index: usize,
    /// The cell's name: environment, algorithm, architecture, training version, configuration and seed. It depends on
    /// nothing else in the plan, so the cell's results stay valid when other cells are added.
    pub id: String,
    /// A hash of settings and tests in eight hexadecimal digits. Environment and seed are left out. The version is left
    /// out unless the policy is trained on a parameter set.
    pub configuration: String,
    /// The number of the run, from 1. Tuning runs are numbered separately.
    pub run: u32,
    /// For a cell that trains a selected configuration again: the [`configuration`](Cell::configuration) of the tuning
    /// cells by which it was selected. `None` for all other cells.
    pub tuned_as: Option<String>,
    /// The name of the plan's parameter set that the policy is trained on; `None` if it is trained on a version.
    pub set: Option<String>,
    /// All settings of the training.
    pub config: TrainConfig,
    /// The tests of the policy.
    pub tests: Tests,
}

/// The tests of a policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tests {
    /// Number of episodes in each test.
    pub episodes: u64,
    /// The test sets: versions in the order D, R, E, R+E, then parameter sets in the order of the file's
    /// `test_versions`.
    pub sets: Vec<TestSet>,
    /// Number of episodes of the separate selection test on the training distribution; `None` if configurations are
    /// selected by the reported tests.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selection: Option<u64>,
    /// Marks: numbers of training episodes after which the intermediate policy is also tested, ascending and below the
    /// budget.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub marks: Vec<u64>,
    /// The success rule; `None` for the environment's own rule.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub success: Option<Rule>,
}

/// The numbers of trainings and tests in a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Counts {
    /// Number of different combinations of method and settings. The environment does not matter.
    pub configurations: usize,
    /// Number of trainings in one run.
    pub trainings: usize,
    /// Number of train/test pairs in one run: each training counts once for each of its test sets.
    pub pairs: usize,
    /// Number of train/test pairs in all runs.
    pub all_pairs: usize,
    /// Number of runs. With `selection = "clean"`, number of tuning runs.
    pub runs: u32,
}

/// The reason why an experiment file was refused.
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
        /// The invalid table and key, and the accepted values.
        reason: AnyError,
    },
}

impl Plan {
    /// Returns an empty plan, for reports without an experiment.
    pub fn without_cells() -> Self {
        let (selection, cells, candidates) = (Selection::Paper, Vec::new(), Vec::new());
        let (text, csv_files, tasks, revisions) = (String::new(), BTreeMap::new(), Vec::new(), BTreeMap::new());
        let (title, date) = Default::default();
        Self { text, title, date, csv_files, tasks, revisions, selection, runs: 0, tuning_runs: 0, cells, candidates }
    }

    /// Reads and expands the file at `path`.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub fn load(path: &Path) -> Result<Self, PlanError> {
        Self::parse(&path.display().to_string(), files::read_toml(path)?)
    }

    /// Reads the parameter sets of the experiment file at `path`, without expanding its cells.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub fn own_sets(path: &Path) -> Result<Vec<TestSet>, PlanError> {
        let refused = |reason: AnyError| PlanError::Refused { path: path.display().to_string(), reason };
        let text = files::read_toml(path)?;
        let file: File = toml::from_str(&text).map_err(|error| refused(words(&error).into()))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let sets = sets::read(&file.sets, None, &|name| sets::content(name, folder), &mut BTreeMap::new())
            .map_err(|error| refused(error.into()))?;
        Ok(sets.into_values().filter(|set| set.plain().is_none()).collect())
    }

    /// Returns the names and contents of the plan's files: the CSV files that its sets name, then `plan.toml`.
    pub fn files(&self) -> impl Iterator<Item = (&str, &[u8])> {
        let csv_files = self.csv_files.iter().map(|(name, content)| (name.as_str(), content.as_slice()));
        csv_files.chain([("plan.toml", self.text.as_bytes())]) // last, because it names the others
    }

    /// Expands `text`, the content of the experiment file at `path`. Files that it names are read from the folder of
    /// `path`.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub fn parse(path: &str, text: String) -> Result<Self, PlanError> {
        let folder = Path::new(path).parent().unwrap_or(Path::new(""));
        Self::parse_with(path, text, folder, &|name| sets::content(name, folder))
    }

    /// Expands `text`, the content of an experiment file. Errors name it `path`. Task folders are relative to `folder`,
    /// and `read_csv_file` reads the CSV files that the plan names.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub(crate) fn parse_with(
        path: &str,
        text: String,
        folder: &Path,
        read_csv_file: &ReadCsvFile<'_>,
    ) -> Result<Self, PlanError> {
        Self::expand(text, folder, read_csv_file).map_err(|reason| PlanError::Refused { path: path.to_owned(), reason })
    }

    /// Parses `text`, checks it, and expands it to cells.
    fn expand(text: String, folder: &Path, read_csv_file: &ReadCsvFile<'_>) -> Result<Self, AnyError> {
        let mut file: File = toml::from_str(&text).map_err(|error| words(&error))?;
        let revisions = file.spell()?;
        file.check()?;
        let mut csv_files = BTreeMap::new();
        let (text, tasks) = tasks::resolve(text, &file.tasks, folder)?;
        let mut sets = BTreeMap::new();
        for environment in file.all_environments() {
            sets.insert(environment, sets::read(&file.sets, Some(environment), read_csv_file, &mut csv_files)?);
        }
        let (cells, candidates) = expansion::expand(&file, &sets)?;
        let (selection, runs, tuning_runs) = (file.selection, file.runs, file.tuning_runs());
        let title = file.title.unwrap_or_default();
        let date = file.date.map(|date| date.to_string()).unwrap_or_default();
        Ok(Self { selection, runs, tuning_runs, cells, candidates, title, date, csv_files, tasks, text, revisions })
    }

    /// Checks that a server's `environment` has everything that the plan's cells need of it: revision, parameters, and
    /// the quantities of success rules.
    ///
    /// # Errors
    /// [`ValueError`] for the first mismatch.
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
            cell.config.common.training_set(trained).check(environment)?;
            cell.tests.sets.iter().try_for_each(|set| set.check(environment))?;
            if let Some(rule) = &cell.tests.success {
                rule.criterion(text.as_ref(), code.as_ref())?;
            }
        }
        Ok(())
    }

    /// Counts trainings and tests, without the cells that are trained after the selection.
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

    /// Returns the plan with another selection rule for the same results. If the paper's rule replaces `clean`, the
    /// tests of the tuning cells are reported.
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

    /// Returns the cell or candidate whose id or index is `name`.
    pub fn find(&self, name: &str) -> Option<&Cell> {
        let all = || self.cells.iter().chain(&self.candidates);
        let by_index = |index: usize| all().find(|cell| cell.index == index);
        all().find(|cell| cell.id == name).or_else(|| name.parse().ok().and_then(by_index))
    }

    /// Returns the environments of all cells in the plan's order, without repetitions.
    pub fn environments(&self) -> Vec<&str> {
        distinct(self.cells.iter().map(|cell| cell.config.common.environment.as_str()))
    }

    /// Returns the methods of all cells in the plan's order, without repetitions.
    pub fn methods(&self) -> Vec<Method> {
        distinct(self.cells.iter().map(Cell::method))
    }

    /// Returns whether configurations must be selected: whether some method has several configurations in the same
    /// environment on the same training distribution.
    pub fn selects(&self) -> bool {
        fn place(cell: &Cell) -> (&str, Method, TrainedOn<'_>) {
            (&cell.config.common.environment, cell.method(), cell.trained_on())
        }
        let places = distinct(self.cells.iter().map(place)).len();
        distinct(self.cells.iter().map(|cell| (place(cell), &cell.configuration))).len() > places
    }
}

impl Cell {
    /// Returns the training distribution: a version or a parameter set of the plan.
    pub fn trained_on(&self) -> TrainedOn<'_> {
        self.set.as_deref().map_or(TrainedOn::Version(self.config.common.version), TrainedOn::Set)
    }

    /// Returns a description without settings and run, e.g. "CartPole ppo ff, trained on R".
    pub fn described(&self) -> String {
        format!("{} {}, trained on {}", self.config.common.environment, self.method(), self.trained_on())
    }

    /// Returns the set and the number of episodes of the separate selection test. Returns `None` if configurations are
    /// selected by the reported tests.
    pub fn selection_test(&self) -> Option<(TestSet, u64)> {
        let set = self.config.common.training_set(SELECTION_TEST);
        self.tests.selection.map(|episodes| (set, episodes))
    }

    /// Returns the method: algorithm, architecture and kind of observation.
    pub fn method(&self) -> Method {
        self.config.method()
    }
}

/// Returns the distinct elements of `items` in order of their first occurrence.
pub fn distinct<T: Eq + std::hash::Hash + Clone>(items: impl Iterator<Item = T>) -> Vec<T> {
    let mut seen = HashSet::new();
    items.filter(|item| seen.insert(item.clone())).collect()
}

/// Returns the message of a TOML error in words for users. For an unknown key, suggests the key that was probably
/// meant.
fn words(error: &toml::de::Error) -> String {
    let whole = "expected a whole number that is not negative, in digits";
    let text = ["expected u32", "expected u64"]
        .iter()
        .fold(error.to_string().trim().to_owned(), |text, word| text.replace(word, whole));
    const UNKNOWN_KEY: &str = "unknown field `";
    let Some((before, names)) = text.split_once(UNKNOWN_KEY) else { return text };
    let Some((key, known)) = names.split_once('`') else { return text };
    let hint = names::did_you_mean(key, known.split('`').skip(1).step_by(2)); // skips the commas between the names
    format!("{before}{UNKNOWN_KEY}{key}`{hint}{known}")
}

#[cfg(test)]
mod tests;
