//! Measures training throughput, in environment steps per second:
//!
//! - `alone`: one PPO training with FF on CartPole D: 8 environments × 128 steps, 10 epochs, one minibatch. It uses a
//!   private server on a Unix socket. It is measured three times: with actions chosen in the server, with actions chosen
//!   in the client, and with actions chosen in the server and a network delay of 5 ms each way.
//! - `together`: 36 trainings of A2C with FF on CartPole, with the paper's one environment and 5 steps per rollout;
//!   then 9 trainings of PPO with 128 steps per rollout. They run in two groups in this process. Each group has a
//!   private server, as with `perturb run --jobs 2`.
//!
//! Arguments select measurements: those whose name contains an argument are run.

use std::time::{Duration, Instant};

use perturb_faults::{FaultPlan, FaultyProxy};
use perturb_files::interrupt::StopFlag;
use perturb_learner::client::{ActorLocation, Address, PrivateServer, Servers};
use perturb_learner::logging::TimeShares;
use perturb_learner::training::{RunDirectory, Start, TrainRequest, train, train_together};
use perturb_settings::TrainConfig;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

const ALONE: &str = "algorithm = 'ppo'\nnum_envs = 8\nn_steps = 128\nn_epochs = 10\nn_minibatches = 1";
const ITERATIONS: u64 = 100;
const SIGNAL: i32 = 15;
const GROUPS: usize = 2;
/// Duration of each `together` measurement. A warm-up of the same duration precedes it.
const MEASURED: Duration = Duration::from_secs(5);
/// Network delay in each direction in the measurement `alone/delayed`.
const DELAY: Duration = Duration::from_millis(5);

fn main() -> Result<()> {
    let wanted: Vec<String> = std::env::args().skip(1).filter(|argument| !argument.starts_with('-')).collect();
    let is_wanted = |name: &str| wanted.is_empty() || wanted.iter().any(|part| name.contains(part.as_str()));
    let server = PrivateServer::start(None)?;
    let address = server.address().clone();
    for (name, act) in [("alone/act_server", ActorLocation::Server), ("alone/act_client", ActorLocation::Client)] {
        if is_wanted(name) {
            alone(name, &Servers::connect(std::slice::from_ref(&address))?.with_act(act))?;
        }
    }
    if is_wanted("alone/delayed") {
        let line = FaultyProxy::start(&address.to_string(), |_| FaultPlan { delay: DELAY, ..FaultPlan::default() })?;
        alone("alone/delayed/act_server", &Servers::connect(&[line.address().parse()?])?)?;
    }
    let a2c = "algorithm = 'a2c'\nnum_envs = 1\nn_steps = 5";
    let ppo = "algorithm = 'ppo'\nnum_envs = 1\nn_steps = 128\nn_minibatches = 4";
    for (name, settings, cells) in [("together/a2c_ff/36", a2c, 36), ("together/ppo_ff/9", ppo, 9)] {
        if is_wanted(name) {
            together(name, settings, cells)?;
        }
    }
    Ok(())
}

fn config(settings: &str, seed: usize) -> Result<TrainConfig> {
    let text = format!("environment = 'CartPole'\nepisodes = 1000000000\nseed = {seed}\n{settings}");
    Ok(TrainConfig::from_table("the bench", text.parse()?)?)
}

fn alone(name: &str, servers: &Servers) -> Result<()> {
    let out = tempfile::tempdir()?;
    let directory = RunDirectory::choose(out.path(), false)?;
    let stop = StopFlag::default();
    let threads = std::thread::available_parallelism()?.get();
    let outcome = train(servers, &config(ALONE, 1)?, &directory, threads, &stop, |progress| {
        if progress.iterations == ITERATIONS {
            stop.raise(SIGNAL);
        }
    })?;

    // Checks that the timed work was done: steps, updates, and some learning.
    let progress = outcome.progress;
    assert_eq!(progress.timesteps, ITERATIONS * 8 * 128);
    assert_eq!(progress.update.n_updates, ITERATIONS * 10);
    let length = progress.recent.map_or(0.0, |recent| recent.length);
    assert!(length > 60.0, "after 100 iterations episodes last {length} steps, no more than without learning");

    let TimeShares { acting, waiting, updating } = progress.percent();
    println!(
        "training/ppo_ff/cart_pole/8x128/{name}: {:.0} env steps/s; {acting:.1} % acting, {waiting:.1} % waiting for the \
         server, {updating:.1} % updating ({} steps in {:.2} s)",
        progress.fps(),
        progress.timesteps,
        progress.elapsed
    );
    Ok(())
}

/// Measures `cells` trainings in [`GROUPS`] groups and prints their steps per second. Each group has its own server, as
/// in `perturb run`.
fn together(name: &str, settings: &str, cells: usize) -> Result<()> {
    let stop = StopFlag::default();
    let start = Instant::now();
    let group = |group: usize| {
        let server = PrivateServer::start(Some(1))?;
        let seeds = (group * cells / GROUPS)..((group + 1) * cells / GROUPS);
        group_of(server.address(), settings, seeds, &stop, start)
    };
    let rates: Vec<f64> = std::thread::scope(|scope| {
        let group = &group;
        let threads: Vec<_> = (0..GROUPS).map(|index| scope.spawn(move || group(index))).collect();
        threads.into_iter().map(|thread| thread.join().map_err(|_| "a group panicked")?).collect::<Result<_>>()
    })?;
    println!("training/cart_pole/{name}: {:.0} env steps/s in {GROUPS} groups", rates.iter().sum::<f64>());
    Ok(())
}

/// Runs a group of trainings with these seeds, and returns its environment steps per second. The time starts at
/// `start`, which all groups share.
fn group_of(
    address: &Address,
    settings: &str,
    seeds: std::ops::Range<usize>,
    stop: &StopFlag,
    start: Instant,
) -> Result<f64> {
    let servers = Servers::connect(std::slice::from_ref(address))?;
    let out = tempfile::tempdir()?;
    let directories: Vec<RunDirectory> = seeds
        .clone()
        .map(|seed| RunDirectory::choose(&out.path().join(seed.to_string()), false))
        .collect::<std::result::Result<_, _>>()?;
    let entry = |(directory, seed)| {
        Ok(TrainRequest { directory, start: Start::Fresh(Box::new(config(settings, seed)?)), marks: &[] })
    };
    let entries: Vec<TrainRequest<'_>> = directories.iter().zip(seeds.clone()).map(entry).collect::<Result<_>>()?;
    let mut steps = vec![0; seeds.len()];
    let mut before = None;
    let mut after = None;
    let mut failure = None;
    train_together(
        &servers,
        entries,
        1,
        stop,
        &mut |index, progress| {
            steps[index] = progress.timesteps;
            let elapsed = start.elapsed();
            let now = || (elapsed, steps.iter().sum::<u64>());
            if elapsed >= MEASURED && before.is_none() {
                before = Some(now());
            }
            if elapsed >= 2 * MEASURED {
                after.get_or_insert_with(now);
                stop.raise(SIGNAL);
            }
        },
        &mut |_, outcome| failure = failure.take().or(outcome.err()),
    )?;
    if let Some(error) = failure {
        return Err(error.into());
    }
    let ((from, first), (to, last)) = before.zip(after).ok_or("the groups ended too early")?;
    Ok((last - first) as f64 / (to - from).as_secs_f64())
}
