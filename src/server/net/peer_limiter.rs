//! Peers, and the limits of concurrent connections or sessions of each.

use std::{
    collections::BTreeMap,
    fmt,
    net::{IpAddr, Ipv6Addr},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};
use tokio::sync::Notify;

/// The other end of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Peer {
    /// A machine, or a network that one machine may have for itself.
    Machine(IpAddr),
    /// A user of this machine, by a Unix socket; `None` if the system does not tell the user.
    User(Option<u32>),
}

impl Peer {
    /// The peer with this address. An IPv6 address stands for its network of 64 bits, the least that a machine is
    /// given.
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

/// A concurrency limiter, with a total limit and a limit for each peer.
#[derive(Clone)]
pub struct PeerLimiter(Arc<PermitCounts>);

struct PermitCounts {
    max_total: usize,
    max_per_peer: usize,
    in_use: Mutex<(usize, BTreeMap<Peer, usize>)>,
    /// Notified whenever `in_use` has changed.
    changed: Notify,
}

/// Why there is no permit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitReached {
    /// All permits are in use.
    All(usize),
    /// The peer has this many permits, as many as it may have.
    Peer(usize),
}

/// A permit, until it is dropped.
pub struct PeerPermit {
    limiter: PeerLimiter,
    peer: Option<Peer>,
}

impl PeerLimiter {
    /// Makes a limiter with a total limit, and a limit for each peer.
    pub fn new(max_total: usize, max_per_peer: usize) -> Self {
        Self(Arc::new(PermitCounts { max_total, max_per_peer, in_use: Mutex::default(), changed: Notify::new() }))
    }

    /// Takes a permit for a peer. An unknown peer has no limit of its own.
    ///
    /// # Errors
    /// [`LimitReached`].
    pub fn acquire(&self, peer: Option<Peer>) -> Result<PeerPermit, LimitReached> {
        let mut in_use = self.lock();
        let (total, by_peer) = &mut *in_use;
        if *total >= self.0.max_total {
            return Err(LimitReached::All(self.0.max_total));
        }
        if let Some(peer) = peer {
            let count = by_peer.entry(peer).or_default();
            if *count >= self.0.max_per_peer {
                return Err(LimitReached::Peer(self.0.max_per_peer));
            }
            *count += 1;
        }
        *total += 1;
        self.0.changed.notify_one();
        Ok(PeerPermit { limiter: self.clone(), peer })
    }

    /// The number of permits in use.
    pub fn in_use(&self) -> usize {
        self.lock().0
    }

    /// The total limit.
    pub fn limit(&self) -> usize {
        self.0.max_total
    }

    /// Waits until the number in use has changed since the last call, for one caller.
    pub async fn changed(&self) {
        self.0.changed.notified().await;
    }

    fn lock(&self) -> MutexGuard<'_, (usize, BTreeMap<Peer, usize>)> {
        self.0.in_use.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for PeerPermit {
    fn drop(&mut self) {
        let mut in_use = self.limiter.lock();
        let (total, by_peer) = &mut *in_use;
        *total -= 1;
        self.limiter.0.changed.notify_one();
        if let Some(peer) = self.peer
            && let Some(count) = by_peer.get_mut(&peer)
        {
            *count -= 1;
            if *count == 0 {
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
        let limiter = PeerLimiter::new(4, 2);
        let [first, _second] = [limiter.acquire(one), limiter.acquire(one)].map(Result::unwrap);
        assert_eq!(limiter.acquire(one).err(), Some(LimitReached::Peer(2)));
        let _others = [limiter.acquire(other), limiter.acquire(None)].map(Result::unwrap);
        assert_eq!(limiter.acquire(other).err(), Some(LimitReached::All(4)));
        drop(first);
        assert!(limiter.acquire(one).is_ok());
        assert!(limiter.acquire(one).is_ok(), "that place was given back");
    }
}
