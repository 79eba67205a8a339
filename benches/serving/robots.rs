//! What serving Hopper and HalfCheetah costs beside physics: the server's CPU time an environment step, and its steps in
//! a second, against the bare loop: MuJoCo's timesteps (mj_step) of the same environments with the same actions, one
//! environment after the other, and nothing else. The environments' own timesteps are shorter, for they leave out a search
//! and walk over bodies in one piece.
//!
//! A server of two workers is asked in a closed loop, where each request waits for the reply to the last and the
//! workers wait with it, and with two requests in flight, where they do not. Server and bare loops take turns, in rounds
//! of the same steps; medians over the rounds are printed.

use crate::{
    Failure,
    client::{Client, Process, SEED, width},
    median,
};
use bytes::Bytes;
use perturb::{
    env::{Action, EnvironmentSpec, Episodes, Settings, Version},
    scene::{PosedModel, Scene},
    tasks::locomotion::Walker,
};
use perturb_mujoco::Simulation;
use std::{fs, ops::Range, path::Path, thread, time::Instant};

const ROUNDS: usize = 15;
/// Environment steps of a round.
const STEPS: usize = 1 << 14;
const N_SUBSTEPS: usize = 4;

/// Makes one of the robots.
pub(crate) type Make = fn() -> Result<Walker, perturb::env::Error>;

/// Prints the figures of one robot and batch size.
pub(crate) async fn served(spec: &'static EnvironmentSpec, make: Make, batch: usize) -> Result<(), Failure> {
    let server = Process::server(2)?;
    let mut client = Client::open(&server.socket, spec.name, batch).await?;
    let mut halves = [Part::new(spec, make, 0..batch / 2)?, Part::new(spec, make, batch / 2..batch)?];
    let mut kinds = [("closed loop", 1, Vec::new()), ("two requests in flight", 2, Vec::new())];
    for _ in 0..ROUNDS {
        for (_, in_flight, rounds) in &mut kinds {
            let actions: Vec<Bytes> = (0..STEPS / batch).map(|_| client.actions()).collect();
            let in_process = one_by_one(&mut halves, |half| half.step(&actions))?;
            let bare = one_by_one(&mut halves, |half| half.bare(&actions))?;
            let at_once = at_once(&mut halves, &actions)?;
            let (start, cpu) = (Instant::now(), process_cpu(&server.proc())?);
            let seen = client.play(&actions, *in_flight).await?;
            let served = Cost { wall: start.elapsed().as_secs_f64(), cpu: process_cpu(&server.proc())? - cpu };
            halves.iter_mut().for_each(|half| half.check(&seen));
            rounds.push(Round { bare, at_once, in_process, served });
        }
    }
    let id = format!("step/{}/{batch}", spec.name);
    for (kind, _, rounds) in kinds {
        let of = |figure: fn(&Round) -> f64| median(&mut rounds.iter().map(figure).collect::<Vec<_>>());
        let micros = |figure: fn(&Round) -> f64| of(figure) * 1e6 / STEPS as f64;
        println!(
            "{id:<22} {:>8.2} us of CPU time, {:.2} us of time an env step, {kind}",
            micros(|round| round.served.cpu),
            micros(|round| round.served.wall)
        );
        println!(
            "{id:<22} {:>8.3} of the CPU time of one bare loop ({:.2} us), {:.3} of two at once ({:.2} us)",
            of(|round| round.served.cpu / round.bare.cpu),
            micros(|round| round.bare.cpu),
            of(|round| round.served.cpu / round.at_once.cpu),
            micros(|round| round.at_once.cpu)
        );
        println!(
            "{id:<22} {:>8.3} of the steps/s of two bare loops at once, which have {:.2} of twice those of one",
            of(|round| round.at_once.wall / round.served.wall),
            of(|round| round.bare.wall / (2.0 * round.at_once.wall))
        );
        println!(
            "{id:<22} {:>8.3} of the CPU time of one bare loop without the server, in this process",
            of(|round| round.in_process.cpu / round.bare.cpu)
        );
    }
    Ok(())
}

/// What the same steps took, by each way.
struct Round {
    bare: Cost,
    /// Two bare loops, half of the environments each.
    at_once: Cost,
    /// The environments one after the other, without a server.
    in_process: Cost,
    served: Cost,
}

/// Seconds.
struct Cost {
    cpu: f64,
    wall: f64,
}

/// Seconds that a process, a folder of /proc, has computed so far.
fn process_cpu(process: &Path) -> Result<f64, Failure> {
    fs::read_dir(process.join("task"))?.map(|thread| thread_cpu(&thread?.path())).sum()
}

/// Seconds that a thread, a folder of /proc, has computed so far.
fn thread_cpu(thread: &Path) -> Result<f64, Failure> {
    let nanoseconds = fs::read_to_string(thread.join("schedstat"))?;
    Ok(nanoseconds.split(' ').next().ok_or("no schedstat")?.parse::<f64>()? * 1e-9)
}

/// What it took this thread.
fn timed(work: impl FnOnce() -> Result<(), Failure>) -> Result<Cost, Failure> {
    let this = Path::new("/proc/thread-self");
    let (start, cpu) = (Instant::now(), thread_cpu(this)?);
    work()?;
    Ok(Cost { wall: start.elapsed().as_secs_f64(), cpu: thread_cpu(this)? - cpu })
}

fn one_by_one(halves: &mut [Part; 2], run: impl Fn(&mut Part) -> Result<(), Failure>) -> Result<Cost, Failure> {
    timed(|| halves.iter_mut().try_for_each(run))
}

fn at_once(halves: &mut [Part; 2], actions: &[Bytes]) -> Result<Cost, Failure> {
    let start = Instant::now();
    let bare = |half: &mut Part| timed(|| half.bare(actions)).map(|cost| cost.cpu).map_err(|error| error.to_string());
    let [a, b] = halves;
    let (a, b) = thread::scope(|scope| {
        let other = scope.spawn(|| bare(b));
        (bare(a), other.join().unwrap_or_else(|_| Err("a bare loop panicked".into())))
    });
    Ok(Cost { cpu: a? + b?, wall: start.elapsed().as_secs_f64() })
}

/// Some of a batch's environments in this process, and their bare loop.
struct Part {
    spec: &'static EnvironmentSpec,
    first: usize,
    environments: Vec<Episodes>,
    observations: Vec<f32>,
    /// Of the bare loop.
    simulation: Simulation,
    /// Of each environment, before the round and after it.
    states: Vec<(Vec<f64>, Vec<f64>)>,
    initial: Vec<f64>,
    /// The episodes that began in the round: environment, trip and state.
    begun: Vec<(usize, usize, Vec<f64>)>,
}

impl Part {
    fn new(spec: &'static EnvironmentSpec, make: Make, range: Range<usize>) -> Result<Self, Failure> {
        let environment = |index: usize| {
            let distributions = spec.distributions(Version::D);
            let settings =
                Settings { seed: SEED, environment_index: index as u32, distributions, episodes_per_trial: 1 };
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

    /// The action of an environment on a trip.
    fn action<'a>(&self, actions: &'a [Bytes], environment: usize, trip: usize) -> impl Iterator<Item = f32> + use<'a> {
        let width = width(self.spec);
        let own = &actions[trip][4 * width * (self.first + environment)..][..4 * width];
        own.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes))
    }

    /// The environments' steps, one environment after the other.
    fn step(&mut self, actions: &[Bytes]) -> Result<(), Failure> {
        let (mut terms, n) = (vec![0.0; self.spec.reward_terms.len()], self.spec.observation.len());
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

    /// MuJoCo's timesteps in [`Self::step`], which came before.
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

    /// Goes on to the next round, if environments, bare loop and server, of whom this was seen, came to the same.
    fn check(&mut self, seen: &[u8]) {
        let own: Vec<u8> = self.observations.iter().flat_map(|value| value.to_le_bytes()).collect();
        assert!(
            seen[4 * self.first * self.spec.observation.len()..].starts_with(&own),
            "the server saw something else"
        );
        for (environment, (before, after)) in self.environments.iter().zip(&mut self.states) {
            let qpos = positions(environment);
            assert_eq!(after[1..=qpos.len()], qpos, "the bare loop went elsewhere");
            before.copy_from_slice(after);
        }
    }
}

/// The state of an environment at the beginning of an episode: at rest.
fn started(initial: &[f64], environment: &Episodes) -> Vec<f64> {
    let (mut state, qpos) = (initial.to_vec(), positions(environment));
    state[1..=qpos.len()].copy_from_slice(&qpos);
    state
}

fn positions(environment: &Episodes) -> Vec<f64> {
    match environment.scene() {
        Some(Scene::Model(PosedModel { qpos, .. })) => qpos,
        _ => unreachable!("nothing diverges with the default parameters"),
    }
}
