//! The cost of serving. Each result has a reference that is measured in the same run:
//!
//! - CartPole, batch of 256, over a Unix socket; reference: a plain tonic echo server with replies of the same size;
//! - Hopper and HalfCheetah, batches of 64, 256 and 1024, two workers; reference: only MuJoCo's timesteps ([`robots`]);
//! - tasks that are loaded from folders; reference: the built-in Hopper, and only MuJoCo's functions ([`folder`]);
//! - CartPole over TCP with TLS; reference: TCP without TLS ([`encrypted`]);
//! - many concurrent sessions with several transport threads, only if requested by name ([`sessions`]);
//! - the round-trip time of one environment, and the memory of one Hopper;
//! - CartPole, 8 environments in which the server acts with a policy; reference: only computing the actions
//!   ([`acting`]);
//! - each environment, batch of 64, with delayed and noisy actions and observations; reference: the same batch without
//!   delay and noise ([`disturbed`]);
//! - this server, compared with another executable of it ([`compare`]);
//! - rendered pictures of each environment, 480 × 480 pixels, and the growth of the server's memory.
//!
//! Servers are separate processes: `perturb-server`, or this program with the arguments `echo` and a socket path.

mod acting;
mod client;
mod compare;
mod disturbed;
mod echo;
mod encrypted;
#[cfg(feature = "mujoco")]
mod folder;
#[cfg(feature = "mujoco")]
mod robots;
mod sessions;

use client::{Client, ServerProcess};
use perturb::tasks;
use std::{env, time::Instant};

type Failure = Box<dyn std::error::Error>;

/// Number of rounds. Reference and server are measured in alternating short rounds, so that other load affects both.
/// The output has medians over the rounds.
const ROUNDS: usize = 25;

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = env::args().collect();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    if let [_, kind, socket, ..] = arguments.as_slice()
        && kind == "echo"
    {
        return runtime.block_on(echo::serve(socket.as_ref()));
    }
    if let Some(place) = arguments.iter().position(|argument| argument == "compare") {
        let program = arguments.get(place + 1).ok_or("compare needs the path of another perturb-server")?;
        return runtime.block_on(compare::compared(program.as_ref()));
    }
    // Cargo passes --bench. Any other argument selects measurements whose id contains it.
    let filter = arguments.iter().skip(1).find(|argument| !argument.starts_with('-'));
    let wanted = |id: &str| filter.is_none_or(|filter| id.contains(filter.as_str()));
    if filter.is_some() {
        sessions::measure(wanted)?;
    }
    runtime.block_on(async {
        if wanted("step/CartPole/256") {
            classic().await?;
        }
        #[cfg(feature = "mujoco")]
        for (spec, make) in [
            (&tasks::hopper::SPEC, tasks::hopper::hopper as robots::MakeRobot),
            (&tasks::half_cheetah::SPEC, tasks::half_cheetah::half_cheetah),
        ] {
            for batch in [64, 256, 1024] {
                if wanted(&format!("step/{}/{batch}", spec.name)) {
                    robots::measure(spec, make, batch).await?;
                }
            }
        }
        #[cfg(feature = "mujoco")]
        for id in folder::ids() {
            if wanted(&id) {
                folder::served(&id).await?;
            }
        }
        if wanted("round_trip/CartPole/1") {
            round_trip().await?;
        }
        for batch in [1, 256] {
            if wanted(&format!("tls/CartPole/{batch}")) {
                encrypted::measure(batch).await?;
            }
        }
        for lstm in [None, Some(256)] {
            if wanted(acting::id(lstm)) {
                acting::measure(lstm).await?;
            }
        }
        for name in tasks::catalogue().names() {
            if wanted(&disturbed::id(name)) {
                disturbed::measure(name).await?;
            }
        }
        if wanted("memory/Hopper") {
            memory().await?;
        }
        for name in tasks::catalogue().names() {
            if wanted(&format!("render/{name}/480")) {
                pictures(name).await?;
            }
        }
        Ok(())
    })
}

/// Measures CartPole with 256 environments, and the echo server.
async fn classic() -> Result<(), Failure> {
    const BATCH: usize = 256;
    const TRIPS: usize = 800;
    let server = ServerProcess::server(1)?;
    let echo = ServerProcess::echo()?;
    let mut served = Client::open(&server.socket, "CartPole", BATCH).await?;
    let mut bare = Client::open(&echo.socket, "CartPole", BATCH).await?;
    let mut ratios = Vec::new();
    let mut steps = Vec::new();
    for _ in 0..ROUNDS {
        let echoed = TRIPS as f64 / bare.run(TRIPS).await?;
        let stepped = TRIPS as f64 / served.run(TRIPS).await?;
        ratios.push(stepped / echoed);
        steps.push(stepped * BATCH as f64);
    }
    println!("step/CartPole/256      {:>12.0} env steps/s over a Unix socket", median(&mut steps));
    println!("step/CartPole/256      {:>12.2} of a bare echo's round trips x 256 (at least 0.5)", median(&mut ratios));
    Ok(())
}

/// Measures the round-trip time of one environment.
async fn round_trip() -> Result<(), Failure> {
    const TRIPS: usize = 20_000;
    let server = ServerProcess::server(1)?;
    let mut client = Client::open(&server.socket, "CartPole", 1).await?;
    client.run(TRIPS / 10).await?;
    let mut micros = Vec::with_capacity(TRIPS);
    for _ in 0..TRIPS {
        micros.push(client.run(1).await? * 1e6);
    }
    micros.sort_by(f64::total_cmp);
    let quantile = |q: f64| micros[(q * (TRIPS - 1) as f64) as usize];
    println!("round_trip/CartPole/1  {:>12.1} us p50, {:.1} us p99", quantile(0.5), quantile(0.99));
    Ok(())
}

/// Measures the resident memory of one Hopper, after enough steps to touch all its pages.
async fn memory() -> Result<(), Failure> {
    const BATCH: usize = 2000;
    if tasks::catalogue().find("Hopper").is_err() {
        return Ok(());
    }
    let server = ServerProcess::server(2)?;
    Client::open(&server.socket, "Hopper", 1).await?.run(10).await?;
    let before = server.resident()?;
    let mut client = Client::open(&server.socket, "Hopper", BATCH).await?;
    client.run(50).await?;
    let each = (server.resident()? - before) / BATCH as f64;
    println!("memory/Hopper           {:>12.1} kB for each environment (at most 4)", each / 1e3);
    Ok(())
}

/// Measures rendered pictures of one environment, with one request at a time.
async fn pictures(name: &'static str) -> Result<(), Failure> {
    const PICTURES: usize = 10;
    let server = ServerProcess::server(1)?;
    let mut client = Client::open(&server.socket, name, 1).await?;
    client.run(10).await?;
    let before = server.resident()?;
    // The first picture loads the graphics driver.
    client.draw().await?;
    let mut rates = Vec::new();
    for _ in 0..ROUNDS {
        let start = Instant::now();
        for _ in 0..PICTURES {
            client.draw().await?;
        }
        rates.push(PICTURES as f64 / start.elapsed().as_secs_f64());
    }
    let id = format!("render/{name}/480");
    let grown = (server.resident()? - before) / 1e6;
    println!("{id:<22} {:>12.0} pictures/s over a Unix socket; {grown:.0} MB more memory", median(&mut rates));
    Ok(())
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
