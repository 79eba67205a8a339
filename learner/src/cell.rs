//! Doing one cell: train, test, write the result.

use std::fmt::Write;
use std::path::Path;
use std::time::Instant;

use crate::checkpoint::{Checkpoint, ResumeState};
use crate::client::Servers;
use crate::evaluation::{TestError, TestOptions, Tester};
use crate::logging::Progress;
use crate::training::{RunDirectory, RunDirectoryError, TrainError, resume, train};
use perturb_protocol::Distribution;
use perturb_study::interrupt::StopFlag;
use perturb_study::records::{self, RecordsError};
use perturb_study::scheduler::CellEvent;
use perturb_study::sets::{Parameters, TestSet};
use perturb_study::{
    Cell, CellFolder, CellResult, CellState, Counters, Failure, FailureMark, FolderError, Tests, Timing, Training,
};

/// Stands for the program that began a training whose checkpoint does not say.
const UNKNOWN: &str = "unknown";
/// What a stop without a signal counts as.
const SIGTERM: i32 = 15;

/// Why a cell has no result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CellError {
    /// It cannot be trained.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// It cannot be tested.
    #[error(transparent)]
    Test(#[from] TestError),
    /// Its episodes cannot be recorded.
    #[error(transparent)]
    Records(#[from] RecordsError),
}

impl CellError {
    /// Whether the fault is that of the servers or of the way to them, not of what was trained.
    fn can_be_retried(&self) -> bool {
        match self {
            Self::Train(error) => error.can_be_retried(),
            Self::Test(error) => error.can_be_retried(),
            Self::Records(_) => false,
        }
    }
}

/// Trains and tests `cell` in `folder`, unless that is done, or has failed otherwise than `retry` says, and says how that
/// ended, which is what a worker's last line tells. Calls `tell` with what is being done.
///
/// # Errors
/// [`FolderError`]: the folder cannot be read or written. Whatever else goes wrong is recorded in it.
pub fn run_cell(
    servers: &Servers,
    cell: &Cell,
    folder: &CellFolder,
    retry: Option<FailureMark>,
    stop: &StopFlag,
    tell: &mut dyn FnMut(CellEvent),
) -> Result<CellEvent, FolderError> {
    let Some(_lock) = folder.try_lock()? else { return Ok(CellEvent::Busy) };
    match folder.state()? {
        CellState::Done(_) => return Ok(CellEvent::Done),
        CellState::Failed(failure) if folder.failure_mark() != retry => {
            return Ok(CellEvent::Failed { reason: failure.reason });
        }
        CellState::Failed(_) => folder.forget_failure()?,
        CellState::Missing => {}
    }
    let start = Instant::now();
    let ended = train_and_test(servers, cell, folder, stop, tell);
    match (ended, stop.signal()) {
        (Ok(Some(result)), _) => {
            folder.write_timing(&Timing { seconds: start.elapsed().as_secs_f64() })?;
            folder.write_result(&result)?; // last: whoever sees it may read everything else
            Ok(CellEvent::Done)
        }
        (Ok(None), signal) => Ok(CellEvent::Stopped { signal: signal.unwrap_or(SIGTERM) }),
        // Whoever stops a run may end its servers too.
        (Err(_), Some(signal)) => Ok(CellEvent::Stopped { signal }),
        (Err(error), None) if error.can_be_retried() => Ok(CellEvent::LostServer { reason: error.to_string() }),
        (Err(error), None) => {
            // Without the folder's place: wherever the same happens, the same is recorded.
            let reason = error.to_string().replace(&format!("{}/", folder.path().display()), "");
            let failure = Failure { id: cell.id.clone(), reason, commit: perturb_study::VERSION.into() };
            folder.write_failure(&failure)?;
            Ok(CellEvent::Failed { reason: failure.reason })
        }
    }
}

/// `None` if the stop flag was raised.
fn train_and_test(
    servers: &Servers,
    cell: &Cell,
    folder: &CellFolder,
    stop: &StopFlag,
    tell: &mut dyn FnMut(CellEvent),
) -> Result<Option<CellResult>, CellError> {
    let Some(checkpoint) = trained(servers, cell, &folder.training(), stop, tell)? else { return Ok(None) };
    let Tests { episodes, ref sets, ref success } = cell.tests;
    let options = TestOptions { episodes, seed: cell.config.common.seed, success: success.clone() };
    let tester = Tester::new(servers, &checkpoint, options)?;
    let mut testing = |set: &TestSet, episodes| tell(CellEvent::Testing { set: set.name.clone(), episodes });
    let records = match tester.test(sets, stop, &mut testing) {
        Err(TestError::Stopped { .. }) => return Ok(None),
        records => records?,
    };
    records.write(&folder.path().join(records::FILE))?;
    let results = sets.iter().map(|set| (set.name.clone(), records.result(&set.name, None))).collect();
    let state = checkpoint.state;
    let common = &state.config.common;
    Ok(Some(CellResult {
        format_version: CellResult::FORMAT_VERSION,
        id: cell.id.clone(),
        training: Training {
            environment: common.environment.clone(),
            environment_revision: state.environment_spec.revision,
            model_hash: state.environment_spec.model_hash,
            version: common.version,
            set: cell.set.clone(),
            method: cell.method(),
            configuration: cell.configuration.clone(),
            run: cell.run,
            seed: common.seed,
            counters: state.counters,
            settings: state.config.table(),
        },
        results,
        agreement: Some(records.agreement()),
        commit: perturb_study::VERSION.into(),
        earlier_commits: earlier_commits(state.commits),
        command: command(cell),
    }))
}

/// Of the programs that trained, those that are not this one.
fn earlier_commits(mut commits: Vec<String>) -> Vec<String> {
    if commits.is_empty() {
        return vec![UNKNOWN.into()];
    }
    commits.retain(|commit| commit != perturb_study::VERSION);
    commits
}

/// The trained policy of a cell; `None` if the stop flag was raised.
///
/// This alone decides what becomes of a training that was broken off: one that had finished is taken as it is, another
/// goes on from its last checkpoint, to the same bytes as without the break, and one without a usable checkpoint begins
/// again.
fn trained(
    servers: &Servers,
    cell: &Cell,
    directory: &Path,
    stop: &StopFlag,
    tell: &mut dyn FnMut(CellEvent),
) -> Result<Option<Checkpoint>, TrainError> {
    let config = &cell.config;
    let earlier = earlier(directory)?.filter(|(_, checkpoint, _)| checkpoint.state.config == *config);
    let Counters { episodes, timesteps, .. } =
        earlier.as_ref().map_or_else(Counters::default, |(_, checkpoint, _)| checkpoint.state.counters);
    tell(CellEvent::Training { episodes, timesteps, saved: timesteps });
    let progress = |&Progress { episodes, timesteps, saved_timesteps: saved, .. }: &Progress| {
        tell(CellEvent::Training { episodes, timesteps, saved });
    };
    let outcome = match earlier {
        Some((_, checkpoint, _)) if episodes >= config.common.episodes => return Ok(Some(checkpoint)),
        Some((directory, checkpoint, state)) => resume(servers, &directory, (checkpoint, state), 1, stop, progress)?,
        None => train(servers, config, &RunDirectory::choose(directory, true)?, 1, stop, progress)?,
    };
    let Counters { episodes, timesteps, .. } = outcome.checkpoint.state.counters;
    tell(CellEvent::Training { episodes, timesteps, saved: timesteps });
    Ok(outcome.signal.is_none().then_some(outcome.checkpoint))
}

/// What is left of a training that was broken off; `None` if there is nothing that could go on.
///
/// # Errors
/// Whatever else keeps it from being read, a lock for instance: then it may still go on later, and is left as it is.
fn earlier(directory: &Path) -> Result<Option<(RunDirectory, Checkpoint, ResumeState)>, RunDirectoryError> {
    match RunDirectory::resume(directory) {
        Ok(earlier) => Ok(Some(earlier)),
        Err(RunDirectoryError::Missing { .. }) => Ok(None),
        Err(error) if error.is_hopeless() => {
            tracing::warn!("the training begins again: {error}");
            Ok(None)
        }
        Err(error) => Err(error),
    }
}

/// Parameters as they are typed.
fn parameters(parameters: &Parameters) -> String {
    let written = |values: &Distribution| match serde_json::to_value(values) {
        Ok(serde_json::Value::String(text)) => text,
        other => other.map(|value| value.to_string()).unwrap_or_default(),
    };
    let texts = parameters.iter().map(|(name, values)| format!("{name}={}", written(values)));
    texts.collect::<Vec<_>>().join(" ")
}

/// What gives a cell's numbers again without the plan.
fn command(cell: &Cell) -> String {
    let common = &cell.config.common;
    let mut text = format!(
        "perturb train --out RUN --env {} --version {} --algorithm {} --architecture {} --episodes {} --seed {}",
        common.environment,
        common.version,
        cell.config.settings.name(),
        common.architecture,
        common.episodes,
        common.seed
    );
    if !common.parameters.is_empty() {
        let _ = write!(text, " --parameters {}", parameters(&common.parameters));
    }
    let flags = ["environment", "version", "parameters", "algorithm", "architecture", "episodes", "seed"];
    for (key, value) in cell.config.table().iter().filter(|(key, _)| !flags.contains(&key.as_str())) {
        let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        let _ = write!(text, " --set {key}={value}"); // writing to a String cannot fail
    }
    let Tests { episodes, sets, success } = &cell.tests;
    let success = success.as_ref().map(|threshold| format!(" --success {threshold}")).unwrap_or_default();
    let mut evaluate = |how: String| {
        let _ = write!(text, " && perturb evaluate --checkpoint RUN {how} --episodes {episodes}{success}");
    };
    let versions: Vec<String> = sets.iter().filter_map(TestSet::plain).map(|version| version.to_string()).collect();
    if !versions.is_empty() {
        evaluate(format!("--versions {}", versions.join(",")));
    }
    // What a set of contexts is stands in the recorded episodes alone.
    for set in sets.iter().filter(|set| set.plain().is_none() && !set.drawn().is_empty()) {
        evaluate(format!("--parameters {} --base {}", parameters(&set.drawn()), set.version));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use perturb_study::Plan;

    fn cell() -> Cell {
        let text = "environments = ['Pendulum']\nversions = ['E']\ntest_versions = ['D', 'E']\ntest_episodes = 9
            [[algorithm]]\nname = 'a2c'\narchitectures = ['rc']\nsettings = { ent_coef = 1e-4, episodes = 3 }";
        Plan::parse("test", text.into()).unwrap().cells.remove(0)
    }

    #[test]
    fn the_command_has_every_setting() {
        let cell = cell();
        let command = command(&cell);
        let expected = "perturb train --out RUN --env Pendulum --version E --algorithm a2c --architecture rc --episodes 3 \
                        --seed 1 --set ";
        assert!(command.starts_with(expected), "{command}");
        assert!(command.ends_with(" && perturb evaluate --checkpoint RUN --versions D,E --episodes 9"), "{command}");
        let mut table: toml::Table =
            "environment = 'Pendulum'\nversion = 'E'\narchitecture = 'rc'\nepisodes = 3\nseed = 1".parse().unwrap();
        let sets: Vec<&str> = command.split(" --set ").skip(1).map(|part| part.split(' ').next().unwrap()).collect();
        for set in sets {
            let (key, value) = set.split_once('=').unwrap();
            let parsed = format!("v = {value}").parse::<toml::Table>().map_or(value.into(), |table| table["v"].clone());
            table.insert(key.into(), parsed);
        }
        table.insert("algorithm".into(), "a2c".into());
        assert_eq!(table, cell.config.table());
    }

    #[test]
    fn only_programs_that_differ_are_named_beside_the_one_that_finished() {
        let of = |commits: &[&str]| earlier_commits(commits.iter().map(|&commit| commit.to_owned()).collect());
        assert!(of(&[perturb_study::VERSION]).is_empty(), "as if it had not been broken off");
        assert_eq!(of(&["a", perturb_study::VERSION, "b"]), ["a", "b"]);
        assert_eq!(of(&[]), [UNKNOWN], "a checkpoint of a program that did not say");
    }

    #[test]
    fn a_training_that_cannot_be_read_now_is_not_begun_again() {
        let directory = tempfile::tempdir().unwrap();
        let training = directory.path().join("training");
        assert!(earlier(&training).unwrap().is_none(), "nothing there");
        let checkpoint = training.join("checkpoint");
        std::fs::create_dir_all(&checkpoint).unwrap();
        assert!(earlier(&training).unwrap().is_none(), "broken off before the first checkpoint");
        std::fs::write(checkpoint.join("checkpoint.json"), "{").unwrap();
        assert!(earlier(&training).unwrap().is_none(), "damaged");
        let lock = std::fs::File::open(&training).unwrap();
        lock.try_lock().unwrap();
        let Err(error) = earlier(&training) else { panic!("it is locked") };
        assert!(error.to_string().contains("another process trains in"), "{error}");
    }
}
