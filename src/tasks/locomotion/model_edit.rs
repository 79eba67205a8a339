//! Edits of a robot's model by its parameters. Each edit starts from the compiled model, so edits do not accumulate.
//!
//! The arrays of an edited model equal those of a model compiled from edited MJCF up to 4e-13. An edit costs a
//! hundredth of a compilation.

use perturb_mujoco::{ElementKind, Error, Model, Simulation};

/// The torso's density in the MJCF, in kg/m³.
const COMPILED_DENSITY: f64 = 1000.0;

/// The indices of the model elements that the parameters change.
#[derive(Debug, Clone, Copy)]
pub(super) struct EditedElements {
    torso_body: usize,
    torso_geom: usize,
    floor: usize,
}

/// An edit of a robot's model: the parameters, and the [model constants](Simulation::constants) that follow from them.
#[derive(Debug)]
pub struct RobotEdit {
    /// The torso's density, in kg/m³.
    pub(super) density: f64,
    /// The sliding friction of all geoms except the floor.
    pub(super) friction: f64,
    pub(super) constants: Box<[f64]>,
}

impl RobotEdit {
    /// Applies the parameters to the model of `simulation`. Returns the edit: the parameters and the edited constants.
    /// `compiled_constants` are the constants of the compiled model. The state of the simulation is undefined
    /// afterwards.
    ///
    /// # Errors
    /// MuJoCo's fatal errors.
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
        // Computes the arrays that follow from masses: subtree masses, inverse weights, and the mean inertia, by which
        // the solver scales its tolerance.
        simulation.set_const()?;
        let mut constants: Box<[f64]> = compiled_constants.into();
        simulation.constants(&mut constants);
        Ok(Self { density, friction, constants })
    }

    /// Whether this is the edit for these parameters.
    pub(super) fn has_parameters(&self, density: f64, friction: f64) -> bool {
        (self.density, self.friction) == (density, friction)
    }
}

impl EditedElements {
    pub(super) fn new(model: &Model) -> Result<Self, Error> {
        Ok(Self {
            torso_body: model.id(ElementKind::Body, "torso")?,
            torso_geom: model.id(ElementKind::Geom, "torso")?,
            floor: model.id(ElementKind::Geom, "floor")?,
        })
    }

    /// Returns the torso's mass in a model, in kg.
    pub(super) fn torso_mass(self, model: &Model) -> f64 {
        model.body_mass()[self.torso_body]
    }

    /// Returns the torso's density in a model, in kg/m³. The density is computed from the torso's mass in `model` and
    /// its mass in `pristine`, the compiled model.
    pub(super) fn density(self, model: &Model, pristine: &Model) -> f64 {
        self.torso_mass(model) / (self.torso_mass(pristine) / COMPILED_DENSITY)
    }

    /// Returns the robot's sliding friction in a model. All geoms of the robot have the same friction.
    pub(super) fn friction(self, model: &Model) -> f64 {
        model.geom_friction()[3 * self.torso_geom]
    }
}
