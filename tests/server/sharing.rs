//! Robots share one simulation for each thread. The sharing must not change any result.

use perturb::{
    env::{Action, ActionSpec, DrawPurpose, Environment, PhiloxStream},
    tasks::{half_cheetah::half_cheetah, hopper::hopper, locomotion::Walker},
};
use perturb_mujoco::Simulation;
use rstest::rstest;
use std::{env, fs, process::Command, thread};

type Make = fn() -> Walker;
const ROBOTS: [Make; 2] = [|| hopper().unwrap(), || half_cheetah().unwrap()];

fn n_actions(walker: &Walker) -> usize {
    match walker.spec().action {
        ActionSpec::Continuous(channels) => channels.len(),
        ActionSpec::Discrete(_) => panic!("walkers have motors"),
    }
}

/// A robot with a random history, which is a function of a number.
struct Life {
    walker: Walker,
    stream: PhiloxStream,
    /// All outputs of the robot so far, as bits.
    seen: Vec<u64>,
    diverged: usize,
}

impl Life {
    fn new(make: Make, number: u64) -> Self {
        let stream = PhiloxStream::new(1, number, DrawPurpose::Parameters, 0);
        Self { walker: make(), stream, seen: Vec::new(), diverged: 0 }
    }

    fn saved(&self) -> Vec<f64> {
        let mut state = Vec::new();
        self.walker.save(&mut state);
        state
    }

    /// Takes a few steps, sometimes after a reset, a change of parameters or a restore.
    fn go_on(&mut self) {
        match self.stream.uniform(0.0, 20.0) as u32 {
            0 => {
                let parameters = [(0.4, 1.1), (500.0, 1500.0), (0.2, 1.4)].map(|(a, b)| self.stream.uniform(a, b));
                self.walker.set_parameters(&parameters);
                self.walker.reset(&mut self.stream);
            }
            1 => self.walker.reset(&mut self.stream),
            2 => {
                let state = self.saved();
                self.walker.load(&state).unwrap();
                assert_eq!(self.saved(), state);
            }
            3 => {
                // The state diverges at once or in the next steps.
                let size = [1e20, 1e7][(self.stream.next_u64() % 2) as usize];
                let state: Vec<f64> =
                    self.walker.spec().state.iter().map(|_| self.stream.uniform(-size, size)).collect();
                self.walker.reset_to(&state);
            }
            _ => {}
        }
        let mut action = vec![0.0; n_actions(&self.walker)];
        let (mut terms, mut observation) = ([0.0; 5], vec![0.0; self.walker.spec().observation.len()]);
        for _ in 0..self.stream.next_u64() % 8 {
            action.fill_with(|| self.stream.uniform(-1.5, 1.5) as f32);
            let transition = self.walker.step(Action::Continuous(&action), &mut terms);
            self.walker.observe(&mut observation);
            self.seen.extend(terms.map(f64::to_bits));
            self.seen.extend(observation.iter().map(|x| u64::from(x.to_bits())));
            self.seen.push(u64::from(transition.terminated));
            self.diverged += usize::from(transition.diverged);
        }
        let mut applied = [0.0; 4];
        self.walker.applied(&mut applied);
        self.seen.extend(applied.map(f64::to_bits));
        if self.stream.next_u64().is_multiple_of(4) {
            self.seen.extend(self.saved().iter().map(|x| x.to_bits()));
        }
    }
}

#[rstest]
fn robots_that_take_turns_live_as_each_does_alone(
    #[values(ROBOTS[0], ROBOTS[1])] make: Make,
    #[values(1, 3)] threads: usize,
) {
    const LIVES: u64 = 7;
    const TURNS: usize = 400;
    let alone = |number| {
        // The robot lives on a separate thread, and so with a separate simulation.
        let live = move || {
            let mut life = Life::new(make, number);
            (0..TURNS).for_each(|_| life.go_on());
            life
        };
        thread::spawn(live).join().unwrap()
    };
    let mut lives: Vec<Life> = (0..LIVES).map(|number| Life::new(make, number)).collect();
    let mut order = PhiloxStream::new(2, 0, DrawPurpose::InitialState, threads as u64);
    let mut turns = [0; LIVES as usize];
    while turns.iter().any(|&turns| turns < TURNS) {
        // Some robots continue now, and each thread gets some of them. A robot moves between threads.
        let mut hands: Vec<Vec<&mut Life>> = (0..threads).map(|_| Vec::new()).collect();
        for (life, turns) in lives.iter_mut().zip(&mut turns) {
            if *turns < TURNS && order.unit() < 0.6 {
                *turns += 1;
                hands[(order.next_u64() % threads as u64) as usize].push(life);
            }
        }
        let own = hands.swap_remove(0);
        thread::scope(|scope| {
            for hand in hands {
                scope.spawn(|| hand.into_iter().for_each(Life::go_on));
            }
            own.into_iter().for_each(Life::go_on);
        });
    }
    let alone: Vec<Life> = (0..LIVES).map(alone).collect();
    for (together, alone) in lives.iter().zip(&alone) {
        assert!(together.seen == alone.seen);
    }
    assert!(alone.iter().map(|life| life.diverged).sum::<usize>() > 100, "neighbours diverged");
}

#[rstest]
fn physics_is_mujocos_with_a_model_and_data_of_ones_own(#[values(ROBOTS[0], ROBOTS[1])] make: Make) {
    let mut neighbour = Life::new(make, 9);
    for friction in [0.2, 0.8, 1.4] {
        let mut walker = make();
        walker.set_parameters(&[1.0, 700.0, friction]);
        walker.reset(&mut PhiloxStream::new(3, 0, DrawPurpose::InitialState, 0));
        let mut own = walker
            .inspect(|simulation| {
                let mut own = Simulation::new(simulation.model().try_clone().unwrap()).unwrap();
                own.qpos_mut().copy_from_slice(simulation.qpos());
                own
            })
            .unwrap();
        own.step1().unwrap();
        let mut draws = PhiloxStream::new(3, 0, DrawPurpose::InitialState, 1);
        let mut action = vec![0.0; n_actions(&walker)];
        let (mut state, mut touched) = (vec![0.0; own.model().n_state()], 0);
        for _ in 0..300 {
            neighbour.go_on();
            action.fill_with(|| draws.uniform(-1.0, 1.0) as f32);
            walker.step(Action::Continuous(&action), &mut [0.0; 5]);
            for (ctrl, &a) in own.ctrl_mut().iter_mut().zip(&action) {
                *ctrl = f64::from(a);
            }
            for _ in 0..4 {
                own.step2().unwrap();
                own.step1().unwrap();
            }
            own.state(&mut state);
            touched += own.contacts().len();
            let mut saved = Vec::new();
            walker.save(&mut saved);
            assert_eq!(saved[1..][..state.len()], state);
        }
        assert!(touched > 0);
    }
}

/// The environment variable that marks the process that measures memory. It is a separate process, so that no other
/// test's memory counts.
const MEASURING: &str = "PERTURB_TEST_MEMORY";

fn resident_kb() -> f64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse().unwrap()
}

#[cfg(target_os = "linux")]
#[test]
fn a_hopper_takes_at_most_4_kb() {
    use crate::common;
    use perturb::{env::Version, tasks::hopper};

    if env::var_os(MEASURING).is_none() {
        let mut alone = Command::new(env::current_exe().unwrap());
        alone.args(["--exact", "sharing::a_hopper_takes_at_most_4_kb"]);
        let output = alone.env(MEASURING, "1").output().unwrap();
        let printed = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && printed.contains("1 passed"), "{printed}");
        return;
    }
    const N: u32 = 20_000;
    let hopper = |index| {
        // The robot has parameters of its own, and it has fallen.
        let mut episodes = common::episodes(&hopper::SPEC, Version::R, 1, index, 1);
        (0..20).for_each(|_| {
            episodes.step(Action::Continuous(&[1.0; 3]), &mut [0.0; 5]);
        });
        episodes
    };
    let first = hopper(0);
    let before = resident_kb();
    let hoppers: Vec<_> = (1..=N).map(hopper).collect();
    let each = (resident_kb() - before) / f64::from(N);
    println!("{each:.1} kB");
    assert!(each <= 4.0, "{each} kB");
    drop((first, hoppers));
}
