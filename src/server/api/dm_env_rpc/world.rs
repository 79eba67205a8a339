//! The part of a world's state that requests of several streams may change. Changes take effect when the next episode
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

/// A world, shared by all streams that know it.
pub(super) struct World {
    name: String,
    spec: &'static EnvironmentSpec,
    draws: DrawAuditor,
    wanted: Mutex<PendingChanges>,
}

/// The settings with which the next episode will begin.
struct PendingChanges {
    version: Version,
    /// The distribution of each parameter.
    distributions: Vec<Distribution>,
    /// Whether the distributions were set since the running episode began.
    new_distributions: bool,
    seed: Option<u64>,
    /// Whether another stream has reset the world. If so, the running episode ends with its next step.
    interruption: bool,
}

/// A world that a stream's agent has joined, and the runner of its episodes.
pub(super) struct JoinedWorld {
    pub(super) world: Arc<World>,
    pub(super) runner: Runner,
}

impl World {
    /// Makes a world with this name for a new environment.
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

    /// The world's name, unique among the worlds of one token.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// The description of the world's environment.
    pub(super) fn spec(&self) -> &'static EnvironmentSpec {
        self.spec
    }

    /// Stores a change for the next episode.
    ///
    /// # Errors
    /// If a parameter is out of its bounds, or the token's role does not allow the draw. The change is not stored then.
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

    /// Takes the stored changes, for an episode that is about to begin.
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

    /// Stores changes again, because the episode for which they were taken could not begin. Later changes take
    /// precedence.
    pub(super) fn keep(&self, changes: Changes) {
        let mut wanted = self.lock();
        wanted.seed = wanted.seed.or(changes.seed);
        wanted.new_distributions |= changes.distributions.is_some();
    }

    /// Requests that the running episode ends with its next step.
    pub(super) fn interrupt(&self) {
        self.lock().interruption = true;
    }

    /// Returns whether the running episode must end with the current step, and clears the request.
    pub(super) fn take_interruption(&self) -> bool {
        std::mem::take(&mut self.lock().interruption)
    }

    fn lock(&self) -> MutexGuard<'_, PendingChanges> {
        self.wanted.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
