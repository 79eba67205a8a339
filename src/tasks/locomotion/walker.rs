//! The environment of Hopper and HalfCheetah: a robot in a vertical plane that must run along +x.

use super::{
    Posture, Robot,
    channels::{CLIP, CONTROL_TIMESTEP},
    model_edit::RobotEdit,
    pristine::{MAX_JOINTS, MAX_STATE, Pristine},
};
use crate::{
    env::{Action, Environment, EnvironmentSpec, Error, PhiloxStream, Transition},
    scene::{PosedModel, Scene},
    tasks::shared,
};
use perturb_mujoco::{Error as SimulationError, Simulation};
use std::sync::Arc;

const N_SUBSTEPS: usize = 4;
const RESET_RANGE: f64 = 0.1;
const ELECTRICITY_COST: f64 = 2.0;
const STALL_TORQUE_COST: f64 = 0.1;
const JOINT_LIMIT_COST: f64 = 0.2;
const AT_LIMIT: f64 = 0.99;
/// Maximal value of each cost. An action may have any f32 value, and the reward contains the action's square, but must
/// still be finite as f32.
const MAX_COST: f64 = 1e30;

/// Number of entries about the torso, at the start of an observation.
const N_TORSO: usize = 8;
/// Maximal length of a robot's observation.
const MAX_OBSERVATION: usize = N_TORSO + 2 * MAX_JOINTS + MAX_JOINTS;

/// A robot in a vertical plane that is rewarded for running along +x.
///
/// A step clips the action to ±1, sets the controls to `power` × this action, and simulates four timesteps of 4.125 ms.
/// The observation has the contact flags of the state at the end of the previous step. In the first step of an episode
/// all flags are false. The flags also decide whether the robot is alive. The reward is the sum of
///
/// | term | value |
/// |---|---|
/// | alive | 1 while alive, else -1, and the episode terminates |
/// | progress | Δx / 0.0165 s, where x is the mean x coordinate of all bodies' centres of mass, in m |
/// | electricity | -2 × mean of abs(a × 0.1 q̇) |
/// | stall_torque | -0.1 × mean of a² |
/// | joint_limits | -0.2 × number of joints beyond 99 % of their range |
///
/// where a is the action as received, not clipped, and q̇ the joints' speeds after the step in rad/s.
///
/// The physics diverge if MuJoCo raises a warning or a fatal error, or if the observation is not finite. Examples of
/// warnings are a bad number and dropped contacts. After a divergence the episode terminates, the term `alive` is -1,
/// the other terms are 0, and the observation of the previous step stays. If a reset sets a state that diverges at
/// once, the observation is all zeros.
///
/// A walker has no simulation of its own. Before each step, the walker's parameters and state are written into a shared
/// simulation. After the step, the walker stores the new state and the results.
pub struct Walker {
    robot: &'static Robot,
    pristine: &'static Pristine,
    /// The edit of the model by the parameters.
    edit: Arc<RobotEdit>,
    power: f64,
    /// The state in the layout of [`Simulation::state`]. It is undefined after the physics diverged.
    state: [f64; MAX_STATE],
    /// The contact flags that the next step observes, in the order of [`Names::contacts`](super::Names::contacts).
    /// `None` if the flags must be computed from the state. At the start of an episode all flags are false.
    contacts: Option<[bool; MAX_JOINTS]>,
    observation: [f32; MAX_OBSERVATION],
    /// The torso's height at the reset, in m.
    initial_height: f64,
    /// The mean x coordinate of all bodies' centres of mass after the last step, in m.
    x: f64,
    /// The maximum of the torso's x coordinate in the episode, in m.
    greatest_x: f64,
    /// The force on the torso in the next step, in N; `None` without a push.
    push: Option<[f64; 3]>,
    /// Whether the physics diverged since the last reset.
    diverged: bool,
}

impl Walker {
    pub(in crate::tasks) fn new(robot: &'static Robot) -> Result<Self, Error> {
        let refuse = |error: &SimulationError| Error::Model { environment: robot.spec.name, reason: error.to_string() };
        let pristine = robot.pristine.get_or_init(|| Pristine::compile(robot)).as_ref().map_err(refuse)?;
        let [power, density, friction] = std::array::from_fn(|i| robot.spec.parameters[i].default);
        let edit = pristine.edit(density, friction).map_err(|error| refuse(&error))?;
        let mut walker = Self {
            robot,
            pristine,
            edit,
            power,
            state: [0.0; MAX_STATE],
            contacts: None,
            observation: [0.0; MAX_OBSERVATION],
            initial_height: 0.0,
            x: 0.0,
            greatest_x: 0.0,
            push: None,
            diverged: false,
        };
        walker.clear();
        walker.start();
        Ok(walker)
    }

    /// Calls `look` with a simulation that has the current parameters and state. Poses and contacts are not computed
    /// yet.
    ///
    /// # Errors
    /// MuJoCo's fatal errors.
    pub fn inspect<T>(&self, look: impl FnOnce(&Simulation) -> T) -> Result<T, SimulationError> {
        shared::with(self.pristine, |shared| Ok(look(shared.at(&self.edit, self.state())?.0)))
    }

    /// The MJCF text of the model, with default parameters.
    pub fn mjcf(&self) -> &'static str {
        self.robot.look.mjcf
    }

    // ---- state

    fn state(&self) -> &[f64] {
        &self.state[..self.pristine.state.len()]
    }

    fn state_mut(&mut self) -> &mut [f64] {
        &mut self.state[..self.pristine.state.len()]
    }

    /// Returns the positions and the velocities in the state, for editing.
    fn positions_mut(&mut self) -> (&mut [f64], &mut [f64]) {
        let model = &self.pristine.model;
        let (qpos, rest) = self.state[1..].split_at_mut(model.n_q());
        (qpos, &mut rest[..model.n_v()])
    }

    /// Sets the state to the model's initial state.
    fn clear(&mut self) {
        let initial = &self.pristine.state;
        self.state[..initial.len()].copy_from_slice(initial);
    }

    /// Begins an episode in the current state.
    fn start(&mut self) {
        let contacts = [false; MAX_JOINTS];
        self.contacts = Some(contacts);
        self.observation = [0.0; MAX_OBSERVATION];
        self.greatest_x = 0.0;
        let pristine = self.pristine;
        let seen = shared::with(pristine, |shared| {
            let (simulation, _) = shared.at(&self.edit, self.state())?;
            simulation.motion()?;
            self.x = pristine.track_position(simulation);
            (self.greatest_x, self.initial_height) = pristine.torso(simulation);
            Ok(self.perceive(simulation, &contacts))
        });
        self.diverged = !matches!(seen, Ok(Some(_)));
    }

    // ---- dynamics

    /// Advances by one step. Returns `None` if the new state is not finite.
    fn advance(
        &mut self,
        simulation: &mut Simulation,
        action: &[f32],
        reward_terms: &mut [f64],
    ) -> Result<Option<Transition>, SimulationError> {
        for (ctrl, &a) in simulation.ctrl_mut().iter_mut().zip(action) {
            *ctrl = self.power * f64::from(a).clamp(-1.0, 1.0);
        }
        simulation.step_without_search()?;
        // A timestep first computes the contacts of the state before it. So after the first timestep of a step, the
        // simulation has the contacts of the state at the end of the previous step.
        let contacts = self.contacts.unwrap_or_else(|| self.pristine.touching(simulation));
        for _ in 1..N_SUBSTEPS {
            simulation.step_without_search()?;
        }
        simulation.motion()?;
        let Some((height, pitch)) = self.perceive(simulation, &contacts) else { return Ok(None) };
        simulation.state(self.state_mut());
        self.contacts = None;
        let alive =
            (self.robot.alive)(&Posture { height, pitch, contacts: &contacts[..self.robot.names.contacts.len()] });
        let x = self.pristine.track_position(simulation);
        let progress = (x - self.x) / CONTROL_TIMESTEP;
        self.x = x;
        let [electricity, stall_torque, joint_limits] = self.costs(simulation, action);
        let alive_bonus = if alive { 1.0 } else { -1.0 };
        reward_terms.copy_from_slice(&[alive_bonus, progress, electricity, stall_torque, joint_limits]);
        self.greatest_x = self.greatest_x.max(self.pristine.torso(simulation).0);
        let goal = self.robot.spec.success.holds(self.achieved());
        Ok(Some(Transition { terminated: !alive, goal, diverged: false }))
    }

    // ---- observation

    /// Computes the observation, and stores it if it is finite. Returns the torso's height in m and pitch in rad;
    /// `None` if the observation is not finite.
    fn perceive(&mut self, simulation: &Simulation, contacts: &[bool; MAX_JOINTS]) -> Option<(f64, f64)> {
        let torso = self.pristine.torso;
        let height = simulation.xipos(torso)[2];
        let [_, _, _, vx, vy, vz] = simulation.body_velocity(torso);
        let pitch = (-simulation.xmat(torso)[6]).clamp(-1.0, 1.0).asin();
        let mut new = [0.0; MAX_OBSERVATION];
        // The robot moves in a plane, so the target is straight ahead, and yaw and roll are 0.
        new[..N_TORSO].copy_from_slice(&[
            height - self.initial_height,
            0.0,
            1.0,
            0.3 * vx,
            0.3 * vy,
            0.3 * vz,
            0.0,
            pitch,
        ]);
        let (qpos, qvel) = (simulation.qpos(), simulation.qvel());
        let (joints, flags) = new[N_TORSO..].split_at_mut(2 * self.pristine.joints.len());
        for (entry, joint) in joints.chunks_exact_mut(2).zip(&self.pristine.joints) {
            entry.copy_from_slice(&[joint.scaled(qpos[joint.qpos]), 0.1 * qvel[joint.dof]]);
        }
        for (entry, &touching) in flags.iter_mut().zip(&contacts[..self.robot.names.contacts.len()]) {
            *entry = f64::from(u8::from(touching));
        }
        if !new.iter().all(|value| value.is_finite()) {
            return None;
        }
        self.observation = new.map(|value| value.clamp(-CLIP, CLIP) as f32);
        Some((height, pitch))
    }

    // ---- reward

    /// Returns the reward terms `electricity`, `stall_torque` and `joint_limits`.
    fn costs(&self, simulation: &Simulation, action: &[f32]) -> [f64; 3] {
        let (qpos, qvel) = (simulation.qpos(), simulation.qvel());
        let (mut power, mut torque, mut at_limit) = (0.0, 0.0, 0.0);
        for (joint, &a) in self.pristine.joints.iter().zip(action) {
            let a = f64::from(a);
            power += (a * (0.1 * qvel[joint.dof])).abs();
            torque += a * a;
            at_limit += f64::from(u8::from(joint.scaled(qpos[joint.qpos]).abs() > AT_LIMIT));
        }
        let n = self.pristine.joints.len() as f64;
        [ELECTRICITY_COST * (power / n), STALL_TORQUE_COST * (torque / n), JOINT_LIMIT_COST * at_limit]
            .map(|cost| -cost.min(MAX_COST))
    }

    /// Writes to `reward_terms` the terms of a step in which the physics diverged. Returns the transition that ends the
    /// episode.
    fn fail(&mut self, reward_terms: &mut [f64]) -> Transition {
        self.diverged = true;
        reward_terms.copy_from_slice(&[-1.0, 0.0, 0.0, 0.0, 0.0]);
        Transition { terminated: true, goal: false, diverged: true }
    }

    fn n_saved(&self) -> usize {
        1 + self.pristine.state.len() + 1 + self.robot.names.contacts.len() + self.robot.spec.observation.len() + 1
    }

    /// Returns the contact flags that the next step observes.
    fn contacts(&self) -> [bool; MAX_JOINTS] {
        let computed = || {
            shared::with(self.pristine, |shared| {
                let (simulation, _) = shared.at(&self.edit, self.state())?;
                let _ = simulation.step1(); // contacts are computed even if it warns; the next step repeats the warning
                Ok(self.pristine.touching(simulation))
            })
        };
        self.contacts.unwrap_or_else(|| computed().expect(NO_MEMORY))
    }
}

/// The message of an `expect` that cannot fail; the message states why. If the `expect` fails anyway, the worker's
/// panic ends its batch, but not the server.
const NO_MEMORY: &str = "there is memory for the one simulation of this thread";

impl Environment for Walker {
    fn spec(&self) -> &'static EnvironmentSpec {
        self.robot.spec
    }

    fn set_parameters(&mut self, values: &[f64]) {
        let &[power, density, friction] = values else {
            unreachable!("a walker is given its three validated parameters")
        };
        self.power = power;
        let edit = || self.pristine.edit(density, friction);
        // After a fatal error of MuJoCo, the edit is tried a second time, with a new simulation.
        self.edit = edit().or_else(|_| edit()).expect(NO_MEMORY);
    }

    fn applied(&self, out: &mut [f64]) {
        let Pristine { targets, model: pristine, .. } = self.pristine;
        let read = shared::with(self.pristine, |shared| {
            let model = shared.edited(&self.edit)?.model();
            let density = targets.density(model, pristine);
            out.copy_from_slice(&[targets.torso_mass(model), targets.friction(model), self.power, density]);
            Ok(())
        });
        read.expect(NO_MEMORY);
    }

    fn achieved(&self) -> Option<f64> {
        Some(self.greatest_x)
    }

    fn model_hash(&self) -> &str {
        &self.pristine.hash
    }

    fn push(&mut self, impulse: [f64; 3]) {
        self.push = Some(impulse.map(|impulse| impulse / CONTROL_TIMESTEP));
    }

    fn reset(&mut self, stream: &mut PhiloxStream) {
        self.clear();
        let joints = &self.pristine.joints;
        let (qpos, _) = self.positions_mut();
        for joint in joints {
            qpos[joint.qpos] = stream.uniform(-RESET_RANGE, RESET_RANGE).clamp(joint.low, joint.high);
        }
        self.start();
    }

    fn reset_to(&mut self, state: &[f64]) {
        self.clear();
        let (qpos, qvel) = self.positions_mut();
        let (positions, velocities) = state.split_at(qpos.len());
        qpos.copy_from_slice(positions);
        qvel.copy_from_slice(velocities);
        self.start();
    }

    fn observe(&self, out: &mut [f32]) {
        out.copy_from_slice(&self.observation[..self.robot.spec.observation.len()]);
    }

    fn scene(&self) -> Option<Scene> {
        let qpos = &self.state[1..][..self.pristine.model.n_q()];
        (!self.diverged).then(|| Scene::Model(PosedModel { look: &self.robot.look, edited: None, qpos: qpos.to_vec() }))
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let Action::Continuous(action) = action else { unreachable!("a walker is stepped with validated controls") };
        if self.diverged {
            return self.fail(reward_terms);
        }
        let push = self.push.take();
        let torso = self.pristine.torso;
        let stepped = shared::with(self.pristine, |shared| {
            let (simulation, _) = shared.at(&self.edit, self.state())?;
            push.into_iter().for_each(|force| simulation.set_force(torso, force));
            let stepped = self.advance(simulation, action, reward_terms);
            push.into_iter().for_each(|_| simulation.set_force(torso, [0.0; 3]));
            stepped
        });
        match stepped {
            Ok(Some(transition)) => transition,
            _ => self.fail(reward_terms),
        }
    }

    fn save(&self, out: &mut Vec<f64>) {
        out.push(f64::from(u8::from(self.diverged)));
        let physics = out.len();
        out.extend_from_slice(self.state());
        out.push(self.initial_height);
        if self.diverged {
            out[physics..].fill(0.0); // a diverged state is not used any more, and may not be finite
        }
        let contacts = self.contacts();
        out.extend(contacts[..self.robot.names.contacts.len()].iter().map(|&flag| f64::from(u8::from(flag))));
        // The observation is saved, because it has the contact flags of the previous step, which cannot be computed
        // from the state.
        out.extend(self.observation[..self.robot.spec.observation.len()].iter().map(|&value| f64::from(value)));
        out.push(self.greatest_x);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        let refuse = |reason: String| Err(Error::Snapshot { reason });
        // Snapshots of older servers end with the observation, and lack the maximum of x.
        let has_greatest_x = state.len() == self.n_saved();
        if !has_greatest_x && state.len() + 1 != self.n_saved() {
            return refuse(format!("its state has {} numbers, expected {}", state.len(), self.n_saved()));
        }
        if !state.iter().all(|value| value.is_finite()) {
            return refuse("its state is not finite".into());
        }
        // The numbers have the order of `save`.
        let mut rest = state;
        let mut take = |n: usize| rest.split_off(..n).unwrap_or_default();
        let diverged = take(1) != [0.0];
        let pristine = self.pristine;
        self.state_mut().copy_from_slice(take(pristine.state.len()));
        let placed = shared::with(pristine, |shared| {
            let (simulation, _) = shared.at(&self.edit, self.state())?;
            simulation.motion()?;
            Ok((pristine.track_position(simulation), pristine.torso(simulation).0))
        });
        let Ok((x, torso_x)) = placed else { return refuse("its state diverges".into()) };
        self.diverged = diverged;
        self.x = x;
        self.initial_height = take(1)[0];
        let mut contacts = [false; MAX_JOINTS];
        for (flag, &saved) in contacts.iter_mut().zip(take(self.robot.names.contacts.len())) {
            *flag = saved != 0.0;
        }
        self.contacts = Some(contacts);
        self.observation = [0.0; MAX_OBSERVATION];
        for (value, &saved) in self.observation.iter_mut().zip(take(self.robot.spec.observation.len())) {
            *value = saved.clamp(-CLIP, CLIP) as f32;
        }
        self.greatest_x = if has_greatest_x { take(1)[0] } else { torso_x };
        Ok(())
    }
}
