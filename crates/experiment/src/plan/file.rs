//! The experiment file as users write it, and its checks before the expansion.

use std::collections::BTreeMap;

use perturb_files::AnyError;
use perturb_protocol::Version;
use perturb_protocol::names::{self, EnvironmentName};
use perturb_records::paper::ENVIRONMENTS;
use perturb_records::success::Rule;
use perturb_settings::{Preset, ValueError, require, spelled};
use serde::de::{DeserializeOwned, Error, IntoDeserializer};
use serde::{Deserialize, Deserializer};
use toml::{Spanned, Table};

use super::SELECTION_TEST;
use super::{Selection, distinct};

/// Settings that `[settings]`, `[algorithm.settings]` and `[algorithm.grid]` must not contain, because other keys of
/// the plan determine them.
const OWN_KEYS: [&str; 8] =
    ["preset", "environment", "version", "parameters", "contexts", "algorithm", "architecture", "seed"];
/// Maximum number of cells of a plan.
const MAX_CELLS: usize = 1_000_000;

/// The keys of an experiment file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct File {
    /// Heading of reports (default: a heading with the methods and environments).
    pub(super) title: Option<String>,
    /// Date that reports show, e.g. `2026-11-23` (default: none). Reports never use the current date.
    pub(super) date: Option<toml::value::Datetime>,
    /// Preset that provides default settings: "perturb" or "paper" (default: `"perturb"`).
    #[serde(default, deserialize_with = "preset")]
    preset: Option<Preset>,
    /// Task folders that locally started servers also serve, relative to this file's folder (default: none). Servers
    /// named by `--server` must already serve these tasks.
    #[serde(default)]
    pub(super) tasks: Vec<Spanned<String>>,
    /// Names of environments in the server's catalogue.
    pub(super) environments: Vec<String>,
    /// Training distributions: "D", "R", "E", "R+E", or names of `sets` (default: `["D", "R", "E"]`).
    #[serde(default = "all_versions")]
    pub(super) versions: Vec<String>,
    /// Rule that selects configurations: "paper" by the reported tests, "clean" by separate trainings and test episodes
    /// (default: `"paper"`).
    #[serde(default, deserialize_with = "selection")]
    pub(super) selection: Selection,
    /// Only with `selection = "clean"`: number of tuning seeds, starting at `seed` (default: `1`). Trainings with
    /// tuning seeds only serve the selection.
    tuning_runs: Option<u32>,
    /// Only with `selection = "clean"`: episodes of each test by which configurations are selected (default:
    /// `test_episodes`).
    selection_episodes: Option<u64>,
    /// Number of repetitions of the whole experiment with different seeds, at least 1 (default: `1`).
    #[serde(default = "one")]
    pub(super) runs: u32,
    /// The seed of run 1; each later run has the next seed (default: `1`).
    #[serde(default = "one")]
    pub(super) seed: u64,
    /// Episodes of each test (default: `1000`).
    #[serde(default = "a_thousand")]
    pub(super) test_episodes: u64,
    /// Distributions that every policy is tested on: versions, or names of `sets` (default: `["D", "R", "E"]`).
    #[serde(default = "all_versions")]
    pub(super) test_versions: Vec<String>,
    /// Numbers of training episodes after which the policy is also tested, ascending (default: none).
    #[serde(default)]
    pub(super) evaluate_at: Vec<u64>,
    /// Parameter sets by name: tables `[sets.NAME]`. Each has the values of some parameters, or `file`, a CSV file of
    /// contexts in this file's folder. `version` is the distribution of all other parameters (default: `"D"`).
    #[serde(default)]
    pub(super) sets: BTreeMap<String, Table>,
    /// Success rule: "text" or "code", or a table with "text", "code" or a threshold such as "steps=90" for each
    /// environment (default: `"code"` for the preset "paper", otherwise `"text"`).
    #[serde(default)]
    success: SuccessRules,
    /// Settings of all trainings, by name.
    #[serde(default)]
    pub(super) settings: Table,
    /// The tables `[[algorithm]]`, each with an algorithm and its settings.
    pub(super) algorithm: Vec<Block>,
}

/// The key `success`: a rule, or rules by environment.
#[derive(Deserialize)]
#[serde(untagged, expecting = "\"text\", \"code\", or a table of environments with \"text\", \"code\" or thresholds")]
enum SuccessRules {
    /// A single rule for every environment.
    All(Rule),
    /// Rules by environment. Environments that are not listed have the default rule of the preset.
    Some(BTreeMap<String, Rule>),
}

impl Default for SuccessRules {
    fn default() -> Self {
        Self::Some(BTreeMap::new())
    }
}

/// A table `[[algorithm]]` of an experiment file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Block {
    /// Preset of this table (default: the file's preset).
    #[serde(default, deserialize_with = "preset")]
    preset: Option<Preset>,
    /// The algorithm's name, as in `perturb train --algorithm`.
    pub(super) name: String,
    /// Architectures: "ff", "rc" or both. RL² allows only "rc".
    pub(super) architectures: Vec<String>,
    /// Environments of this table (default: the file's environments).
    environments: Option<Vec<String>>,
    /// Training distributions of this table (default: the file's versions).
    versions: Option<Vec<String>>,
    /// Settings of these trainings. They override the file's `[settings]`.
    #[serde(default)]
    pub(super) settings: Table,
    /// Lists of values by setting. Every combination is one configuration (default: a single configuration).
    #[serde(default)]
    pub(super) grid: Table,
}

/// Reads the name of a preset.
fn preset<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Preset>, D::Error> {
    one_of(deserializer, &Preset::NAMES).map(Some)
}

/// Reads the name of a selection rule.
fn selection<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Selection, D::Error> {
    one_of(deserializer, &Selection::NAMES)
}

/// Reads one of the `known` names, in any accepted spelling, and returns its value.
fn one_of<'de, T: DeserializeOwned, D: Deserializer<'de>>(
    deserializer: D,
    known: &'static [&'static str],
) -> Result<T, D::Error> {
    let written = String::deserialize(deserializer)?;
    let place = names::find(&written, known.iter().copied());
    T::deserialize(known[place.ok_or_else(|| D::Error::unknown_variant(&written, known))?].into_deserializer())
}

/// The default of lists of versions: D, R and E.
fn all_versions() -> Vec<String> {
    Version::ALL.map(|version| version.to_string()).to_vec()
}

/// The default 1 for counts.
fn one<T: From<u8>>() -> T {
    T::from(1)
}

/// The default 1000 for counts.
fn a_thousand() -> u64 {
    1000
}

impl File {
    /// Replaces names by their canonical spelling. Returns the revisions that names such as `perturb/CartPole-v1`
    /// request, by environment. Keeps names of environments that are not in the paper as written, because only servers
    /// know them.
    pub(super) fn spell(&mut self) -> Result<BTreeMap<String, u32>, AnyError> {
        // Replaces the names of settings.
        self.settings = spelled("[settings]", std::mem::take(&mut self.settings))?;
        for (index, block) in self.algorithm.iter_mut().enumerate() {
            let name = format!("[[algorithm]] {} ({})", index + 1, block.name);
            let place = |table: &str| format!("{name}: [algorithm.{table}]");
            block.settings = spelled(&place("settings"), std::mem::take(&mut block.settings))?;
            block.grid = spelled(&place("grid"), std::mem::take(&mut block.grid))?;
        }
        // Collects the requested revisions. All names of an environment must request the same revision.
        let mut revisions = BTreeMap::new();
        let blocks = || self.algorithm.iter().flat_map(|block| block.environments.iter().flatten());
        for written in self.environments.iter().chain(blocks()) {
            let (name, revision) = environment(written);
            let Some(revision) = revision else { continue };
            let first = *revisions.entry(name.clone()).or_insert(revision);
            let expected = format!("as above, perturb/{name}-v{first}");
            require(first == revision, "environments", format!("`{written}`"), expected)?;
        }
        // Replaces the names of environments and versions by their usual spelling.
        let spell_environments =
            |names: &mut Vec<String>| names.iter_mut().for_each(|name| *name = environment(name).0);
        let spell_versions = |names: &mut Vec<String>| {
            for name in names {
                *name = name.parse().map_or_else(|_| name.clone(), |version: Version| version.to_string());
            }
        };
        spell_environments(&mut self.environments);
        spell_versions(&mut self.versions);
        spell_versions(&mut self.test_versions);
        for block in &mut self.algorithm {
            block.environments.iter_mut().for_each(spell_environments);
            block.versions.iter_mut().for_each(spell_versions);
        }
        if let SuccessRules::Some(rules) = &mut self.success {
            for (written, rule) in std::mem::take(rules) {
                let name = environment(&written).0;
                let expected = format!("an environment that has no rule yet: {name} has one");
                require(rules.insert(name, rule).is_none(), "[success]", format!("`{written}`"), expected)?;
            }
        }
        Ok(revisions)
    }

    /// Returns the environments of the key `environments`, then environments that only tables `[[algorithm]]` name.
    pub(super) fn all_environments(&self) -> Vec<&str> {
        let own = self.algorithm.iter().flat_map(|block| block.environments.iter().flatten());
        distinct(self.environments.iter().chain(own).map(String::as_str))
    }

    /// Returns the environments of `block`: its own, or else the file's.
    pub(super) fn environments_of<'a>(&'a self, block: &'a Block) -> &'a [String] {
        block.environments.as_ref().unwrap_or(&self.environments)
    }

    /// Returns the training versions of `block`: its own, or else the file's.
    pub(super) fn versions_of<'a>(&'a self, block: &'a Block) -> &'a [String] {
        block.versions.as_ref().unwrap_or(&self.versions)
    }

    /// Returns the preset of `block`: its own, or else the file's.
    pub(super) fn preset_of(&self, block: &Block) -> Preset {
        block.preset.or(self.preset).unwrap_or_default()
    }

    /// Returns the success rule for tests in `environment` of trainings with `preset`. Returns `None` for the
    /// environment's own rule (`text`).
    pub(super) fn success_in(&self, environment: &str, preset: Preset) -> Option<Rule> {
        let given = match &self.success {
            SuccessRules::All(rule) => Some(rule),
            SuccessRules::Some(rules) => rules.get(environment),
        };
        let usual = if preset == Preset::Paper { Rule::Code } else { Rule::Text };
        Some(given.cloned().unwrap_or(usual)).filter(|rule| *rule != Rule::Text)
    }

    /// Returns the number of tuning runs. Their tests serve only to select configurations, and are not reported. The
    /// number is 0 unless `selection` is "clean".
    pub(super) fn tuning_runs(&self) -> u32 {
        if self.selection == Selection::Clean { self.tuning_runs.unwrap_or(1) } else { 0 }
    }

    /// Returns the number of episodes of the separate test by which configurations are selected. Returns `None` if they
    /// are selected by the reported tests.
    pub(super) fn selection_episodes(&self) -> Option<u64> {
        (self.selection == Selection::Clean).then(|| self.selection_episodes.unwrap_or(self.test_episodes))
    }

    /// Checks all keys except `tasks`, `sets`, `settings` and the tables `[[algorithm]]`.
    pub(super) fn check(&self) -> Result<(), ValueError> {
        let most = i64::MAX as u64 - 2 * u64::from(u32::MAX);
        require(self.runs > 0, "runs", self.runs, "at least 1")?;
        self.check_selection()?;
        let ascending = self.evaluate_at.first() != Some(&0) && self.evaluate_at.is_sorted_by(|a, b| a < b);
        let expected = "numbers of episodes, at least 1, in ascending order";
        require(ascending, "evaluate_at", format!("{:?}", self.evaluate_at), expected)?;
        require(self.seed <= most, "seed", self.seed, format!("at most {most}"))?;
        require(self.test_episodes > 0, "test_episodes", self.test_episodes, "at least 1")?;
        require(!self.algorithm.is_empty(), "algorithm", "empty", "one or more tables [[algorithm]]")?;
        check_list("environments", &self.environments)?;
        check_list("versions", &self.versions)?;
        check_list("test_versions", &self.test_versions)?;
        let environments = self.all_environments();
        match &self.success {
            SuccessRules::All(Rule::At(threshold)) => {
                let expected = "\"text\" or \"code\"; a threshold belongs to an environment: [success] NAME = …";
                Err(ValueError::new("success", threshold, expected))
            }
            SuccessRules::All(_) => Ok(()),
            SuccessRules::Some(rules) => rules.keys().try_for_each(|name| {
                let known = environments.contains(&name.as_str());
                require(known, "[success]", format!("`{name}`"), format!("one of {}", environments.join(", ")))
            }),
        }
    }

    /// Checks the keys that belong to `selection = "clean"`. With this rule, no parameter set may have the name of the
    /// selection test.
    fn check_selection(&self) -> Result<(), ValueError> {
        for (key, given) in
            [("tuning_runs", self.tuning_runs.map(u64::from)), ("selection_episodes", self.selection_episodes)]
        {
            let Some(given) = given else { continue };
            let expected = "left out, or given with selection = \"clean\"";
            require(self.selection == Selection::Clean, key, given, expected)?;
            require(given > 0, key, given, "at least 1")?;
        }
        let key = format!("[sets.{SELECTION_TEST}]");
        let is_free = self.selection == Selection::Paper || !self.sets.contains_key(SELECTION_TEST);
        require(is_free, key, format!("`{SELECTION_TEST}`"), "another name: the test that selects has this one")
    }

    /// Checks the lists of `block`, the keys of all settings, and the number of cells. The values of settings and of
    /// the grid are not checked. Errors refer to the block as `name`. `before` is the number of cells from earlier
    /// blocks.
    pub(super) fn check_block(&self, name: &str, block: &Block, before: usize) -> Result<(), ValueError> {
        let environments = self.environments_of(block);
        let key = format!("{name}: environments");
        check_list(&key, environments)?;
        for environment in environments {
            require(is_plain(environment), &key, format!("`{environment}`"), "names of letters, digits and _")?;
        }
        check_list(&format!("{name}: versions"), self.versions_of(block))?;
        check_list(&format!("{name}: architectures"), &block.architectures)?;
        self.check_keys(name, block)?;
        self.check_size(name, block, before)
    }

    /// Refuses settings that other keys of the plan determine, and settings that are in both `settings` and `grid`.
    fn check_keys(&self, name: &str, block: &Block) -> Result<(), ValueError> {
        let expected =
            "left out: the plan's own keys decide it (preset, environments, versions, sets, name, architectures, seed)";
        for (table, settings) in [
            ("[settings]".to_owned(), &self.settings),
            (format!("{name}: [algorithm.settings]"), &block.settings),
            (format!("{name}: [algorithm.grid]"), &block.grid),
        ] {
            for (key, value) in settings {
                require(!OWN_KEYS.contains(&key.as_str()), format!("{table} {key}"), value, expected)?;
            }
        }
        block.settings.keys().try_for_each(|key| {
            let expected = "in one of [algorithm.settings] and [algorithm.grid] only";
            require(!block.grid.contains_key(key), format!("{name}: {key}"), "in both", expected)
        })
    }

    /// Refuses plans of more than [`MAX_CELLS`] cells, before the cells are created in memory.
    fn check_size(&self, name: &str, block: &Block, before: usize) -> Result<(), ValueError> {
        let lists = [self.environments_of(block), self.versions_of(block), &block.architectures].map(<[_]>::len);
        let runs = self.runs as usize + self.tuning_runs() as usize;
        let values = block.grid.values().map(|values| values.as_array().map_or(1, Vec::len));
        let cells = lists.into_iter().chain([runs]).chain(values).fold(1, usize::saturating_mul);
        let cells = cells.saturating_add(before);
        let what =
            format!("{name}: the number of cells up to here, every combination of [algorithm.grid] in each run,");
        require(cells <= MAX_CELLS, what, cells, format!("at most {MAX_CELLS}"))
    }
}

/// Splits a written name such as `perturb/CartPole-v1` into the environment's name and the requested revision, if any.
fn environment(written: &str) -> (String, Option<u32>) {
    let EnvironmentName { name, revision } = EnvironmentName::new(written);
    let known = names::find(&name, ENVIRONMENTS.into_iter());
    (known.map_or(name, |place| ENVIRONMENTS[place].to_owned()), revision)
}

/// Refuses empty lists and repeated elements.
fn check_list(key: &str, list: &[String]) -> Result<(), ValueError> {
    require(!list.is_empty(), key, "empty", "a list of at least one name")?;
    require(distinct(list.iter()).len() == list.len(), key, list.join(", "), "a list without repetitions")
}

/// Returns whether a name has only letters, digits and `_`, so that it may be a part of a cell's id.
pub(super) fn is_plain(name: &str) -> bool {
    name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}
