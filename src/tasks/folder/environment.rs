//! The environment of a folder. MuJoCo simulates the model; `task.toml` defines observations, rewards and ends of
//! episodes.

use super::{
    number::{Stage, StepActions},
    parameter::{AppliedQuantity, EditedParameter},
    reading::Reading,
    reset::InitialStateDistribution,
    reward::{StepValues, Term},
    rules::{Aggregate, Goal, Range},
    template::{ModelEdit, Template},
};
use crate::{
    env::{Action, Environment, EnvironmentSpec, Error, ParameterSpec, PhiloxStream, Transition},
    scene::{Look, PosedModel, Scene},
    tasks::shared,
};
use perturb_mujoco::{Error as SimulationError, ModelField, Simulation};
use std::sync::Arc;

/// Maximal absolute position or velocity in a saved state. MuJoCo reports divergence above this value.
const MAX_STATE: f64 = 1e10;
/// The message of an `expect` that cannot fail; the message states why. If the `expect` fails anyway, the worker's
/// panic ends its batch, but not the server.
const NO_MEMORY: &str = "there is memory for the one simulation of this thread";

/// The time at which MuJoCo computes the poses that a step's readings use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Poses {
    /// MuJoCo computes the poses at the start of the step's last timestep, as part of the simulation. With the
    /// integrator RK4, the poses are those of the timestep's last stage.
    Before,
    /// MuJoCo computes the poses after the step, by an additional computation.
    After,
}

/// The task of a folder, with its compiled model. It lives as long as the process.
pub(super) struct FolderTask {
    pub(super) spec: EnvironmentSpec,
    pub(super) template: Template,
    pub(super) hash: String,
    pub(super) look: Look,
    pub(super) frame_skip: u32,
    pub(super) poses: Poses,
    pub(super) observation: Vec<Reading>,
    pub(super) reward: Vec<Term>,
    pub(super) healthy: Vec<Range>,
    pub(super) terminate_when_unhealthy: bool,
    pub(super) goal: Goal,
    pub(super) reset: InitialStateDistribution,
    /// The range (low, high) of each control. An action has one entry for each control.
    pub(super) controls: Vec<(f64, f64)>,
    /// Whether actions are scaled, so that -1 and 1 stand for the ends of the control's range.
    pub(super) scaled: bool,
    pub(super) parameters: Vec<EditedParameter>,
    pub(super) applied: Vec<AppliedQuantity>,
    /// The index of the body that is pushed; `None` if no body can move.
    pub(super) pushed_body: Option<usize>,
    /// The disturbances whose values in versions R and E the file configures. If there are any, the catalogue lists all
    /// disturbances as parameters.
    pub(super) disturbances: Vec<ParameterSpec>,
    pub(super) needs: Needs,
    /// Whether the model's text has `settotalmass`, which scales all masses. Edited masses are not scaled again.
    pub(super) has_total_mass: bool,
}

/// The computations that a task's readings need in each step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Needs {
    pub(super) stage: Stage,
    pub(super) external_forces: bool,
    /// The total number of values that reward terms remember from one step to the next.
    pub(super) n_remembered: usize,
}

impl Needs {
    /// Collects the computations that the parts of a task need.
    pub(super) fn new(observation: &[Reading], reward: &[Term], healthy: &[Range], goal: &Goal) -> Self {
        let ranges = healthy.iter().chain(&goal.ranges).map(Range::reading);
        let achieved = goal.achieved.iter().map(|(_, reading)| reading);
        let readings: Vec<&Reading> = observation.iter().chain(ranges).chain(achieved).collect();
        let stages = readings.iter().map(|reading| reading.stage()).chain(reward.iter().map(Term::stage));
        Self {
            stage: stages.max().unwrap_or(Stage::State),
            external_forces: readings.iter().any(|reading| reading.needs_external_forces())
                || reward.iter().any(Term::needs_external_forces),
            n_remembered: reward.iter().filter_map(Term::remembered).map(Reading::len).sum(),
        }
    }
}

/// An environment of a folder.
///
/// A step sets the controls to the action, clipped to their range. If the task scales actions, the action is clipped to
/// ±1 and scaled to this range instead. Then the step simulates `frame_skip` timesteps. Then the environment computes
/// health, the terms of the reward, the goal, the observation and the achieved value, in this order, from the same
/// state.
///
/// The physics diverge if MuJoCo raises a warning or a fatal error. Examples of warnings are a bad number and dropped
/// contacts. The physics also count as diverged if a number of the reward, the observation or the achieved value is not
/// finite. After a divergence the episode terminates, all terms except those of the kind `healthy` are 0, and the
/// observation of the previous step stays. If a reset sets a state that diverges at once, the observation is all zeros.
///
/// An environment has no simulation of its own. Before each step, the environment's parameters and state are written
/// into a shared simulation. After the step, the environment stores the new state and the results.
pub(super) struct FolderEnvironment {
    task: &'static FolderTask,
    edit: Arc<ModelEdit>,
    /// The state in the layout of [`Simulation::state`]. It is undefined after the physics diverged.
    state: Box<[f64]>,
    /// The numbers that reward terms remember from the previous step.
    remembered: Box<[f64]>,
    /// The last action; zeros after a reset.
    action: Box<[f32]>,
    observation: Box<[f32]>,
    achieved: f64,
    /// The force on the pushed body in the next step, in N; `None` without a push.
    push: Option<[f64; 3]>,
    /// Whether the physics have diverged since the last reset.
    diverged: bool,
    /// Whether the model could not be compiled with the lengths that the last parameters give. Then the physics use the
    /// defaults of all parameters, and each episode ends as diverged in its first step.
    is_impossible: bool,
}

impl FolderEnvironment {
    /// Creates an environment with default parameters.
    ///
    /// # Errors
    /// [`Error::Model`] if there is not enough memory for a simulation.
    pub(super) fn new(task: &'static FolderTask) -> Result<Self, Error> {
        let edit = task
            .template
            .edit(&task.parameters, &defaults(task))
            .map_err(|error| Error::Model { environment: task.spec.name, reason: error.to_string() })?;
        let mut environment = Self {
            task,
            edit,
            state: task.template.state.clone().into(),
            remembered: vec![0.0; task.needs.n_remembered].into(),
            action: vec![0.0; task.controls.len()].into(),
            observation: vec![0.0; task.spec.observation.len()].into(),
            achieved: 0.0,
            push: None,
            diverged: false,
            is_impossible: false,
        };
        environment.start();
        Ok(environment)
    }

    /// Returns the positions and the velocities in the state, for editing.
    fn positions_mut(&mut self) -> (&mut [f64], &mut [f64]) {
        let model = &self.task.template.model;
        let (qpos, rest) = self.state[1..].split_at_mut(model.n_q());
        (qpos, &mut rest[..model.n_v()])
    }

    /// Sets the state to the model's initial state, and clears action, observation and achieved value.
    fn clear(&mut self) {
        self.state.copy_from_slice(&self.task.template.state);
        self.action.fill(0.0);
        self.observation.fill(0.0);
        self.achieved = 0.0;
    }

    /// Begins an episode in the current state.
    fn start(&mut self) {
        let task = self.task;
        let started = shared::with(&task.template, |shared| {
            let (simulation, numbers) = shared.at(&self.edit, &self.state)?;
            // The shared simulation may still have the contact forces on bodies (`cfrc_ext`) of another environment.
            // They are set to 0, so that no reading returns them. `forward` computes them only if a sensor needs them.
            simulation.clear_external_forces();
            simulation.forward()?;
            simulation.state(&mut self.state);
            if task.poses == Poses::After && task.needs.external_forces {
                simulation.external_forces()?;
            }
            let action = vec![0.0; self.action.len()];
            let context = StepActions { action: &action, previous_action: &action };
            let mut remembered = Vec::with_capacity(self.remembered.len());
            for reading in task.reward.iter().filter_map(Term::remembered) {
                reading.read(simulation, &context, &mut remembered);
            }
            self.remembered.copy_from_slice(&remembered);
            Ok(is_finite(&self.remembered) && self.observe_now(simulation, &context, numbers, true))
        });
        self.diverged = self.is_impossible || !matches!(started, Ok(true));
    }

    /// Computes the observation and the achieved value, and stores them. Returns false and stores nothing if a number
    /// is not finite. `is_first` is true at the start of an episode.
    fn observe_now(
        &mut self,
        simulation: &Simulation,
        context: &StepActions<'_>,
        numbers: &mut Vec<f64>,
        is_first: bool,
    ) -> bool {
        numbers.clear();
        for reading in &self.task.observation {
            reading.read(simulation, context, numbers);
        }
        if !numbers.iter().all(|&value| (value as f32).is_finite()) {
            return false;
        }
        let achieved = self.task.goal.achieved.as_ref().map(|(aggregate, reading)| {
            let n = numbers.len();
            reading.read(simulation, context, numbers);
            let now = numbers.drain(n..).next().unwrap_or(f64::NAN);
            match aggregate {
                Aggregate::Greatest if !is_first => self.achieved.max(now),
                Aggregate::Least if !is_first => self.achieved.min(now),
                _ => now,
            }
        });
        let achieved = achieved.unwrap_or(0.0);
        if !achieved.is_finite() {
            return false;
        }
        self.achieved = achieved;
        for (entry, &value) in self.observation.iter_mut().zip(numbers.iter()) {
            *entry = value as f32;
        }
        true
    }

    /// Advances by one step. Returns `None` if a resulting number is not finite.
    fn advance(
        &mut self,
        (simulation, numbers): (&mut Simulation, &mut Vec<f64>),
        action: &[f32],
        reward_terms: &mut [f64],
    ) -> Result<Option<Transition>, SimulationError> {
        let task = self.task;
        for ((ctrl, &a), &(low, high)) in simulation.ctrl_mut().iter_mut().zip(action).zip(&task.controls) {
            let a = f64::from(a);
            *ctrl =
                if task.scaled { low + (high - low) * ((a.clamp(-1.0, 1.0) + 1.0) / 2.0) } else { a.clamp(low, high) };
        }
        for _ in 0..task.frame_skip {
            simulation.step_without_search()?;
        }
        // The state is copied before poses are computed again, because that computation changes the solver's starting
        // point and normalises quaternions.
        simulation.state(&mut self.state);
        if task.poses == Poses::After {
            match task.needs.stage {
                Stage::State => {}
                Stage::Motion => simulation.motion()?,
                Stage::Forward => simulation.forward()?,
            }
        }
        if task.needs.external_forces {
            simulation.external_forces()?;
        }
        // Health, reward terms, goal and observation are computed from the same state, in this order.
        let (mut previous, mut remembered) = (std::mem::take(&mut self.action), std::mem::take(&mut self.remembered));
        let context = StepActions { action, previous_action: &previous };
        let healthy = is_finite(simulation.qpos())
            && is_finite(simulation.qvel())
            && task.healthy.iter().all(|range| range.holds(simulation, &context, numbers));
        let step = StepValues { context, healthy, seconds: task.spec.control_timestep, before: &remembered };
        for (value, term) in reward_terms.iter_mut().zip(&task.reward) {
            *value = term.compute(simulation, &step, numbers);
        }
        let context = StepActions { action, previous_action: &previous };
        numbers.clear();
        for reading in task.reward.iter().filter_map(Term::remembered) {
            reading.read(simulation, &context, numbers);
        }
        remembered.copy_from_slice(numbers);
        let goal = !task.goal.ranges.is_empty()
            && task.goal.ranges.iter().all(|range| range.holds(simulation, &context, numbers));
        let is_observed = self.observe_now(simulation, &context, numbers, false) && is_finite(&remembered);
        previous.copy_from_slice(action);
        (self.action, self.remembered) = (previous, remembered);
        if !is_observed || !is_finite(reward_terms) {
            return Ok(None);
        }
        let terminated = !healthy && task.terminate_when_unhealthy && !task.healthy.is_empty();
        Ok(Some(Transition { terminated, goal, diverged: false }))
    }

    /// Writes to `reward_terms` the terms of a step in which the physics diverged. Returns the transition that ends the
    /// episode.
    fn fail(&mut self, reward_terms: &mut [f64]) -> Transition {
        self.diverged = true;
        for (value, term) in reward_terms.iter_mut().zip(&self.task.reward) {
            *value = term.diverged();
        }
        Transition { terminated: true, goal: false, diverged: true }
    }

    fn n_saved(&self) -> usize {
        2 + self.state.len() + self.remembered.len() + self.action.len() + self.observation.len()
    }
}

fn defaults(task: &FolderTask) -> Vec<f64> {
    task.spec.parameters.iter().map(|parameter| parameter.default).collect()
}

fn is_finite(numbers: &[f64]) -> bool {
    numbers.iter().all(|value| value.is_finite())
}

impl Environment for FolderEnvironment {
    fn spec(&self) -> &'static EnvironmentSpec {
        &self.task.spec
    }

    fn set_parameters(&mut self, values: &[f64]) {
        let task = self.task;
        let edit = |values: &[f64]| {
            let edit = || task.template.edit(&task.parameters, values);
            edit().or_else(|_| edit()) // a fatal error needs a second attempt, with a new simulation
        };
        let edited = edit(values);
        self.is_impossible = matches!(edited, Err(SimulationError::Compile { .. }));
        let edited = if self.is_impossible { edit(&defaults(task)) } else { edited };
        self.edit = edited.expect(NO_MEMORY);
    }

    fn applied(&self, out: &mut [f64]) {
        let task = self.task;
        let read = shared::with(&task.template, |shared| {
            let model = shared.edited(&self.edit)?.model();
            let parameters = task.parameters.iter().zip(&self.edit.values);
            let pristine = (&*task.template.model, &*self.edit.compiled);
            let read_back = parameters.map(|(parameter, &value)| parameter.read_back(pristine, model, value));
            let values = read_back.chain(task.applied.iter().map(|quantity| quantity.read(model)));
            out.iter_mut().zip(values).for_each(|(out, value)| *out = value);
            Ok(())
        });
        read.expect(NO_MEMORY);
    }

    fn achieved(&self) -> Option<f64> {
        self.task.goal.achieved.is_some().then_some(self.achieved)
    }

    fn model_hash(&self) -> &str {
        &self.task.hash
    }

    /// Writes the action that sets each control to the number in its range that is nearest to 0.
    fn neutral_action(&self, out: &mut [f32]) {
        for (entry, &(low, high)) in out.iter_mut().zip(&self.task.controls) {
            let control = 0.0_f64.clamp(low, high);
            let is_scaled = self.task.scaled && high > low;
            *entry = if is_scaled { 2.0 * (control - low) / (high - low) - 1.0 } else { control } as f32;
        }
    }

    fn push(&mut self, impulse: [f64; 3]) {
        self.push = Some(impulse.map(|impulse| impulse / self.task.spec.control_timestep));
    }

    fn reset(&mut self, stream: &mut PhiloxStream) {
        self.clear();
        let reset = &self.task.reset;
        let (qpos, qvel) = self.positions_mut();
        reset.draw(stream, qpos, qvel);
        // Edited lengths may change the initial positions of bodies with free joints. The drawn positions are shifted
        // by the same differences.
        let (own, compiled) = (Arc::clone(&self.task.template.model), Arc::clone(&self.edit.compiled));
        if !Arc::ptr_eq(&own, &compiled) {
            let initial =
                own.field(ModelField::InitialPositions).iter().zip(compiled.field(ModelField::InitialPositions));
            let (qpos, _) = self.positions_mut();
            qpos.iter_mut().zip(initial).for_each(|(q, (own, compiled))| *q += compiled - own);
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
        out.copy_from_slice(&self.observation);
    }

    fn scene(&self) -> Option<Scene> {
        let qpos = &self.state[1..][..self.task.template.model.n_q()];
        let edited = || self.task.template.recompilation.as_ref()?.picture(&self.edit.values);
        let posed = || PosedModel { look: &self.task.look, edited: edited(), qpos: qpos.to_vec() };
        (!self.diverged).then(|| Scene::Model(posed()))
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let Action::Continuous(action) = action else { unreachable!("folders are stepped with validated controls") };
        if self.diverged {
            return self.fail(reward_terms);
        }
        let edit = Arc::clone(&self.edit);
        let push = self.push.take().zip(self.task.pushed_body);
        let stepped = shared::with(&self.task.template, |shared| {
            let (simulation, numbers) = shared.at(&edit, &self.state)?;
            push.into_iter().for_each(|(force, body)| simulation.set_force(body, force));
            let stepped = self.advance((&mut *simulation, numbers), action, reward_terms);
            push.into_iter().for_each(|(_, body)| simulation.set_force(body, [0.0; 3]));
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
        out.extend_from_slice(&self.state);
        out.extend_from_slice(&self.remembered);
        if self.diverged {
            out[physics..].fill(0.0); // a diverged state is not used any more, and may not be finite
        }
        out.extend(self.action.iter().chain(&self.observation).map(|&value| f64::from(value)));
        out.push(self.achieved);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        let refuse = |reason: String| Err(Error::Snapshot { reason });
        if state.len() != self.n_saved() {
            return refuse(format!("its state has {} numbers, expected {}", state.len(), self.n_saved()));
        }
        if !is_finite(state) {
            return refuse("its state is not finite".into());
        }
        let mut rest = state;
        let mut take = |n: usize| rest.split_off(..n).unwrap_or_default();
        let diverged = take(1) != [0.0];
        let physics = take(self.state.len());
        let model = &self.task.template.model;
        if physics[1..][..model.n_q() + model.n_v()].iter().any(|value| value.abs() > MAX_STATE) {
            return refuse("its state diverges".into());
        }
        self.diverged = diverged || self.is_impossible;
        self.state.copy_from_slice(physics);
        self.remembered.copy_from_slice(take(self.remembered.len()));
        let single =
            |value: f64, low: f64, high: f64| value.clamp(low, high).clamp(f32::MIN.into(), f32::MAX.into()) as f32;
        let actions = take(self.action.len());
        for (own, &saved) in self.action.iter_mut().zip(actions) {
            *own = single(saved, f64::NEG_INFINITY, f64::INFINITY);
        }
        let channels = self.task.spec.observation;
        let observations = take(self.observation.len());
        for ((own, &saved), channel) in self.observation.iter_mut().zip(observations).zip(channels) {
            *own = single(saved, channel.low, channel.high);
        }
        self.achieved = take(1).first().copied().unwrap_or(0.0);
        Ok(())
    }
}
