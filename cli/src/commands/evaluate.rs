//! `perturb evaluate`.

use std::io::Write;
use std::path::Path;

use anyhow::{Context, Result};
use serde_json::{Map, Value, json};

use super::args::EvaluateArgs;
use super::bar::Bar;
use super::{Ending, servers};
use perturb_learner::checkpoint::{Checkpoint, State};
use perturb_learner::evaluation::test;
use perturb_study::interrupt::StopFlag;
use perturb_study::table::Table;
use perturb_study::{TestResult, Version};

pub(super) fn run(args: &EvaluateArgs) -> Result<Ending> {
    let checkpoint = Checkpoint::load(&args.checkpoint)?;
    let mut versions = args.versions.clone();
    versions.sort_unstable();
    versions.dedup();
    let seed = args.seed.unwrap_or(checkpoint.state.seed);
    let stop = StopFlag::on_signals().context("cannot wait for signals")?;
    let servers = servers(&args.server, 0)?;
    let state = &checkpoint.state;
    let mut results = Vec::new();
    for version in versions {
        let mut bar = Bar::new(format!("testing on {version}"), args.episodes);
        let report = |episodes| bar.testing(episodes);
        results.push((version, test(&servers, &checkpoint, version, args.episodes, seed, &stop, report)?));
    }
    if let Some(path) = &args.json {
        write_json(path, state, seed, &results)?;
    }
    let table = Table::of("", &results)
        .text("version", |(version, _)| version)
        .number("success, %", |(_, result)| format!("{:.1}", result.success_percent))
        .number("95 % interval", |(_, result)| {
            let [low, high] = result.success_percent_95;
            format!("{low:.1} … {high:.1}")
        })
        .number("mean return", |(_, result)| format!("{:.2}", result.mean_return))
        .number("mean length", |(_, result)| format!("{:.2}", result.mean_length));
    writeln!(
        std::io::stdout(),
        "{} {} {}, trained on {} with seed {}, {} test episodes each\n{}",
        state.environment,
        state.algorithm,
        state.architecture,
        state.train_version,
        state.seed,
        args.episodes,
        table.build().to_text()
    )?;
    Ok(Ending::Done)
}

/// The result as JSON: who was tested, and the figures of each version.
fn document(state: &State, evaluation_seed: u64, results: &[(Version, TestResult)]) -> Result<Value> {
    let results: Map<String, Value> = results
        .iter()
        .map(|(version, result)| Ok((version.to_string(), serde_json::to_value(result)?)))
        .collect::<Result<_>>()?;
    Ok(json!({
        "environment": state.environment,
        "algorithm": state.algorithm,
        "architecture": state.architecture,
        "train_version": state.train_version,
        "episodes_per_trial": state.episodes_per_trial,
        "seed": state.seed,
        "evaluation_seed": evaluation_seed,
        "training_episodes": state.counters.episodes,
        "results": results,
    }))
}

fn write_json(path: &Path, state: &State, seed: u64, results: &[(Version, TestResult)]) -> Result<()> {
    let mut text = serde_json::to_string_pretty(&document(state, seed, results)?)?;
    text.push('\n');
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
