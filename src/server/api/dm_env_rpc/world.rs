//! The state of a world that requests of several streams may change. Changes reach the physics when the next episode
//! begins.

use super::{
    Error,
    runner::{Changes, Runner},
    settings::WorldChange,
};
use crate::{
    env::{Distribution, EnvironmentSpec, Version, resolve},
    server::audit::draws::DrawAuditor,
};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// A world, as all streams see it.
pub(super) struct World {
    name: String,
    spec: &'static EnvironmentSpec,
    draws: DrawAuditor,
    wanted: Mutex<PendingChanges>,
}

/// The settings that the next episode begins with.
struct PendingChanges {
    version: Version,
    /// The distribution of each parameter.
    distributions: Vec<Distribution>,
    /// Whether the distributions differ from those of the running episode.
    new_distributions: bool,
    seed: Option<u64>,
    /// Whether another stream has reset the world, so that the running episode ends with its next step.
    interruption: bool,
}

/// A world and its agent's episodes in it.
pub(super) struct JoinedWorld {
    pub(super) world: Arc<World>,
    pub(super) runner: Runner,
}

impl World {
    /// Makes the world of a new environment.
    pub(super) fn new(name: String, runner: &Runner) -> Self {
        let wanted = PendingChanges {
            version: runner.version(),
            distributions: runner.episodes().distributions.clone(),
            new_distributions: false,
            seed: None,
            interruption: false,
        };
        Self { name, spec: runner.spec(), draws: runner.draws().clone(), wanted: Mutex::new(wanted) }
    }

    /// The name, unique on the server among the worlds of one token.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// The environment.
    pub(super) fn spec(&self) -> &'static EnvironmentSpec {
        self.spec
    }

    /// Stores a change for the next episode.
    ///
    /// # Errors
    /// If a parameter is out of its bounds, or the token's role does not allow the draw. Nothing is changed then.
    pub(super) fn change(&self, change: WorldChange) -> Result<(), Error> {
        let mut wanted = self.lock();
        let version = change.version.unwrap_or(wanted.version);
        if change.version.is_some() || !change.parameters.is_empty() {
            let mut distributions = match change.version {
                Some(version) => self.spec.distributions(version),
                None => wanted.distributions.clone(),
            };
            resolve(self.spec, &mut distributions, change.parameters)?;
            self.draws.check(self.spec, &distributions)?;
            (wanted.distributions, wanted.new_distributions) = (distributions, true);
        }
        wanted.version = version;
        wanted.seed = change.seed.or(wanted.seed);
        Ok(())
    }

    /// Takes the settings for the episode that begins now.
    pub(super) fn take_changes(&self) -> Changes {
        let mut wanted = self.lock();
        wanted.interruption = false;
        let new = std::mem::take(&mut wanted.new_distributions);
        Changes {
            version: wanted.version,
            seed: wanted.seed.take(),
            distributions: new.then(|| wanted.distributions.clone().into()),
        }
    }

    /// Stores the changes of an episode that could not begin again. Changes that came since take precedence.
    pub(super) fn keep(&self, changes: Changes) {
        let mut wanted = self.lock();
        wanted.seed = wanted.seed.or(changes.seed);
        wanted.new_distributions |= changes.distributions.is_some();
    }

    /// Marks the running episode to end with its next step.
    pub(super) fn interrupt(&self) {
        self.lock().interruption = true;
    }

    /// Returns whether the running episode must end with the present step, and clears the mark.
    pub(super) fn take_interruption(&self) -> bool {
        std::mem::take(&mut self.lock().interruption)
    }

    fn lock(&self) -> MutexGuard<'_, PendingChanges> {
        self.wanted.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
