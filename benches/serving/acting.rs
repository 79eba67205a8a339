//! The cost of a policy that acts on the server, compared with only computing the policy's actions.

use super::{
    Failure, ROUNDS,
    client::{Client, SEED, ServerProcess},
    median,
};
use perturb::proto;
use perturb_policy::{
    ActionKind, Inputs, Normalisers, Player, PlayerRole, PolicySpec, StepOutcome, initial_weights,
    random::{Purpose, stream},
};
use std::time::Instant;

/// The number of environments.
const BATCH: usize = 8;
/// The number of elements in CartPole's observation.
const OBSERVATION: usize = 4;
const ACTION: ActionKind = ActionKind::Discrete { n: 2 };
/// The number of steps in a request for a feed-forward policy. A recurrent policy plays a sixteenth of them.
const STEPS: u32 = 1024;

/// Returns the id of the measurement.
pub(crate) fn id(lstm: Option<usize>) -> &'static str {
    if lstm.is_some() { "act/CartPole/8/RC" } else { "act/CartPole/8/FF" }
}

/// Measures a policy of the paper's size in 8 CartPole environments. `lstm` is the width of its LSTM, if it is
/// recurrent.
pub(crate) async fn measure(lstm: Option<usize>) -> Result<(), Failure> {
    let spec = match lstm {
        None => PolicySpec::feed_forward(OBSERVATION, ACTION),
        Some(_) => PolicySpec::recurrent(OBSERVATION, ACTION),
    };
    let arrays = initial_weights(&spec, &mut stream(SEED, Purpose::Weights));
    let weights: Vec<f32> = arrays.into_iter().flat_map(|array| array.data).collect();
    let steps = if lstm.is_some() { STEPS / 16 } else { STEPS };

    let server = ServerProcess::server(1)?;
    let mut client = Client::open(&server.socket, "CartPole", BATCH).await?;
    let mut request = proto::Act {
        weights: weights.iter().flat_map(|x| x.to_le_bytes()).collect(),
        task: Some(proto::act::Task::Steps(steps)),
        ..Default::default()
    };
    let training = proto::RandomStream { key: vec![0; 32].into(), stream: 0, position: 0 };
    let policy = proto::Policy {
        hidden: spec.hidden.iter().map(|&width| width as u32).collect(),
        lstm: spec.lstm.map_or(0, |width| width as u32),
        role: Some(proto::policy::Role::Training(training)),
        ..Default::default()
    };
    client.act(proto::Act { policy: Some(policy), ..request.clone() }, steps).await?;
    request.weights.clear();
    let mut player = local_player(&spec, &weights)?;
    let mut step_times = Vec::new();
    let mut computed = Vec::new();
    for _ in 0..ROUNDS {
        step_times.push(client.act(request.clone(), steps).await? * 1e6 / f64::from(steps));
        computed.push(compute(&mut player, steps)? * 1e6 / f64::from(steps));
    }
    let step = median(&mut step_times);
    let computed = median(&mut computed);
    println!("{:<22} {step:>12.2} us a step of 8, of which {computed:.2} are the policy's", id(lstm));
    Ok(())
}

fn local_player(spec: &PolicySpec, weights: &[f32]) -> Result<Player, Failure> {
    let inputs = Inputs::new(OBSERVATION, ACTION, BATCH, false);
    let mut player = Player::new(spec, inputs, BATCH, 1, Normalisers::default(), PlayerRole::training(SEED));
    player.load(weights)?;
    player.begin(&[0.01; BATCH * OBSERVATION], None)?;
    Ok(player)
}

/// Computes the player's actions for `steps` steps without environments, always with the same observation. Returns the
/// elapsed time in seconds.
fn compute(player: &mut Player, steps: u32) -> Result<f64, Failure> {
    let outcome = StepOutcome {
        observations: &[0.02; BATCH * OBSERVATION],
        rewards: &[1.0; BATCH],
        terminated: &[false; BATCH],
        truncated: &[false; BATCH],
        final_observations: &[],
        ended: &[],
    };
    let start = Instant::now();
    for _ in 0..steps {
        assert_eq!(player.act()?.len(), 4 * BATCH);
        player.observe(&outcome, None)?;
    }
    Ok(start.elapsed().as_secs_f64())
}
