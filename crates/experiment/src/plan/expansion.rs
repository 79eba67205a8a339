//! Expands an experiment file to its cells.

use std::collections::{BTreeMap, HashMap};

use perturb_protocol::Version;
use perturb_settings::sets::{Contexts, TestSet};
use perturb_settings::{ConfigError, SettingError, TrainConfig, ValueError, require};
use toml::{Table, Value};

use super::file::{Block, File};
use super::{AnyError, Cell, SELECTION_TEST, Tests};

type Result<T, E = AnyError> = std::result::Result<T, E>;

/// The versions and the parameter sets of an experiment file, by environment and name.
type Sets<'a> = BTreeMap<&'a str, BTreeMap<String, TestSet>>;

/// Expands `file` to two lists: its cells, and the candidates that its selection may add. `sets` has the sets of each of
/// the file's environments. Cells are ordered by environment, then as in the tables `[[algorithm]]`.
pub(super) fn expand(file: &File, sets: &Sets<'_>) -> Result<(Vec<Cell>, Vec<Cell>)> {
    let mut expansion = Expansion { file, sets, cells: Vec::new(), tables: HashMap::new() };
    for (index, block) in file.algorithm.iter().enumerate() {
        expansion.add_block(&format!("[[algorithm]] {} ({})", index + 1, block.name), block)?;
    }
    let mut cells = expansion.cells;
    let environments = file.all_environments();
    let place = |cell: &Cell| environments.iter().position(|name| *name == cell.config.common.environment);
    cells.sort_by_cached_key(|cell| (cell.tuned_as.is_some(), place(cell)));
    cells.iter_mut().enumerate().for_each(|(index, cell)| cell.index = index);
    let candidates = cells.split_off(cells.partition_point(|cell| cell.tuned_as.is_none()));
    Ok((cells, candidates))
}

/// The state of the expansion of an experiment file.
struct Expansion<'a> {
    file: &'a File,
    sets: &'a Sets<'a>,
    cells: Vec<Cell>,
    /// The name of the table `[[algorithm]]` that each cell is from, by cell id.
    tables: HashMap<String, String>,
}

impl Expansion<'_> {
    /// Returns the version or parameter set of an environment with this name.
    fn set(&self, environment: &str, name: &str) -> Result<&TestSet, ValueError> {
        let sets = &self.sets[environment];
        sets.get(name).ok_or_else(|| {
            let known: Vec<&str> = sets.keys().map(String::as_str).collect();
            let expected = format!("one of {}, or a set [sets.{name}]", known.join(", "));
            ValueError::new("a version", format!("`{name}`"), expected)
        })
    }

    /// Adds the cells of a table `[[algorithm]]`.
    fn add_block(&mut self, name: &str, block: &Block) -> Result<()> {
        let file = self.file;
        file.check_block(name, block, self.cells.len())?;
        let points = grid_points(name, &block.grid)?;
        for environment in file.environments_of(block) {
            for architecture in &block.architectures {
                for point in &points {
                    for trained_on in file.versions_of(block) {
                        let config = self.config(name, block, [environment, architecture, trained_on], point)?;
                        self.add_runs(name, config, trained_on)?;
                    }
                }
            }
        }
        Ok(())
    }

    /// Returns the settings of a training. Settings of the grid point override those of the block, which override those
    /// of the file.
    fn config(
        &self,
        name: &str,
        block: &Block,
        [environment, architecture, trained_on]: [&str; 3],
        point: &Table,
    ) -> Result<TrainConfig> {
        let set = self.set(environment, trained_on)?;
        let mut table = self.file.settings.clone();
        table.extend(block.settings.clone());
        table.extend(point.clone());
        for (key, value) in [
            ("preset", self.file.preset_of(block).to_string().as_str()),
            ("environment", environment),
            ("version", &set.version.to_string()),
            ("algorithm", &block.name),
            ("architecture", architecture),
        ] {
            table.insert(key.to_owned(), value.into());
        }
        match &set.contexts {
            Contexts::Drawn(parameters) if parameters.is_empty() => None,
            Contexts::Drawn(parameters) => table.insert("parameters".into(), Value::try_from(parameters)?),
            Contexts::Listed(contexts) => table.insert("contexts".into(), Value::try_from(contexts)?),
        };
        TrainConfig::from_table("the cell", table).map_err(|error| {
            let place = place_of(&error, name, block, &self.file.settings);
            format!("{place}: {error}").into()
        })
    }

    /// Adds the cells of all runs of one configuration. With `selection = "clean"`, adds its tuning runs first.
    fn add_runs(&mut self, name: &str, config: TrainConfig, trained_on: &str) -> Result<()> {
        let file = self.file;
        let environment = &config.common.environment;
        let sets = file.test_versions.iter().map(|name| self.set(environment, name).cloned());
        let mut sets = sets.collect::<Result<Vec<_>, _>>()?;
        sets.sort_by_key(|set| set.plain().map_or(Version::KNOWN.len(), |version| version as usize));
        let success = file.success_in(environment, config.common.preset);
        let budget = config.common.episodes;
        let last = file.evaluate_at.last().copied().unwrap_or_default();
        let expected = format!("at most the {budget} episodes of a training");
        require(last <= budget, format!("{name}: evaluate_at"), last, expected)?;
        let marks = file.evaluate_at.iter().copied().filter(|mark| *mark < budget).collect();
        let tests = Tests { episodes: file.test_episodes, sets, selection: None, marks, success };
        let mut tuned_as = None;
        if let Some(episodes) = file.selection_episodes() {
            let tests = Tests { selection: Some(episodes), marks: Vec::new(), ..tests.clone() };
            tuned_as = Some(fingerprint(&config, &tests));
            self.add_cells(name, &config, trained_on, &tests, (file.seed, file.tuning_runs()), None)?;
        }
        let seed = file.seed + u64::from(file.tuning_runs());
        self.add_cells(name, &config, trained_on, &tests, (seed, file.runs), tuned_as)
    }

    /// Adds a cell for each run. Run 1 has the seed `seed`, and each further run the next seed.
    fn add_cells(
        &mut self,
        name: &str,
        config: &TrainConfig,
        trained_on: &str,
        tests: &Tests,
        (seed, runs): (u64, u32),
        tuned_as: Option<String>,
    ) -> Result<()> {
        let configuration = fingerprint(config, tests);
        let plain = self.set(&config.common.environment, trained_on)?.plain();
        let set = plain.is_none().then(|| trained_on.to_owned());
        let trained_on = plain.map_or(trained_on, |version| version.file_name());
        for run in 1..=runs {
            let mut config = config.clone();
            config.common.seed = seed + u64::from(run - 1);
            let (common, algorithm) = (&config.common, config.settings.name());
            let id = format!(
                "{}-{algorithm}-{}-{trained_on}-{configuration}-s{}",
                common.environment, common.architecture, common.seed
            );
            if let Some(first) = self.tables.insert(id.clone(), name.to_owned()) {
                return Err(format!("{first} and {name} both contain the cell {id}: remove it from one of them").into());
            }
            let (configuration, set, tests) = (configuration.clone(), set.clone(), tests.clone());
            let tuned_as = tuned_as.clone();
            self.cells.push(Cell { index: 0, id, configuration, run, tuned_as, set, config, tests });
        }
        Ok(())
    }
}

/// Returns all combinations of a grid's values. The last key varies fastest. An empty grid has one empty combination.
fn grid_points(name: &str, grid: &Table) -> Result<Vec<Table>, ValueError> {
    let mut points = vec![Table::new()];
    for (key, values) in grid {
        let what = format!("{name}: [algorithm.grid] {key}");
        let expected = "a list of values to try, e.g. [3e-3, 3e-4]";
        let Value::Array(values) = values else { return Err(ValueError::new(what, values, expected)) };
        require(!values.is_empty(), what, "empty", expected)?;
        let with = |point: &Table, value: &Value| {
            let mut point = point.clone();
            point.insert(key.clone(), value.clone());
            point
        };
        points = points.iter().flat_map(|point| values.iter().map(move |value| with(point, value))).collect();
    }
    Ok(points)
}

/// Returns the name of the table in the experiment file that contains the invalid setting of `error`.
fn place_of(error: &ConfigError, name: &str, block: &Block, common: &Table) -> String {
    let key = match error {
        ConfigError::UnknownKey { key, .. } | ConfigError::Value(ValueError { what: key, .. }) => key.as_str(),
        ConfigError::Setting(SettingError { name, .. }) => name,
        _ => "",
    };
    if block.grid.contains_key(key) {
        format!("{name}: [algorithm.grid]")
    } else if block.settings.contains_key(key) {
        format!("{name}: [algorithm.settings]")
    } else if common.contains_key(key) {
        format!("{name}: [settings]")
    } else {
        name.to_owned()
    }
}

/// Returns a hash of settings and tests as eight hexadecimal digits. Environment and seed are left out of the hash. The
/// version is left out unless the policy is trained on a parameter set.
fn fingerprint(config: &TrainConfig, tests: &Tests) -> String {
    let mut table = config.table();
    table.remove("environment");
    table.remove("seed");
    // A cell's id names the version or the parameter set. The name of a set does not determine its parameters and its
    // version, so both stay in the hash.
    if config.common.parameter_names().next().is_none() {
        table.remove("version");
    }
    // The hash does not depend on the order of keys in the file, because `toml::Table` is a sorted map.
    let shown = |set: &TestSet| match set.plain() {
        Some(version) => version.to_string(),
        None => serde_json::to_string(set).unwrap_or_default(),
    };
    let sets: Vec<String> = tests.sets.iter().map(shown).collect();
    let success = tests.success.as_ref().map(|rule| format!(" {rule}")).unwrap_or_default();
    let selection = tests.selection.map(|episodes| format!(" {SELECTION_TEST} {episodes}")).unwrap_or_default();
    let marks = if tests.marks.is_empty() { String::new() } else { format!(" at {:?}", tests.marks) };
    let text = format!("{table}\n{} [{}]{success}{selection}{marks}", tests.episodes, sets.join(", "));
    format!("{:08x}", crc32c::crc32c(text.as_bytes()))
}
