//! `perturb evaluate`.

use std::io::{ErrorKind, Write};
use std::path::Path;

use anyhow::{Context, Result};
use serde_json::{Map, Value, json};

use super::args::EvaluateArgs;
use super::bar::Bar;
use super::{Ending, servers};
use perturb_learner::checkpoint::{Checkpoint, State};
use perturb_learner::evaluation::test;
use perturb_study::interrupt::StopFlag;
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
    let mut out = std::io::stdout();
    let mut print = |line: String| match writeln!(out, "{line}") {
        // Whoever has read enough still gets the file that was asked for.
        Err(error) if error.kind() == ErrorKind::BrokenPipe && args.json.is_some() => Ok(()),
        printed => printed,
    };
    print(format!(
        "{} {} {}, trained on {} with seed {}, {} test episodes each",
        state.environment, state.algorithm, state.architecture, state.train_version, state.seed, args.episodes
    ))?;
    print("version  success   95 % interval   mean return  mean length".into())?;
    let mut results = Vec::new();
    for version in versions {
        let mut bar = Bar::new(format!("testing on {version}"), args.episodes);
        let result =
            test(&servers, &checkpoint, version, args.episodes, seed, &stop, |episodes| bar.testing(episodes))?;
        drop(bar);
        let [low, high] = result.success_percent_95;
        print(format!(
            "{version:<7} {:>7.1} %  {low:>5.1} … {high:>5.1} %  {:>12.2} {:>12.2}",
            result.success_percent, result.mean_return, result.mean_length
        ))?;
        results.push((version, result));
    }
    if let Some(path) = &args.json {
        write_json(path, state, seed, &results)?;
    }
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
