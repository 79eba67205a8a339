//! Tests of EPOpt: complete episodes are collected without bias and packed without loss, and only the worst are learned
//! from.

use std::collections::{BTreeMap, HashSet};

use perturb_learner::algorithm::{
    A2c, Algorithm, AlgorithmState, BaseAlgorithm, EpisodeSelection, Epopt, Ppo, UpdateStats, gae, n_step_returns,
};
use perturb_learner::client::{ClientSession, EndedEpisode, PrivateServer};
use perturb_learner::error::Error;
use perturb_learner::policy::TrainablePolicy;
use perturb_learner::rollout::{
    Collector, EpisodeSlice, Estimates, Normalisers, RolloutBuffer, RolloutStep, Trajectories,
};
use perturb_policy::random::{Purpose, normal, stream, uniform};
use perturb_policy::{
    ActionKind, Actor, ActorOutput, CollectUntil, Inputs, ObservationNormaliser, Player, PlayerRole, PolicySpec,
    RewardNormaliser,
};
use perturb_settings::{A2cConfig, EpoptConfig, PpoConfig, Ranking};
use perturb_torch::{Sequences, TorchPolicy};

use crate::common::{bases, connect, contents, moved, options, server};
use proptest::prelude::*;
use rand_chacha::ChaCha8Rng;
use rstest::rstest;
use tch::{Kind, Tensor};

const O: usize = 3;
const DISCRETE: ActionKind = ActionKind::Discrete { n: 3 };
const CONTINUOUS: ActionKind = ActionKind::Continuous { size: 2 };

fn spec(action: ActionKind, lstm: Option<usize>) -> PolicySpec {
    perturb_torch::register();
    PolicySpec { observation_size: O, action, hidden: vec![8], lstm }
}

fn noise(count: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    (0..count).map(|_| normal(rng) as f32).collect()
}

/// Fills `rollout` with episodes of random numbers. Successive episodes of environment n have the lengths `lengths[n]`
/// and the returns `returns[n]`. An environment that has played all its episodes is stepped further, outside of any
/// episode, until the others have ended. The task ends about half of the episodes, and the step limit ends the others.
fn play(
    policy: &TrainablePolicy,
    lengths: &[Vec<usize>],
    returns: &[Vec<f64>],
    mut rollout: RolloutBuffer,
) -> RolloutBuffer {
    let action = policy.spec().action;
    let n_envs = lengths.len();
    let mut rng = stream(7, Purpose::Actions);
    let mut actor = Actor::new(policy.spec(), n_envs);
    actor.load(&policy.weights()).expect("weights that fit");
    let mut acts = ActorOutput::new(action, n_envs);
    rollout.begin(actor.memory());
    let mut episodes = vec![0; n_envs];
    let mut ages = vec![0; n_envs];
    let n_steps = lengths.iter().map(|lengths| lengths.iter().sum::<usize>()).max().unwrap_or(0);
    for _ in 0..n_steps {
        let observations = noise(n_envs * O, &mut rng);
        actor.act(&observations, &mut rng, &mut acts).expect("actions");
        let starts: Vec<bool> = ages.iter().map(|&age| age == 0).collect();
        ages.iter_mut().for_each(|age| *age += 1);
        let ended: Vec<bool> = (0..n_envs).map(|n| lengths[n].get(episodes[n]) == Some(&ages[n])).collect();
        let truncated: Vec<bool> = ended.iter().map(|&ended| ended && uniform(&mut rng) < 0.5).collect();
        let terminated: Vec<bool> = ended.iter().zip(&truncated).map(|(&ended, &limit)| ended && !limit).collect();
        let step = RolloutStep {
            observations: &observations,
            starts: &starts,
            actions: &acts.actions,
            log_probs: &acts.log_probs,
            values: &acts.values,
            rewards: &noise(n_envs, &mut rng),
            terminated: &terminated,
            truncated: &truncated,
            truncation_values: &noise(n_envs, &mut rng),
        };
        rollout.push(step).expect("a step that fits");
        for n in (0..n_envs).filter(|&n| ended[n]) {
            rollout
                .note_episode(n, rollout.len(), ages[n], returns[n][episodes[n]])
                .expect("an episode of the rollout");
            (episodes[n], ages[n]) = (episodes[n] + 1, 0);
            actor.forget(n);
        }
    }
    rollout.finish(&vec![9.0; n_envs]).expect("values that fit"); // estimates must not depend on these values
    rollout
}

/// Gives all episodes the return 0, for tests in which returns do not matter.
fn zeros(lengths: &[Vec<usize>]) -> Vec<Vec<f64>> {
    lengths.iter().map(|lengths| vec![0.0; lengths.len()]).collect()
}

fn of_episodes(spec: &PolicySpec, n_envs: usize) -> RolloutBuffer {
    RolloutBuffer::of_episodes(n_envs, O, spec.action.width())
}

fn epopt(base: Box<dyn BaseAlgorithm>, epsilon: f64, full_iterations: u64) -> Epopt {
    let config = EpoptConfig { episodes_per_iteration: 8, epsilon, full_iterations, ..EpoptConfig::default() };
    Epopt::new(config, base).expect("valid settings")
}

#[test]
fn epopt_with_epsilon_1_equals_its_base() {
    let lengths = vec![vec![9]; 6]; // a rollout without padding
    for (lstm, action) in [(None, DISCRETE), (None, CONTINUOUS), (Some(8), DISCRETE), (Some(8), CONTINUOUS)] {
        let spec = spec(action, lstm);
        for which in 0..2 {
            let mut plain = moved(&spec);
            let mut wrapped = moved(&spec);
            let [a2c, ppo] = bases(9, 2, &plain);
            let mut base = if which == 0 { a2c } else { ppo };
            let [a2c, ppo] = bases(9, 2, &wrapped);
            let mut epopt = epopt(if which == 0 { a2c } else { ppo }, 1.0, 0);
            for _ in 0..3 {
                let fixed = RolloutBuffer::new(9, 6, O, action.width());
                let fixed = play(&plain, &lengths, &zeros(&lengths), fixed);
                let complete = play(&wrapped, &lengths, &zeros(&lengths), of_episodes(&spec, 6));
                let expected = base.update(&mut plain, &fixed, 1.0).expect("an update");
                let got = epopt.update(&mut wrapped, &complete, 1.0).expect("an update");
                assert_eq!(got.selection.map(|selection| (selection.kept, selection.kept_steps)), Some((6, 54)));
                assert_eq!(UpdateStats { selection: None, ..got }, expected, "{lstm:?} {action:?}");
                assert_eq!(wrapped.weights(), plain.weights(), "{lstm:?} {action:?}");
            }
        }
    }
}

/// Returns lengths and returns of eight episodes of unequal lengths. The worst four have the returns -1, 0, 1 and 2.
fn eight() -> (Vec<Vec<usize>>, Vec<Vec<f64>>) {
    let lengths = vec![vec![3, 7], vec![9, 2], vec![4, 4], vec![1, 6]];
    let returns = vec![vec![5.0, -1.0], vec![0.0, 3.0], vec![8.0, 2.0], vec![1.0, 7.0]];
    (lengths, returns)
}

#[test]
fn epopt_learns_only_from_the_worst_episodes() {
    let (lengths, returns) = eight();
    let span = |environment, start, length, episode_return| EpisodeSlice { environment, start, length, episode_return };
    // The episodes are in the order in which they ended.
    let worst = [span(3, 0, 1, 1.0), span(2, 4, 4, 2.0), span(1, 0, 9, 0.0), span(0, 3, 7, -1.0)];
    for lstm in [None, Some(8)] {
        let spec = spec(DISCRETE, lstm);
        for which in 0..2 {
            let start = || {
                let policy = moved(&spec);
                let [a2c, ppo] = bases(1, 1, &policy);
                let rollout = play(&policy, &lengths, &returns, of_episodes(&spec, 4));
                (if which == 0 { a2c } else { ppo }, policy, rollout)
            };
            let of_chosen = |chosen: Option<&[EpisodeSlice]>| {
                let (mut base, mut policy, rollout) = start();
                let packed = rollout.select(chosen.unwrap_or(rollout.episodes())).expect("its own episodes");
                (base.update(&mut policy, &packed, 1.0).expect("an update"), policy.weights())
            };
            let (expected, expected_weights) = of_chosen(Some(&worst));
            let (_, weights_of_all) = of_chosen(None);
            let (base, mut policy, rollout) = start();
            let stats = epopt(base, 0.5, 0).update(&mut policy, &rollout, 1.0).expect("an update");
            assert_eq!(UpdateStats { selection: None, ..stats }, expected, "{lstm:?}");
            assert_eq!(policy.weights(), expected_weights, "{lstm:?}");
            assert_ne!(policy.weights(), weights_of_all, "the better half would matter");
            let expected =
                EpisodeSelection { epsilon: 0.5, kept: 4, kept_steps: 21, mean_return: 25.0 / 8.0, cvar: 0.5 };
            assert_eq!(stats.selection, Some(expected));
        }
    }
}

#[test]
fn epopt_can_rank_by_normalised_rewards() {
    let (lengths, returns) = eight();
    let spec = spec(DISCRETE, None);
    let mut policy = moved(&spec);
    let rollout = play(&policy, &lengths, &returns, of_episodes(&spec, 4));
    let learned = rollout.normalized_returns();
    let rewards = rollout.trajectories().expect("a finished rollout").rewards;
    let last = rollout.episodes()[7]; // the second episode of environment 1
    let sum: f64 = (9..11).map(|t| f64::from(rewards[4 * t + 1])).sum();
    assert_eq!((last.environment, last.length, learned[7]), (1, 2, sum));
    let mut ranked: Vec<usize> = (0..8).collect();
    ranked.sort_by(|&a, &b| learned[a].total_cmp(&learned[b]));
    let worst: u64 = ranked[..4].iter().map(|&i| rollout.episodes()[i].length as u64).sum();
    assert_ne!(worst, 21, "those of the worst returns");
    let config = EpoptConfig { epsilon: 0.5, full_iterations: 0, rank_by: Ranking::Normalized, ..Default::default() };
    let [a2c, _] = bases(1, 1, &policy);
    let stats = Epopt::new(config, a2c).expect("settings").update(&mut policy, &rollout, 1.0).expect("an update");
    assert_eq!(stats.selection.map(|selection| (selection.kept, selection.kept_steps)), Some((4, worst)));
}

#[test]
fn each_kept_episode_can_have_an_update_of_its_own() {
    let (lengths, returns) = eight();
    for lstm in [None, Some(8)] {
        let spec = spec(DISCRETE, lstm);
        for which in 0..2 {
            let base = |policy: &TrainablePolicy| {
                let [a2c, ppo] = bases(1, 1, policy);
                if which == 0 { a2c } else { ppo }
            };
            let mut policy = moved(&spec);
            let rollout = play(&policy, &lengths, &returns, of_episodes(&spec, 4));
            let mut worst: Vec<EpisodeSlice> = rollout.episodes().to_vec();
            worst.retain(|span| span.episode_return < 3.0);
            let alone: Vec<RolloutBuffer> =
                worst.iter().map(|span| rollout.select(&[*span]).expect("an episode")).collect();

            let config =
                EpoptConfig { epsilon: 0.5, full_iterations: 0, update_per_episode: true, ..Default::default() };
            let mut epopt = Epopt::new(config, base(&policy)).expect("valid settings");
            let stats = epopt.update(&mut policy, &rollout, 1.0).expect("an update");
            let epochs = [1, 3][which];
            assert_eq!(stats.n_updates, 4 * epochs, "a step for each episode and epoch");

            let mut other = moved(&spec);
            let mut each = base(&other);
            let parts: Vec<&RolloutBuffer> = alone.iter().collect();
            let expected = each.update_many(&mut other, &parts, 1.0).expect("an update");
            assert_eq!(policy.weights(), other.weights(), "{lstm:?}");
            assert_eq!(UpdateStats { selection: None, ..stats }, expected, "{lstm:?}");
            let mut other = moved(&spec);
            let mut each = base(&other);
            let mut update = |part| each.update(&mut other, part, 1.0).expect("an update");
            let steps: Vec<UpdateStats> = alone.iter().map(&mut update).collect();
            let one_after_the_other = policy.weights() == other.weights();
            assert_eq!(one_after_the_other, which == 0, "PPO takes an epoch on all before the next");

            let figures: [fn(&UpdateStats) -> f64; 4] =
                [|it| it.entropy_loss, |it| it.value_loss, |it| it.loss, |it| it.grad_norm];
            // With PPO, a joint update takes its steps in another order than successive updates. So its losses are
            // computed with other weights, and only the entropy hardly changes.
            let (count, share) = [(4, 1e-9), (1, 0.1)][which];
            for figure in &figures[..count] {
                let mean = steps.iter().map(figure).sum::<f64>() / 4.0;
                assert!((figure(&stats) - mean).abs() < share * mean.abs(), "a mean over all steps: {stats:?} {mean}");
            }
            let together = rollout.select(&worst).expect("its own episodes");
            let mut other = moved(&spec);
            let whole = base(&other).update(&mut other, &together, 1.0).expect("an update");
            let explained = [stats, whole].map(|it| it.explained_variance.expect("returns that vary"));
            assert!((explained[0] - explained[1]).abs() < 1e-5, "of all episodes, up to rounding: {explained:?}");
        }
    }
}

#[test]
fn an_epoch_of_ppo_is_a_round_of_all_kept_episodes() {
    let (lengths, returns) = eight();
    for lstm in [None, Some(8)] {
        let spec = spec(DISCRETE, lstm);
        let rollout = play(&moved(&spec), &lengths, &returns, of_episodes(&spec, 4));
        let select = |span: &EpisodeSlice| rollout.select(&[*span]).expect("an episode");
        let alone: Vec<RolloutBuffer> = rollout.episodes().iter().map(select).collect();
        let parts: Vec<&RolloutBuffer> = alone.iter().collect();
        let after = |updates: usize, n_epochs: usize| {
            let mut policy = moved(&spec);
            let config = PpoConfig { n_epochs, learning_rate: 3e-3, ..PpoConfig::default() };
            let mut ppo = Ppo::new(config, &policy, 1).expect("valid settings");
            for _ in 0..updates {
                ppo.update_many(&mut policy, &parts, 1.0).expect("an update");
            }
            policy.weights()
        };
        assert_eq!(after(1, 3), after(3, 1), "{lstm:?}");
    }
}

#[test]
fn epsilon_falls_after_full_iterations_also_when_resumed() {
    let (lengths, returns) = eight();
    let spec = spec(DISCRETE, Some(8));
    for which in 0..2 {
        let fresh = |policy: &TrainablePolicy| {
            let [a2c, ppo] = bases(1, 1, policy);
            epopt(if which == 0 { a2c } else { ppo }, 0.5, 2)
        };
        let run = |resumed_after: Option<usize>| {
            let mut policy = moved(&spec);
            let mut algorithm = fresh(&policy);
            let mut selections = Vec::new();
            for iteration in 0..4 {
                if resumed_after == Some(iteration) {
                    let json = serde_json::to_string(&algorithm.state()).expect("JSON");
                    let state: AlgorithmState = serde_json::from_str(&json).expect("a state");
                    policy = TrainablePolicy::from_weights(spec.clone(), &policy.weights()).expect("a policy");
                    algorithm = fresh(&policy);
                    algorithm.load_state(&state).expect("a state that fits");
                }
                let rollout = play(&policy, &lengths, &returns, of_episodes(&spec, 4));
                let stats = algorithm.update(&mut policy, &rollout, 1.0).expect("an update");
                selections.push(stats.selection.expect("EPOpt's"));
            }
            (selections, policy.weights())
        };
        let whole = run(None);
        let figures: Vec<_> =
            whole.0.iter().map(|s| (s.epsilon, s.kept, s.kept_steps, s.mean_return, s.cvar)).collect();
        let full = (1.0, 8, 36, 3.125, 0.5);
        let half = (0.5, 4, 21, 3.125, 0.5);
        assert_eq!(figures, [full, full, half, half], "the value at risk is always that of the configured share");
        for iteration in 1..4 {
            assert_eq!(run(Some(iteration)), whole, "resumed after {iteration}");
        }
    }
}

/// Returns a rollout in which every number encodes its position: the sample with index p = t·N + n has the observation
/// (p, -p), and its other numbers are functions of p.
fn coded(lengths: &[Vec<usize>]) -> RolloutBuffer {
    let n_envs = lengths.len();
    let mut rollout = RolloutBuffer::of_episodes(n_envs, 2, 1);
    rollout.begin(&vec![1.0; 2 * n_envs]);
    let ends: Vec<Vec<usize>> = lengths
        .iter()
        .map(|lengths| (1..=lengths.len()).map(|count| lengths[..count].iter().sum()).collect())
        .collect();
    let n_steps = ends.iter().filter_map(|ends| ends.last()).max().copied().unwrap_or(0);
    for t in 0..n_steps {
        let number = |k: usize| (0..n_envs).map(move |n| (((t * n_envs + n) * k) % 101) as f32 / 10.0 - 5.0);
        let place = |n: usize| t * n_envs + n;
        let ended = |n: usize| ends[n].contains(&(t + 1));
        let step = RolloutStep {
            observations: &(0..n_envs).flat_map(|n| [place(n) as f32, -(place(n) as f32)]).collect::<Vec<_>>(),
            starts: &(0..n_envs).map(|n| t == 0 || ends[n].contains(&t)).collect::<Vec<_>>(),
            actions: &number(7).collect::<Vec<_>>(),
            log_probs: &number(11).collect::<Vec<_>>(),
            values: &number(13).collect::<Vec<_>>(),
            rewards: &number(17).collect::<Vec<_>>(),
            terminated: &(0..n_envs).map(|n| ended(n) && !place(n).is_multiple_of(3)).collect::<Vec<_>>(),
            truncated: &(0..n_envs).map(|n| ended(n) && place(n) % 3 != 1).collect::<Vec<_>>(),
            truncation_values: &number(19).collect::<Vec<_>>(),
        };
        rollout.push(step).expect("a step that fits");
        for n in (0..n_envs).filter(|&n| ended(n)) {
            let k = ends[n].iter().position(|&end| end == t + 1).expect("its number");
            rollout.note_episode(n, rollout.len(), lengths[n][k], 0.0).expect("an episode of the rollout");
        }
    }
    rollout.finish(&vec![99.0; n_envs]).expect("values that fit");
    rollout
}

/// Returns the numbers and the flags of sample `p` of a rollout made by [`coded`], or selected from such a rollout.
fn at(rollout: &RolloutBuffer, p: usize) -> (Vec<f32>, [bool; 2]) {
    let trajectories = rollout.trajectories().expect("a finished rollout");
    let numbers = [
        rollout.observations()[2 * p],
        rollout.observations()[2 * p + 1],
        rollout.actions()[p],
        rollout.log_probs()[p],
        rollout.values()[p],
        trajectories.rewards[p],
        trajectories.truncation_values[p],
    ];
    (numbers.to_vec(), [trajectories.terminated[p], trajectories.truncated[p]])
}

/// Generates a rollout with episodes in up to six environments, and a selection of these episodes.
fn some_episodes() -> impl Strategy<Value = (RolloutBuffer, Vec<EpisodeSlice>)> {
    let lengths = prop::collection::vec(prop::collection::vec(1usize..12, 1..6), 1..7);
    (lengths, prop::collection::vec(any::<bool>(), 36)).prop_map(|(lengths, choice)| {
        let rollout = coded(&lengths);
        let episodes = rollout.episodes();
        assert_eq!(episodes.len(), lengths.iter().map(Vec::len).sum::<usize>());
        let mut chosen: Vec<EpisodeSlice> =
            episodes.iter().zip(&choice).filter(|(_, chosen)| **chosen).map(|(e, _)| *e).collect();
        if chosen.is_empty() {
            chosen.push(episodes[0]);
        }
        (rollout, chosen)
    })
}

/// Computes the estimates of an episode as if it were alone in the rollout.
fn alone(
    rollout: &RolloutBuffer,
    episode: &EpisodeSlice,
    estimate: &dyn Fn(&Trajectories<'_>) -> Estimates,
) -> Estimates {
    let whole = rollout.trajectories().expect("finished");
    let places = || (0..episode.length).map(|t| (episode.start + t) * rollout.n_envs() + episode.environment);
    let numbers = |data: &[f32]| places().map(|p| data[p]).collect::<Vec<_>>();
    let flags = |data: &[bool]| places().map(|p| data[p]).collect::<Vec<_>>();
    estimate(&Trajectories {
        n_envs: 1,
        rewards: &numbers(whole.rewards),
        values: &numbers(whole.values),
        terminated: &flags(whole.terminated),
        truncated: &flags(whole.truncated),
        truncation_values: &numbers(whole.truncation_values),
        last_values: &[99.0],
    })
}

proptest! {
    #[test]
    fn every_step_of_the_chosen_episodes_is_a_sample_once((rollout, chosen) in some_episodes()) {
        let n_envs = rollout.n_envs();
        let packed = rollout.select(&chosen).expect("its own episodes");
        let samples: Vec<usize> = packed.samples().expect("not all are").into_iter().map(|i| i as usize).collect();
        let columns = packed.n_envs();
        prop_assert_eq!(packed.n_steps(), chosen.iter().map(|e| e.length).max().expect("one"));
        prop_assert_eq!(packed.memory(), vec![0.0; 2 * columns]);

        // The expected steps: index in the original rollout, and whether the step starts an episode.
        let mut expected = BTreeMap::new();
        for episode in &chosen {
            for step in 0..episode.length {
                expected.insert((episode.start + step) * n_envs + episode.environment, step == 0);
            }
        }
        let steps = packed.lengths().expect("packed").iter().sum::<usize>();
        prop_assert_eq!((samples.len(), steps), (expected.len(), expected.len()));
        let is_sample: HashSet<usize> = samples.iter().copied().collect();
        prop_assert_eq!(is_sample.len(), samples.len());
        let mut seen = HashSet::new();
        for place in 0..packed.n_steps() * columns {
            let t = place / columns;
            let column = place % columns;
            let sample = t < packed.lengths().expect("packed")[column];
            prop_assert_eq!(sample, is_sample.contains(&place));
            if !sample {
                prop_assert!(!packed.starts()[place], "padding starts nothing");
                continue;
            }
            let source = packed.observations()[2 * place] as usize;
            prop_assert!(seen.insert(source), "step {} twice", source);
            prop_assert_eq!(Some(&packed.starts()[place]), expected.get(&source));
            prop_assert_eq!(at(&packed, place), at(&rollout, source));
            if !packed.starts()[place] {
                let before = packed.observations()[2 * (place - columns)] as usize;
                prop_assert_eq!(before + n_envs, source, "steps are in order");
            }
        }
    }

    /// An episode's advantages and returns are exactly equal in both computations, because the same sums are computed
    /// in the same order.
    #[test]
    fn advantages_of_chosen_episodes_are_those_of_each_alone(
        (rollout, chosen) in some_episodes(), bootstrap in any::<bool>()
    ) {
        let packed = rollout.select(&chosen).expect("its own episodes");
        let samples: Vec<usize> = packed.samples().expect("not all are").into_iter().map(|i| i as usize).collect();
        let estimators: [&dyn Fn(&Trajectories<'_>) -> Estimates; 2] = [
            &|trajectories| gae(trajectories, 0.9, 0.8, bootstrap),
            &|trajectories| n_step_returns(trajectories, 0.9, bootstrap),
        ];
        for estimate in estimators {
            let together = estimate(&packed.trajectories().expect("finished"));
            for episode in &chosen {
                let alone = alone(&rollout, episode, estimate);
                let first = episode.start * rollout.n_envs() + episode.environment;
                let is_first = |&&place: &&usize| packed.observations()[2 * place] as usize == first;
                let start = *samples.iter().find(is_first).expect("it is there");
                for t in 0..episode.length {
                    prop_assert_eq!(together.advantages[start + t * packed.n_envs()], alone.advantages[t]);
                    prop_assert_eq!(together.returns[start + t * packed.n_envs()], alone.returns[t]);
                }
            }
        }
    }
}

#[test]
fn episodes_that_a_rollout_does_not_hold_are_refused() {
    let mut rollout = coded(&[vec![4, 2], vec![3]]);
    let own = rollout.episodes()[0];
    assert!(matches!(rollout.select(&[]), Err(Error::RolloutLength { .. })));
    for wrong in [
        EpisodeSlice { environment: 2, ..own },
        EpisodeSlice { start: 5, ..own },
        EpisodeSlice { start: usize::MAX, ..own },
        EpisodeSlice { length: 0, ..own },
    ] {
        let result = rollout.select(&[own, wrong]);
        assert!(matches!(result, Err(Error::Episode { n_envs: 2, n_steps: 6, .. })), "{wrong:?}: {result:?}");
    }
    for (environment, length) in [(2, 1), (0, 7), (0, 0)] {
        let result = rollout.note_episode(environment, rollout.len(), length, 0.0);
        assert!(matches!(result, Err(Error::Episode { .. })), "{environment} {length}: {result:?}");
    }
    let policy = moved(&spec(DISCRETE, None));
    let [base, _] = bases(1, 1, &policy);
    let unfinished = RolloutBuffer::of_episodes(2, O, 1);
    let result = epopt(base, 0.5, 0).update(&mut moved(&spec(DISCRETE, None)), &unfinished, 1.0);
    assert!(matches!(result, Err(Error::RolloutLength { .. })), "{result:?}");
}

/// Returns a loss that depends on every output of the policy, as the mean over the samples of a packed `rollout`, and
/// its gradient.
fn loss_of(policy: &TorchPolicy, rollout: &RolloutBuffer) -> (f64, Vec<f32>) {
    let sequences =
        Sequences::new(policy.spec(), rollout.n_steps(), rollout.observations(), rollout.starts(), rollout.memory())
            .and_then(|sequences| sequences.with_lengths(rollout.lengths().expect("packed")))
            .expect("shapes that fit");
    let evaluated = policy.evaluate(&sequences, &Tensor::of_slice(rollout.actions()));
    let samples = rollout.samples().expect("packed");
    let weights: Vec<f32> = samples.iter().map(|&i| rollout.observations()[O * i as usize]).collect();
    let terms =
        &evaluated.log_probs * Tensor::of_slice(&weights) + evaluated.values.square() + &evaluated.entropy * 0.3;
    let loss = terms.mean(Kind::Float);
    let mut gradient = vec![0.0; policy.spec().n_weights()];
    policy.gradient(&evaluated, &loss, &mut gradient).expect("a gradient");
    (loss.double_value(&[]), gradient)
}

/// Returns lengths of episodes by environment, thirty steps in total.
fn unequal() -> Vec<Vec<usize>> {
    vec![vec![6, 2], vec![9], vec![1, 3, 5], vec![4]]
}

#[test]
fn padding_does_not_count_in_recurrent_gradients() {
    for action in [DISCRETE, CONTINUOUS] {
        for plain_autograd in [false, true] {
            let policy = moved(&spec(action, Some(8)));
            let torch = TorchPolicy::new(policy.spec(), policy.flat_weights()).expect("a policy");
            let torch = if plain_autograd { torch.with_plain_autograd() } else { torch };
            let rollout = play(&policy, &unequal(), &zeros(&unequal()), of_episodes(policy.spec(), 4));
            let select = |episodes: &[EpisodeSlice]| rollout.select(episodes).expect("its own episodes");
            let packed = select(rollout.episodes());
            let places = packed.n_steps() * packed.n_envs();
            let steps = 30;
            assert!(packed.samples().is_some_and(|samples| samples.len() == steps) && places > steps, "{places}");
            let (loss, gradient) = loss_of(&torch, &packed);

            let mut mean = 0.0;
            let mut mean_gradient = vec![0.0f64; gradient.len()];
            for episode in rollout.episodes() {
                let share = episode.length as f64 / steps as f64;
                let (loss, gradient) = loss_of(&torch, &select(&[*episode]));
                mean += share * loss;
                mean_gradient.iter_mut().zip(gradient).for_each(|(sum, g)| *sum += share * f64::from(g));
            }
            assert!((loss - mean).abs() < 1e-6, "f32 rounding of a mean of order 1: {loss} {mean}");
            let mut start = 0;
            for array in policy.weights() {
                let range = start..start + array.data.len();
                start = range.end;
                let norm = |numbers: &mut dyn Iterator<Item = f64>| numbers.map(|x| x * x).sum::<f64>().sqrt();
                let size = norm(&mut mean_gradient[range.clone()].iter().copied());
                let difference = norm(&mut range.map(|i| f64::from(gradient[i]) - mean_gradient[i]));
                // The tolerance covers sums of 30 products in another order, each rounded to 2⁻²⁴.
                assert!(size > 0.0 && difference < 1e-5 * size, "{}: {difference} of {size}", array.name);
            }
        }
    }
}

#[test]
fn padding_does_not_count_in_updates() {
    for lstm in [None, Some(8)] {
        for action in [DISCRETE, CONTINUOUS] {
            let spec = spec(action, lstm);
            let rollout = play(&moved(&spec), &unequal(), &zeros(&unequal()), of_episodes(&spec, 4));
            let update = |mut algorithm: Box<dyn BaseAlgorithm>, episodes: &[EpisodeSlice]| {
                let packed = rollout.select(episodes).expect("its own episodes");
                algorithm.update(&mut moved(&spec), &packed, 1.0).expect("an update")
            };
            let a2c = || Box::new(A2c::new(A2cConfig::default(), &moved(&spec)).expect("valid settings"));
            let parts =
                |stats: UpdateStats| [stats.policy_gradient_loss, stats.value_loss, stats.entropy_loss, stats.loss];
            let got = parts(update(a2c(), rollout.episodes()));
            let mut expected = [0.0; 4];
            for episode in rollout.episodes() {
                let alone = parts(update(a2c(), &[*episode]));
                expected.iter_mut().zip(alone).for_each(|(sum, x)| *sum += x * episode.length as f64 / 30.0);
            }
            for (got, expected) in got.iter().zip(expected) {
                assert!((got - expected).abs() < 2e-6, "f32 rounding of means below 10: {got} {expected}");
            }

            let config = PpoConfig { n_epochs: 1, learning_rate: 1e-12, kl_coef: 0.2, ..PpoConfig::default() };
            let ppo = Ppo::new(config, &moved(&spec), 1).expect("valid settings");
            let stats = update(Box::new(ppo), rollout.episodes());
            assert_eq!(stats.clip_fraction, Some(0.0));
            // As in the tests of PPO, the divergences are half the square of errors of 1e-6, with terms rounded to
            // 2⁻²⁴. The loss has the order of these errors.
            assert!(stats.approx_kl.is_some_and(|kl| kl.abs() < 2e-7), "{stats:?}");
            assert!(stats.policy_gradient_loss.abs() < 1e-5, "{stats:?}");
            assert!(stats.kl_divergence.is_some_and(|kl| kl.abs() < 5e-7), "{stats:?}");
        }
    }
}

const CARTPOLES: usize = 4;
/// Number of episodes. It is not divisible by the four environments, which play 3, 3, 2 and 2 episodes.
const COUNT: usize = 10;

/// Returns a recurrent policy that ignores observations and pushes to either side with equal probability.
fn blind(input_size: usize) -> TrainablePolicy {
    perturb_torch::register();
    let spec = PolicySpec {
        observation_size: input_size,
        action: ActionKind::Discrete { n: 2 },
        hidden: vec![],
        lstm: Some(4),
    };
    let mut weights = moved(&spec).weights();
    weights.iter_mut().filter(|array| array.name.starts_with("policy")).for_each(|array| array.data.fill(0.0));
    TrainablePolicy::from_weights(spec, &weights).expect("a policy")
}

/// Collects two rollouts of complete episodes. Returns each with the episodes that ended in it, and the final
/// normalisers.
fn collect(servers: &[PrivateServer], normalised: bool) -> (Vec<(RolloutBuffer, Vec<EndedEpisode>)>, Normalisers) {
    let servers = connect(servers);
    let mut observations = Vec::new();
    let mut session =
        ClientSession::open(&servers, &options("CartPole", CARTPOLES, 1), &mut observations).expect("a session");
    let size = session.observation_size();
    let policy = blind(size);
    let inputs = Inputs::new(size, policy.spec().action, CARTPOLES, false);
    let normalisers = Normalisers {
        observations: normalised.then(|| ObservationNormaliser::new(size)),
        rewards: normalised.then(|| RewardNormaliser::new(CARTPOLES, 0.9)),
    };
    let mut player = Player::new(policy.spec(), inputs, CARTPOLES, 1, normalisers, PlayerRole::training(1));
    player.begin(&observations, None).expect("observations");
    let mut collector = Collector::new(player);
    let mut collected = Vec::new();
    for _ in 0..2 {
        let mut rollout = RolloutBuffer::of_episodes(CARTPOLES, size, 1);
        let mut ended = Vec::new();
        let on_episode = |episode: &EndedEpisode| ended.push(episode.clone());
        let episodes = CollectUntil::Episodes(COUNT);
        let weights = policy.flat_weights();
        collector.collect(&mut session, weights, episodes, &mut rollout, on_episode).expect("a rollout");
        collected.push((rollout, ended));
    }
    (collected, collector.player().normalisers().clone())
}

#[test]
fn collected_episodes_are_fixed_beforehand() {
    let (collected, _) = collect(&[server()], false);
    let mut parameters = HashSet::new();
    for (iteration, (rollout, ended)) in collected.iter().enumerate() {
        assert_eq!(ended.len(), COUNT);
        let spans: Vec<_> = rollout.episodes().iter().map(|e| (e.environment, e.length, e.episode_return)).collect();
        let said: Vec<_> = ended.iter().map(|e| (e.slot, e.length as usize, e.episode_return)).collect();
        assert_eq!(spans, said, "the server's word on every episode");
        let trajectories = rollout.trajectories().expect("a finished rollout");
        for slot in 0..CARTPOLES {
            let own: Vec<&EndedEpisode> = ended.iter().filter(|episode| episode.slot == slot).collect();
            assert_eq!(own.len(), [3, 3, 2, 2][slot], "however short they are");
            let first = own[0].episode_index;
            assert!(own.iter().zip(first..).all(|(episode, index)| episode.episode_index == index), "its first ones");
            assert!(iteration > 0 || first == 1, "what was opened is broken off");
            // Episodes follow one another from the rollout's first step on. Only the last step of an episode has an end
            // flag.
            let mut t = 0;
            for span in rollout.episodes().iter().filter(|span| span.environment == slot) {
                assert_eq!(span.start, t);
                for step in 0..span.length {
                    let place = t * CARTPOLES + slot;
                    assert_eq!(rollout.starts()[place], step == 0);
                    let ended = trajectories.terminated[place] || trajectories.truncated[place];
                    assert_eq!(ended, step + 1 == span.length);
                    t += 1;
                }
            }
        }
        assert_eq!(rollout.memory(), vec![0.0; CARTPOLES * 8], "nothing of the rollout before");
        let last = rollout.episodes().iter().map(|span| span.start + span.length).max();
        assert_eq!(last, Some(rollout.n_steps()), "it ends with the last episode");
        assert!(ended.iter().any(|e| e.length != ended[0].length), "lengths differ");
        parameters.extend(ended.iter().map(|episode| format!("{:?}", episode.receipt.requested)));
    }
    assert_eq!(parameters.len(), 2 * COUNT, "every episode is in an environment of its own");
}

#[test]
fn unseen_steps_are_no_part_of_the_statistics() {
    let server = [server()];
    let (raw, _) = collect(&server, false);
    let (normalised, normalisers) = collect(&server, true);
    let mut rows = Vec::new(); // the session's first observations, later all observations that the policy acted on
    ClientSession::open(&connect(&server), &options("CartPole", CARTPOLES, 1), &mut rows).expect("a session");
    let size = rows.len() / CARTPOLES;
    let mut seen = 0;
    let mut unseen = 0;
    for ((rollout, _), (normalised, _)) in raw.iter().zip(&normalised) {
        assert_eq!(rollout.actions(), normalised.actions(), "the same episodes");
        for span in rollout.episodes() {
            for t in span.start..span.start + span.length {
                rows.extend(&rollout.observations()[(t * CARTPOLES + span.environment) * size..][..size]);
            }
            seen += span.length;
        }
        unseen += rollout.n_steps() * CARTPOLES;
    }
    unseen -= seen;
    assert!(unseen > 10, "{unseen}");

    let moments = normalisers.observations.as_ref().expect("statistics").moments();
    assert_eq!(moments.count(), (CARTPOLES + seen) as u64);
    for i in 0..size {
        let column = || rows.iter().skip(i).step_by(size).map(|&x| f64::from(x));
        let count = (rows.len() / size) as f64;
        let mean = column().sum::<f64>() / count;
        let variance = column().map(|x| (x - mean).powi(2)).sum::<f64>() / count;
        // The tolerance covers sums of some hundred f64 numbers in another order.
        assert!((moments.mean()[i] - mean).abs() < 1e-12, "{} {mean}", moments.mean()[i]);
        assert!((moments.variance(i) - variance).abs() < 1e-12, "{} {variance}", moments.variance(i));
    }
    assert_eq!(normalisers.rewards.as_ref().expect("statistics").moments().count(), seen as u64);
}

#[test]
fn complete_episodes_are_the_same_on_one_server_and_on_two() {
    let both = [server(), server()];
    let (one, one_after) = collect(&both[..1], true);
    let (two, two_after) = collect(&both, true);
    for ((one, one_ended), (two, two_ended)) in one.iter().zip(&two) {
        assert_eq!(contents(one), contents(two));
        assert_eq!((one.episodes(), one_ended), (two.episodes(), two_ended));
    }
    assert_eq!(one_after, two_after);
}

const SAFE: f32 = 0.0;
const ENVS: usize = 16;

/// Plays episodes of one step with a choice of two arms. The safe arm always pays 0. The risky arm pays 1, but -2.5 in
/// a fifth of the environments, so its mean is 0.3.
fn pull(policy: &TrainablePolicy, rng: &mut ChaCha8Rng, episodes: usize) -> RolloutBuffer {
    let mut rollout = RolloutBuffer::of_episodes(ENVS, 1, 1);
    let mut actor = Actor::new(policy.spec(), ENVS);
    actor.load(&policy.weights()).expect("weights that fit");
    let mut acts = ActorOutput::new(policy.spec().action, ENVS);
    rollout.begin(&[]);
    for _ in 0..episodes / ENVS {
        actor.act(&[1.0; ENVS], rng, &mut acts).expect("actions");
        let rewards: [f32; ENVS] = std::array::from_fn(|n| match (acts.actions[n] == SAFE, uniform(rng) < 0.2) {
            (true, _) => 0.0,
            (false, false) => 1.0,
            (false, true) => -2.5,
        });
        let step = RolloutStep {
            observations: &[1.0; ENVS],
            starts: &[true; ENVS],
            actions: &acts.actions,
            log_probs: &acts.log_probs,
            values: &acts.values,
            rewards: &rewards,
            terminated: &[true; ENVS],
            truncated: &[false; ENVS],
            truncation_values: &[0.0; ENVS],
        };
        rollout.push(step).expect("a step that fits");
        for (n, reward) in rewards.into_iter().enumerate() {
            rollout.note_episode(n, rollout.len(), 1, f64::from(reward)).expect("an episode");
        }
    }
    rollout.finish(&[0.0; ENVS]).expect("a finished rollout");
    rollout
}

fn a2c(policy: &TrainablePolicy) -> Box<dyn BaseAlgorithm> {
    let config = A2cConfig { learning_rate: 7e-3, ..A2cConfig::default() };
    Box::new(A2c::new(config, policy).expect("valid settings"))
}

fn ppo(policy: &TrainablePolicy) -> Box<dyn BaseAlgorithm> {
    let config = PpoConfig { learning_rate: 3e-3, ..PpoConfig::default() };
    Box::new(Ppo::new(config, policy, 5).expect("valid settings"))
}

/// At first the policy takes each arm with probability ½, so a tenth of the episodes are catastrophes. The worst fifth
/// of the episodes then consists of these catastrophes and of episodes with the safe arm.
#[rstest]
#[case::a2c(a2c, 1500)]
#[case::ppo(ppo, 100)]
fn epopt_avoids_catastrophes_that_its_base_accepts(
    #[case] base: fn(&TrainablePolicy) -> Box<dyn BaseAlgorithm>,
    #[case] updates: usize,
    #[values(0.2, 1.0)] epsilon: f64,
) {
    let spec = PolicySpec { observation_size: 1, action: ActionKind::Discrete { n: 2 }, hidden: vec![8], lstm: None };
    let mut policy = TrainablePolicy::new(spec, 5).expect("a policy");
    let mut rng = stream(5, Purpose::Actions);
    let mut algorithm = epopt(base(&policy), epsilon, 0);
    for _ in 0..updates {
        let rollout = pull(&policy, &mut rng, 128);
        algorithm.update(&mut policy, &rollout, 1.0).expect("an update");
    }
    let last = pull(&policy, &mut rng, 1024);
    let safe = last.actions().iter().filter(|&&action| action == SAFE).count() as f64 / 1024.0;
    // In the end, the policy takes one arm almost always; at first the share is ½.
    let expected = if epsilon < 1.0 { 0.9..=1.0 } else { 0.0..=0.1 };
    assert!(expected.contains(&safe), "{safe}");
}
