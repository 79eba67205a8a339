//! `perturb evaluate`: tests a policy.

use std::io::Write;

use perturb_files::interrupt::StopFlag;
use perturb_files::require_writable;
use perturb_learner::checkpoint::{Checkpoint, State};
use perturb_learner::evaluation::{TestOptions, Tester};
use perturb_records::TestResult;
use perturb_records::success::Criterion;
use perturb_settings::TrainConfig;
use perturb_settings::sets::TestSet;
use perturb_text::Table;
use serde_json::{Map, Value, json};

use super::args::EvaluateArgs;
use super::by::{checked_by, table_by};
use super::display::{Display, output};
use super::error::{Result, system};
use super::{playing_servers, sets};

pub(super) fn run(args: &EvaluateArgs) -> Result<()> {
    args.json.check()?;
    args.records.as_deref().map_or(Ok(()), require_writable)?;
    let checkpoint = Checkpoint::load(&args.checkpoint)?;
    let sets = sets::test_sets(&args.versions, &args.set)?;
    let seed = args.seed.unwrap_or(checkpoint.state.config.common.seed);
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = playing_servers(&args.play, &stop)?;
    let state = &checkpoint.state;
    let config = &checkpoint.state.config;
    let common = &config.common;
    let environment = servers.environment(&common.environment)?;
    let normalize = |set| sets::normalize_set(set, &environment);
    let sets = sets.into_iter().map(normalize).collect::<Result<Vec<_>, _>>()?;
    let text = Criterion::from_environment(&environment);
    let code = Criterion::from_environment_code(&environment);
    let success =
        args.success.as_ref().map(|rule| sets::normalize_rule(rule, text.as_ref(), code.as_ref())).transpose()?;
    let by = args.by.as_deref().map(|by| checked_by(by, &environment)).transpose()?;
    // Play the tests. Each set has its own progress display.
    let options = TestOptions { episodes: args.episodes, seed, selects: args.selection_episodes, success };
    let tester = Tester::new(&servers, &checkpoint, options)?;
    let mut display: Option<(String, Display)> = None;
    let mut report = |set: &TestSet, episodes| {
        if display.as_ref().is_none_or(|(name, _)| *name != set.name) {
            display =
                Some((set.name.clone(), Display::for_episodes(format!("testing on {}", set.name), args.episodes)));
        }
        if let Some((_, display)) = &mut display {
            display.episodes(episodes);
        }
    };
    let records = tester.test(&sets, &stop, &mut report)?;
    drop(display);
    if let Some(path) = &args.records {
        records.write(path)?;
    }
    // Print the results as JSON or as a table.
    let results: Vec<(String, TestResult)> =
        sets.iter().map(|set| (set.name.clone(), records.result(&set.name, None))).collect();
    args.json.write(document(state, seed, &results))?;
    if args.json.is_printed() {
        return Ok(());
    }
    let table = Table::builder("", &results)
        .text("tested on", |(set, _)| set)
        .number("episodes", |(_, result)| result.episodes)
        .number("success, %", |(_, result)| format!("{:.1}", result.success_percent))
        .number("95 % interval", |(_, result)| {
            let [low, high] = result.success_percent_95;
            format!("{low:.1} … {high:.1}")
        })
        .number("mean return", |(_, result)| format!("{:.2}", result.mean_return))
        .number("mean length", |(_, result)| format!("{:.2}", result.mean_length));
    let criterion = records.about.success.as_ref();
    let success = criterion.map(|criterion| format!(", success: {criterion}")).unwrap_or_default();
    writeln!(
        output(),
        "{} {}, trained on {} with seed {}{success}\n{}",
        common.environment,
        config.method(),
        common.trained_on(),
        common.seed,
        table.build().to_text()
    )?;
    if let Some(by) = &by {
        writeln!(output(), "\n{}", table_by(&records, None, by)?.to_text())?;
    }
    Ok(())
}

/// Returns the result as JSON: the settings of the policy's training, and the statistics of each test.
fn document(state: &State, evaluation_seed: u64, results: &[(String, TestResult)]) -> Value {
    let results: Map<String, Value> = results.iter().map(|(set, result)| (set.clone(), json!(result))).collect();
    let TrainConfig { common, settings } = &state.config;
    json!({
        "environment": common.environment,
        "algorithm": settings.name(),
        "architecture": common.architecture,
        "train_version": common.version,
        "train_parameters": common.parameters,
        "train_contexts": common.contexts,
        "episodes_per_trial": settings.episodes_per_trial(),
        "seed": common.seed,
        "evaluation_seed": evaluation_seed,
        "preset": common.preset,
        "observe": common.observe,
        "training_episodes": state.counters.episodes,
        "results": results,
    })
}
