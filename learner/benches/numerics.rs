//! Measures the time of choosing actions and of updates. Run it with `cargo bench -p perturb-learner --bench numerics
//! [filter]`.
//!
//! Each line of the output has the times of the fastest and of the median repetition, in µs. The result of each timed
//! call is checked.

use std::time::Instant;

use perturb_learner::algorithm::{A2c, Algorithm, Ppo};
use perturb_learner::policy::TrainablePolicy;
use perturb_learner::rollout::{RolloutBuffer, RolloutStep};
use perturb_policy::random::{Purpose, normal, stream};
use perturb_policy::{ActionKind, Actor, ActorOutput, ObservationNormaliser, PolicySpec};
use perturb_settings::{A2cConfig, PpoConfig};

const TASKS: [(&str, usize, ActionKind); 2] =
    [("cart_pole", 4, ActionKind::Discrete { n: 2 }), ("half_cheetah", 26, ActionKind::Continuous { size: 6 })];

/// Measures `run` and prints its fastest and its median time, unless a filter on the command line excludes `id`.
fn time(id: &str, repetitions: usize, mut run: impl FnMut()) {
    if std::env::args().skip(1).any(|filter| !filter.starts_with('-') && !id.contains(&filter)) {
        return;
    }
    for _ in 0..repetitions / 10 {
        run();
    }
    let mut times: Vec<f64> = Vec::with_capacity(repetitions);
    for _ in 0..repetitions {
        let start = Instant::now();
        run();
        times.push(start.elapsed().as_secs_f64() * 1e6);
    }
    times.sort_by(f64::total_cmp);
    println!("{id:40} {:10.2} µs fastest {:10.2} µs median", times[0], times[repetitions / 2]);
}

fn policy(observation_size: usize, action: ActionKind) -> TrainablePolicy {
    TrainablePolicy::new(PolicySpec::feed_forward(observation_size, action), 1).expect("a policy")
}

fn observations(size: usize) -> Vec<f32> {
    let mut rng = stream(1, Purpose::Weights);
    (0..size).map(|_| normal(&mut rng) as f32).collect()
}

/// Returns a full rollout of `n_steps` steps in `n_envs` environments: random observations, and the actions that
/// `policy` chose for them.
fn rollout(policy: &TrainablePolicy, n_steps: usize, n_envs: usize) -> RolloutBuffer {
    let spec = policy.spec();
    let mut actor = Actor::new(spec, n_envs);
    actor.load_flat(policy.flat_weights()).expect("weights that fit");
    let mut rng = stream(1, Purpose::Actions);
    let mut acts = ActorOutput::new(spec.action, n_envs);
    let mut rollout = RolloutBuffer::new(n_steps, n_envs, spec.observation_size, spec.action.width());
    rollout.begin(actor.memory());
    for rows in observations(n_steps * n_envs * spec.observation_size).chunks(n_envs * spec.observation_size) {
        actor.act(rows, &mut rng, &mut acts).expect("actions");
        let step = RolloutStep {
            observations: rows,
            actions: &acts.actions,
            log_probs: &acts.log_probs,
            values: &acts.values,
            rewards: &rows[..n_envs],
            starts: &vec![false; n_envs],
            terminated: &vec![false; n_envs],
            truncated: &vec![false; n_envs],
            truncation_values: &vec![0.0; n_envs],
        };
        rollout.push(step).expect("a step that fits");
    }
    rollout.finish(&acts.values).expect("a full rollout");
    rollout
}

/// Measures the times of choosing actions, loading weights and updating for a recurrent policy with the paper's layer
/// sizes.
fn recurrent(task: &str, observation_size: usize, action: ActionKind) {
    perturb_torch::register();
    let mut policy = TrainablePolicy::new(PolicySpec::recurrent(observation_size, action), 1).expect("a policy");
    for n_envs in [1, 16] {
        let mut actor = Actor::new(policy.spec(), n_envs);
        actor.load_flat(policy.flat_weights()).expect("weights that fit");
        let rows = observations(n_envs * observation_size);
        let mut rng = stream(1, Purpose::Actions);
        let mut acts = ActorOutput::new(action, n_envs);
        time(&format!("act_rc/{task}/{n_envs}"), 300, || {
            actor.act(&rows, &mut rng, &mut acts).expect("actions");
            assert_eq!(acts.values.len(), n_envs);
        });
    }
    let mut actor = Actor::new(policy.spec(), 1);
    time(&format!("load_rc/{task}"), 100, || actor.load_flat(policy.flat_weights()).expect("weights that fit"));
    for (n_steps, n_envs) in [(5, 16), (15, 16)] {
        time_a2c(&format!("a2c_rc/{task}/{n_steps}x{n_envs}"), 50, &mut policy, n_steps, n_envs);
    }
    for (n_steps, n_envs) in [(128, 1), (128, 16)] {
        time_ppo(&format!("ppo_epoch_rc/{task}/{n_steps}x{n_envs}"), 20, &mut policy, n_steps, n_envs);
    }
}

fn time_a2c(id: &str, repetitions: usize, policy: &mut TrainablePolicy, n_steps: usize, n_envs: usize) {
    let rollout = rollout(policy, n_steps, n_envs);
    let config = A2cConfig { n_steps, learning_rate: 1e-6, ..A2cConfig::default() };
    let mut a2c = A2c::new(config, policy).expect("valid settings");
    time(id, repetitions, || {
        let stats = a2c.update(policy, &rollout, 1.0).expect("an update");
        assert!(stats.grad_norm > 0.0);
    });
}

/// Measures one epoch of PPO.
fn time_ppo(id: &str, repetitions: usize, policy: &mut TrainablePolicy, n_steps: usize, n_envs: usize) {
    let rollout = rollout(policy, n_steps, n_envs);
    let config = PpoConfig { n_steps, n_epochs: 1, learning_rate: 1e-6, ..PpoConfig::default() };
    let mut ppo = Ppo::new(config, policy, 1).expect("valid settings");
    time(id, repetitions, || {
        let stats = ppo.update(policy, &rollout, 1.0).expect("an update");
        assert!(stats.grad_norm > 0.0);
    });
}

fn main() {
    for (task, observation_size, action) in TASKS {
        recurrent(task, observation_size, action);
        for n_envs in [1, 16, 64, 256] {
            let policy = policy(observation_size, action);
            let mut actor = Actor::new(policy.spec(), n_envs);
            actor.load_flat(policy.flat_weights()).expect("weights that fit");
            let rows = observations(n_envs * observation_size);
            let mut rng = stream(1, Purpose::Actions);
            let mut acts = ActorOutput::new(action, n_envs);
            time(&format!("act/{task}/{n_envs}"), 2000, || {
                actor.act(&rows, &mut rng, &mut acts).expect("actions");
                assert_eq!(acts.values.len(), n_envs);
            });
            let mut normaliser = ObservationNormaliser::new(observation_size);
            let mut normal_rows = rows.clone();
            time(&format!("normalise/{task}/{n_envs}"), 2000, || {
                normal_rows.copy_from_slice(&rows);
                normaliser.update(&rows).expect("finite numbers");
                normaliser.normalise(&mut normal_rows).expect("whole observations");
                assert!(normal_rows[0].is_finite());
            });
        }
        let policy_for_load = policy(observation_size, action);
        let mut actor = Actor::new(policy_for_load.spec(), 1);
        time(&format!("load/{task}"), 2000, || {
            actor.load_flat(policy_for_load.flat_weights()).expect("weights that fit")
        });
        for threads in [1, 2] {
            let mut policy = policy(observation_size, action).with_threads(threads).expect("threads");
            for (n_steps, n_envs) in [(5, 1), (5, 16), (15, 16), (5, 64)] {
                let id = format!("a2c/{task}/{n_steps}x{n_envs}/{threads}");
                time_a2c(&id, 1000, &mut policy, n_steps, n_envs);
            }
            for (n_steps, n_envs) in [(128, 1), (512, 1), (128, 8), (128, 16)] {
                let id = format!("ppo_epoch/{task}/{n_steps}x{n_envs}/{threads}");
                time_ppo(&id, 200, &mut policy, n_steps, n_envs);
            }
        }
    }
}
