//! The cost of serving Hopper and HalfCheetah, in addition to their physics.
//!
//! The results are the server's CPU time for each environment step, and its steps per second. The reference is a bare
//! loop: MuJoCo's timesteps (mj_step) of the same environments with the same actions, one environment after the other.
//! A timestep of the environments takes less time than mj_step, because it skips MuJoCo's search for nearby geoms and
//! visits all bodies in one pass.
//!
//! A server with two workers is measured in a closed loop, where each request waits for the previous reply, and with
//! two requests in flight. Server and bare loops are measured in alternating rounds with the same steps. The output has
//! medians over the rounds.

use crate::{
    Failure,
    client::{Client, SEED, ServerProcess, width},
    median,
};
use bytes::Bytes;
use perturb::{
    env::{Action, EnvironmentSpec, EpisodeSettings, Episodes, Version},
    scene::{PosedModel, Scene},
    tasks::locomotion::Walker,
};
use perturb_mujoco::Simulation;
use std::{fs, ops::Range, path::Path, thread, time::Instant};

/// The number of rounds.
const ROUNDS: usize = 15;
/// The number of environment steps in a round.
const STEPS: usize = 1 << 14;
/// The number of MuJoCo's timesteps in an environment step.
const N_SUBSTEPS: usize = 4;

/// A function that creates one of the robots.
pub(crate) type MakeRobot = fn() -> Result<Walker, perturb::env::Error>;

/// Measures one robot with one batch size and prints the results.
pub(crate) async fn measure(spec: &'static EnvironmentSpec, make: MakeRobot, batch: usize) -> Result<(), Failure> {
    let server = ServerProcess::server(2)?;
    let mut client = Client::open(&server.socket, spec.name, batch).await?;
    let mut halves =
        [LocalEnvironments::new(spec, make, 0..batch / 2)?, LocalEnvironments::new(spec, make, batch / 2..batch)?];
    let mut kinds = [("closed loop", 1, Vec::new()), ("two requests in flight", 2, Vec::new())];
    for _ in 0..ROUNDS {
        for (_, in_flight, rounds) in &mut kinds {
            let actions: Vec<Bytes> = (0..STEPS / batch).map(|_| client.actions()).collect();
            let in_process = one_by_one(&mut halves, |half| half.step(&actions))?;
            let bare = one_by_one(&mut halves, |half| half.bare(&actions))?;
            let at_once = at_once(&mut halves, &actions)?;
            let start = Instant::now();
            let cpu = process_cpu(&server.proc())?;
            let seen = client.play(&actions, *in_flight).await?;
            let served = Cost { wall: start.elapsed().as_secs_f64(), cpu: process_cpu(&server.proc())? - cpu };
            halves.iter_mut().for_each(|half| half.check(&seen));
            rounds.push(RoundCosts { bare, at_once, in_process, served });
        }
    }
    let id = format!("step/{}/{batch}", spec.name);
    for (kind, _, rounds) in kinds {
        let median_of = |figure: fn(&RoundCosts) -> f64| median(&mut rounds.iter().map(figure).collect::<Vec<_>>());
        let micros = |figure: fn(&RoundCosts) -> f64| median_of(figure) * 1e6 / STEPS as f64;
        println!(
            "{id:<22} {:>8.2} us of CPU time, {:.2} us of time an env step, {kind}",
            micros(|round| round.served.cpu),
            micros(|round| round.served.wall)
        );
        println!(
            "{id:<22} {:>8.3} of the CPU time of one bare loop ({:.2} us), {:.3} of two at once ({:.2} us)",
            median_of(|round| round.served.cpu / round.bare.cpu),
            micros(|round| round.bare.cpu),
            median_of(|round| round.served.cpu / round.at_once.cpu),
            micros(|round| round.at_once.cpu)
        );
        println!(
            "{id:<22} {:>8.3} of the steps/s of two bare loops at once, which have {:.2} of twice those of one",
            median_of(|round| round.at_once.wall / round.served.wall),
            median_of(|round| round.bare.wall / (2.0 * round.at_once.wall))
        );
        println!(
            "{id:<22} {:>8.3} of the CPU time of one bare loop without the server, in this process",
            median_of(|round| round.in_process.cpu / round.bare.cpu)
        );
    }
    Ok(())
}

/// The costs of a round's steps, which are computed in several ways.
struct RoundCosts {
    bare: Cost,
    /// Two bare loops at the same time, with half of the environments each.
    at_once: Cost,
    /// The complete environments one after the other, in this process without a server.
    in_process: Cost,
    served: Cost,
}

/// CPU time and elapsed time, in s.
struct Cost {
    cpu: f64,
    wall: f64,
}

/// Returns the CPU time of a process in seconds. `process` is its folder in /proc.
pub(crate) fn process_cpu(process: &Path) -> Result<f64, Failure> {
    fs::read_dir(process.join("task"))?.map(|thread| thread_cpu(&thread?.path())).sum()
}

/// Returns the CPU time of a thread in seconds. `thread` is its folder in /proc.
pub(crate) fn thread_cpu(thread: &Path) -> Result<f64, Failure> {
    let nanoseconds = fs::read_to_string(thread.join("schedstat"))?;
    Ok(nanoseconds.split(' ').next().ok_or("no schedstat")?.parse::<f64>()? * 1e-9)
}

/// Runs `work` on this thread and measures its cost.
fn timed(work: impl FnOnce() -> Result<(), Failure>) -> Result<Cost, Failure> {
    let this = Path::new("/proc/thread-self");
    let start = Instant::now();
    let cpu = thread_cpu(this)?;
    work()?;
    Ok(Cost { wall: start.elapsed().as_secs_f64(), cpu: thread_cpu(this)? - cpu })
}

fn one_by_one(
    halves: &mut [LocalEnvironments; 2],
    run: impl Fn(&mut LocalEnvironments) -> Result<(), Failure>,
) -> Result<Cost, Failure> {
    timed(|| halves.iter_mut().try_for_each(run))
}

fn at_once(halves: &mut [LocalEnvironments; 2], actions: &[Bytes]) -> Result<Cost, Failure> {
    let start = Instant::now();
    let bare = |half: &mut LocalEnvironments| {
        timed(|| half.bare(actions)).map(|cost| cost.cpu).map_err(|error| error.to_string())
    };
    let [a, b] = halves;
    let (a, b) = thread::scope(|scope| {
        let other = scope.spawn(|| bare(b));
        (bare(a), other.join().unwrap_or_else(|_| Err("a bare loop panicked".into())))
    });
    Ok(Cost { cpu: a? + b?, wall: start.elapsed().as_secs_f64() })
}

/// A part of a batch's environments, in this process, with the simulation of their bare loop.
struct LocalEnvironments {
    spec: &'static EnvironmentSpec,
    first: usize,
    environments: Vec<Episodes>,
    observations: Vec<f32>,
    /// The simulation of the bare loop.
    simulation: Simulation,
    /// MuJoCo's state of each environment before and after the bare loop's round.
    states: Vec<(Vec<f64>, Vec<f64>)>,
    initial: Vec<f64>,
    /// The episodes that began in the round: index of the environment, index of the step after which the episode began,
    /// and initial state.
    begun: Vec<(usize, usize, Vec<f64>)>,
}

impl LocalEnvironments {
    fn new(spec: &'static EnvironmentSpec, make: MakeRobot, range: Range<usize>) -> Result<Self, Failure> {
        let environment = |index: usize| {
            let distributions = spec.distributions(Version::D).into();
            let settings =
                EpisodeSettings { seed: SEED, environment_index: index as u32, distributions, episodes_per_trial: 1 };
            Ok(Episodes::new((spec.make)()?, settings))
        };
        let environments = range.clone().map(environment).collect::<Result<Vec<_>, Failure>>()?;
        let model = make()?.inspect(|simulation| simulation.model().try_clone())??;
        let simulation = Simulation::new(model)?;
        let mut initial = vec![0.0; simulation.model().n_state()];
        simulation.state(&mut initial);
        let both = |environment| (started(&initial, environment), initial.clone());
        let states = environments.iter().map(both).collect();
        let observations = vec![0.0; environments.len() * spec.observation.len()];
        Ok(Self {
            spec,
            first: range.start,
            environments,
            observations,
            simulation,
            states,
            initial,
            begun: Vec::new(),
        })
    }

    /// Returns the action of an environment in step `trip`.
    fn action<'a>(&self, actions: &'a [Bytes], environment: usize, trip: usize) -> impl Iterator<Item = f32> + use<'a> {
        let width = width(self.spec);
        let own = &actions[trip][4 * width * (self.first + environment)..][..4 * width];
        own.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes))
    }

    /// Steps the complete environments, one after the other.
    fn step(&mut self, actions: &[Bytes]) -> Result<(), Failure> {
        let mut terms = vec![0.0; self.spec.reward_terms.len()];
        let n = self.spec.observation.len();
        let mut action = vec![0.0; width(self.spec)];
        self.begun.clear();
        for i in 0..self.environments.len() {
            for trip in 0..actions.len() {
                action.iter_mut().zip(self.action(actions, i, trip)).for_each(|(to, from)| *to = from);
                let environment = &mut self.environments[i];
                environment.step(Action::Continuous(&action), &mut terms);
                if environment.ended() {
                    environment.begin(None);
                    self.begun.push((i, trip, started(&self.initial, environment)));
                }
                environment.observe(&mut self.observations[n * i..][..n]);
            }
        }
        Ok(())
    }

    /// Repeats the steps of the preceding call of [`Self::step`], but runs only MuJoCo's timesteps.
    fn bare(&mut self, actions: &[Bytes]) -> Result<(), Failure> {
        let power = self.spec.parameters[0].default;
        let mut begun = self.begun.iter().peekable();
        for i in 0..self.states.len() {
            self.simulation.set_state(&self.states[i].0)?;
            for trip in 0..actions.len() {
                let action = self.action(actions, i, trip);
                self.simulation.ctrl_mut().iter_mut().zip(action).for_each(|(to, from)| *to = power * f64::from(from));
                for _ in 0..N_SUBSTEPS {
                    self.simulation.step()?;
                }
                if let Some((_, _, state)) = begun.next_if(|begun| (begun.0, begun.1) == (i, trip)) {
                    self.simulation.set_state(state)?;
                }
            }
            self.simulation.state(&mut self.states[i].1);
        }
        Ok(())
    }

    /// Checks that the environments, the bare loop and the server agree. `seen` are the server's observations. Then
    /// prepares the next round.
    fn check(&mut self, seen: &[u8]) {
        let own: Vec<u8> = self.observations.iter().flat_map(|value| value.to_le_bytes()).collect();
        assert!(
            seen[4 * self.first * self.spec.observation.len()..].starts_with(&own),
            "the server's observations differ"
        );
        for (environment, (before, after)) in self.environments.iter().zip(&mut self.states) {
            let qpos = positions(environment);
            assert_eq!(after[1..=qpos.len()], qpos, "the bare loop's positions differ");
            before.copy_from_slice(after);
        }
    }
}

/// Returns MuJoCo's state of an environment at the start of an episode, with all velocities 0.
fn started(initial: &[f64], environment: &Episodes) -> Vec<f64> {
    let mut state = initial.to_vec();
    let qpos = positions(environment);
    state[1..=qpos.len()].copy_from_slice(&qpos);
    state
}

fn positions(environment: &Episodes) -> Vec<f64> {
    match environment.scene() {
        Some(Scene::Model(PosedModel { qpos, .. })) => qpos,
        _ => unreachable!("nothing diverges with the default parameters"),
    }
}
