//! Tests of RL²: inputs and memories within a trial, updates, tests of policies, and learning within a trial.

use perturb_files::interrupt::StopFlag;
use perturb_learner::algorithm::{A2c, Algorithm, Ppo, gae};
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::{ClientSession, EndedEpisode, OpenOptions, Servers, StepReply};
use perturb_learner::evaluation::test;
use perturb_learner::policy::TrainablePolicy;
use perturb_learner::rollout::{Collector, Normalisers, RolloutBuffer, RolloutStep};
use perturb_learner::training::{RunDirectory, train};
use perturb_policy::random::{Purpose, stream, uniform};
use perturb_policy::{ActionKind, Actor, ActorOutput, CollectUntil, Inputs, Player, PlayerRole, PolicySpec};
use perturb_protocol::Version;
use perturb_settings::{self as settings, A2cConfig, PpoConfig, TrainConfig};

use crate::common::{bases, connect, contents, moved, options, server};
use rand_chacha::ChaCha8Rng;

const TWO: ActionKind = ActionKind::Discrete { n: 2 };
const ONE: ActionKind = ActionKind::Continuous { size: 1 };
const N_ENVS: usize = 3;

/// Returns a small recurrent policy whose inputs contain the outcome of the previous step: last action, last reward,
/// and whether an episode ended.
fn policy(observation_size: usize, action: ActionKind) -> TrainablePolicy {
    let observation_size = Inputs::new(observation_size, action, 1, true).size();
    moved(&PolicySpec { observation_size, action, hidden: vec![8], lstm: Some(6) })
}

fn collector<'a>(
    servers: &'a Servers,
    options: &OpenOptions,
    policy: &TrainablePolicy,
) -> (ClientSession<'a>, Collector) {
    let mut observations = Vec::new();
    let session = ClientSession::open(servers, options, &mut observations).expect("a session");
    let inputs = Inputs::new(session.observation_size(), policy.spec().action, options.num_envs, true);
    let n = options.num_envs;
    let trial = options.episodes_per_trial;
    let none = Normalisers::default();
    let mut player = Player::new(policy.spec(), inputs, n, trial, none, PlayerRole::training(1));
    player.begin(&observations, None).expect("observations");
    (session, Collector::new(player))
}

fn as_bits(flag: bool) -> f32 {
    f32::from(u8::from(flag))
}

/// Returns the numbers that follow the observation in an input: last action, last reward, and 0, because no episode has
/// ended.
fn beside(action: ActionKind, taken: f32, reward: f32) -> Vec<f32> {
    let mut beside: Vec<f32> = match action {
        ActionKind::Discrete { n } => (0..n).map(|j| as_bits(taken == j as f32)).collect(),
        ActionKind::Continuous { .. } => vec![taken],
    };
    beside.extend([reward, 0.0]);
    beside
}

/// Returns the rollout of a plain recurrent policy whose observations this function extends itself: to `[s, a, r, 0]`,
/// or to `[s, 0, 0, 0]` at the start of an episode.
fn extended_by_hand(
    servers: &Servers,
    options: &OpenOptions,
    policy: &TrainablePolicy,
    n_steps: usize,
) -> RolloutBuffer {
    let spec = policy.spec();
    let n = options.num_envs;
    let mut reply = StepReply::default();
    let mut session = ClientSession::open(servers, options, &mut reply.observations).expect("a session");
    let size = session.observation_size();
    let extra = spec.observation_size - size;
    let mut rollout = RolloutBuffer::new(n_steps, n, spec.observation_size, spec.action.width());
    let mut actor = Actor::new(spec, n);
    actor.load(&policy.weights()).expect("weights that fit");
    let mut rng = stream(1, Purpose::Actions);
    let mut acts = ActorOutput::new(spec.action, n);
    let mut beside = vec![vec![0.0; extra]; n];
    let mut starts = vec![true; n];
    let row = |observation: &[f32], beside: &[f32]| [observation, beside].concat();
    let rows = |observations: &[f32], beside: &[Vec<f32>]| -> Vec<f32> {
        observations.chunks(size).zip(beside).flat_map(|(observation, beside)| row(observation, beside)).collect()
    };
    rollout.begin(actor.memory());
    for _ in 0..n_steps {
        let inputs = rows(&reply.observations, &beside);
        actor.act(&inputs, &mut rng, &mut acts).expect("actions");
        let mut bytes = Vec::new();
        acts.write_bytes(&mut bytes);
        session.step(&bytes, &mut reply).expect("a step");
        for (i, beside) in beside.iter_mut().enumerate() {
            *beside = self::beside(spec.action, acts.actions[i], reply.rewards[i]);
        }
        let mut truncation_values = vec![0.0; n];
        for (end, observation) in reply.ended.iter().zip(reply.final_observations.chunks(size)) {
            if reply.truncated[end.slot] {
                let mut value = Vec::new();
                actor.values_in(&row(observation, &beside[end.slot]), &[end.slot], &mut value).expect("a value");
                truncation_values[end.slot] = value[0];
            }
        }
        let step = RolloutStep {
            observations: &inputs,
            starts: &starts,
            actions: &acts.actions,
            log_probs: &acts.log_probs,
            values: &acts.values,
            rewards: &reply.rewards,
            terminated: &reply.terminated,
            truncated: &reply.truncated,
            truncation_values: &truncation_values,
        };
        rollout.push(step).expect("a step that fits");
        starts.fill(false);
        for end in &reply.ended {
            actor.forget(end.slot);
            beside[end.slot].fill(0.0);
            starts[end.slot] = true;
        }
    }
    let mut values = Vec::new();
    actor.values(&rows(&reply.observations, &beside), &mut values).expect("values");
    rollout.finish(&values).expect("a full rollout");
    rollout
}

#[test]
fn trial_of_one_episode_equals_longer_inputs() {
    let server = [server()];
    let servers = connect(&server);
    // Falls end episodes of CartPole, and the limit of 200 steps ends episodes of Pendulum.
    for (environment, size, action, n_steps) in [("CartPole", 4, TWO, 60), ("Pendulum", 3, ONE, 210)] {
        let options = options(environment, N_ENVS, 1);
        let policy = policy(size, action);
        let expected = extended_by_hand(&servers, &options, &policy, n_steps);
        let mut rollout = RolloutBuffer::new(n_steps, N_ENVS, policy.spec().observation_size, 1);
        let (mut session, mut collector) = collector(&servers, &options, &policy);
        collector
            .collect(&mut session, policy.flat_weights(), CollectUntil::Steps(n_steps), &mut rollout, |_| {})
            .expect("a rollout");
        assert!(rollout.starts()[N_ENVS..].contains(&true), "an episode has ended");
        assert_eq!(contents(&rollout), contents(&expected), "{environment}");
        for which in 0..2 {
            let updated = |rollout: &RolloutBuffer| {
                let mut policy = moved(policy.spec());
                let [a2c, ppo] = bases(n_steps, 3, &policy);
                let stats = [a2c, ppo][which].update(&mut policy, rollout, 1.0);
                (stats.expect("an update"), policy.weights())
            };
            assert_eq!(updated(&rollout), updated(&expected), "{environment}");
        }
    }
}

/// Rollouts of one step each, so that their `memory` is the memory before each step; and the ended episodes with the
/// steps in which they ended.
struct Steps {
    rollouts: Vec<RolloutBuffer>,
    ended: Vec<(usize, EndedEpisode)>,
}

impl Steps {
    fn collect(environment: &str, policy: &TrainablePolicy, episodes_per_trial: u32, n_steps: usize) -> Self {
        let server = [server()];
        let servers = connect(&server);
        let options = options(environment, N_ENVS, episodes_per_trial);
        let (mut session, mut collector) = collector(&servers, &options, policy);
        let mut steps = Steps { rollouts: Vec::new(), ended: Vec::new() };
        for t in 0..n_steps {
            let mut rollout = RolloutBuffer::new(1, N_ENVS, policy.spec().observation_size, 1);
            let on_episode = |episode: &EndedEpisode| steps.ended.push((t, episode.clone()));
            let one = CollectUntil::Steps(1);
            collector.collect(&mut session, policy.flat_weights(), one, &mut rollout, on_episode).expect("a rollout");
            steps.rollouts.push(rollout);
        }
        steps
    }

    /// Returns the episode of environment n that ended in step t, if any.
    fn ended(&self, t: usize, n: usize) -> Option<&EndedEpisode> {
        self.ended.iter().find(|(at, episode)| (*at, episode.slot) == (t, n)).map(|(_, episode)| episode)
    }
}

#[test]
fn memory_lasts_for_a_trial() {
    for (environment, size, action, n_steps) in [("CartPole", 4, TWO, 150), ("Pendulum", 3, ONE, 410)] {
        let policy = policy(size, action);
        let steps = Steps::collect(environment, &policy, 2, n_steps);
        let mut trials = 0;
        let mut inner = 0;
        for (t, rollout) in steps.rollouts.iter().enumerate() {
            let trajectories = rollout.trajectories().expect("a finished rollout");
            for n in 0..N_ENVS {
                let before = t.checked_sub(1).and_then(|t| steps.ended(t, n));
                let trial_starts = t == 0 || before.is_some_and(|episode| episode.episode_in_trial == 1);
                let inner_start = before.is_some_and(|episode| episode.episode_in_trial == 0);
                (trials, inner) = (trials + usize::from(trial_starts), inner + usize::from(inner_start));
                assert_eq!(rollout.starts()[n], trial_starts, "{environment} step {t}");
                let memory = &rollout.memory()[n * 12..][..12];
                assert_eq!(memory.iter().all(|&x| x == 0.0), trial_starts, "{environment} step {t}: {memory:?}");
                let width = policy.spec().observation_size;
                let input = &rollout.observations()[n * width..][..width];
                let done = input[width - 1];
                assert_eq!(done, as_bits(inner_start), "only ends within a trial are told");
                let last = &input[size..width - 1];
                assert_eq!(last.iter().all(|&x| x == 0.0), trial_starts, "{environment} step {t}: {last:?}");

                let ends = steps.ended(t, n).filter(|episode| episode.episode_in_trial == 1);
                let flags = (trajectories.terminated[n], trajectories.truncated[n]);
                let limit = environment == "Pendulum";
                let expected = ends.map_or((false, false), |_| (!limit, limit));
                assert_eq!(flags, expected, "ends within a trial are none for the update");
                assert_eq!(trajectories.truncation_values[n] != 0.0, flags.1);
            }
        }
        assert!(trials > N_ENVS && inner >= N_ENVS, "{environment}: {trials} {inner}");
    }
}

#[test]
fn a_trial_is_in_one_environment_and_the_next_in_another() {
    let policy = policy(4, TWO);
    let ended = Steps::collect("CartPole", &policy, 2, 150).ended;
    let mut compared = [0, 0];
    for n in 0..N_ENVS {
        let own: Vec<&EndedEpisode> = ended.iter().map(|(_, e)| e).filter(|episode| episode.slot == n).collect();
        for pair in own.windows(2) {
            let same = pair[0].trial_index == pair[1].trial_index;
            assert_eq!(pair[0].receipt == pair[1].receipt, same, "{pair:?}");
            compared[usize::from(same)] += 1;
        }
    }
    assert!(compared.iter().all(|&count| count >= N_ENVS), "{compared:?}");
}

#[test]
fn advantages_run_across_the_episodes_of_a_trial() {
    let server = [server()];
    let servers = connect(&server);
    let policy = policy(4, TWO);
    let mut rollout = RolloutBuffer::new(150, N_ENVS, policy.spec().observation_size, 1);
    let (mut session, mut collector) = collector(&servers, &options("CartPole", N_ENVS, 2), &policy);
    let mut lengths: [Vec<(u32, u32)>; N_ENVS] = Default::default();
    let on_episode = |end: &EndedEpisode| lengths[end.slot].push((end.length, end.episode_in_trial));
    let steps = CollectUntil::Steps(150);
    collector.collect(&mut session, policy.flat_weights(), steps, &mut rollout, on_episode).expect("a rollout");
    let trajectories = rollout.trajectories().expect("a finished rollout");
    let gamma = 0.9;
    let values = rollout.values();
    let one_step = gae(&trajectories, gamma, 0.0, true).advantages;
    let all_steps = gae(&trajectories, gamma, 1.0, true).advantages;
    let mut inner = 0;
    let mut outer = 0;
    for (n, lengths) in lengths.iter().enumerate() {
        let mut end = 0;
        for &(length, episode_in_trial) in lengths {
            end += length as usize;
            let place = (end - 1) * N_ENVS + n;
            let next = place + N_ENVS;
            if end == rollout.n_steps() {
                continue; // the next value is in the next rollout
            }
            let value = f64::from(values[place]);
            let reward = 1.0; // CartPole pays 1 per step
            // The tolerance is the f32 rounding of numbers below 16.
            let close = |got: f32, expected: f64| (f64::from(got) - expected).abs() < 2e-6;
            if episode_in_trial == 0 {
                inner += 1;
                let delta = reward + gamma * f64::from(values[next]) - value;
                assert!(close(one_step[place], delta), "the value of the next episode's first input");
                assert!(close(all_steps[place], delta + gamma * f64::from(all_steps[next])), "and all that follows");
            } else {
                outer += 1;
                assert!(close(one_step[place], reward - value) && close(all_steps[place], reward - value));
            }
        }
    }
    assert!(inner >= N_ENVS && outer >= N_ENVS, "{inner} {outer}");
}

/// Returns a checkpoint of RL² on CartPole whose LSTM has four hand-made cells:
///
/// - the first counts the ended episodes n of the trial: h = tanh n;
/// - the second has the side to which the pole leans and falls;
/// - the third holds the last reward r: h = tanh tanh r;
/// - the fourth is on if the trial has an earlier step.
///
/// The policy balances the pole if n = 1 and r = 0.1, which is a normalised reward of 1. Otherwise it pushes to one
/// side until the pole falls.
fn balancing_in_the_second_episode(servers: &Servers) -> Checkpoint {
    let settings = "environment = 'CartPole'\nalgorithm = 'rl2-a2c'\nepisodes = 1\nnum_envs = 2";
    let config = TrainConfig::from_table("the test", settings.parse().expect("TOML")).expect("a configuration");
    let out = tempfile::tempdir().expect("a directory");
    let directory = RunDirectory::choose(out.path(), false).expect("an empty directory");
    let outcome = train(servers, &config, &directory, 1, &StopFlag::default(), |_| {}).expect("a training");
    let mut checkpoint = outcome.checkpoint;
    assert_eq!(checkpoint.policy.observation_size, 4 + 2 + 1 + 1);
    let spec = PolicySpec { hidden: vec![], lstm: Some(4), ..checkpoint.policy.clone() };
    let mut weights = TrainablePolicy::new(spec.clone(), 1).expect("a policy").weights();
    let counting = 1e6f32;
    let rewarded = 1e6f32;
    for array in &mut weights {
        array.data.fill(0.0);
        match array.name.as_str() {
            // Rows are the gates i, f, g and o, with four cells each. Columns are the inputs x, v, θ, ω, two actions, the
            // last reward, and whether the last step ended an episode.
            "lstm.input.weight" => {
                array.data[8 * 8 + 7] = 20.0;
                array.data[9 * 8..][..4].copy_from_slice(&[0.0, 0.0, 5.0, 5.0]);
                array.data[10 * 8 + 6] = 1.0;
            }
            // The first cell's input gate opens if the fourth cell remembers a step.
            "lstm.recurrent.weight" => array.data[3] = 40.0,
            // All other input gates are open, and the second and third cell forget.
            "lstm.bias" => {
                let i = [-20.0, 20.0, 20.0, 20.0];
                let f = [20.0, -20.0, -20.0, 20.0];
                array.data = [i, f, [0.0, 0.0, 0.0, 20.0], [20.0; 4]].concat();
            }
            "policy.weight" => array.data[4..].copy_from_slice(&[counting, 1e3, rewarded, 0.0]),
            "policy.bias" => array.data[1] = -counting * 1f32.tanh() - rewarded * 0.1f32.tanh().tanh(),
            _ => {}
        }
    }
    checkpoint.weights = weights;
    checkpoint.policy = spec;
    checkpoint.state.observation_normaliser = None;
    // The variance of rewards is 100, so a reward of 1 is normalised to 0.1.
    let moments = serde_json::json!({ "count": 2, "mean": [0.0], "squares": [200.0] });
    let normaliser = serde_json::json!({ "gamma": 0.99, "returns": [0.0, 0.0], "moments": moments });
    checkpoint.state.reward_normaliser = Some(serde_json::from_value(normaliser).expect("a normaliser"));
    checkpoint
}

#[test]
fn tests_count_the_last_episode_of_each_trial() {
    let both = [server(), server()];
    let one = connect(&both[..1]);
    let two = connect(&both);
    let checkpoint = balancing_in_the_second_episode(&one);
    let figures_of = |servers: &Servers, checkpoint: &Checkpoint, seed| {
        // There are more than 100 trials, so that environments play more than one trial each.
        test(servers, checkpoint, Version::D, 250, seed, &StopFlag::default(), |_| {}).expect("a test")
    };
    let figures = |servers: &Servers, checkpoint: &Checkpoint| figures_of(servers, checkpoint, 1);
    let result = figures(&one, &checkpoint);
    // The first episode of a trial ends within a dozen steps, and the second lasts for nearly 200 steps.
    assert!(result.mean_length > 150.0, "{result:?}");
    assert_eq!(result.episodes, 250);
    assert_eq!(figures(&two, &checkpoint), result);

    let raw = &mut checkpoint.clone();
    raw.state.reward_normaliser = None;
    assert!(figures(&one, raw).mean_length < 15.0, "the reward is no longer what the policy knows");
    // The time until a pole falls depends on the start of the episode, and so on the seed.
    assert_eq!(figures(&two, raw), figures(&one, raw));
    assert_ne!(figures_of(&one, raw, 2), figures(&one, raw));
    let single = &mut checkpoint.clone();
    single.state.config.settings.wrapper = settings::Wrapper::Rl2(settings::Rl2Config { episodes_per_trial: 1 });
    assert!(figures(&one, single).mean_length < 15.0, "there is no second episode");
}

const ARMS: usize = 16;
/// Number of steps in an episode. Each step is a choice of one arm.
const EPISODE: usize = 3;
const TRIAL: usize = 2 * EPISODE;

/// A bandit task with two arms: one pays 1, the other pays nothing. The paying arm is drawn for every trial, and the
/// observation does not show it.
struct Bandits {
    policy: TrainablePolicy,
    actor: Actor,
    inputs: Inputs,
    /// Whether the policy's memory lasts for a whole trial, as with RL². If not, it lasts for an episode.
    by_trial: bool,
    paying: [f32; ARMS],
    start: bool,
    rng: ChaCha8Rng,
    rollout: RolloutBuffer,
}

impl Bandits {
    fn new(rl2: bool, n_trials: usize) -> Self {
        let inputs = Inputs::new(1, TWO, ARMS, rl2);
        let spec = PolicySpec { observation_size: inputs.size(), action: TWO, hidden: vec![16], lstm: Some(16) };
        Bandits {
            policy: TrainablePolicy::new(spec.clone(), 5).expect("a policy"),
            actor: Actor::new(&spec, ARMS),
            rollout: RolloutBuffer::new(n_trials * TRIAL, ARMS, inputs.size(), 1),
            inputs,
            by_trial: rl2,
            paying: [0.0; ARMS],
            start: true,
            rng: stream(5, Purpose::Actions),
        }
    }

    /// Collects a rollout of complete trials. Returns the share of paying steps in the last episodes of the trials.
    fn collect(&mut self) -> f64 {
        self.actor.load(&self.policy.weights()).expect("weights that fit");
        self.rollout.begin(self.actor.memory());
        let mut acts = ActorOutput::new(TWO, ARMS);
        let mut paid = 0.0;
        let mut pulls = 0.0;
        for t in 0..self.rollout.n_steps() {
            if t.is_multiple_of(TRIAL) {
                self.paying = std::array::from_fn(|_| as_bits(uniform(&mut self.rng) < 0.5));
            }
            let inputs = self.inputs.from_observations(&[1.0; ARMS]);
            self.actor.act(inputs, &mut self.rng, &mut acts).expect("actions");
            let rewards: [f32; ARMS] = std::array::from_fn(|n| as_bits(acts.actions[n] == self.paying[n]));
            if t % TRIAL >= EPISODE {
                paid += rewards.iter().map(|&r| f64::from(r)).sum::<f64>();
                pulls += ARMS as f64;
            }
            let episode_ends = (t + 1).is_multiple_of(EPISODE);
            let forgets = if self.by_trial { (t + 1).is_multiple_of(TRIAL) } else { episode_ends };
            let step = RolloutStep {
                observations: inputs,
                starts: &[self.start; ARMS],
                actions: &acts.actions,
                log_probs: &acts.log_probs,
                values: &acts.values,
                rewards: &rewards,
                terminated: &[forgets; ARMS],
                truncated: &[false; ARMS],
                truncation_values: &[0.0; ARMS],
            };
            self.rollout.push(step).expect("a step that fits");
            self.inputs.remember(&acts, &rewards, &[episode_ends; ARMS]).expect("lengths that fit");
            for n in (0..ARMS).filter(|_| forgets) {
                self.actor.forget(n);
                self.inputs.forget(n);
            }
            self.start = forgets;
        }
        self.rollout.finish(&[0.0; ARMS]).expect("a full rollout");
        paid / pulls
    }

    /// Updates the policy `updates` times. Returns the share of paying steps in some 400 more trials.
    fn train(&mut self, algorithm: &mut dyn Algorithm, updates: usize) -> f64 {
        for _ in 0..updates {
            self.collect();
            algorithm.update(&mut self.policy, &self.rollout, 1.0).expect("an update");
        }
        let rollouts = (400 / ARMS).div_ceil(self.rollout.n_steps() / TRIAL);
        (0..rollouts).map(|_| self.collect()).sum::<f64>() / rollouts as f64
    }
}

fn bandits_a2c(policy: &TrainablePolicy) -> A2c {
    let config = A2cConfig { n_steps: TRIAL, learning_rate: 7e-3, ..A2cConfig::default() };
    A2c::new(config, policy).expect("valid settings")
}

// The best share is 1, because the first step of a trial shows which arm pays. A policy that does not see its reward
// reaches at most ½.

#[test]
fn a2c_adapts_within_a_trial() {
    let mut bandits = Bandits::new(true, 1);
    let mut a2c = bandits_a2c(&bandits.policy);
    let share = bandits.train(&mut a2c, 1500);
    assert!(share > 0.9, "{share}");
}

#[test]
fn ppo_adapts_within_a_trial() {
    let mut bandits = Bandits::new(true, 4);
    let config =
        PpoConfig { n_steps: 4 * TRIAL, learning_rate: 3e-3, n_epochs: 5, kl_coef: 0.2, ..PpoConfig::default() };
    let mut ppo = Ppo::new(config, &bandits.policy, 5).expect("valid settings");
    let share = bandits.train(&mut ppo, 100);
    assert!(share > 0.9, "{share}");
}

#[test]
fn without_rl2_it_does_not_adapt() {
    let mut bandits = Bandits::new(false, 1);
    let mut a2c = bandits_a2c(&bandits.policy);
    let share = bandits.train(&mut a2c, 1500);
    // The tolerance is four standard deviations of the mean of 400 numbers that are 0 or 1. It assumes the worst case,
    // that all steps of a trial choose the same arm.
    assert!((share - 0.5).abs() < 0.1, "{share}");
}
