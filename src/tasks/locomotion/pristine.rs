//! A robot's compiled model, and the indices of the robot's parts in MuJoCo's arrays.

use super::{
    Robot,
    model_edit::{EditedElements, RobotEdit},
};
use crate::tasks::shared::{self, SharedModel};
use perturb_mujoco::{ElementKind, Error, Model, Simulation};
use sha2::{Digest, Sha256};
use std::{fmt::Write, sync::Arc};

const TIMESTEP: f64 = 0.004125;
/// Number of joints without motors, which come first: root_x, root_z, root_pitch.
const N_ROOT: usize = 3;
/// Maximal number of joints with motors, and of geoms whose contacts are observed. HalfCheetah has this many of both.
pub(super) const MAX_JOINTS: usize = 6;
/// Maximal length of a robot's [state](Simulation::state).
pub(super) const MAX_STATE: usize = 1 + 3 * (N_ROOT + MAX_JOINTS) + MAX_JOINTS;

/// A robot's compiled model, which is never modified, and values that are computed from the model once.
pub struct Pristine {
    pub(super) model: Model,
    pub(super) constants: Vec<f64>,
    /// The initial state.
    pub(super) state: Vec<f64>,
    pub(super) hash: String,
    pub(super) targets: EditedElements,
    pub(super) torso: usize,
    pub(super) joints: Vec<Joint>,
    /// For each geom of the model, its index in the observed contacts; `None` if its contacts are not observed.
    flag_of_geom: Vec<Option<usize>>,
}

/// A joint with a motor.
#[derive(Debug, Clone, Copy)]
pub(super) struct Joint {
    pub(super) qpos: usize,
    pub(super) dof: usize,
    pub(super) low: f64,
    pub(super) high: f64,
}

impl Joint {
    /// Scales position `q` so that the joint's range becomes -1 … 1.
    pub(super) fn scaled(self, q: f64) -> f64 {
        2.0 * (q - (self.low + self.high) / 2.0) / (self.high - self.low)
    }
}

impl Pristine {
    pub(super) fn compile(robot: &Robot) -> Result<Self, Error> {
        let model = Model::from_xml(robot.look.mjcf)?;
        assert_eq!(model.timestep(), TIMESTEP, "the control timestep is four of these");
        assert_eq!(
            (model.n_q(), model.n_act()),
            (N_ROOT + robot.names.joints.len(), 0),
            "the model does not fit the robot"
        );
        let (qpos, dof) = (model.joint_qpos_address(), model.joint_dof_address());
        let all: Vec<Joint> = qpos
            .zip(dof)
            .zip(model.joint_range())
            .map(|((qpos, dof), (low, high))| Joint { qpos, dof, low, high })
            .collect();
        let joints = robot
            .names
            .joints
            .iter()
            .map(|name| Ok(all[model.id(ElementKind::Joint, name)?]))
            .collect::<Result<_, _>>()?;
        let mut flag_of_geom = vec![None; model.n_geom()];
        for (flag, name) in robot.names.contacts.iter().enumerate() {
            flag_of_geom[model.id(ElementKind::Geom, name)?] = Some(flag);
        }
        let hash = Sha256::digest(robot.look.mjcf).iter().fold(String::new(), |mut hex, byte| {
            let _ = write!(hex, "{byte:02x}"); // writing to a String cannot fail
            hex
        });
        let (targets, torso) = (EditedElements::new(&model)?, model.id(ElementKind::Body, "torso")?);
        let (mut constants, mut state) = (vec![0.0; model.n_constants()], vec![0.0; model.n_state()]);
        let simulation = Simulation::new(model.try_clone()?)?;
        simulation.constants(&mut constants);
        simulation.state(&mut state);
        Ok(Self { model, constants, state, hash, targets, torso, joints, flag_of_geom })
    }

    /// Returns the x and z coordinates of the torso's centre of mass, in m.
    pub(super) fn torso(&self, simulation: &Simulation) -> (f64, f64) {
        let [x, _, z] = simulation.xipos(self.torso);
        (x, z)
    }

    /// Returns the mean of the x coordinates of all bodies' centres of mass, in m. The mean is not weighted by mass.
    pub(super) fn track_position(&self, simulation: &Simulation) -> f64 {
        let n_body = self.model.n_body();
        (1..n_body).map(|body| simulation.xipos(body)[0]).sum::<f64>() / (n_body - 1) as f64
    }

    /// Returns whether each geom in [`Names::contacts`](super::Names::contacts) touches anything.
    pub(super) fn touching(&self, simulation: &Simulation) -> [bool; MAX_JOINTS] {
        let mut touching = [false; MAX_JOINTS];
        for (a, b) in simulation.contacts() {
            for flag in [a, b].into_iter().filter_map(|geom| self.flag_of_geom[geom]) {
                touching[flag] = true;
            }
        }
        touching
    }
}

impl Pristine {
    /// Returns the edit for these parameters, computed by this thread's simulation.
    ///
    /// # Errors
    /// MuJoCo's fatal errors.
    pub(super) fn edit(&'static self, density: f64, friction: f64) -> Result<Arc<RobotEdit>, Error> {
        shared::with(self, |shared| {
            shared.edit(
                |edit| edit.has_parameters(density, friction),
                |own, simulation| RobotEdit::new(own.targets, &own.constants, simulation, density, friction),
            )
        })
    }
}

impl SharedModel for Pristine {
    type Edit = RobotEdit;

    fn model(&self) -> &Model {
        &self.model
    }

    fn is_same(a: &RobotEdit, b: &RobotEdit) -> bool {
        a.has_parameters(b.density, b.friction)
    }

    fn write(&self, simulation: &mut Simulation, _: Option<&RobotEdit>, edit: &RobotEdit) -> Result<(), Error> {
        simulation.set_constants(&edit.constants);
        Ok(())
    }
}
