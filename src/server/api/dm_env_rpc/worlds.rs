//! The registry of all worlds of the server, by name. A world lives while the stream that made it is open or an agent
//! has joined it. A client may join a world if it knows the name and has the token of the world's maker. Names are
//! random unless a client chose them.

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

/// The number by which the registry identifies a stream.
type StreamId = u64;

/// The stream from which a request came, with its token.
pub(super) struct Caller {
    stream: StreamId,
    bearer: Option<Bearer>,
}

impl Caller {
    /// Takes `count` environments from the quota of the stream's token. Returns `None` if there is no token.
    ///
    /// # Errors
    /// If the quota has fewer environments left.
    pub(super) fn envs(&self, count: usize) -> Result<Option<QuotaGuard>, Error> {
        Ok(self.bearer.as_ref().map(|bearer| bearer.envs(count)).transpose()?)
    }

    /// Returns the registry key of the world with this name among the worlds of the stream's token.
    fn key(&self, name: &str) -> Key {
        (self.bearer.as_ref().map(|bearer| bearer.name().to_owned()), name.to_owned())
    }
}

/// The name of the token with which a world was made, `None` without a token; and the world's name. Each token has its
/// own set of names.
type Key = (Option<String>, String);

/// The worlds of a server, shared by all streams.
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
    /// The stream that made the world; `None` after its end.
    maker: Option<StreamId>,
    /// The stream whose agent has joined the world, if any.
    agent: Option<StreamId>,
    /// Whether every stream with the same token may reset and destroy the world.
    shared: bool,
    /// The runner of the world's episodes; `None` while an agent has it.
    runner: Option<Runner>,
    /// The guard that takes one environment from the quota of the maker's token.
    _held: Option<QuotaGuard>,
}

impl Worlds {
    /// Makes an empty registry. The environments of its worlds run on `pool`.
    pub(super) fn new(pool: Arc<Pool>, catalogue: Arc<Catalogue>, ledger: Option<Ledger>) -> Self {
        Self { pool, catalogue, ledger, registry: Mutex::default() }
    }

    /// Makes the auditor of draws for a new world that `maker` makes.
    pub(super) fn draws(&self, maker: &Caller) -> DrawAuditor {
        DrawAuditor::new(maker.bearer.clone(), self.ledger.clone())
    }

    /// The pool that runs the environments of all worlds.
    pub(super) fn pool(&self) -> &Pool {
        &self.pool
    }

    /// The catalogue of environments that worlds can be made of.
    pub(super) fn catalogue(&self) -> &Catalogue {
        &self.catalogue
    }

    /// Gives a new stream its number. Returns the stream with its token.
    pub(super) fn caller(&self, bearer: Option<Bearer>) -> Caller {
        let mut registry = self.lock();
        registry.streams += 1;
        Caller { stream: registry.streams, bearer }
    }

    /// Checks that the requested name is free. A request for a random name always passes.
    ///
    /// # Errors
    /// [`Error::Taken`], if a world of the same token has the name.
    pub(super) fn check_name_is_free(&self, maker: &Caller, ownership: &Ownership) -> Result<(), Error> {
        match ownership.name.as_ref().filter(|name| self.lock().worlds.contains_key(&maker.key(name))) {
            Some(name) => Err(Error::Taken { world: name.clone() }),
            None => Ok(()),
        }
    }

    /// Adds a new world with its runner. The world keeps `held`, the guard that takes the world's environment from the
    /// token's quota. Returns the world's name.
    ///
    /// # Errors
    /// [`Error::Taken`] if another world has the requested name, [`Error::NoRandomness`] if no random name can be made.
    pub(super) fn add(
        &self,
        maker: &Caller,
        runner: Runner,
        ownership: Ownership,
        held: Option<QuotaGuard>,
    ) -> Result<String, Error> {
        let name = match ownership.name {
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
            shared: ownership.shared,
            runner: Some(runner),
            _held: held,
        };
        registry.worlds.insert(key, entry);
        Ok(name)
    }

    /// Returns the world with this name, if the stream may reset and destroy it.
    ///
    /// # Errors
    /// [`Error::Unknown`] if there is no such world, [`Error::NotYours`] if the stream may not reset and destroy it.
    pub(super) fn find_owned(&self, caller: &Caller, name: &str, request: &'static str) -> Result<Arc<World>, Error> {
        Ok(Arc::clone(&self.lock().find_owned(caller, name, request)?.world))
    }

    /// Lets a stream's agent join a world. Returns the world and its runner.
    ///
    /// # Errors
    /// [`Error::Unknown`] if there is no such world, [`Error::Occupied`] if it has an agent.
    pub(super) fn join(&self, caller: &Caller, name: &str) -> Result<(Arc<World>, Runner), Error> {
        let mut registry = self.lock();
        let entry = registry.find(caller, name)?;
        let occupied = || Error::Occupied { world: name.into(), request: "join_world" };
        let runner = entry.runner.take().ok_or_else(occupied)?;
        entry.agent = Some(caller.stream);
        Ok((Arc::clone(&entry.world), runner))
    }

    /// Puts the runner of a world back into the registry, because the agent leaves the world.
    pub(super) fn leave(&self, agent: &Caller, world: &World, runner: Runner) {
        let mut registry = self.lock();
        if let Some(entry) = registry.worlds.get_mut(&agent.key(world.name())) {
            (entry.agent, entry.runner) = (None, Some(runner));
        }
        registry.reap();
    }

    /// Destroys a world and frees its environment.
    ///
    /// # Errors
    /// [`Error::Unknown`] if there is no such world, [`Error::NotYours`] if the stream may not destroy it,
    /// [`Error::Occupied`] if it has an agent.
    pub(super) fn destroy(&self, caller: &Caller, name: &str) -> Result<(), Error> {
        let mut registry = self.lock();
        if registry.find_owned(caller, name, "destroy_world")?.runner.is_none() {
            return Err(Error::Occupied { world: name.into(), request: "destroy_world" });
        }
        registry.worlds.remove(&caller.key(name));
        Ok(())
    }

    /// Whether a world that this stream made still exists.
    pub(super) fn has_world_of(&self, caller: &Caller) -> bool {
        self.lock().worlds.values().any(|entry| entry.maker == Some(caller.stream))
    }

    /// Records the end of a stream, and frees the worlds that it made unless they have an agent.
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
    /// Returns the world with this name if the stream made it, the stream's agent has joined it, or it is shared.
    fn find_owned(&mut self, caller: &Caller, name: &str, request: &'static str) -> Result<&WorldEntry, Error> {
        let entry = self.find(caller, name)?;
        let is_allowed = entry.shared || [entry.maker, entry.agent].contains(&Some(caller.stream));
        if is_allowed { Ok(entry) } else { Err(Error::NotYours { world: name.into(), request }) }
    }

    /// Returns the world with this name among the worlds of the stream's token.
    fn find(&mut self, caller: &Caller, name: &str) -> Result<&mut WorldEntry, Error> {
        self.worlds.get_mut(&caller.key(name)).ok_or_else(|| unknown(name))
    }

    /// Frees all worlds that have neither a maker nor an agent.
    fn reap(&mut self) {
        self.worlds.retain(|_, entry| entry.maker.is_some() || entry.runner.is_none());
    }
}

/// Makes a name that nobody can guess.
fn random_name(environment: &str) -> Result<String, Error> {
    Ok(format!("{environment}-{:032x}", u128::from_ne_bytes(id::random()?)))
}

fn unknown(name: &str) -> Error {
    let known = "send the name that create_world returned; a world is freed when it has neither an agent nor the \
                 stream that made it";
    Error::Unknown { what: "world", name: format!("{:?}", shorten(name)), known: known.into() }
}
