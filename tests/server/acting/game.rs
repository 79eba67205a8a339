//! A policy that plays environments, once on the server and once in a client that chooses the actions itself.

use crate::common::server::{Server, Session, doubles, floats, mixed};
use bytes::Bytes;
use perturb::proto::{
    Act, Acted, AutoresetMode, EndedAt, Environment, Moments, Open, Policy, RandomStream, Reset, RewardMoments, Step,
    TestStreams, Version, act, action_space::Kind, policy::Role,
};
use perturb_policy::{
    self as acting, ActionKind, CollectUntil, Inputs, Normalisers, ObservationNormaliser, Player, PolicySpec,
    RemainingRollout, RewardNormaliser, RunningMoments, SlotEnd, StepOutcome,
    random::{Purpose, stream},
};

/// The seed of the policy's random streams.
pub const SEED: u64 = 77;

/// An environment and a policy, with all settings of the policy that tests vary.
#[derive(Clone, Copy)]
pub struct Game {
    pub environment: &'static str,
    /// N, the number of environments.
    pub n: usize,
    pub per_trial: u32,
    /// The width of the LSTM; 0 for a feed-forward policy.
    pub lstm: u32,
    /// Whether the policy's inputs contain the previous action, reward and end of episode.
    pub outcomes: bool,
    /// Whether observations and rewards are normalised.
    pub normalised: bool,
    pub testing: bool,
    /// Whether observations contain the parameters.
    pub sees: bool,
}

/// A training with all features: recurrent policy, RL², normalisation; in CartPole.
pub const FULL: Game = Game {
    environment: "CartPole",
    n: 5,
    per_trial: 2,
    lstm: 6,
    outcomes: true,
    normalised: true,
    testing: false,
    sees: false,
};

/// A small feed-forward policy without normalisation in CartPole.
pub const PLAIN: Game = Game { per_trial: 1, lstm: 0, outcomes: false, normalised: false, ..FULL };

/// The number of samples in the normalisers' initial statistics.
const SEEN: u64 = 100;
const GAMMA: f64 = 0.99;

impl Game {
    pub fn open(self) -> Open {
        Open {
            environment: self.environment.into(),
            version: Version::Random.into(),
            batch_size: self.n as u32,
            seed: 3,
            first_environment_index: 40,
            episodes_per_trial: self.per_trial,
            autoreset_mode: AutoresetMode::SameStep.into(),
            receipts: true,
            observe_parameters: self.sees,
            ..Open::default()
        }
    }

    fn inputs(self, environment: &Environment) -> Inputs {
        Inputs::new(environment.observation.len(), kind(environment), self.n, self.outcomes)
    }

    pub fn spec(self, environment: &Environment) -> PolicySpec {
        PolicySpec {
            observation_size: self.inputs(environment).size(),
            action: kind(environment),
            hidden: vec![9, 7],
            lstm: (self.lstm > 0).then_some(self.lstm as usize),
        }
    }

    /// Returns the weights of a policy. Each weight is a function of its index and of `version` only.
    pub fn weights(self, environment: &Environment, version: u64) -> Vec<f32> {
        let weight = |i| (mixed(mixed(i) ^ version) >> 40) as f32 / (1 << 24) as f32 * 1.6 - 0.8;
        (0..self.spec(environment).n_weights() as u64).map(weight).collect()
    }

    /// Whether the normaliser's return continues over the ends of episodes: true for feed-forward policies.
    fn return_runs_on(self) -> bool {
        self.lstm == 0
    }

    fn normalisers(self, environment: &Environment) -> Normalisers {
        if !self.normalised {
            return Normalisers::default();
        }
        let parameters = if self.sees { environment.parameters.len() } else { 0 };
        let size = environment.observation.len() - parameters;
        let moments = |size| RunningMoments::from_parts(SEEN, vec![0.05; size], vec![80.0; size]);
        Normalisers {
            observations: Some(ObservationNormaliser::from_moments(moments(size)).leaving_alone(parameters)),
            rewards: Some(
                RewardNormaliser::from_parts(GAMMA, vec![0.0; self.n], moments(1)).running_on(self.return_runs_on()),
            ),
        }
    }

    /// Returns the policy as a client sends it.
    pub fn policy(self, environment: &Environment) -> Policy {
        let of = |size: usize| Moments {
            count: SEEN,
            mean: doubles(&vec![0.05; size]),
            squares: doubles(&vec![80.0; size]),
        };
        let parameters = if self.sees { environment.parameters.len() } else { 0 };
        let rewards = || RewardMoments {
            gamma: GAMMA,
            returns: doubles(&vec![0.0; self.n]),
            moments: Some(of(1)),
            runs_on: self.return_runs_on(),
        };
        let role = if self.testing {
            Role::Testing(TestStreams { seed: SEED })
        } else {
            let actions = stream(SEED, Purpose::Actions);
            let (key, stream) = (actions.get_seed().to_vec().into(), actions.get_stream());
            Role::Training(RandomStream { key, stream, position: 0 })
        };
        Policy {
            hidden: vec![9, 7],
            lstm: self.lstm,
            outcomes: self.outcomes,
            observations: self.normalised.then(|| of(environment.observation.len() - parameters)),
            rewards: self.normalised.then(rewards),
            role: Some(role),
            state: None,
        }
    }

    /// Returns a request to play `task` with a new policy.
    pub fn act(self, environment: &Environment, task: act::Task) -> Act {
        Act {
            policy: Some(self.policy(environment)),
            weights: wire(&self.weights(environment, 0)),
            task: Some(task),
            ..Act::default()
        }
    }

    /// Opens a session with the game's environments.
    pub async fn session(self, server: &Server) -> (Session, Environment) {
        let (session, opened) = Session::open(server.unix(), self.open()).await;
        (session, opened.environment.unwrap())
    }
}

pub fn kind(environment: &Environment) -> ActionKind {
    match environment.action.as_ref().unwrap().kind.as_ref().unwrap() {
        Kind::Discrete(space) => ActionKind::Discrete { n: space.names.len() },
        Kind::Continuous(space) => ActionKind::Continuous { size: space.channels.len() },
    }
}

/// Encodes f32 values as little-endian bytes.
pub fn wire(numbers: &[f32]) -> Bytes {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}

/// A client that chooses the actions itself and sends ordinary steps.
pub struct Client {
    game: Game,
    session: Session,
    environment: Environment,
    pub player: Player,
}

impl Client {
    pub async fn begin(game: Game, server: &Server) -> Self {
        let (session, opened) = Session::open(server.unix(), game.open()).await;
        let role = if game.testing {
            acting::PlayerRole::testing(SEED, game.open().first_environment_index, game.n)
        } else {
            acting::PlayerRole::training(SEED)
        };
        let environment = opened.environment.unwrap();
        let (spec, inputs) = (game.spec(&environment), game.inputs(&environment));
        let normalisers = game.normalisers(&environment);
        let mut player = Player::new(&spec, inputs, game.n, game.per_trial, normalisers, role);
        player.begin(&floats(&opened.observations), None).unwrap();
        Self { game, session, environment, player }
    }

    /// Plays a task with the weights of `version`. Returns the reply that the server should give to the same task.
    pub async fn play(&mut self, version: u64, task: CollectUntil) -> Acted {
        let Self { game, session, environment, player } = self;
        player.load(&game.weights(environment, version)).unwrap();
        let mut task = task.begin(game.n);
        if let RemainingRollout::Episodes(_) = task {
            let reset = session.ask(Reset::default()).await;
            player.begin(&floats(&reset.observations), Some(&task)).unwrap();
            for start in reset.started.iter().filter(|_| game.testing) {
                player.begin_trial(start.slot as usize, SEED, start.episode.unwrap().trial_index);
            }
        }
        let mut played = Rollout { memory: wire(player.memory()).to_vec(), ..Rollout::default() };
        while !task.is_done() {
            let actions = Bytes::copy_from_slice(player.act().unwrap());
            let stepped = session.ask(Step { actions: actions.clone() }).await;
            let ended: Vec<SlotEnd> = stepped.ended.iter().map(ended).collect();
            let flags = |bytes: &Bytes| bytes.iter().map(|&flag| flag == 1).collect::<Vec<bool>>();
            let (terminated, truncated) = (flags(&stepped.terminated), flags(&stepped.truncated));
            let outcome = StepOutcome {
                observations: &floats(&stepped.observations),
                rewards: &floats(&stepped.rewards),
                terminated: &terminated,
                truncated: &truncated,
                final_observations: &floats(&stepped.final_observations),
                ended: &ended,
            };
            task.advance(ended.iter().map(|end| end.slot));
            player.observe(&outcome, Some(&task)).unwrap();
            for end in stepped.ended.into_iter().filter(|end| task.counts(end.slot as usize)) {
                let slot = end.slot as usize;
                let (terminated, truncated) = (terminated[slot], truncated[slot]);
                played.ended.push(EndedAt { step: played.steps, end: Some(end), terminated, truncated });
            }
            played.push(player, &actions);
        }
        played.last_values = wire(player.last_values(&task).unwrap()).to_vec();
        played.finish()
    }
}

fn ended(end: &perturb::proto::EpisodeEnd) -> SlotEnd {
    let episode = end.episode.unwrap();
    SlotEnd { slot: end.slot as usize, trial_index: episode.trial_index, episode_in_trial: episode.episode_in_trial }
}

/// The arrays of an [`Acted`], collected step by step.
#[derive(Default)]
struct Rollout {
    steps: u32,
    ended: Vec<EndedAt>,
    arrays: [Vec<u8>; 9],
    memory: Vec<u8>,
    last_values: Vec<u8>,
}

impl Rollout {
    fn push(&mut self, player: &Player, actions: &[u8]) {
        let step = player.played();
        let flags = |flags: &[bool]| flags.iter().map(|&flag| u8::from(flag)).collect::<Bytes>();
        let arrays = [
            wire(step.observations),
            flags(step.starts),
            Bytes::copy_from_slice(actions),
            wire(step.log_probs),
            wire(step.values),
            wire(step.rewards),
            flags(step.terminated),
            flags(step.truncated),
            wire(step.truncation_values),
        ];
        self.arrays.iter_mut().zip(arrays).for_each(|(all, array)| all.extend_from_slice(&array));
        self.steps += 1;
    }

    fn finish(self) -> Acted {
        let [observations, starts, actions, log_probs, values, rewards, terminated, truncated, truncation_values] =
            self.arrays.map(Bytes::from);
        Acted {
            steps: self.steps,
            observations,
            starts,
            actions,
            log_probs,
            values,
            rewards,
            terminated,
            truncated,
            truncation_values,
            ended: self.ended,
            finished: true,
            last_values: self.last_values.into(),
            memory: self.memory.into(),
        }
    }
}

/// Has the server play a task to its end. Returns the joined replies, and their number.
pub async fn play(session: &mut Session, act: Act) -> (Acted, usize) {
    let (most_steps, only_ended) = (act.most_steps, act.only_ended);
    let mut all = session.ask(act).await;
    let mut replies = 1;
    while !all.finished {
        assert_eq!(all.last_values.len(), 0, "values come with the last reply");
        let next = session.ask(Act { most_steps, only_ended, ..Act::default() }).await;
        assert_eq!(next.memory.len(), 0, "a memory comes with the first reply");
        assert!(next.steps > 0, "every reply brings something");
        let join = |a: &Bytes, b: &Bytes| Bytes::from([&a[..], &b[..]].concat());
        let later = |end: EndedAt| EndedAt { step: all.steps + end.step, ..end };
        let ended = all.ended.iter().cloned().chain(next.ended.into_iter().map(later)).collect();
        all = Acted {
            steps: all.steps + next.steps,
            observations: join(&all.observations, &next.observations),
            starts: join(&all.starts, &next.starts),
            actions: join(&all.actions, &next.actions),
            log_probs: join(&all.log_probs, &next.log_probs),
            values: join(&all.values, &next.values),
            rewards: join(&all.rewards, &next.rewards),
            terminated: join(&all.terminated, &next.terminated),
            truncated: join(&all.truncated, &next.truncated),
            truncation_values: join(&all.truncation_values, &next.truncation_values),
            ended,
            finished: next.finished,
            last_values: next.last_values,
            memory: all.memory,
        };
        replies += 1;
    }
    (all, replies)
}
