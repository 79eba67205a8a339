//! The cost of disturbances: the steps of a batch with delays and noise, compared with the same batch without
//! disturbances.

use super::{
    Failure, ROUNDS,
    client::{Client, ServerProcess},
    median,
};
use perturb::env::ActionSpec;
use perturb::tasks;

/// The number of environments in a batch.
const BATCH: usize = 64;
/// The approximate computing time of a round's steps, in µs.
const ROUND_US: f64 = 100_000.0;

/// Returns the id of the measurement.
pub(crate) fn id(name: &str) -> String {
    format!("disturbed/{name}/{BATCH}")
}

/// Measures an environment with delayed and noisy observations and delayed actions. Continuous actions are also noisy.
pub(crate) async fn measure(name: &str) -> Result<(), Failure> {
    let spec = tasks::catalogue().find(name)?;
    let all = [("action_delay", 2.0), ("sensor_delay", 1.0), ("sensor_noise", 0.05), ("action_noise", 0.05)];
    let values = if let ActionSpec::Discrete(_) = spec.action { &all[..3] } else { &all };
    let trips = ((ROUND_US / (spec.step_cost * BATCH as f64)) as usize).clamp(20, 2000);
    let server = ServerProcess::server(1)?;
    let mut plain = Client::open(&server.socket, name, BATCH).await?;
    let mut disturbed = Client::open_disturbed(&server.socket, name, BATCH, values).await?;
    let mut ratios = Vec::new();
    for round in 0..ROUNDS {
        let mut seconds = [0.0; 2];
        for turn in 0..2 {
            let which = (round + turn) % 2; // alternates the order, because the first one is slower
            let client = if which == 0 { &mut plain } else { &mut disturbed };
            seconds[which] = client.run(trips).await?;
        }
        ratios.push(seconds[0] / seconds[1]);
    }
    println!("{:<22} {:>12.3} of the steps a second without disturbances", id(name), median(&mut ratios));
    Ok(())
}
