//! All worlds of the server, by name. A world lives as long as the stream that made it or an agent that is in it.

use super::{runner::Runner, world::World};
use crate::{
    env::{Catalogue, shorten},
    pool::Pool,
    server::status::Refusal,
};
use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

/// Tells streams apart.
pub(super) type StreamId = u64;

/// The registry that all streams share.
pub(super) struct Worlds {
    pool: Arc<Pool>,
    catalogue: Arc<Catalogue>,
    registry: Mutex<Registry>,
}

#[derive(Default)]
struct Registry {
    worlds: BTreeMap<String, Entry>,
    /// So many were made; numbers are not used twice.
    made: u64,
    streams: StreamId,
}

struct Entry {
    world: Arc<World>,
    /// The stream that made it, until it ends.
    maker: Option<StreamId>,
    /// None while an agent has it.
    runner: Option<Runner>,
}

impl Worlds {
    /// No worlds yet.
    pub(super) fn new(pool: Arc<Pool>, catalogue: Arc<Catalogue>) -> Self {
        Self { pool, catalogue, registry: Mutex::default() }
    }

    /// Where worlds' environments run.
    pub(super) fn pool(&self) -> &Pool {
        &self.pool
    }

    /// The environments that there may be worlds of.
    pub(super) fn catalogue(&self) -> &Catalogue {
        &self.catalogue
    }

    /// A new stream's id.
    pub(super) fn stream(&self) -> StreamId {
        let mut registry = self.lock();
        registry.streams += 1;
        registry.streams
    }

    /// Takes a world that a stream has made. Returns its name.
    pub(super) fn add(&self, maker: StreamId, runner: Runner) -> String {
        let mut registry = self.lock();
        registry.made += 1;
        let name = format!("{}-{}", runner.spec().name, registry.made);
        let world = Arc::new(World::new(name.clone(), &runner));
        registry.worlds.insert(name.clone(), Entry { world, maker: Some(maker), runner: Some(runner) });
        name
    }

    /// The world of that name.
    ///
    /// # Errors
    /// [`Refusal::Unknown`].
    pub(super) fn find(&self, name: &str) -> Result<Arc<World>, Refusal> {
        self.lock().worlds.get(name).map(|entry| Arc::clone(&entry.world)).ok_or_else(|| unknown(name))
    }

    /// Gives a world to an agent.
    ///
    /// # Errors
    /// [`Refusal::Unknown`], [`Refusal::Occupied`].
    pub(super) fn join(&self, name: &str) -> Result<(Arc<World>, Runner), Refusal> {
        let mut registry = self.lock();
        let entry = registry.worlds.get_mut(name).ok_or_else(|| unknown(name))?;
        let occupied = || Refusal::Occupied { world: name.into(), request: "join_world" };
        let runner = entry.runner.take().ok_or_else(occupied)?;
        Ok((Arc::clone(&entry.world), runner))
    }

    /// Takes a world back from its agent.
    pub(super) fn leave(&self, world: &World, runner: Runner) {
        let mut registry = self.lock();
        if let Some(entry) = registry.worlds.get_mut(world.name()) {
            entry.runner = Some(runner);
        }
        registry.reap();
    }

    /// Frees a world.
    ///
    /// # Errors
    /// [`Refusal::Unknown`], [`Refusal::Occupied`].
    pub(super) fn destroy(&self, name: &str) -> Result<(), Refusal> {
        let mut registry = self.lock();
        let entry = registry.worlds.get(name).ok_or_else(|| unknown(name))?;
        if entry.runner.is_none() {
            return Err(Refusal::Occupied { world: name.into(), request: "destroy_world" });
        }
        registry.worlds.remove(name);
        Ok(())
    }

    /// Whether there are worlds that this stream has made.
    pub(super) fn are_made_by(&self, stream: StreamId) -> bool {
        self.lock().worlds.values().any(|entry| entry.maker == Some(stream))
    }

    /// A stream is gone, and with it those of its worlds that have no agent.
    pub(super) fn stream_ended(&self, stream: StreamId) {
        let mut registry = self.lock();
        for entry in registry.worlds.values_mut().filter(|entry| entry.maker == Some(stream)) {
            entry.maker = None;
        }
        registry.reap();
    }

    fn lock(&self) -> MutexGuard<'_, Registry> {
        self.registry.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Registry {
    /// Frees the worlds that have neither maker nor agent.
    fn reap(&mut self) {
        self.worlds.retain(|_, entry| entry.maker.is_some() || entry.runner.is_none());
    }
}

fn unknown(name: &str) -> Refusal {
    let known = "send the name that create_world returned; a world goes when it has neither an agent nor the stream \
                 that made it";
    Refusal::Unknown { what: "world", name: format!("{:?}", shorten(name)), known: known.into() }
}
