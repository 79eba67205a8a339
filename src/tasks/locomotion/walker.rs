//! The task that Hopper and HalfCheetah share: a planar robot runs along +x.

use super::{
    channels::{CLIP, CONTROL_TIMESTEP, Names},
    model_edit::Targets,
};
use crate::{
    env::{Action, Environment, EnvironmentSpec, Error, Stream, Transition},
    scene::{Look, PosedModel, Scene},
};
use perturb_mujoco::{Error as SimulationError, Kind, Model, Simulation};
use sha2::{Digest, Sha256};
use std::{fmt::Write, sync::OnceLock};

const TIMESTEP: f64 = 0.004125;
const N_SUBSTEPS: usize = 4;
const RESET_RANGE: f64 = 0.1;
const ELECTRICITY_COST: f64 = 2.0;
const STALL_TORQUE_COST: f64 = 0.1;
const JOINT_LIMIT_COST: f64 = 0.2;
const AT_LIMIT: f64 = 0.99;
/// Costs end here: actions may be as large as an f32, and their squares must not make a reward that is not.
const MOST_COST: f64 = 1e30;

/// Entries of an observation before the joints'.
const N_TORSO: usize = 8;
/// Joints before the motors': root_x, root_z, root_pitch.
const N_ROOT: usize = 3;
/// Room for the larger robot.
const MOST_JOINTS: usize = 6;
const MOST_OBSERVATION: usize = N_TORSO + 2 * MOST_JOINTS + MOST_JOINTS;

/// What differs between the robots.
pub struct Task {
    pub spec: &'static EnvironmentSpec,
    /// The model, and how it is shown.
    pub look: Look,
    pub names: Names,
    pub alive: fn(&Posture<'_>) -> bool,
    /// Compiled once in the process.
    pub pristine: OnceLock<Result<Pristine, SimulationError>>,
}

/// What decides whether a robot is alive.
pub struct Posture<'a> {
    /// The torso's centre of mass above the floor, m.
    pub height: f64,
    /// The torso's turn about +y, rad.
    pub pitch: f64,
    /// The contact flags of the step before, in the task's order.
    pub contacts: &'a [bool],
}

/// A model as compiled, and where its parts are.
pub struct Pristine {
    model: Model,
    hash: String,
    targets: Targets,
    torso: usize,
    joints: Vec<Joint>,
    /// For each geom the contact flag that it raises, if any.
    flag_of_geom: Vec<Option<usize>>,
}

#[derive(Debug, Clone, Copy)]
struct Joint {
    qpos: usize,
    dof: usize,
    low: f64,
    high: f64,
}

impl Joint {
    /// The position, with the joint's range scaled to ±1.
    fn scaled(self, q: f64) -> f64 {
        2.0 * (q - (self.low + self.high) / 2.0) / (self.high - self.low)
    }
}

impl Pristine {
    fn compile(task: &Task) -> Result<Self, SimulationError> {
        let model = Model::from_xml(task.look.mjcf)?;
        assert_eq!(model.timestep(), TIMESTEP, "the control timestep is four of these");
        assert_eq!(
            (model.n_q(), model.n_act()),
            (N_ROOT + task.names.joints.len(), 0),
            "the model does not fit the task"
        );
        let (qpos, dof) = (model.joint_qpos_address(), model.joint_dof_address());
        let all: Vec<Joint> = qpos
            .zip(dof)
            .zip(model.joint_range())
            .map(|((qpos, dof), (low, high))| Joint { qpos, dof, low, high })
            .collect();
        let joints =
            task.names.joints.iter().map(|name| Ok(all[model.id(Kind::Joint, name)?])).collect::<Result<_, _>>()?;
        let mut flag_of_geom = vec![None; model.n_geom()];
        for (flag, name) in task.names.contacts.iter().enumerate() {
            flag_of_geom[model.id(Kind::Geom, name)?] = Some(flag);
        }
        let hash = Sha256::digest(task.look.mjcf).iter().fold(String::new(), |mut hex, byte| {
            let _ = write!(hex, "{byte:02x}"); // writing to a String cannot fail
            hex
        });
        let (targets, torso) = (Targets::of(&model)?, model.id(Kind::Body, "torso")?);
        Ok(Self { targets, torso, joints, flag_of_geom, hash, model })
    }
}

/// A planar robot that is paid for running along +x.
///
/// A step sets the controls to `power` × the action clipped to ±1 and holds them for four timesteps of 4.125 ms. Then,
/// in this order: observation, alive, progress, contact flags, costs; so the flags that are observed and that decide
/// about life are those of the step before. The reward is the sum of
///
/// | term | value |
/// |---|---|
/// | alive | 1 while alive, else -1, and the episode terminates |
/// | progress | Δx / 0.0165 s, x the mean over the robot's bodies of their centres of mass, m |
/// | electricity | -2 × mean of abs(a × 0.1 q̇) |
/// | stall_torque | -0.1 × mean of a² |
/// | joint_limits | -0.2 × number of joints beyond 99 % of their range |
///
/// with a the action as received, not clipped, and q̇ the joints' speeds after the step in rad/s.
///
/// If the physics diverge (MuJoCo warns of a number, or of lost contacts, or fails), the step terminates with alive -1
/// and no other term, and the observation stays that of the step before; after a reset to a state that diverges at
/// once it is zeros.
pub struct Walker {
    task: &'static Task,
    pristine: &'static Pristine,
    simulation: Simulation,
    power: f64,
    /// After the last step, in the task's order.
    contacts: [bool; MOST_JOINTS],
    observation: [f32; MOST_OBSERVATION],
    /// The torso's height at the reset, m.
    initial_height: f64,
    /// The robot's place along the track, m.
    x: f64,
    /// The torso's greatest x in the episode, m.
    greatest_x: f64,
    /// Until the next reset.
    diverged: bool,
}

impl Walker {
    pub(in crate::tasks) fn new(task: &'static Task) -> Result<Self, Error> {
        let refuse = |error: &SimulationError| Error::Model { environment: task.spec.name, reason: error.to_string() };
        let pristine = task.pristine.get_or_init(|| Pristine::compile(task)).as_ref().map_err(refuse)?;
        let simulation = pristine.model.try_clone().and_then(Simulation::new).map_err(|error| refuse(&error))?;
        let mut walker = Self {
            task,
            pristine,
            simulation,
            power: 0.0,
            contacts: [false; MOST_JOINTS],
            observation: [0.0; MOST_OBSERVATION],
            initial_height: 0.0,
            x: 0.0,
            greatest_x: 0.0,
            diverged: false,
        };
        walker.set_parameters(&std::array::from_fn::<f64, 3, _>(|i| task.spec.parameters[i].default));
        walker.clear();
        walker.start();
        Ok(walker)
    }

    /// The model with the parameters in force.
    pub fn model(&self) -> &Model {
        self.simulation.model()
    }

    /// The model's MJCF text, with default parameters.
    pub fn mjcf(&self) -> &'static str {
        self.task.look.mjcf
    }

    // ---- reset

    /// The model's initial state, whatever happened before.
    fn clear(&mut self) {
        // Only a fatal error makes the reset fail; then the data are replaced. Without memory for that the simulation
        // stays unusable, and `start` notices.
        if self.simulation.reset().is_err() {
            let _ = self.simulation.renew();
        }
    }

    /// Begins an episode at the positions and velocities that the simulation holds.
    fn start(&mut self) {
        self.contacts = [false; MOST_JOINTS];
        self.observation = [0.0; MOST_OBSERVATION];
        self.greatest_x = 0.0;
        self.diverged = self.simulation.step1().is_err();
        if !self.diverged {
            self.x = self.track_position();
            self.greatest_x = self.torso_x();
            self.initial_height = self.simulation.xipos(self.pristine.torso)[2];
            self.diverged = self.perceive().is_none();
        }
    }

    // ---- dynamics

    fn advance(&mut self) -> Result<(), SimulationError> {
        for _ in 0..N_SUBSTEPS {
            // In this order poses and contacts are those of the new state, not one timestep late.
            self.simulation.step2()?;
            self.simulation.step1()?;
        }
        Ok(())
    }

    /// The mean over the robot's bodies of their centres' x, m.
    fn track_position(&self) -> f64 {
        let n_body = self.simulation.model().n_body();
        (1..n_body).map(|body| self.simulation.xipos(body)[0]).sum::<f64>() / (n_body - 1) as f64
    }

    fn torso_x(&self) -> f64 {
        self.simulation.xipos(self.pristine.torso)[0]
    }

    fn touching(&self) -> [bool; MOST_JOINTS] {
        let mut touching = [false; MOST_JOINTS];
        for (a, b) in self.simulation.contacts() {
            for flag in [a, b].into_iter().filter_map(|geom| self.pristine.flag_of_geom[geom]) {
                touching[flag] = true;
            }
        }
        touching
    }

    // ---- observation

    /// Computes the observation and keeps it if it is finite. Returns height and pitch.
    fn perceive(&mut self) -> Option<(f64, f64)> {
        let (simulation, torso) = (&self.simulation, self.pristine.torso);
        let height = simulation.xipos(torso)[2];
        let [_, _, _, vx, vy, vz] = simulation.body_velocity(torso);
        let pitch = (-simulation.xmat(torso)[6]).clamp(-1.0, 1.0).asin();
        let mut new = [0.0; MOST_OBSERVATION];
        // In the plane the target lies straight ahead, and yaw and roll are 0.
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
        let (joints, contacts) = new[N_TORSO..].split_at_mut(2 * self.pristine.joints.len());
        for (entry, joint) in joints.chunks_exact_mut(2).zip(&self.pristine.joints) {
            entry.copy_from_slice(&[joint.scaled(qpos[joint.qpos]), 0.1 * qvel[joint.dof]]);
        }
        for (entry, &touching) in contacts.iter_mut().zip(&self.contacts[..self.task.names.contacts.len()]) {
            *entry = f64::from(u8::from(touching));
        }
        if !new.iter().all(|value| value.is_finite()) {
            return None;
        }
        self.observation = new.map(|value| value.clamp(-CLIP, CLIP) as f32);
        Some((height, pitch))
    }

    // ---- reward

    /// Electricity, stall torque and joint limits.
    fn costs(&self, action: &[f32]) -> [f64; 3] {
        let (qpos, qvel) = (self.simulation.qpos(), self.simulation.qvel());
        let (mut power, mut torque, mut at_limit) = (0.0, 0.0, 0.0);
        for (joint, &a) in self.pristine.joints.iter().zip(action) {
            let a = f64::from(a);
            power += (a * (0.1 * qvel[joint.dof])).abs();
            torque += a * a;
            at_limit += f64::from(u8::from(joint.scaled(qpos[joint.qpos]).abs() > AT_LIMIT));
        }
        let n = self.pristine.joints.len() as f64;
        [ELECTRICITY_COST * (power / n), STALL_TORQUE_COST * (torque / n), JOINT_LIMIT_COST * at_limit]
            .map(|cost| -cost.min(MOST_COST))
    }

    /// What a step gives after divergence.
    fn fail(&mut self, reward_terms: &mut [f64]) -> Transition {
        self.diverged = true;
        reward_terms.copy_from_slice(&[-1.0, 0.0, 0.0, 0.0, 0.0]);
        Transition { terminated: true, goal: false, diverged: true }
    }

    fn n_saved(&self) -> usize {
        let model = self.simulation.model();
        let physics = 1 + model.n_q() + 2 * model.n_v() + model.n_act() + model.n_u();
        1 + physics + 1 + self.task.names.contacts.len() + self.task.spec.observation.len() + 1
    }
}

impl Environment for Walker {
    fn spec(&self) -> &'static EnvironmentSpec {
        self.task.spec
    }

    fn set_parameters(&mut self, values: &[f64]) {
        let [power, density, friction] = values else {
            unreachable!("a walker is given its three validated parameters")
        };
        self.power = *power;
        let Pristine { targets, model, .. } = self.pristine;
        // A fatal error leaves data that cannot be used to recompute the constants: once more with new ones.
        if targets.apply(&mut self.simulation, model, *density, *friction).is_err() && self.simulation.renew().is_ok() {
            let _ = targets.apply(&mut self.simulation, model, *density, *friction);
        }
    }

    fn applied(&self, out: &mut [f64]) {
        let (Pristine { targets, model: pristine, .. }, model) = (self.pristine, self.simulation.model());
        let density = targets.density(model, pristine);
        out.copy_from_slice(&[targets.torso_mass(model), targets.friction(model), self.power, density]);
    }

    fn achieved(&self) -> Option<f64> {
        Some(self.greatest_x)
    }

    fn model_hash(&self) -> &str {
        &self.pristine.hash
    }

    fn reset(&mut self, stream: &mut Stream) {
        self.clear();
        let qpos = self.simulation.qpos_mut();
        for joint in &self.pristine.joints {
            qpos[joint.qpos] = stream.uniform(-RESET_RANGE, RESET_RANGE).clamp(joint.low, joint.high);
        }
        self.start();
    }

    fn reset_to(&mut self, state: &[f64]) {
        self.clear();
        let (qpos, qvel) = state.split_at(self.simulation.model().n_q());
        self.simulation.qpos_mut().copy_from_slice(qpos);
        self.simulation.qvel_mut().copy_from_slice(qvel);
        self.start();
    }

    fn observe(&self, out: &mut [f32]) {
        out.copy_from_slice(&self.observation[..self.task.spec.observation.len()]);
    }

    fn scene(&self) -> Option<Scene> {
        let qpos = self.simulation.qpos();
        // After divergence MuJoCo may have put the initial state in its place.
        let known = !self.diverged && qpos.iter().all(|q| q.is_finite());
        known.then(|| Scene::Model(PosedModel { look: &self.task.look, qpos: qpos.to_vec() }))
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let Action::Continuous(action) = action else { unreachable!("a walker is stepped with validated controls") };
        for (ctrl, &a) in self.simulation.ctrl_mut().iter_mut().zip(action) {
            *ctrl = self.power * f64::from(a).clamp(-1.0, 1.0);
        }
        if self.diverged || self.advance().is_err() {
            return self.fail(reward_terms);
        }
        let Some((height, pitch)) = self.perceive() else {
            return self.fail(reward_terms);
        };
        let contacts = &self.contacts[..self.task.names.contacts.len()];
        let alive = (self.task.alive)(&Posture { height, pitch, contacts });
        let x = self.track_position();
        let progress = (x - self.x) / CONTROL_TIMESTEP;
        self.x = x;
        self.contacts = self.touching();
        let [electricity, stall_torque, joint_limits] = self.costs(action);
        let alive_bonus = if alive { 1.0 } else { -1.0 };
        reward_terms.copy_from_slice(&[alive_bonus, progress, electricity, stall_torque, joint_limits]);
        self.greatest_x = self.greatest_x.max(self.torso_x());
        Transition { terminated: !alive, goal: self.task.spec.success.holds(self.achieved()), diverged: false }
    }

    fn save(&self, out: &mut Vec<f64>) {
        let simulation = &self.simulation;
        out.push(f64::from(u8::from(self.diverged)));
        let physics = out.len();
        out.push(simulation.time());
        for part in
            [simulation.qpos(), simulation.qvel(), simulation.act(), simulation.qacc_warmstart(), simulation.ctrl()]
        {
            out.extend_from_slice(part);
        }
        out.push(self.initial_height);
        if self.diverged {
            out[physics..].fill(0.0); // nothing follows from it any more, and it may not be finite
        }
        out.extend(self.contacts[..self.task.names.contacts.len()].iter().map(|&flag| f64::from(u8::from(flag))));
        // It holds the flags of the step before, which nothing else remembers.
        out.extend(self.observation[..self.task.spec.observation.len()].iter().map(|&value| f64::from(value)));
        out.push(self.greatest_x);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        let refuse = |reason: String| Err(Error::Snapshot { reason });
        // States that were saved before it ended with the observation.
        let has_greatest_x = state.len() == self.n_saved();
        if !has_greatest_x && state.len() + 1 != self.n_saved() {
            return refuse(format!("its state has {} numbers, expected {}", state.len(), self.n_saved()));
        }
        if !state.iter().all(|value| value.is_finite()) {
            return refuse("its state is not finite".into());
        }
        let mut rest = state;
        let mut take = |n: usize| rest.split_off(..n).unwrap_or_default();
        self.clear();
        let diverged = take(1) != [0.0];
        let simulation = &mut self.simulation;
        simulation.set_time(take(1)[0]);
        for part in [
            <fn(&mut Simulation) -> &mut [f64]>::from(Simulation::qpos_mut),
            Simulation::qvel_mut,
            Simulation::act_mut,
            Simulation::qacc_warmstart_mut,
            Simulation::ctrl_mut,
        ] {
            let target = part(simulation);
            target.copy_from_slice(take(target.len()));
        }
        // Poses, contacts and passive forces follow from the state; the next step begins by using them.
        if simulation.step1().is_err() {
            return refuse("its state diverges".into());
        }
        self.diverged = diverged;
        self.x = self.track_position();
        self.initial_height = take(1)[0];
        self.contacts = [false; MOST_JOINTS];
        for (flag, &saved) in self.contacts.iter_mut().zip(take(self.task.names.contacts.len())) {
            *flag = saved != 0.0;
        }
        self.observation = [0.0; MOST_OBSERVATION];
        for (value, &saved) in self.observation.iter_mut().zip(take(self.task.spec.observation.len())) {
            *value = saved.clamp(-CLIP, CLIP) as f32;
        }
        self.greatest_x = if has_greatest_x { take(1)[0] } else { self.torso_x() };
        Ok(())
    }
}
