//! Repeats the tests of stored policies, and compares the checksums of their episodes with those of a results table.

use std::path::{Path, PathBuf};

use perturb_experiment::{Cell, Plan, SELECTION_TEST, StudyResults};
use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::{Checkpoint, find_policy};
use perturb_learner::client::Servers;
use perturb_learner::evaluation::{Audit, TestOptions, Tester};
use perturb_records::{Records, ResultsTable, StudyEpisodes, TableRow};
use perturb_settings::sets::TestSet;

use super::super::display::Display;
use super::super::error::{CommandError, Result};
use super::super::export::POLICIES;

/// The file name of a results table.
const TABLE: &str = "results.parquet";

/// A stored policy. A results table has the checksums of its test episodes.
#[derive(Clone, Debug)]
pub(super) struct ChecksummedPolicy {
    /// The id of the policy's cell.
    pub(super) name: String,
    checkpoint: PathBuf,
    cell: Cell,
    /// The name of each test, with the checksum of its episodes.
    checksums: Vec<(String, String)>,
    /// The file with the recorded episodes of the policy's study. It need not exist.
    episodes: PathBuf,
}

/// Finds a results table, and the id of a policy's cell if `path` means a single policy.
///
/// `path` is a table, a folder with a table, a policy file in the folder `policies` beside a table, or the name of such
/// a policy. Returns `None` for any other path, and for an experiment's folder even if it contains a table.
pub(super) fn table_of(path: &Path) -> Result<Option<(PathBuf, Option<String>)>> {
    if path.join("plan.toml").is_file() {
        return Ok(None);
    }
    if path.join(TABLE).is_file() {
        return Ok(Some((path.join(TABLE), None)));
    }
    if path.extension().is_some_and(|ending| ending == "parquet") && ResultsTable::read(path).is_ok() {
        return Ok(Some((path.to_owned(), None)));
    }
    let found = if path.exists() { None } else { find_policy(path)? };
    let file = found.as_deref().unwrap_or(path);
    let folder = file.parent().filter(|folder| folder.ends_with(POLICIES) && file.is_file());
    let Some(table) = folder.and_then(Path::parent).map(|beside| beside.join(TABLE)).filter(|table| table.is_file())
    else {
        return Ok(None);
    };
    let cell = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Ok(Some((table, Some(cell))))
}

/// Returns the stored policies whose tests have checksums in the table at `path`. If `cell` is given, returns only the
/// policy of this cell.
pub(super) fn stored_policies(path: &Path, cell: Option<&str>) -> Result<Vec<ChecksummedPolicy>> {
    let table = ResultsTable::read(path)?;
    let beside = path.parent().unwrap_or(Path::new(""));
    let mut policies = Vec::new();
    for (study, plan) in &table.studies {
        let plan = Plan::of_study(study, plan)?;
        let results = StudyResults::new(&table, study);
        for known in plan.cells.iter().chain(&plan.candidates).filter(|known| cell.is_none_or(|id| known.id == id)) {
            let checkpoint = beside.join(POLICIES).join(format!("{}.safetensors", known.id));
            let rows = results.rows(&known.id);
            // Keep only the tests of the final policy. A table's folder has no policies of intermediate evaluations.
            let last = rows.last().and_then(|row| row.after_episodes);
            let sum = |row: &&TableRow| Some((row.tested_on.clone()?, row.checksum.clone()?));
            let of_final = rows.iter().filter(|row| row.after_episodes == last);
            let checksums: Vec<_> = of_final.filter_map(sum).collect();
            if !checksums.is_empty() && (checkpoint.is_file() || cell.is_some()) {
                let episodes = StudyEpisodes::path(beside, study);
                policies.push(ChecksummedPolicy {
                    name: known.id.clone(),
                    checkpoint,
                    cell: known.clone(),
                    checksums,
                    episodes,
                });
            }
        }
    }
    if policies.is_empty() {
        let message = format!(
            "{} has no checksums of a stored policy{}: expected a file in {POLICIES}/ beside it, and the cell's rows",
            path.display(),
            cell.map(|cell| format!(" {cell}")).unwrap_or_default()
        );
        return Err(CommandError::Failed(message));
    }
    Ok(policies)
}

impl ChecksummedPolicy {
    /// Plays all tests of the policy again, and compares the checksums of their episodes.
    pub(super) fn audit(&self, servers: &Servers, stop: &StopFlag) -> Result<Audit> {
        let checkpoint = Checkpoint::load(&self.checkpoint)?;
        let tests = &self.cell.tests;
        let known = |set: &TestSet| self.checksums.iter().any(|(name, _)| *name == set.name);
        let sets: Vec<TestSet> = tests.sets.iter().filter(|set| known(set)).cloned().collect();
        let selection = self.cell.selection_test().filter(|(set, _)| known(set));
        let total = tests.episodes.saturating_mul(sets.len() as u64);
        let mut display = Display::for_episodes(format!("replaying {}", self.name), total);
        let mut test = |sets: &[TestSet], episodes, selects| {
            let seed = self.cell.config.common.seed;
            let options = TestOptions { episodes, seed, selects, success: tests.success.clone() };
            Tester::new(servers, &checkpoint, options)?.test(sets, stop, &mut |_, done| display.episodes(done))
        };
        // The tests on the cell's sets, and then the test that selects configurations.
        let mut replayed = test(&sets, tests.episodes, false)?;
        if let Some((set, episodes)) = selection {
            replayed.append(test(&[set], episodes, true)?);
        }
        drop(display);
        self.compare(&replayed)
    }

    /// Compares the checksums of `replayed` with the checksums in the table. If the file with the recorded episodes
    /// exists, the result names the first episode that differs.
    fn compare(&self, replayed: &Records) -> Result<Audit> {
        let mut audit = Audit { episodes: replayed.episodes.len() as u64, different: Vec::new() };
        let mut recorded = None;
        for (name, checksum) in &self.checksums {
            let got = replayed.checksum(name);
            if got.as_ref() == Some(checksum) {
                continue;
            }
            if recorded.is_none() {
                recorded = Some(StudyEpisodes::read_if_exists(&self.episodes)?.unwrap_or_default());
            }
            let first = recorded.as_ref().and_then(|all| all.first_difference(&self.name, name, replayed));
            let got = got.unwrap_or_else(|| "missing".into());
            let what = if name == SELECTION_TEST { "the selection episodes".into() } else { format!("test on {name}") };
            audit.different.push(first.map_or_else(
                || format!("{what}: the episodes have the checksum {got}, the table has {checksum}"),
                |first| format!("{what}: the first episode that differs is {first}"),
            ));
        }
        Ok(audit)
    }
}
