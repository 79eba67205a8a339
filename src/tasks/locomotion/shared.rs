//! The simulations that environments take turns in. Each thread has one simulation of each robot.
//!
//! A model with MuJoCo's data is 129 kB, but the difference between two hoppers is some hundred bytes. Environments of so
//! few bytes stay in the caches. An environment cannot see what another one did: its whole state is written into the
//! simulation before it runs.

use super::{model_edit::RobotEdit, pristine::Pristine};
use perturb_mujoco::{Error, Simulation};
use std::{cell::RefCell, ptr, sync::Arc};

thread_local! {
    /// The simulations that are not in use at the moment.
    static IDLE: RefCell<Vec<Shared>> = const { RefCell::new(Vec::new()) };
}

/// A simulation, and the last change of its model.
pub(super) struct Shared {
    pristine: &'static Pristine,
    simulation: Simulation,
    edit: Option<Arc<RobotEdit>>,
}

/// Runs `work` with this thread's simulation of the robot, which is made when it is first needed and after a fatal error.
///
/// # Errors
/// Those of `work`, and [`Error::Fatal`] without memory for a simulation.
pub(super) fn with<T>(
    pristine: &'static Pristine,
    work: impl FnOnce(&mut Shared) -> Result<T, Error>,
) -> Result<T, Error> {
    let idle = IDLE.with_borrow_mut(|idle| {
        let place = idle.iter().position(|shared| ptr::eq(shared.pristine, pristine))?;
        Some(idle.swap_remove(place))
    });
    let mut shared = match idle {
        Some(shared) => shared,
        None => Shared { pristine, simulation: Simulation::new(pristine.model.try_clone()?)?, edit: None },
    };
    let result = work(&mut shared);
    if !shared.simulation.is_poisoned() {
        IDLE.with_borrow_mut(|idle| idle.push(shared));
    }
    result
}

impl Shared {
    /// Changes the model, starting from the compiled one. The state is undefined afterwards.
    ///
    /// # Errors
    /// MuJoCo's fatal ones.
    pub(super) fn edit(&mut self, density: f64, friction: f64) -> Result<Arc<RobotEdit>, Error> {
        match &self.edit {
            Some(edit) if edit.is_of(density, friction) => Ok(Arc::clone(edit)),
            _ => {
                let edit = Arc::new(RobotEdit::new(
                    self.pristine.targets,
                    &self.pristine.constants,
                    &mut self.simulation,
                    density,
                    friction,
                )?);
                self.edit = Some(Arc::clone(&edit));
                Ok(edit)
            }
        }
    }

    /// Returns the simulation with the changed model. Its state is undefined.
    pub(super) fn edited(&mut self, edit: &Arc<RobotEdit>) -> &mut Simulation {
        if !self.edit.as_ref().is_some_and(|held| held.is_of(edit.density, edit.friction)) {
            self.simulation.set_constants(&edit.constants);
            self.edit = Some(Arc::clone(edit));
        }
        &mut self.simulation
    }

    /// Returns the simulation with the changed model in this [state](Simulation::state). Poses and contacts are not computed
    /// yet.
    ///
    /// # Errors
    /// MuJoCo's fatal ones.
    pub(super) fn at(&mut self, edit: &Arc<RobotEdit>, state: &[f64]) -> Result<&mut Simulation, Error> {
        let simulation = self.edited(edit);
        simulation.set_state(state)?;
        Ok(simulation)
    }
}

#[cfg(test)]
mod tests {
    use crate::{
        env::{Action, Environment},
        scene::{Look, ModelView, Scenery},
        tasks::{
            hopper,
            locomotion::{
                Robot, SCENERY, Walker,
                channels::{Names, names},
            },
        },
    };
    use std::sync::OnceLock;

    const NAMES: Names = names!(joints: ["thigh", "leg", "foot"], contacts: ["foot"]);

    /// A hopper whose memory suffices in flight, where there is no constraint, and not on the floor.
    static WITH_A_SMALL_STACK: OnceLock<Robot> = OnceLock::new();

    fn walker() -> Walker {
        let robot = WITH_A_SMALL_STACK.get_or_init(|| Robot {
            spec: &hopper::SPEC,
            look: Look {
                name: "Hopper",
                mjcf: include_str!("../../../models/hopper.xml").replace("20000", "200").leak(),
                files: &[],
                scenery: Some(Scenery { mjcf: SCENERY, hidden: "floor", colours: &[] }),
                view: ModelView::Beside { followed: "torso", distance: 1.0, height: 1.0 },
            },
            names: NAMES,
            alive: |_| true,
            pristine: OnceLock::new(),
        });
        Walker::new(robot).unwrap()
    }

    /// In the air, with its joints within their limits.
    fn fly(walker: &mut Walker) {
        walker.reset_to(&[0.0, 5.0, 0.0, -0.5, -0.5, 0.1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    }

    fn step(walker: &mut Walker) -> (bool, Vec<f64>) {
        let diverged = walker.step(Action::Continuous(&[0.1, -0.1, 0.2]), &mut [0.0; 5]).diverged;
        let mut state = Vec::new();
        walker.save(&mut state);
        (diverged, state)
    }

    #[test]
    fn a_fatal_error_ends_the_episode_of_one_robot_only() {
        let (mut alone, mut next, mut lands) = (walker(), walker(), walker());
        fly(&mut alone);
        fly(&mut next);
        let flight: Vec<_> = (0..20).map(|_| step(&mut alone)).collect();
        for (diverged, state) in flight {
            fly(&mut lands);
            assert!(!step(&mut lands).0);
            lands.reset_to(&[0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
            assert!(step(&mut lands).0, "it touches the floor, which is fatal");
            assert!(step(&mut lands).0, "until it is reset");
            assert_eq!(step(&mut next), (diverged, state));
            assert!(!diverged);
        }
    }
}
