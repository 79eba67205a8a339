//! Who is at the other end of a connection, and places by peer.

use std::{
    collections::BTreeMap,
    fmt,
    net::{IpAddr, Ipv6Addr},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};
use tokio::sync::Notify;

/// Whom a connection is from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Peer {
    /// A machine, or a network of them that one may have for itself.
    Machine(IpAddr),
    /// A user of this machine, by a Unix socket; none where the system does not tell.
    User(Option<u32>),
}

impl Peer {
    /// Whoever has this address: of IPv6 its network of 64 bits, which is the least that a machine is given.
    pub fn at(address: IpAddr) -> Self {
        Self::Machine(match address.to_canonical() {
            IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)).into(),
            address => address,
        })
    }
}

impl fmt::Display for Peer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Machine(address) => address.fmt(f),
            Self::User(Some(user)) => write!(f, "user {user}"),
            Self::User(None) => f.write_str("a user"),
        }
    }
}

/// Places, of which there are so many in all and for each peer.
#[derive(Clone)]
pub struct PeerLimiter(Arc<State>);

struct State {
    all: usize,
    each: usize,
    taken: Mutex<(usize, BTreeMap<Peer, usize>)>,
    /// Told whenever `taken` has changed.
    changed: Notify,
}

/// Why there is no place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitReached {
    /// All are taken.
    All(usize),
    /// The peer has as many as it may.
    Peer(usize),
}

/// A place, until it is dropped.
pub struct PeerPermit {
    places: PeerLimiter,
    peer: Option<Peer>,
}

impl PeerLimiter {
    /// So many in all, and for each peer.
    pub fn new(all: usize, each: usize) -> Self {
        Self(Arc::new(State { all, each, taken: Mutex::default(), changed: Notify::new() }))
    }

    /// A place for a peer. One that is not known has no quota of its own.
    ///
    /// # Errors
    /// [`LimitReached`].
    pub fn take(&self, peer: Option<Peer>) -> Result<PeerPermit, LimitReached> {
        let mut taken = self.lock();
        let (all, by_peer) = &mut *taken;
        if *all >= self.0.all {
            return Err(LimitReached::All(self.0.all));
        }
        if let Some(peer) = peer {
            let its = by_peer.entry(peer).or_default();
            if *its >= self.0.each {
                return Err(LimitReached::Peer(self.0.each));
            }
            *its += 1;
        }
        *all += 1;
        self.0.changed.notify_one();
        Ok(PeerPermit { places: self.clone(), peer })
    }

    /// How many are taken.
    pub fn taken(&self) -> usize {
        self.lock().0
    }

    /// How many there are.
    pub fn limit(&self) -> usize {
        self.0.all
    }

    /// Waits until some were taken or given back since this was last waited for, by one caller.
    pub async fn changed(&self) {
        self.0.changed.notified().await;
    }

    fn lock(&self) -> MutexGuard<'_, (usize, BTreeMap<Peer, usize>)> {
        self.0.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for PeerPermit {
    fn drop(&mut self) {
        let mut taken = self.places.lock();
        let (all, by_peer) = &mut *taken;
        *all -= 1;
        self.places.0.changed.notify_one();
        if let Some(peer) = self.peer
            && let Some(its) = by_peer.get_mut(&peer)
        {
            *its -= 1;
            if *its == 0 {
                by_peer.remove(&peer);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_one_machine_are_one_peer() {
        let [same, other] = ["2001:db8::1", "2001:db8:0:1::1"].map(|text| Peer::at(text.parse().unwrap()));
        assert_eq!(Peer::at("2001:db8::ffff:0:0:2".parse().unwrap()), same);
        assert_ne!(same, other);
        let [old, mapped] = ["192.0.2.1", "::ffff:192.0.2.1"].map(|text| Peer::at(text.parse().unwrap()));
        assert_eq!(old, mapped);
        assert_ne!(old, Peer::at("192.0.2.2".parse().unwrap()));
    }

    #[test]
    fn a_peer_takes_its_own_places_and_no_more() {
        let [one, other] = [1, 2].map(|user| Some(Peer::User(Some(user))));
        let places = PeerLimiter::new(4, 2);
        let [first, _second] = [places.take(one), places.take(one)].map(Result::unwrap);
        assert_eq!(places.take(one).err(), Some(LimitReached::Peer(2)));
        let _others = [places.take(other), places.take(None)].map(Result::unwrap);
        assert_eq!(places.take(other).err(), Some(LimitReached::All(4)));
        drop(first);
        assert!(places.take(one).is_ok());
        assert!(places.take(one).is_ok(), "that place was given back");
    }
}
