//! All worlds of the server, by name. A world lives as long as the stream that made it, or an agent that is in it. A
//! client that knows the name may join, with the token that the world was made with. Names cannot be guessed, unless a
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

/// A stream.
pub(super) struct Caller {
    stream: StreamId,
    bearer: Option<Bearer>,
}

impl Caller {
    /// Takes environments out of the quota of the stream's token.
    ///
    /// # Errors
    /// If it has as many as it may have.
    pub(super) fn envs(&self, count: usize) -> Result<Option<QuotaGuard>, Error> {
        Ok(self.bearer.as_ref().map(|bearer| bearer.envs(count)).transpose()?)
    }

    /// The key of the world that the stream calls by this name.
    fn key(&self, name: &str) -> Key {
        (self.bearer.as_ref().map(|bearer| bearer.name().to_owned()), name.to_owned())
    }
}

/// A world's name, with that of the token which it was made with: others do not see it, and may use the name too.
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
    /// The stream that made it, until it ends.
    maker: Option<StreamId>,
    /// The stream whose agent is in it.
    agent: Option<StreamId>,
    /// Whether every stream may reset and destroy it.
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

    /// The checks and records of what a new world of a stream draws from.
    pub(super) fn draws(&self, maker: &Caller) -> DrawAuditor {
        DrawAuditor::new(maker.bearer.clone(), self.ledger.clone())
    }

    /// The pool that runs the environments of all worlds.
    pub(super) fn pool(&self) -> &Pool {
        &self.pool
    }

    /// The environments that there may be worlds of.
    pub(super) fn catalogue(&self) -> &Catalogue {
        &self.catalogue
    }

    /// A new stream.
    pub(super) fn caller(&self, bearer: Option<Bearer>) -> Caller {
        let mut registry = self.lock();
        registry.streams += 1;
        Caller { stream: registry.streams, bearer }
    }

    /// Whether there is no world of the name that is asked for.
    ///
    /// # Errors
    /// [`Error::Taken`].
    pub(super) fn is_free(&self, maker: &Caller, own: &Ownership) -> Result<(), Error> {
        match own.name.as_ref().filter(|name| self.lock().worlds.contains_key(&maker.key(name))) {
            Some(name) => Err(Error::Taken { world: name.clone() }),
            None => Ok(()),
        }
    }

    /// Takes a world that a stream has made, and what it holds of its token's. Returns its name.
    ///
    /// # Errors
    /// [`Error::Taken`] if another has the name that was asked for, [`Error::NoRandomness`].
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

    /// The world of that name, for a stream that wants to change it.
    ///
    /// # Errors
    /// [`Error::Unknown`], [`Error::NotYours`].
    pub(super) fn find_owned(&self, caller: &Caller, name: &str, request: &'static str) -> Result<Arc<World>, Error> {
        Ok(Arc::clone(&self.lock().find_owned(caller, name, request)?.world))
    }

    /// Gives a world to a stream's agent.
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

    /// Takes a world back from its agent.
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

    /// Whether there are worlds that this stream has made.
    pub(super) fn are_made_by(&self, caller: &Caller) -> bool {
        self.lock().worlds.values().any(|entry| entry.maker == Some(caller.stream))
    }

    /// A stream is gone, and with it those of its worlds that have no agent.
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
    /// The world of that name, if the stream has made it, is its agent's, or may do as if.
    fn find_owned(&mut self, caller: &Caller, name: &str, request: &'static str) -> Result<&WorldEntry, Error> {
        let entry = self.find(caller, name)?;
        let is_its = entry.shared || [entry.maker, entry.agent].contains(&Some(caller.stream));
        if is_its { Ok(entry) } else { Err(Error::NotYours { world: name.into(), request }) }
    }

    /// The world of that name, if there is one for streams with this token.
    fn find(&mut self, caller: &Caller, name: &str) -> Result<&mut WorldEntry, Error> {
        self.worlds.get_mut(&caller.key(name)).ok_or_else(|| unknown(name))
    }

    /// Frees the worlds that have neither maker nor agent.
    fn reap(&mut self) {
        self.worlds.retain(|_, entry| entry.maker.is_some() || entry.runner.is_none());
    }
}

/// A name that nobody guesses.
fn random_name(environment: &str) -> Result<String, Error> {
    Ok(format!("{environment}-{:032x}", u128::from_ne_bytes(id::random()?)))
}

fn unknown(name: &str) -> Error {
    let known = "send the name that create_world returned; a world goes when it has neither an agent nor the stream \
                 that made it";
    Error::Unknown { what: "world", name: format!("{:?}", shorten(name)), known: known.into() }
}
