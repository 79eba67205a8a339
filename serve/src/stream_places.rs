//! Limits the number of open event streams, in total and for each client.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Maximum total number of event streams.
pub(crate) const MAX_STREAMS: usize = 64;
/// Maximum number of event streams for one client address. A browser opens a stream for each page that it shows.
const MAX_STREAMS_PER_PEER: usize = 32;

/// A limiter that counts the open event streams by client address.
#[derive(Clone, Debug, Default)]
pub(crate) struct StreamPlaces(Arc<Mutex<HashMap<IpAddr, usize>>>);

/// A permit for one event stream. Dropping it makes room for another stream.
#[derive(Debug)]
pub(crate) struct StreamPlace {
    places: StreamPlaces,
    peer: IpAddr,
}

impl StreamPlaces {
    /// Returns a permit for a stream to the client `peer`, or `None` if a limit is reached.
    pub(crate) fn take(&self, peer: IpAddr) -> Option<StreamPlace> {
        let mut taken = self.lock();
        let total: usize = taken.values().sum();
        let own = taken.get(&peer).copied().unwrap_or_default();
        if total >= MAX_STREAMS || own >= MAX_STREAMS_PER_PEER {
            return None;
        }
        taken.insert(peer, own + 1);
        Some(StreamPlace { places: self.clone(), peer })
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<IpAddr, usize>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for StreamPlace {
    fn drop(&mut self) {
        let mut taken = self.places.lock();
        if let Some(own) = taken.get_mut(&self.peer) {
            *own -= 1;
            if *own == 0 {
                taken.remove(&self.peer);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_shared_between_clients_and_given_back() {
        let places = StreamPlaces::default();
        let peer = |number| IpAddr::from([10, 0, 0, number]);
        let first: Vec<_> = (0..MAX_STREAMS_PER_PEER).map(|_| places.take(peer(1)).unwrap()).collect();
        assert!(places.take(peer(1)).is_none(), "one client has its share");
        let second: Vec<_> = (0..MAX_STREAMS_PER_PEER).map(|_| places.take(peer(2)).unwrap()).collect();
        assert!(places.take(peer(3)).is_none(), "all are taken");
        drop(first);
        assert!(places.take(peer(3)).is_some() && places.take(peer(1)).is_some());
        drop(second);
        assert!(places.lock().is_empty());
    }
}
