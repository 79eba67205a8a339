//! The result of a cell: tests of its policy, and all that says what they are of.

use std::fmt::Write;

use super::CellError;
use crate::checkpoint::Checkpoint;
use crate::client::Servers;
use crate::evaluation::{TestError, TestOptions, Tester};
use perturb_protocol::Distribution;
use perturb_study::interrupt::StopFlag;
use perturb_study::records::{self, RecordedTest};
use perturb_study::scheduler::CellEvent;
use perturb_study::sets::{Parameters, TestSet};
use perturb_study::{Cell, CellFolder, CellResult, Tests, Training};

/// Stands for the program that began a training whose checkpoint does not say.
const UNKNOWN: &str = "unknown";

/// Tests the policy that was trained for `cell`, and records the episodes in `folder`; `None` if the stop flag was raised.
pub(super) fn tested(
    servers: &Servers,
    cell: &Cell,
    folder: &CellFolder,
    checkpoint: Checkpoint,
    stop: &StopFlag,
    tell: &mut dyn FnMut(CellEvent),
) -> Result<Option<CellResult>, CellError> {
    let Tests { episodes, ref sets, ref success, .. } = cell.tests;
    let mut testing = |set: &TestSet, episodes| tell(CellEvent::Testing { set: set.name.clone(), episodes });
    let mut test = |sets: &[TestSet], episodes, selects| {
        let options = TestOptions { episodes, seed: cell.config.common.seed, selects, success: success.clone() };
        Tester::new(servers, &checkpoint, options)?.test(sets, stop, &mut testing)
    };
    let tested = test(sets, episodes, false).and_then(|mut records| {
        if let Some((set, episodes)) = cell.selection_test() {
            records.append(test(&[set], episodes, true)?);
        }
        Ok(records)
    });
    let records = match tested {
        Err(TestError::Stopped { .. }) => return Ok(None),
        records => records?,
    };
    records.write(&folder.path().join(records::FILE))?;
    let result = |test: &RecordedTest| (test.set.name.clone(), records.result(&test.set.name, None));
    let results = records.about.tests.iter().map(result).collect();
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
    let Tests { episodes, sets, success, .. } = &cell.tests;
    let success = success.as_ref().map(|threshold| format!(" --success {threshold}")).unwrap_or_default();
    let mut evaluate = |how: String, episodes: u64| {
        let _ = write!(text, " && perturb evaluate --checkpoint RUN {how} --episodes {episodes}{success}");
    };
    let versions: Vec<String> = sets.iter().filter_map(TestSet::plain).map(|version| version.to_string()).collect();
    if !versions.is_empty() {
        evaluate(format!("--versions {}", versions.join(",")), *episodes);
    }
    // What a set of contexts is stands in the recorded episodes alone.
    let own = |set: &TestSet| format!("--parameters {} --base {}", parameters(&set.drawn()), set.version);
    for set in sets.iter().filter(|set| set.plain().is_none() && !set.drawn().is_empty()) {
        evaluate(own(set), *episodes);
    }
    if let Some((set, episodes)) = cell.selection_test() {
        let how = set.plain().map_or_else(|| own(&set), |version| format!("--versions {version}"));
        evaluate(format!("{how} --selection"), episodes);
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
}
