//! Limits the number of concurrent connections or sessions, in total and for each peer.

use std::{
    collections::BTreeMap,
    fmt,
    net::{IpAddr, Ipv6Addr},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};
use tokio::sync::Notify;

/// The other end of a connection, to which limits apply.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Peer {
    /// A machine, identified by its IPv4 address or its IPv6 network.
    Machine(IpAddr),
    /// The user ID of a client that connected over a Unix socket; `None` if the operating system does not report it.
    User(Option<u32>),
}

impl Peer {
    /// Returns the peer with this address. All IPv6 addresses of a /64 network are one peer, because a single machine
    /// usually gets at least such a network.
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

/// The limit because of which no further permit is available, with the limit's value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitReached {
    /// The limit on all peers together.
    All(usize),
    /// The limit on each peer.
    Peer(usize),
}

/// A permit for one connection or session. Dropping it frees the permit.
pub struct PeerPermit {
    limiter: PeerLimiter,
    peer: Option<Peer>,
}

impl PeerLimiter {
    /// Makes a limiter with a total limit, and a limit for each peer.
    pub fn new(max_total: usize, max_per_peer: usize) -> Self {
        Self(Arc::new(PermitCounts { max_total, max_per_peer, in_use: Mutex::default(), changed: Notify::new() }))
    }

    /// Takes a permit for a peer. An unknown peer (`None`) is only subject to the total limit.
    ///
    /// # Errors
    /// [`LimitReached`], if all permits, or all permits of this peer, are in use.
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

    /// Returns the number of permits in use.
    pub fn in_use(&self) -> usize {
        self.lock().0
    }

    /// Returns the limit on all peers together.
    pub fn limit(&self) -> usize {
        self.0.max_total
    }

    /// Waits until the number of permits in use has changed since the last call. Only one task may wait.
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
    fn a_peer_gets_its_own_permits_and_no_more() {
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
