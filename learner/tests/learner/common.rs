//! Helpers for tests with a server.

use perturb_learner::algorithm::{A2c, BaseAlgorithm, Ppo};
use perturb_learner::client::{Address, OpenOptions, PrivateServer, Servers};
use perturb_learner::policy::TrainablePolicy;
use perturb_learner::rollout::RolloutBuffer;
use perturb_policy::PolicySpec;
use perturb_policy::random::{Purpose, normal, stream};
use perturb_protocol::Version;
use perturb_settings::{A2cConfig, PpoConfig};

/// Starts a server with one physics thread.
pub fn server() -> PrivateServer {
    perturb_torch::register(); // for recurrent policies that train on this server
    PrivateServer::start(Some(1)).unwrap_or_else(|error| panic!("{error}"))
}

/// Connects to all of `servers`.
pub fn connect(servers: &[PrivateServer]) -> Servers {
    let addresses: Vec<Address> = servers.iter().map(|server| server.address().clone()).collect();
    Servers::connect(&addresses).expect("connections")
}

/// Returns options for environments of version R.
pub fn options(environment: &str, num_envs: usize, episodes_per_trial: u32) -> OpenOptions {
    OpenOptions {
        environment: environment.into(),
        version: Version::R,
        parameters: Default::default(),
        contexts: Vec::new(),
        num_envs,
        seed: 3,
        episodes_per_trial,
        observe: Default::default(),
    }
}

/// Returns a policy in which every number, including biases and log_std, differs from its initial value by about 0.1.
pub fn moved(spec: &PolicySpec) -> TrainablePolicy {
    perturb_torch::register();
    let mut rng = stream(9, Purpose::Weights);
    let mut weights = TrainablePolicy::new(spec.clone(), 1).expect("a policy").weights();
    weights.iter_mut().flat_map(|array| &mut array.data).for_each(|x| *x += 0.1 * normal(&mut rng) as f32);
    TrainablePolicy::from_weights(spec.clone(), &weights).expect("a policy")
}

/// Returns A2C and PPO with these settings.
pub fn bases(n_steps: usize, n_minibatches: usize, policy: &TrainablePolicy) -> [Box<dyn BaseAlgorithm>; 2] {
    let a2c = A2cConfig { n_steps, learning_rate: 7e-3, ..A2cConfig::default() };
    let ppo =
        PpoConfig { n_steps, n_minibatches, n_epochs: 3, learning_rate: 3e-3, kl_coef: 0.1, ..Default::default() };
    [
        Box::new(A2c::new(a2c, policy).expect("valid settings")),
        Box::new(Ppo::new(ppo, policy, 5).expect("valid settings")),
    ]
}

/// Returns all arrays of a finished rollout, with flags as 0 and 1.
pub fn contents(rollout: &RolloutBuffer) -> Vec<Vec<f32>> {
    let flags = |flags: &[bool]| flags.iter().map(|&flag| f32::from(u8::from(flag))).collect::<Vec<_>>();
    let trajectories = rollout.trajectories().expect("a finished rollout");
    vec![
        rollout.observations().to_vec(),
        flags(rollout.starts()),
        rollout.actions().to_vec(),
        rollout.log_probs().to_vec(),
        rollout.values().to_vec(),
        trajectories.rewards.to_vec(),
        flags(trajectories.terminated),
        flags(trajectories.truncated),
        trajectories.truncation_values.to_vec(),
        trajectories.last_values.to_vec(),
        rollout.memory().to_vec(),
    ]
}
