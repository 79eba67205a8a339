//! `perturb demo`: a small version of the paper's experiment.
//!
//! It trains one policy on default physics and one on random physics, and tests both on physics that they were not
//! trained on.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use perturb_files::interrupt::StopFlag;
use perturb_files::write_atomically;
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::{ClientError, Servers};
use perturb_learner::evaluation::{TestError, heatmap, test};
use perturb_learner::logging::Progress;
use perturb_learner::training::{RunDirectory, train};
use perturb_protocol::Version;
use perturb_records::{HeatmapOptions, Metric, Scenario, paper};
use perturb_report::{PolicyHeatmap, plot, policies_side_by_side};
use perturb_settings::TrainConfig;
use perturb_settings::sets::Context;
use perturb_text::{Table, duration, grouped};

use super::args::DemoArgs;
use super::display::{Display, note, output};
use super::error::{CommandError, Result, system};
use super::{reconnecting_servers, refuse_file, require_default_out, signal_code, threads};
use crate::video::{VideoError, VideoFile, VideoOptions, film};

/// Number of episodes of each training in the paper.
const PAPER_EPISODES: u64 = 15_000;
/// Number of episodes of each test in the paper.
const PAPER_TEST_EPISODES: u64 = 1000;
/// Number of runs in the paper. Its results are means over these runs.
const PAPER_RUNS: u64 = 5;
/// Versions on which policies are trained.
const TRAINED_ON: [Version; 2] = [Version::D, Version::R];
/// Number of points along each axis of the heatmap.
const GRID: usize = 12;
/// Number of test episodes at each point of the heatmap.
const POINT_EPISODES: u64 = 5;
/// Maximum number of seeds that are tried to find an episode to film.
const MAX_TRIES: u64 = 20;
/// Width and height of the films' pictures without the captions below them, in pixels.
const PIXELS: (u32, u32) = (240, 240);
/// Number of steps between two frames of the films. Not every step is drawn, because a robot's frame takes about 60 ms.
const FRAME_STEPS: u32 = 8;

/// A trained policy with its success rates on D, R and E, in percent.
struct DemoPolicy {
    version: Version,
    checkpoint: Checkpoint,
    rates: BTreeMap<Version, f64>,
}

struct Demo<'a> {
    args: &'a DemoArgs,
    servers: Servers,
    stop: StopFlag,
    out: PathBuf,
}

pub(super) fn run(args: &DemoArgs) -> Result<ExitCode> {
    let start = Instant::now();
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let default_folder = || PathBuf::from(format!("runs/demo-{}", chrono::Utc::now().format("%Y%m%d-%H%M%S")));
    let out = args.out.clone().unwrap_or_else(default_folder);
    refuse_file(&out)?;
    if args.out.is_none() {
        require_default_out(&out)?;
    }
    if !perturb_files::list(&out)?.is_empty() {
        let message = format!("{} is not empty: give another --out, or delete that folder", out.display());
        return Err(CommandError::Usage(message));
    }
    let demo = Demo { args, servers: reconnecting_servers(&args.server, args.wait, &stop)?, stop, out };
    match demo.run(start) {
        Ok(()) => Ok(ExitCode::SUCCESS),
        Err(error) => {
            let Some(signal) = error.signal() else { return Err(error) };
            note(format_args!("stopped by signal {signal}; finished parts are kept in {}", demo.out.display()));
            Ok(signal_code(signal))
        }
    }
}

impl Demo<'_> {
    fn run(&self, start: Instant) -> Result<()> {
        let environment = self.servers.environment(&self.args.env)?;
        let mut out = output();
        writeln!(
            out,
            "{}: PPO with feed-forward networks is trained on default physics (D)\n\
             and on random physics (R), and tested on both and on extreme physics (E), on\n\
             which neither policy was trained.\n",
            environment.name
        )?;
        let [on_d, on_r] = TRAINED_ON;
        let train = |version| self.train(&environment.name, version);
        let trained: [_; 2] = side_by_side(|| train(on_d), || train(on_r))?.into();
        for policy in &trained {
            writeln!(out, "{}", first_result(policy))?;
        }
        writeln!(out, "\n{}\n", rates_table(&trained).to_text())?;
        writeln!(out, "{}\n", self.comparison_table(&environment.name, &trained).to_text())?;
        writeln!(
            out,
            "Default is success on D after training on D. Interpolation is success on R\n\
             after training on R. Extrapolation is the geometric mean of three success\n\
             rates: on R and on E after training on D, and on E after training on R.\n"
        )?;
        if ["Hopper", "HalfCheetah"].contains(&environment.name.as_str()) {
            writeln!(
                out,
                "The paper's robots ran in another simulator. Do not compare the success\n\
                 rates of the two rows. Compare how much success falls along each row.\n"
            )?;
        }
        writeln!(out, "{}", conclusion(&trained))?;
        let axes = environment.heatmap_axes.clone();
        let (heatmap, films) = side_by_side(|| self.heatmap(&trained, axes), || self.films(&trained[0].checkpoint))?;
        for (what, path) in heatmap.into_iter().chain(films) {
            writeln!(out, "{what}: {}", path.display())?;
        }
        let seconds = duration(start.elapsed().as_secs_f64());
        Ok(writeln!(out, "\n{seconds} in all, seed {}; the runs are in {}", self.args.seed, self.out.display())?)
    }

    fn episodes(&self, environment: &str) -> u64 {
        self.args.episodes.unwrap_or(budget(environment).0)
    }

    /// Trains a policy and tests it on D, R and E.
    fn train(&self, environment: &str, version: Version) -> Result<DemoPolicy> {
        let DemoArgs { test_episodes, seed, .. } = *self.args;
        let episodes = self.episodes(environment);
        let mut settings = vec![
            format!("environment={environment}"),
            format!("version={version}"),
            format!("episodes={episodes}"),
            format!("seed={seed}"),
        ];
        settings.extend(budget(environment).1.iter().map(|&setting| setting.to_owned()));
        let config = TrainConfig::load(None, &settings, toml::Table::new())?;
        let directory = RunDirectory::choose(&self.out.join(format!("trained-on-{version}")), false)?;
        let mut display = Display::for_training(config.to_string(), &config, 0, 0);
        let report = |progress: &Progress| display.training(progress);
        let outcome = train(&self.servers, &config, &directory, threads(None), &self.stop, report)?;
        drop(display);
        if let Some(signal) = outcome.signal {
            return Err(TestError::Stopped { signal }.into());
        }
        let mut rates = BTreeMap::new();
        for set in Version::ALL {
            let mut display = Display::for_episodes(format!("trained on {version}, testing on {set}"), test_episodes);
            let report = |episodes| display.episodes(episodes);
            let result = test(&self.servers, &outcome.checkpoint, set, test_episodes, seed, &self.stop, report)?;
            rates.insert(set, result.success_percent);
        }
        Ok(DemoPolicy { version, checkpoint: outcome.checkpoint, rates })
    }

    /// Returns a table with two rows: the results of `trained`, and the paper's results. It also shows the numbers of
    /// runs and episodes.
    fn comparison_table(&self, environment: &str, trained: &[DemoPolicy]) -> Table {
        let rates: BTreeMap<Scenario, f64> = trained
            .iter()
            .flat_map(|one| one.rates.iter().map(|(&test, &rate)| (Scenario { train: one.version, test }, rate)))
            .collect();
        let method = trained[0].checkpoint.state.config.method();
        let here = |metric: Metric| metric.value(|scenario| rates.get(&scenario).copied());
        let rows = [
            ("here", 1, self.episodes(environment), self.args.test_episodes),
            ("paper", PAPER_RUNS, PAPER_EPISODES, PAPER_TEST_EPISODES),
        ];
        let shown = |row: &str, metric: Metric| match row {
            "here" => here(metric).map(|percent| format!("{percent:.1}")),
            _ => paper::number(environment, &method, metric).map(|number| number.to_string()),
        };
        let column = |metric| move |row: &(&str, u64, u64, u64)| shown(row.0, metric).unwrap_or_else(|| "–".into());
        Table::builder("", &rows)
            .text("success, %", |(row, ..)| *row)
            .number("runs", |(_, runs, ..)| runs)
            .number("episodes", |(.., episodes, _)| grouped(*episodes as usize))
            .number("tested", |(.., tested)| grouped(*tested as usize))
            .number("Default", column(Metric::Default))
            .number("Interpolation", column(Metric::Interpolation))
            .number("Extrapolation", column(Metric::Extrapolation))
            .build()
    }

    /// Draws the success of both policies over two parameters, side by side.
    fn heatmap(&self, trained: &[DemoPolicy], axes: Vec<String>) -> Result<Option<(&'static str, PathBuf)>> {
        let Ok(parameters) = <[String; 2]>::try_from(axes) else { return Ok(None) };
        let seed = self.args.seed;
        let grid = GRID;
        let episodes = POINT_EPISODES;
        let base = Version::D;
        let fixed = Context::new();
        let options = HeatmapOptions { parameters, base, grid, episodes, seed, fixed };
        let mut policies = Vec::new();
        for DemoPolicy { version, checkpoint, .. } in trained {
            let total = (GRID * GRID) as u64 * POINT_EPISODES;
            let mut display = Display::for_episodes(format!("trained on {version}, heatmap"), total);
            let report = &mut |episodes| display.episodes(episodes);
            let (heatmap, _) = heatmap(&self.servers, checkpoint, &options, &self.stop, report)?;
            let config = &checkpoint.state.config;
            let method = config.method().to_string();
            let trained_on = config.common.trained_on();
            policies.push(PolicyHeatmap { method, trained_on, seed, heatmap });
        }
        let Some((panels, _)) = policies_side_by_side(&policies) else { return Ok(None) };
        let path = self.out.join("heatmap.png");
        write_atomically(&path, &plot::png(&panels)?)?;
        Ok(Some(("success over two parameters", path)))
    }

    /// Films the policy that was trained on D: a success on D and a failure on E.
    fn films(&self, checkpoint: &Checkpoint) -> Result<Vec<(&'static str, PathBuf)>> {
        let wanted = [
            ("success of the policy trained on D", Version::D, true),
            ("failure of this policy on E", Version::E, false),
        ];
        let mut films = Vec::new();
        for (what, version, success) in wanted {
            let path = self.out.join(if success { "success.gif" } else { "failure.gif" });
            note(format_args!("filming {what}"));
            let Some(seed) = self.find_episode(checkpoint, version, success)? else {
                let kind = if success { "success" } else { "failure" };
                note(format_args!("no film of a {kind}: none of {MAX_TRIES} episodes on {version} was one"));
                continue;
            };
            match self.film(checkpoint, version, seed, &path) {
                Ok(()) => films.push((what, path)),
                // A server without OpenGL cannot draw robots. The error names what is missing.
                Err(VideoError::Test(TestError::Client(error @ ClientError::Refused { .. }))) => {
                    note(format_args!("no films: {error}"));
                    break;
                }
                Err(error) => return Err(error.into()),
            }
        }
        Ok(films)
    }

    /// Returns the first seed whose test episode has this outcome, or `None` after [`MAX_TRIES`] seeds.
    fn find_episode(&self, checkpoint: &Checkpoint, version: Version, success: bool) -> Result<Option<u64>> {
        for seed in self.args.seed..self.args.seed + MAX_TRIES {
            let result = test(&self.servers, checkpoint, version, 1, seed, &self.stop, |_| {})?;
            if (result.success_percent > 0.0) == success {
                return Ok(Some(seed));
            }
        }
        Ok(None)
    }

    fn film(&self, checkpoint: &Checkpoint, version: Version, seed: u64, path: &Path) -> Result<(), VideoError> {
        let options =
            VideoOptions { sets: vec![version.into()], episodes: 1, seed, size: PIXELS, fps: None, every: FRAME_STEPS };
        let footage = film(&self.servers, checkpoint, &options, VideoFile::create(path)?, &self.stop, &mut |_| {})?;
        footage.thinning().into_iter().for_each(note);
        Ok(())
    }
}

/// Returns the default number of training episodes in an environment, and the settings that differ from the defaults.
///
/// CartPole has a high learning rate, as in experiments/quick.toml. With default settings a policy that was trained on
/// D succeeds on all versions, so training on R would show no improvement. Hopper needs fewer episodes with more
/// minibatches, and a falling learning rate prevents its policy from getting worse at the end.
fn budget(environment: &str) -> (u64, &'static [&'static str]) {
    match environment {
        "CartPole" => (1500, &["learning_rate=3e-3"]),
        "Hopper" => (1500, &["n_minibatches=8", "learning_rate_schedule=linear"]),
        _ => (5000, &[]),
    }
}

/// Calls two functions, such as two trainings, in parallel. A single training would leave a core idle, because its
/// server and its learner work alternately.
fn side_by_side<A: Send, B>(
    first: impl FnOnce() -> Result<A> + Send,
    second: impl FnOnce() -> Result<B>,
) -> Result<(A, B)> {
    std::thread::scope(|scope| {
        let first = std::thread::Builder::new().spawn_scoped(scope, first).map_err(system("start a thread"))?;
        let second = second();
        let first = first.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        Ok((first?, second?))
    })
}

/// Returns a sentence with a policy's success rates.
fn first_result(policy: &DemoPolicy) -> String {
    let rates: Vec<_> = policy.rates.iter().map(|(test, rate)| format!("{rate:.1} % on {test}")).collect();
    format!("Trained on {}, the policy succeeds in {}.", policy.version, rates.join(", "))
}

fn rates_table(trained: &[DemoPolicy]) -> Table {
    let mut table = Table::builder("", trained).text("success, %", |one| format!("trained on {}", one.version));
    for test in Version::ALL {
        let shown = move |one: &DemoPolicy| one.rates.get(&test).map_or_else(String::new, |rate| format!("{rate:.1}"));
        table = table.number(format!("tested on {test}"), shown);
    }
    table.build()
}

/// Returns a summary of the tables in two sentences.
fn conclusion(trained: &[DemoPolicy]) -> String {
    let rate = |policy: usize, test| trained[policy].rates.get(&test).copied().unwrap_or_default();
    let [dd, dr, de] = Version::ALL.map(|test| rate(0, test));
    let [_, rr, re] = Version::ALL.map(|test| rate(1, test));
    format!(
        "Trained on default physics, the policy succeeds in {dd:.1} % of the episodes on\n\
         default physics, in {dr:.1} % on random physics and in {de:.1} % on extreme physics.\n\
         Trained on random physics, the policy succeeds in {rr:.1} % of the episodes on\n\
         random physics and in {re:.1} % on extreme physics."
    )
}
