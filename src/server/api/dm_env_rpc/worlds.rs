//! All worlds of the server, by name. A world lives as long as the stream that made it is open, or an agent has joined
//! it. A client that knows the name and shows the token of the world's maker may join. Names are random, unless a
//! client chose them.

use super::{Error, runner::Runner, settings::Ownership, world::World};
use crate::{
    env::{Catalogue, shorten},
    pool::Pool,
    server::{
        audit::{draws::DrawAuditor, ledger::Ledger},
        auth::{Bearer, QuotaGuard},
        id,
    },
};
use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

/// The number of a stream.
type StreamId = u64;

/// The stream that a request came from.
pub(super) struct Caller {
    stream: StreamId,
    bearer: Option<Bearer>,
}

impl Caller {
    /// Takes environments out of the quota of the stream's token.
    ///
    /// # Errors
    /// If the quota is exceeded.
    pub(super) fn envs(&self, count: usize) -> Result<Option<QuotaGuard>, Error> {
        Ok(self.bearer.as_ref().map(|bearer| bearer.envs(count)).transpose()?)
    }

    /// The key of the world that the stream calls by this name.
    fn key(&self, name: &str) -> Key {
        (self.bearer.as_ref().map(|bearer| bearer.name().to_owned()), name.to_owned())
    }
}

/// A world's name with the name of its maker's token, so that each token has names of its own.
type Key = (Option<String>, String);

/// The registry that all streams share.
pub(super) struct Worlds {
    pool: Arc<Pool>,
    catalogue: Arc<Catalogue>,
    ledger: Option<Ledger>,
    registry: Mutex<Registry>,
}

#[derive(Default)]
struct Registry {
    worlds: BTreeMap<Key, WorldEntry>,
    streams: StreamId,
}

struct WorldEntry {
    world: Arc<World>,
    /// The stream that made the world, as long as it is open.
    maker: Option<StreamId>,
    /// The stream whose agent has joined the world.
    agent: Option<StreamId>,
    /// Whether every stream with the same token may reset and destroy the world.
    shared: bool,
    /// The episodes; `None` while an agent has them.
    runner: Option<Runner>,
    /// The world's part of its maker's quota of environments.
    _held: Option<QuotaGuard>,
}

impl Worlds {
    /// No worlds yet.
    pub(super) fn new(pool: Arc<Pool>, catalogue: Arc<Catalogue>, ledger: Option<Ledger>) -> Self {
        Self { pool, catalogue, ledger, registry: Mutex::default() }
    }

    /// Makes the auditor of the draws of a stream's new world.
    pub(super) fn draws(&self, maker: &Caller) -> DrawAuditor {
        DrawAuditor::new(maker.bearer.clone(), self.ledger.clone())
    }

    /// The pool that runs the environments of all worlds.
    pub(super) fn pool(&self) -> &Pool {
        &self.pool
    }

    /// The environments that a world can have.
    pub(super) fn catalogue(&self) -> &Catalogue {
        &self.catalogue
    }

    /// A new stream.
    pub(super) fn caller(&self, bearer: Option<Bearer>) -> Caller {
        let mut registry = self.lock();
        registry.streams += 1;
        Caller { stream: registry.streams, bearer }
    }

    /// Checks that the requested name, if any, is free.
    ///
    /// # Errors
    /// [`Error::Taken`].
    pub(super) fn is_free(&self, maker: &Caller, own: &Ownership) -> Result<(), Error> {
        match own.name.as_ref().filter(|name| self.lock().worlds.contains_key(&maker.key(name))) {
            Some(name) => Err(Error::Taken { world: name.clone() }),
            None => Ok(()),
        }
    }

    /// Adds a world that a stream has made, with the part of its token's quota that it holds. Returns its name.
    ///
    /// # Errors
    /// [`Error::Taken`] if another world has the requested name, [`Error::NoRandomness`].
    pub(super) fn add(
        &self,
        maker: &Caller,
        runner: Runner,
        own: Ownership,
        held: Option<QuotaGuard>,
    ) -> Result<String, Error> {
        let name = match own.name {
            Some(name) => name,
            None => random_name(runner.spec().name)?,
        };
        let (key, mut registry) = (maker.key(&name), self.lock());
        if registry.worlds.contains_key(&key) {
            return Err(Error::Taken { world: name });
        }
        let world = Arc::new(World::new(name.clone(), &runner));
        let entry = WorldEntry {
            world,
            maker: Some(maker.stream),
            agent: None,
            shared: own.shared,
            runner: Some(runner),
            _held: held,
        };
        registry.worlds.insert(key, entry);
        Ok(name)
    }

    /// Returns the world of that name, if the stream may change it.
    ///
    /// # Errors
    /// [`Error::Unknown`], [`Error::NotYours`].
    pub(super) fn find_owned(&self, caller: &Caller, name: &str, request: &'static str) -> Result<Arc<World>, Error> {
        Ok(Arc::clone(&self.lock().find_owned(caller, name, request)?.world))
    }

    /// Hands a world's runner to a stream's agent.
    ///
    /// # Errors
    /// [`Error::Unknown`], [`Error::Occupied`].
    pub(super) fn join(&self, caller: &Caller, name: &str) -> Result<(Arc<World>, Runner), Error> {
        let mut registry = self.lock();
        let entry = registry.find(caller, name)?;
        let occupied = || Error::Occupied { world: name.into(), request: "join_world" };
        let runner = entry.runner.take().ok_or_else(occupied)?;
        entry.agent = Some(caller.stream);
        Ok((Arc::clone(&entry.world), runner))
    }

    /// Takes the runner of a world back from the agent that leaves it.
    pub(super) fn leave(&self, agent: &Caller, world: &World, runner: Runner) {
        let mut registry = self.lock();
        if let Some(entry) = registry.worlds.get_mut(&agent.key(world.name())) {
            (entry.agent, entry.runner) = (None, Some(runner));
        }
        registry.reap();
    }

    /// Frees a world.
    ///
    /// # Errors
    /// [`Error::Unknown`], [`Error::NotYours`], [`Error::Occupied`].
    pub(super) fn destroy(&self, caller: &Caller, name: &str) -> Result<(), Error> {
        let mut registry = self.lock();
        if registry.find_owned(caller, name, "destroy_world")?.runner.is_none() {
            return Err(Error::Occupied { world: name.into(), request: "destroy_world" });
        }
        registry.worlds.remove(&caller.key(name));
        Ok(())
    }

    /// Whether a world of this stream exists.
    pub(super) fn are_made_by(&self, caller: &Caller) -> bool {
        self.lock().worlds.values().any(|entry| entry.maker == Some(caller.stream))
    }

    /// Frees the worlds of a stream that has ended, unless they have an agent.
    pub(super) fn stream_ended(&self, caller: &Caller) {
        let mut registry = self.lock();
        for entry in registry.worlds.values_mut().filter(|entry| entry.maker == Some(caller.stream)) {
            entry.maker = None;
        }
        registry.reap();
    }

    fn lock(&self) -> MutexGuard<'_, Registry> {
        self.registry.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Registry {
    /// The world of that name, if the stream made it or has joined it, or if it is shared.
    fn find_owned(&mut self, caller: &Caller, name: &str, request: &'static str) -> Result<&WorldEntry, Error> {
        let entry = self.find(caller, name)?;
        let is_its = entry.shared || [entry.maker, entry.agent].contains(&Some(caller.stream));
        if is_its { Ok(entry) } else { Err(Error::NotYours { world: name.into(), request }) }
    }

    /// The world of that name among those of the stream's token.
    fn find(&mut self, caller: &Caller, name: &str) -> Result<&mut WorldEntry, Error> {
        self.worlds.get_mut(&caller.key(name)).ok_or_else(|| unknown(name))
    }

    /// Frees the worlds that have neither maker nor agent.
    fn reap(&mut self) {
        self.worlds.retain(|_, entry| entry.maker.is_some() || entry.runner.is_none());
    }
}

/// Makes a name that cannot be guessed.
fn random_name(environment: &str) -> Result<String, Error> {
    Ok(format!("{environment}-{:032x}", u128::from_ne_bytes(id::random()?)))
}

fn unknown(name: &str) -> Error {
    let known = "send the name that create_world returned; a world goes when it has neither an agent nor the stream \
                 that made it";
    Error::Unknown { what: "world", name: format!("{:?}", shorten(name)), known: known.into() }
}
