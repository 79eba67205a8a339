//! `perturb demo`: the paper's protocol on CartPole, small.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;
use std::process::ExitCode;
use std::time::Instant;

use super::args::DemoArgs;
use super::display::Display;
use super::error::{Result, system};
use super::train::describe;
use super::{servers, signal_code, threads};
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::Servers;
use perturb_learner::evaluation::test;
use perturb_learner::training::{Outcome, RunDirectory, train};
use perturb_study::interrupt::StopFlag;
use perturb_study::settings::{Preset, TrainConfig};
use perturb_study::table::Table;
use perturb_study::{Method, Metric, Scenario, Version, paper};

/// The paper's budgets.
const PAPER_EPISODES: u64 = 15_000;
const PAPER_TEST_EPISODES: u64 = 1000;
const ENVIRONMENT: &str = "CartPole";

pub(super) fn run(args: &DemoArgs) -> Result<ExitCode> {
    let start = Instant::now();
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = servers(&args.server)?;
    let scratch = tempfile::tempdir().map_err(system("create a temporary directory"))?;
    let mut out = std::io::stdout();
    let directory = args.out.clone().unwrap_or_else(|| scratch.path().to_owned());

    writeln!(out, "PPO with feed-forward networks on {ENVIRONMENT}: three trainings, nine tests.")?;
    budget(&mut out, "training", args.episodes, PAPER_EPISODES)?;
    budget(&mut out, "test", args.test_episodes, PAPER_TEST_EPISODES)?;
    let mut rates = BTreeMap::new();
    for version in Version::ALL {
        let outcome = train_on(&servers, args, version, &directory.join(version.to_string()), &stop)?;
        if let Some(number) = outcome.signal {
            eprintln!("stopped by signal {number}");
            return Ok(signal_code(number));
        }
        for test in Version::ALL {
            let rate = success_percent(&servers, args, &outcome.checkpoint, test, &stop)?;
            rates.insert(Scenario { train: version, test }, rate);
        }
    }
    writeln!(out, "\n{}", rates_table(&rates).to_text())?;
    writeln!(out, "\n{}", metrics_table(&rates).to_text())?;
    writeln!(out, "\n{:.0} s in all, seed {}", start.elapsed().as_secs_f64(), args.seed)?;
    if let Some(kept) = &args.out {
        writeln!(out, "the runs are kept in {}", kept.display())?;
    }
    Ok(ExitCode::SUCCESS)
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
    let settings = [
        format!("environment={ENVIRONMENT}"),
        format!("version={version}"),
        format!("episodes={}", args.episodes),
        format!("seed={}", args.seed),
    ];
    let config = TrainConfig::load(None, &settings, toml::Table::new())?;
    let directory = RunDirectory::choose(directory, false)?;
    let start = Instant::now();
    let mut display = Display::of_episodes(describe(&config), args.episodes);
    let outcome = train(servers, &config, &directory, threads(None), stop, |progress| display.training(progress))?;
    drop(display);
    let (progress, seconds) = (&outcome.progress, start.elapsed().as_secs_f64());
    writeln!(
        std::io::stdout(),
        "trained on {version}: {} episodes, {} steps, {seconds:.0} s",
        progress.episodes,
        progress.timesteps
    )?;
    Ok(outcome)
}

fn success_percent(
    servers: &Servers,
    args: &DemoArgs,
    checkpoint: &Checkpoint,
    version: Version,
    stop: &StopFlag,
) -> Result<f64> {
    let mut display = Display::of_episodes(format!("testing on {version}"), args.test_episodes);
    let report = |episodes| display.episodes(episodes);
    Ok(test(servers, checkpoint, version, args.test_episodes, args.seed, stop, report)?.success_percent)
}

fn rates_table(rates: &BTreeMap<Scenario, f64>) -> Table {
    let mut table = Table::of("", &Version::ALL).text("success, %", |train| format!("train {train}"));
    for test in Version::ALL {
        let shown = |&train| rates.get(&Scenario { train, test }).map_or_else(String::new, |rate| format!("{rate:.1}"));
        table = table.number(format!("test {test}"), shown);
    }
    table.build()
}

fn metrics_table(rates: &BTreeMap<Scenario, f64>) -> Table {
    let method = Method {
        algorithm: "ppo".into(),
        architecture: "ff".into(),
        episodes_per_trial: None,
        preset: Preset::Perturb,
        observe: Default::default(),
    };
    let here = |metric: Metric| metric.of(|scenario| rates.get(&scenario).copied());
    let paper = |metric| paper::number(ENVIRONMENT, &method, metric);
    Table::of("", &Metric::ALL)
        .text("", |metric| match metric {
            Metric::Default => "Default (DD)",
            Metric::Interpolation => "Interpolation (RR)",
            Metric::Extrapolation => "Extrapolation (DR, DE, RE)",
        })
        .number("here", |&metric| here(metric).map_or_else(String::new, |percent| format!("{percent:.1}")))
        .text("paper (mean ± std of 5 runs)", |&metric| {
            paper(metric).map_or_else(|| "not given".into(), |number| number.to_string())
        })
        .build()
}
