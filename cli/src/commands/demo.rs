//! `perturb demo`: the paper's protocol on CartPole, small.

use std::io::Write;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result};
use toml::Table;

use super::args::DemoArgs;
use super::bar::Bar;
use super::train::describe;
use super::{Ending, servers};
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::Servers;
use perturb_learner::evaluation::test;
use perturb_learner::training::{Outcome, RunDirectory, train};
use perturb_study::interrupt::StopFlag;
use perturb_study::settings::{AlgorithmName, Architecture, TrainConfig};
use perturb_study::{Metrics, Rates, Version, paper};

/// Episodes of each training, unless told otherwise.
pub(super) const EPISODES: u64 = 2000;
/// Episodes of each test, unless told otherwise.
pub(super) const TEST_EPISODES: u64 = 1000;
/// The paper's budgets.
const PAPER_EPISODES: u64 = 15_000;
const PAPER_TEST_EPISODES: u64 = 1000;
const ENVIRONMENT: &str = "CartPole";

pub(super) fn run(args: &DemoArgs) -> Result<Ending> {
    let start = Instant::now();
    let stop = StopFlag::on_signals().context("cannot wait for signals")?;
    let servers = servers(&args.server, 0)?;
    let scratch = tempfile::tempdir().context("cannot create a temporary directory")?;
    let mut out = std::io::stdout();
    let directory = args.out.clone().unwrap_or_else(|| scratch.path().to_owned());

    writeln!(out, "PPO with feed-forward networks on {ENVIRONMENT}: three trainings, nine tests.")?;
    budget(&mut out, "training", args.episodes, PAPER_EPISODES)?;
    budget(&mut out, "test", args.test_episodes, PAPER_TEST_EPISODES)?;
    let mut rates = Rates([[0.0; 3]; 3]);
    for version in Version::ALL {
        let outcome = train_on(&servers, args, version, &directory.join(version.to_string()), &stop)?;
        if let Some(number) = outcome.signal {
            eprintln!("stopped by signal {number}");
            return Ok(Ending::Signal(number));
        }
        rates.0[version as usize] = test_on_all(&servers, args, &outcome.checkpoint, &stop)?;
    }
    writeln!(out)?;
    print_rates(&mut out, &rates)?;
    writeln!(out)?;
    print_metrics(&mut out, &rates.metrics())?;
    writeln!(out, "\n{:.0} s in all, seed {}", start.elapsed().as_secs_f64(), args.seed)?;
    if let Some(kept) = &args.out {
        writeln!(out, "the runs are kept in {}", kept.display())?;
    }
    Ok(Ending::Done)
}

fn budget(out: &mut impl Write, what: &str, episodes: u64, paper: u64) -> std::io::Result<()> {
    match episodes.cmp(&paper) {
        std::cmp::Ordering::Less => {
            writeln!(out, "Reduced budget: {episodes} episodes in each {what}, where the paper has {paper}.")
        }
        _ => writeln!(out, "{episodes} episodes in each {what} (the paper: {paper})."),
    }
}

fn train_on(
    servers: &Servers,
    args: &DemoArgs,
    version: Version,
    directory: &Path,
    stop: &StopFlag,
) -> Result<Outcome> {
    let mut config = TrainConfig::defaults(AlgorithmName::Ppo, Architecture::Ff);
    config.common.environment = ENVIRONMENT.into();
    config.common.version = version;
    config.common.episodes = args.episodes;
    config.common.seed = args.seed;
    let config = TrainConfig::from_table("the demo", Table::clone(&config.table()))?;
    let directory = RunDirectory::choose(directory, false)?;
    let start = Instant::now();
    let mut bar = Bar::new(describe(&config), args.episodes);
    let outcome = train(servers, &config, &directory, stop, |progress| bar.training(progress))?;
    drop(bar);
    let (progress, seconds) = (&outcome.progress, start.elapsed().as_secs_f64());
    writeln!(
        std::io::stdout(),
        "trained on {version}: {} episodes, {} steps, {seconds:.0} s",
        progress.episodes,
        progress.timesteps
    )?;
    Ok(outcome)
}

/// Success rates on D, R and E, %.
fn test_on_all(servers: &Servers, args: &DemoArgs, checkpoint: &Checkpoint, stop: &StopFlag) -> Result<[f64; 3]> {
    let mut percent = [0.0; 3];
    for version in Version::ALL {
        let mut bar = Bar::new(format!("testing on {version}"), args.test_episodes);
        let report = |episodes| bar.testing(episodes);
        let result = test(servers, checkpoint, version, args.test_episodes, args.seed, stop, report)?;
        percent[version as usize] = result.success_percent;
    }
    Ok(percent)
}

fn print_rates(out: &mut impl Write, rates: &Rates) -> std::io::Result<()> {
    writeln!(out, "success, %    test D   test R   test E")?;
    for (train, row) in Version::ALL.into_iter().zip(rates.0) {
        writeln!(out, "train {train}      {:>8.1} {:>8.1} {:>8.1}", row[0], row[1], row[2])?;
    }
    Ok(())
}

fn print_metrics(out: &mut impl Write, metrics: &Metrics) -> std::io::Result<()> {
    let row = paper::row(ENVIRONMENT, "PPO", "FF");
    let paper = |cell: Option<paper::Cell>| cell.map_or_else(|| "not given".to_owned(), |cell| cell.to_string());
    writeln!(out, "                              here   paper (mean ± std of 5 runs)")?;
    for (name, here, cell) in [
        ("Default (DD)", metrics.default, row.map(|row| row.default)),
        ("Interpolation (RR)", metrics.interpolation, row.map(|row| row.interpolation)),
        ("Extrapolation (DR, DE, RE)", metrics.extrapolation, row.map(|row| row.extrapolation)),
    ] {
        writeln!(out, "{name:<26} {here:>7.1}   {}", paper(cell))?;
    }
    Ok(())
}
