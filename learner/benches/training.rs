//! Training throughput: PPO FF on CartPole D, 8 environments × 128 steps, 10 epochs, one minibatch, over a private
//! server on a Unix socket. Prints env steps/s and where the time went.

use perturb_learner::client::Servers;
use perturb_learner::logging::TimeShares;
use perturb_learner::training::{RunDirectory, train};
use perturb_study::interrupt::StopFlag;
use perturb_study::settings::TrainConfig;

const CONFIG: &str = "
environment = 'CartPole'
algorithm = 'ppo'
num_envs = 8
n_steps = 128
n_epochs = 10
n_minibatches = 1
episodes = 1000000
";
const ITERATIONS: u64 = 100;
const SIGNAL: i32 = 15;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let servers = Servers::local(None)?;
    let config = TrainConfig::from_table("the bench", CONFIG.parse()?)?;
    let out = tempfile::tempdir()?;
    let directory = RunDirectory::choose(out.path(), false)?;
    let stop = StopFlag::default();
    let threads = std::thread::available_parallelism()?.get();
    let outcome = train(&servers, &config, &directory, threads, &stop, |progress| {
        if progress.iterations == ITERATIONS {
            stop.raise(SIGNAL);
        }
    })?;

    // What was timed really happened: the steps, the updates, and learning.
    let progress = outcome.progress;
    assert_eq!(progress.timesteps, ITERATIONS * 8 * 128);
    assert_eq!(progress.update.n_updates, ITERATIONS * 10);
    let length = progress.recent.map_or(0.0, |recent| recent.length);
    assert!(length > 60.0, "after 100 iterations episodes last {length} steps, no more than without learning");

    let TimeShares { acting, waiting, updating } = progress.percent();
    let threads = std::env::var("OPENBLAS_NUM_THREADS").unwrap_or_else(|_| "default".into());
    println!(
        "training/ppo_ff/cart_pole/8x128: {:.0} env steps/s; {acting:.1} % acting, {waiting:.1} % waiting for the \
         server, {updating:.1} % updating ({} steps in {:.2} s, BLAS threads: {threads})",
        progress.fps(),
        progress.timesteps,
        progress.elapsed
    );
    Ok(())
}
