//! Makes the result of a cell: tests its policies, and describes its training.

use std::collections::BTreeMap;
use std::fmt::Write;

use perturb_experiment::scheduler::CellEvent;
use perturb_experiment::{Cell, CellFolder, CellResult, IntermediateEvaluation, Tests, Training};
use perturb_files::interrupt::StopFlag;
use perturb_protocol::Distribution;
use perturb_records::paper::ENVIRONMENTS;
use perturb_records::{RecordedTest, Records, TestResult};
use perturb_settings::sets::{Contexts, Parameters, TestSet};

use super::CellError;
use crate::checkpoint::Checkpoint;
use crate::client::Servers;
use crate::evaluation::{TestError, TestOptions, Tester};
use crate::training::{TrainError, mark_in};

/// The program version to record if a checkpoint does not name one.
const UNKNOWN: &str = "unknown";

/// Tests the final and the intermediate policies of `cell`, and records the test episodes in `folder`. Returns the
/// cell's result, or `None` if the stop flag was raised.
pub(super) fn tested(
    servers: &Servers,
    cell: &Cell,
    folder: &CellFolder,
    checkpoint: Checkpoint,
    stop: &StopFlag,
    tell: &mut dyn FnMut(CellEvent),
) -> Result<Option<CellResult>, CellError> {
    let Tests { episodes, ref sets, ref success, ref marks, .. } = cell.tests;
    let selection = cell.selection_test();
    let all: Vec<TestSet> = sets.iter().cloned().chain(selection.iter().map(|(set, _)| set.clone())).collect();
    let mut test = |checkpoint: &Checkpoint, sets: &[TestSet], episodes, selects, when: &str| {
        let options = TestOptions { episodes, seed: cell.config.common.seed, selects, success: success.clone() };
        let mut testing = |set: &TestSet, episodes| {
            let set = format!("{}{when}", set.name);
            tell(CellEvent::Testing { set, episodes });
        };
        let tester = Tester::new(servers, checkpoint, options)?.recording_for(&all)?;
        match tester.test(sets, stop, &mut testing) {
            Err(TestError::Stopped { .. }) => Ok(None),
            records => records.map(Some),
        }
    };
    // Tests the intermediate policies, saved after given numbers of training episodes (marks).
    let mut of_marks = BTreeMap::new();
    for &mark in marks {
        let kept = Checkpoint::load(&mark_in(&folder.training(), mark)).map_err(TrainError::from)?;
        let when = format!(" after {mark} episodes");
        let Some(records) = test(&kept, sets, episodes, false, &when)? else { return Ok(None) };
        records.write(&folder.mark(mark).join(perturb_records::FILE))?;
        let results = results(&records);
        let agreement = records.agreement();
        of_marks.insert(mark, IntermediateEvaluation { counters: kept.state.counters, results, agreement });
    }
    // Tests the final policy. If the plan selects configurations by a separate test, also plays this test, on separate
    // episodes.
    let Some(mut records) = test(&checkpoint, sets, episodes, false, "")? else { return Ok(None) };
    if let Some((set, episodes)) = selection {
        let Some(selecting) = test(&checkpoint, &[set], episodes, true, "")? else { return Ok(None) };
        records.append(selecting);
    }
    records.write(&folder.path().join(perturb_records::FILE))?;
    let results = results(&records);
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
        marks: of_marks,
        agreement: Some(records.agreement()),
        commit: perturb_experiment::VERSION.into(),
        earlier_commits: earlier_commits(state.commits),
        command: command(cell),
    }))
}

/// Returns the result of each test, by the name of its parameter set.
fn results(records: &Records) -> BTreeMap<String, TestResult> {
    let result = |test: &RecordedTest| (test.set.name.clone(), records.result(&test.set.name, None));
    records.about.tests.iter().map(result).collect()
}

/// Returns the versions in `commits`, which trained the policy, without the version of this program. If `commits` is
/// empty, returns [`UNKNOWN`] as the only version.
fn earlier_commits(mut commits: Vec<String>) -> Vec<String> {
    if commits.is_empty() {
        return vec![UNKNOWN.into()];
    }
    commits.retain(|commit| commit != perturb_experiment::VERSION);
    commits
}

/// Formats parameters as arguments of the option `--parameters`.
fn parameters(parameters: &Parameters) -> String {
    let written = |values: &Distribution| match serde_json::to_value(values) {
        Ok(serde_json::Value::String(text)) => text,
        other => other.map(|value| value.to_string()).unwrap_or_default(),
    };
    let texts = parameters.iter().map(|(name, values)| format!("{name}={}", written(values)));
    texts.collect::<Vec<_>>().join(" ")
}

/// Returns the shell command that reproduces a cell's result without the plan. RUN stands for the output folder, TASK
/// for the folder of a task that is not built in, and CONTEXTS for the CSV file of the contexts that it is trained on.
fn command(cell: &Cell) -> String {
    let common = &cell.config.common;
    // The command of the training: the main settings have flags, all others are passed with `--set`.
    let mut text = format!(
        "perturb train --out RUN --env {} --version {} --algorithm {} --architecture {} --episodes {} --seed {}",
        common.environment,
        common.version,
        cell.config.settings.name(),
        common.architecture,
        common.episodes,
        common.seed
    );
    let task = if ENVIRONMENTS.contains(&common.environment.as_str()) { "" } else { " --task TASK" };
    text += task;
    if !common.parameters.is_empty() {
        let _ = write!(text, " --parameters {}", parameters(&common.parameters));
    }
    if !common.contexts.is_empty() {
        text += " --contexts CONTEXTS";
    }
    let flags = ["environment", "version", "parameters", "contexts", "algorithm", "architecture", "episodes", "seed"];
    for (key, value) in cell.config.table().iter().filter(|(key, _)| !flags.contains(&key.as_str())) {
        let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        let _ = write!(text, " --set {key}={value}"); // writing to a String cannot fail
    }
    // The commands of the tests: one for all sets that are plain versions, then one for each other set.
    let Tests { episodes, sets, success, .. } = &cell.tests;
    let success = success.as_ref().map(|threshold| format!(" --success {threshold}")).unwrap_or_default();
    let mut evaluate = |how: String, episodes: u64| {
        let _ = write!(text, " && perturb evaluate --checkpoint RUN {how} --episodes {episodes}{success}{task}");
    };
    let versions: Vec<String> = sets.iter().filter_map(TestSet::plain).map(|version| version.to_string()).collect();
    if !versions.is_empty() {
        evaluate(format!("--versions {}", versions.join(",")), *episodes);
    }
    // Sets of listed contexts have no command, because the command line cannot list contexts.
    let own = |set: &TestSet| format!("--parameters {} --base-version {}", parameters(&set.drawn()), set.version);
    for set in sets.iter().filter(|set| set.plain().is_none() && !set.drawn().is_empty()) {
        evaluate(own(set), *episodes);
    }
    if let Some((set, episodes)) = cell.selection_test() {
        let how = match (set.plain(), &set.contexts) {
            (Some(version), _) => format!("--versions {version}"),
            (None, Contexts::Drawn(_)) => own(&set),
            (None, Contexts::Listed(_)) => format!("--contexts CONTEXTS --base-version {}", set.version),
        };
        evaluate(format!("{how} --selection-episodes"), episodes);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use perturb_experiment::Plan;

    fn cell() -> Cell {
        let text = "environments = ['Pendulum']\nversions = ['E']\ntest_versions = ['D', 'E']\ntest_episodes = 9
            [[algorithm]]\nname = 'a2c'\narchitectures = ['rc']\nsettings = { ent_coef = 1e-4, episodes = 3 }";
        Plan::parse("test", text.into()).unwrap().cells.remove(0)
    }

    #[test]
    fn command_has_every_setting() {
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
    fn the_command_of_a_task_folder_names_the_folder() {
        let mut cell = cell();
        cell.config.common.environment = "Walker".into();
        let command = command(&cell);
        assert!(command.contains(" --seed 1 --task TASK --set "), "{command}");
        assert!(command.ends_with(" --episodes 9 --task TASK"), "{command}");
    }

    #[test]
    fn earlier_commits_leave_out_the_present_one() {
        let of = |commits: &[&str]| earlier_commits(commits.iter().map(|&commit| commit.to_owned()).collect());
        assert!(of(&[perturb_experiment::VERSION]).is_empty(), "as if it had not been interrupted");
        assert_eq!(of(&["a", perturb_experiment::VERSION, "b"]), ["a", "b"]);
        assert_eq!(of(&[]), [UNKNOWN], "a checkpoint of a program that did not say");
    }
}
