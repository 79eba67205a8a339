//! Changes of the physics. Each starts from the unchanged compiled model, so changes do not accumulate.
//!
//! The result equals that of compiling an edited MJCF to 4e-13 in every array, at a hundredth of the cost.

use perturb_mujoco::{Error, Kind, Model, Simulation};

/// The torso's density in the MJCF, kg/m³.
const COMPILED_DENSITY: f64 = 1000.0;

/// The elements of a model that the parameters change.
#[derive(Debug, Clone, Copy)]
pub(super) struct EditedElements {
    torso_body: usize,
    torso_geom: usize,
    floor: usize,
}

/// A change of the model: the parameters, and the [constants](Simulation::constants) that result from them.
#[derive(Debug)]
pub struct RobotEdit {
    /// The torso's density, kg/m³.
    pub(super) density: f64,
    /// The sliding friction of every geom but the floor.
    pub(super) friction: f64,
    pub(super) constants: Box<[f64]>,
}

impl RobotEdit {
    /// Edits a simulation of the compiled model, whose constants before any edit are `compiled_constants`. The state of the
    /// simulation is undefined afterwards.
    ///
    /// # Errors
    /// MuJoCo's fatal ones.
    pub(super) fn new(
        targets: EditedElements,
        compiled_constants: &[f64],
        simulation: &mut Simulation,
        density: f64,
        friction: f64,
    ) -> Result<Self, Error> {
        let EditedElements { torso_body, floor, .. } = targets;
        simulation.set_constants(compiled_constants);
        let scale = density / COMPILED_DENSITY;
        simulation.body_mass_mut()[torso_body] *= scale;
        for moment in &mut simulation.body_inertia_mut()[3 * torso_body..][..3] {
            *moment *= scale;
        }
        for (geom, coefficients) in simulation.geom_friction_mut().chunks_exact_mut(3).enumerate() {
            if geom != floor {
                coefficients[0] = friction;
            }
        }
        // Masses enter many derived arrays: subtree masses, inverse weights, the solver's scale.
        simulation.set_const()?;
        let mut constants: Box<[f64]> = compiled_constants.into();
        simulation.constants(&mut constants);
        Ok(Self { density, friction, constants })
    }

    /// Tells whether this is the change to these parameters.
    pub(super) fn is_of(&self, density: f64, friction: f64) -> bool {
        (self.density, self.friction) == (density, friction)
    }
}

impl EditedElements {
    pub(super) fn new(model: &Model) -> Result<Self, Error> {
        Ok(Self {
            torso_body: model.id(Kind::Body, "torso")?,
            torso_geom: model.id(Kind::Geom, "torso")?,
            floor: model.id(Kind::Geom, "floor")?,
        })
    }

    /// The torso's mass in kg.
    pub(super) fn torso_mass(self, model: &Model) -> f64 {
        model.body_mass()[self.torso_body]
    }

    /// Returns the torso's density in kg/m³, computed from its mass.
    pub(super) fn density(self, model: &Model, pristine: &Model) -> f64 {
        self.torso_mass(model) / (self.torso_mass(pristine) / COMPILED_DENSITY)
    }

    /// The robot's sliding friction, the same for all of its geoms.
    pub(super) fn friction(self, model: &Model) -> f64 {
        model.geom_friction()[3 * self.torso_geom]
    }
}
