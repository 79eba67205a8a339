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
    pending: Mutex<PendingChanges>,
}

/// The settings with which the next episode will begin.
struct PendingChanges {
    version: Version,
    /// The distribution of each parameter.
    distributions: Arc<[Distribution]>,
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
        let pending = PendingChanges {
            version: runner.version(),
            distributions: Arc::clone(&runner.episodes().distributions),
            new_distributions: false,
            seed: None,
            interruption: false,
        };
        Self { name, spec: runner.spec(), draws: runner.draws().clone(), pending: Mutex::new(pending) }
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
        let mut pending = self.lock();
        let version = change.version.unwrap_or(pending.version);
        if change.version.is_some() || !change.parameters.is_empty() {
            let mut distributions = match change.version {
                Some(version) => self.spec.distributions(version),
                None => pending.distributions.to_vec(),
            };
            resolve(self.spec, &mut distributions, change.parameters)?;
            self.draws.check(self.spec, &distributions)?;
            (pending.distributions, pending.new_distributions) = (distributions.into(), true);
        }
        pending.version = version;
        pending.seed = change.seed.or(pending.seed);
        Ok(())
    }

    /// Takes the stored changes, for an episode that is about to begin.
    pub(super) fn take_changes(&self) -> Changes {
        let mut pending = self.lock();
        pending.interruption = false;
        let new = std::mem::take(&mut pending.new_distributions);
        Changes {
            version: pending.version,
            seed: pending.seed.take(),
            distributions: new.then(|| Arc::clone(&pending.distributions)),
        }
    }

    /// Stores changes again, because the episode for which they were taken could not begin. Changes that were stored in
    /// the meantime take precedence.
    pub(super) fn restore_changes(&self, changes: Changes) {
        let mut pending = self.lock();
        pending.seed = pending.seed.or(changes.seed);
        pending.new_distributions |= changes.distributions.is_some();
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
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
