//! An experiment file, and the cells that it expands to.
//!
//! A cell is one training and its tests. Cells are the product of environments, algorithms, architectures, grid,
//! training versions and runs, in this order, the last one varying fastest. All cells of a run have the same seed, so
//! that two of them differ in nothing but what the file says.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

use perturb_protocol::proto;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use crate::files::{self, FileError};
use crate::sets::{self, Assignment, Contexts, SetError, TestSet, set_of, set_of_csv};
use crate::settings::{ConfigError, TrainConfig};
use crate::success::{Criterion, Threshold, ThresholdError};
use crate::{Method, Version};

/// Settings that the plan itself decides for each cell.
const OWN_KEYS: [&str; 6] = ["environment", "version", "parameters", "algorithm", "architecture", "seed"];

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
    /// The threshold of success; `None` for the environment's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub success: Option<Threshold>,
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
    /// Runs.
    pub runs: u32,
}

/// Why a plan does not fit the environments that are served.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanCheckError {
    /// A set has parameters or values that an environment does not take.
    #[error(transparent)]
    Set(#[from] SetError),
    /// A threshold is of something else than what an environment's success rule compares.
    #[error(transparent)]
    Threshold(#[from] ThresholdError),
}

/// What a set's table may name beside parameters.
const VERSION: &str = "version";
const FILE: &str = "file";
/// The most cells of a plan.
const MOST_CELLS: usize = 1_000_000;

/// Why an experiment file was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// It cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// It is not TOML, or has other keys than an experiment file.
    #[error("{path}: {reason}")]
    Syntax {
        /// Its path.
        path: String,
        /// What is wrong, and where.
        reason: String,
    },
    /// A value of the plan itself cannot be.
    #[error("{path}: {key} is {got}, but must be {expected}")]
    Value {
        /// Its path.
        path: String,
        /// The key with its table.
        key: String,
        /// What was given.
        got: String,
        /// What is accepted.
        expected: String,
    },
    /// A training was refused.
    #[error("{path}: {table}: {source}")]
    Cell {
        /// Its path.
        path: String,
        /// Which table of the file the refused key stands in, and for what.
        table: String,
        /// The refusal, which names the key.
        source: Box<ConfigError>,
    },
    /// Two tables ask for the same cell.
    #[error("{path}: {first} and {second} both ask for {id}: take it out of one of them")]
    Twice {
        /// Its path.
        path: String,
        /// A table.
        first: String,
        /// Another one, or the same.
        second: String,
        /// The cell.
        id: String,
    },
}

/// An experiment file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    environments: Vec<String>,
    #[serde(default = "all_versions")]
    versions: Vec<String>,
    #[serde(default = "one")]
    runs: u32,
    #[serde(default = "one")]
    seed: u64,
    #[serde(default = "a_thousand")]
    test_episodes: u64,
    #[serde(default = "all_versions")]
    test_versions: Vec<String>,
    #[serde(default)]
    sets: BTreeMap<String, Table>,
    #[serde(default)]
    success: BTreeMap<String, Threshold>,
    #[serde(default)]
    settings: Table,
    algorithm: Vec<Block>,
}

/// A table `[[algorithm]]`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Block {
    name: String,
    architectures: Vec<String>,
    environments: Option<Vec<String>>,
    versions: Option<Vec<String>>,
    #[serde(default)]
    settings: Table,
    #[serde(default)]
    grid: Table,
}

fn all_versions() -> Vec<String> {
    Version::ALL.map(|version| version.to_string()).to_vec()
}

fn one<T: From<u8>>() -> T {
    T::from(1)
}

fn a_thousand() -> u64 {
    1000
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

    /// Whether the environments are there and have the parameters and thresholds that the plan names. `environment` looks
    /// one up.
    ///
    /// # Errors
    /// [`PlanCheckError`], or what `environment` says.
    pub fn check<E: From<PlanCheckError>>(
        &self,
        mut environment: impl FnMut(&str) -> Result<proto::Environment, E>,
    ) -> Result<(), E> {
        for name in self.environments() {
            let served = environment(name)?;
            let criterion = Criterion::of(&served);
            for cell in self.cells.iter().filter(|cell| cell.config.common.environment == name) {
                let check = || -> Result<(), PlanCheckError> {
                    let trained = cell.set.as_deref().unwrap_or_default();
                    sets::check(trained, &cell.config.common.parameters, &served)?;
                    cell.tests.sets.iter().try_for_each(|set| set.check(&served))?;
                    if let Some(threshold) = &cell.tests.success {
                        threshold.of(criterion.as_ref())?;
                    }
                    Ok(())
                };
                check()?;
            }
        }
        Ok(())
    }

    /// Expands `text`, which `path` names in errors.
    ///
    /// # Errors
    /// [`PlanError`], which names the table and the key.
    pub fn parse(path: &str, text: String) -> Result<Self, PlanError> {
        let file: File = toml::from_str(&text).map_err(|error| PlanError::Syntax {
            path: path.to_owned(),
            reason: error.to_string().trim().to_owned(),
        })?;
        let mut expansion = Expansion {
            path,
            file: &file,
            sets: Version::ALL.map(|version| (version.to_string(), version.into())).into(),
            beside: BTreeMap::new(),
            cells: Vec::new(),
            places: HashMap::new(),
        };
        expansion.check_plan()?;
        expansion.add_sets()?;
        expansion.check_success()?;
        for (number, block) in file.algorithm.iter().enumerate() {
            expansion.add_block(number, block)?;
        }
        let cells = in_order(expansion.cells, &file);
        Ok(Self { runs: file.runs, cells, beside: expansion.beside, text })
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
    let mut seen = std::collections::HashSet::new();
    items.filter(|item| seen.insert(item.clone())).collect()
}

/// Cells in the order of the environments, otherwise as the file's tables give them; numbered.
fn in_order(mut cells: Vec<Cell>, file: &File) -> Vec<Cell> {
    let environments: Vec<&String> = distinct(
        file.environments.iter().chain(file.algorithm.iter().flat_map(|block| block.environments.iter().flatten())),
    );
    let place = |cell: &Cell| environments.iter().position(|name| **name == cell.config.common.environment);
    cells.sort_by_cached_key(place);
    cells.iter_mut().enumerate().for_each(|(index, cell)| cell.index = index);
    cells
}

struct Expansion<'a> {
    path: &'a str,
    file: &'a File,
    /// By their names.
    sets: BTreeMap<String, TestSet>,
    beside: BTreeMap<String, Vec<u8>>,
    cells: Vec<Cell>,
    /// Which table asked for a cell.
    places: HashMap<String, String>,
}

impl Expansion<'_> {
    fn value(&self, key: impl Into<String>, got: impl ToString, expected: impl Into<String>) -> PlanError {
        PlanError::Value {
            path: self.path.to_owned(),
            key: key.into(),
            got: got.to_string(),
            expected: expected.into(),
        }
    }

    fn check_plan(&self) -> Result<(), PlanError> {
        let File { runs, seed, test_episodes, test_versions, algorithm, .. } = self.file;
        let most = i64::MAX as u64 - u64::from(u32::MAX);
        if *runs == 0 {
            return Err(self.value("runs", runs, "at least 1"));
        }
        if *seed > most {
            return Err(self.value("seed", seed, format!("at most {most}")));
        }
        if *test_episodes == 0 {
            return Err(self.value("test_episodes", test_episodes, "at least 1"));
        }
        if algorithm.is_empty() {
            return Err(self.value("algorithm", "empty", "one or more tables [[algorithm]]"));
        }
        self.check_list("environments", &self.file.environments)?;
        self.check_list("versions", &self.file.versions)?;
        self.check_list("test_versions", test_versions)
    }

    /// The set of that name.
    fn set(&self, name: &str) -> Result<&TestSet, PlanError> {
        self.sets.get(name).ok_or_else(|| {
            let known: Vec<&str> = self.sets.keys().map(String::as_str).collect();
            self.value("a version", format!("`{name}`"), format!("one of {}, or a set [sets.{name}]", known.join(", ")))
        })
    }

    /// Thresholds belong to environments of the plan.
    fn check_success(&self) -> Result<(), PlanError> {
        let own = self.file.algorithm.iter().flat_map(|block| block.environments.iter().flatten());
        let known: Vec<&String> = distinct(self.file.environments.iter().chain(own));
        match self.file.success.keys().find(|name| !known.contains(name)) {
            Some(name) => {
                let names: Vec<&str> = known.iter().map(|name| name.as_str()).collect();
                Err(self.value("[success]", format!("`{name}`"), format!("one of {}", names.join(", "))))
            }
            None => Ok(()),
        }
    }

    /// Reads the tables `[sets.NAME]`.
    fn add_sets(&mut self) -> Result<(), PlanError> {
        for (name, table) in &self.file.sets {
            let key = format!("[sets.{name}]");
            if name.is_empty() || !name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') {
                return Err(self.value(key, format!("`{name}`"), "a name of letters, digits and _"));
            }
            if self.sets.contains_key(name) {
                return Err(self.value(key, "there already", "another name than D, R and E"));
            }
            if table.keys().all(|key| key == VERSION) {
                return Err(self.value(
                    key,
                    "without parameters",
                    "values of some parameters, or left out: it is a version",
                ));
            }
            let set = self.read_set(name, table).map_err(|error| {
                let SetError { what, got, expected } = error;
                self.value(format!("{key}: {what}"), got, expected)
            })?;
            if let Some(Value::String(file)) = table.get(FILE) {
                self.beside.insert(file.clone(), self.content(file).unwrap_or_default());
            }
            self.sets.insert(name.clone(), set);
        }
        Ok(())
    }

    fn read_set(&self, name: &str, table: &Table) -> Result<TestSet, SetError> {
        let wrong = |what: &str, got: &dyn ToString, expected: &str| SetError {
            what: what.into(),
            got: got.to_string(),
            expected: expected.into(),
        };
        let mut version = Version::D;
        let mut file = None;
        let mut assignments: Vec<Assignment> = Vec::new();
        for (key, value) in table {
            match (key.as_str(), value) {
                (VERSION, Value::String(text)) => {
                    version = text.parse().map_err(|_| wrong(key, value, "\"D\", \"R\" or \"E\""))?;
                }
                (FILE, Value::String(name)) => file = Some(name),
                (VERSION | FILE, _) => return Err(wrong(key, value, "a text")),
                (_, Value::String(text)) => assignments.push(format!("{key}={text}").parse()?),
                (_, Value::Integer(_) | Value::Float(_)) => assignments.push(format!("{key}={value}").parse()?),
                _ => return Err(wrong(key, value, "a value, or a text such as \"0.3..0.4\" or \"0.1..1.0/10\"")),
            }
        }
        match file {
            None => set_of(name, version, assignments),
            Some(_) if !assignments.is_empty() => {
                Err(wrong(FILE, &"beside parameters", "alone: the file's header names the parameters"))
            }
            Some(file) => {
                let content =
                    self.content(file).map_err(|reason| wrong(FILE, &reason, "a CSV file beside the plan"))?;
                set_of_csv(name, version, &content)
            }
        }
    }

    /// A file beside the plan.
    fn content(&self, file: &str) -> Result<Vec<u8>, String> {
        if Path::new(file).components().count() != 1 || file.starts_with('.') || !file.ends_with(".csv") {
            return Err(format!("`{file}`, which is not the name of a file .csv"));
        }
        let path = Path::new(self.path).parent().unwrap_or(Path::new("")).join(file);
        std::fs::read(&path).map_err(|error| format!("`{}`, which cannot be read ({error})", path.display()))
    }

    /// A list must name something, and nothing twice.
    fn check_list<T: Eq + std::hash::Hash + ToString>(&self, key: &str, list: &[T]) -> Result<(), PlanError> {
        let shown = || list.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        if list.is_empty() {
            return Err(self.value(key, "empty", "a list of at least one name"));
        }
        if distinct(list.iter()).len() < list.len() {
            return Err(self.value(key, shown(), "a list without repetitions"));
        }
        Ok(())
    }

    /// Refuses more cells than anybody can do, before they fill the memory.
    fn check_size(&self, name: &str, block: &Block, places: usize) -> Result<(), PlanError> {
        let values = block.grid.values().map(|values| values.as_array().map_or(1, Vec::len));
        let cells = [places, block.architectures.len(), self.file.runs as usize]
            .into_iter()
            .chain(values)
            .fold(1, usize::saturating_mul)
            .saturating_add(self.cells.len());
        if cells > MOST_CELLS {
            let key =
                format!("{name}: the number of cells up to here, every combination of [algorithm.grid] in each run,");
            return Err(self.value(key, cells, format!("at most {MOST_CELLS}")));
        }
        Ok(())
    }

    fn add_block(&mut self, number: usize, block: &Block) -> Result<(), PlanError> {
        let name = format!("[[algorithm]] {} ({})", number + 1, block.name);
        let environments = block.environments.as_ref().unwrap_or(&self.file.environments);
        let versions = block.versions.as_ref().unwrap_or(&self.file.versions);
        self.check_list(&format!("{name}: environments"), environments)?;
        let plain = |environment: &&String| environment.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        if let Some(environment) = environments.iter().find(|environment| !plain(environment)) {
            return Err(self.value(
                format!("{name}: environments"),
                format!("`{environment}`"),
                "names of letters, digits and _",
            ));
        }
        self.check_list(&format!("{name}: versions"), versions)?;
        self.check_list(&format!("{name}: architectures"), &block.architectures)?;
        self.check_keys(&name, block)?;
        self.check_size(&name, block, environments.len() * versions.len())?;
        let points = self.grid_points(&name, &block.grid)?;
        for environment in environments {
            for architecture in &block.architectures {
                for point in &points {
                    for version in versions {
                        self.add_runs(&name, block, environment, architecture, point, version)?;
                    }
                }
            }
        }
        Ok(())
    }

    /// Settings belong to trainings, not to the plan, and stand in one place.
    fn check_keys(&self, name: &str, block: &Block) -> Result<(), PlanError> {
        let tables = [
            ("[settings]".to_owned(), &self.file.settings),
            (format!("{name}: [algorithm.settings]"), &block.settings),
            (format!("{name}: [algorithm.grid]"), &block.grid),
        ];
        for (table, settings) in &tables {
            if let Some(key) = settings.keys().find(|key| OWN_KEYS.contains(&key.as_str())) {
                let expected =
                    "left out: the plan's own keys decide it (environments, versions, sets, name, architectures, seed)";
                return Err(self.value(format!("{table} {key}"), &settings[key], expected));
            }
        }
        if let Some(key) = block.settings.keys().find(|key| block.grid.contains_key(*key)) {
            let expected = "in one of [algorithm.settings] and [algorithm.grid] only";
            return Err(self.value(format!("{name}: {key}"), "in both", expected));
        }
        Ok(())
    }

    /// All combinations of a grid's values; one empty combination of an empty grid.
    fn grid_points(&self, name: &str, grid: &Table) -> Result<Vec<Table>, PlanError> {
        let mut points = vec![Table::new()];
        for (key, values) in grid {
            let refuse = |got: &str| {
                let expected = "a list of values to try, e.g. [3e-3, 3e-4]";
                self.value(format!("{name}: [algorithm.grid] {key}"), got, expected)
            };
            let Value::Array(values) = values else { return Err(refuse(&values.to_string())) };
            if values.is_empty() {
                return Err(refuse("empty"));
            }
            let with = |point: &Table, value: &Value| {
                let mut point = point.clone();
                point.insert(key.clone(), value.clone());
                point
            };
            points = points.iter().flat_map(|point| values.iter().map(move |value| with(point, value))).collect();
        }
        Ok(points)
    }

    fn add_runs(
        &mut self,
        name: &str,
        block: &Block,
        environment: &str,
        architecture: &str,
        point: &Table,
        trained_on: &str,
    ) -> Result<(), PlanError> {
        let set = self.set(trained_on)?.clone();
        if let Contexts::Listed(_) = set.contexts {
            let expected = "a version or a set whose parameters are drawn: a training draws them";
            return Err(self.value(format!("{name}: versions"), format!("`{trained_on}`"), expected));
        }
        let mut table = self.file.settings.clone();
        for layer in [&block.settings, point] {
            table.extend(layer.clone());
        }
        for (key, value) in [
            ("environment", environment),
            ("version", &set.version.to_string()),
            ("algorithm", &block.name),
            ("architecture", architecture),
        ] {
            table.insert(key.to_owned(), Value::String(value.to_owned()));
        }
        if set.plain().is_none() {
            let parameters = Table::try_from(set.drawn()).unwrap_or_default();
            table.insert("parameters".into(), Value::Table(parameters));
        }
        let config = TrainConfig::from_table("the cell", table).map_err(|source| PlanError::Cell {
            path: self.path.to_owned(),
            table: place_of(&source, name, block, &self.file.settings),
            source: Box::new(source),
        })?;
        let mut sets =
            self.file.test_versions.iter().map(|name| self.set(name).cloned()).collect::<Result<Vec<_>, _>>()?;
        sets.sort_by_key(|set| set.plain().map_or(Version::ALL.len(), |version| version as usize));
        let success = self.file.success.get(environment).cloned();
        let tests = Tests { episodes: self.file.test_episodes, sets, success };
        let configuration = fingerprint(&config, &tests);
        for run in 1..=self.file.runs {
            let mut config = config.clone();
            config.common.seed = self.file.seed + u64::from(run - 1);
            let (algorithm, common) = (config.settings.name(), &config.common);
            let id = format!(
                "{environment}-{algorithm}-{}-{trained_on}-{configuration}-s{}",
                common.architecture, common.seed
            );
            if let Some(first) = self.places.insert(id.clone(), name.to_owned()) {
                return Err(PlanError::Twice { path: self.path.to_owned(), first, second: name.to_owned(), id });
            }
            let (configuration, tests) = (configuration.clone(), tests.clone());
            let set = set.plain().is_none().then(|| trained_on.to_owned());
            self.cells.push(Cell { index: 0, id, configuration, run, set, config, tests });
        }
        Ok(())
    }
}

/// Which table a refused key stands in.
fn place_of(error: &ConfigError, name: &str, block: &Block, common: &Table) -> String {
    let key = match error {
        ConfigError::UnknownKey { key, .. } | ConfigError::Value { key, .. } => key.as_str(),
        ConfigError::Setting(crate::settings::SettingError { name, .. }) => name,
        _ => "",
    };
    if block.grid.contains_key(key) {
        format!("{name}: [algorithm.grid]")
    } else if !block.settings.contains_key(key) && common.contains_key(key) {
        format!("{name}: [settings]")
    } else if block.settings.contains_key(key) {
        format!("{name}: [algorithm.settings]")
    } else {
        name.to_owned()
    }
}

/// Settings and tests, without environment, version and seed, as eight hexadecimal digits.
fn fingerprint(config: &TrainConfig, tests: &Tests) -> String {
    let mut table = config.table();
    // The id names the version; of a set of the plan's own it has the name alone.
    let named = if config.common.parameters.is_empty() {
        &["environment", "version", "seed"][..]
    } else {
        &["environment", "seed"]
    };
    for key in named {
        table.remove(*key);
    }
    // Sorted keys, and numbers in one form only: toml's table is a sorted map, whatever the order of the file.
    let shown = |set: &TestSet| match set.plain() {
        Some(version) => version.to_string(),
        None => serde_json::to_string(set).unwrap_or_default(),
    };
    let sets: Vec<String> = tests.sets.iter().map(shown).collect();
    let success = tests.success.as_ref().map(|threshold| format!(" {threshold}")).unwrap_or_default();
    let text = format!("{table}\n{} [{}]{success}", tests.episodes, sets.join(", "));
    format!("{:08x}", crc32c::crc32c(text.as_bytes()))
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;
