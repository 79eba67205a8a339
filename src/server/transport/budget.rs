//! The memory budget for bytes in flight: the requests, replies, pictures and policies of all sessions. A token may
//! have a quota of these bytes.

use super::Error;
use crate::server::auth::{Bearer, QuotaGuard, Token};
use bytes::Bytes;
use std::sync::{
    Arc, Mutex, PoisonError,
    atomic::{AtomicUsize, Ordering},
};

/// A handle to the server's memory budget. If the handle has a token, reservations made through the handle also count
/// against the token's quota.
#[derive(Clone)]
pub struct Budget {
    state: Arc<BudgetCounter>,
    bearer: Option<Bearer>,
}

struct BudgetCounter {
    used: AtomicUsize,
    limit: usize,
}

impl Budget {
    /// Makes a budget of `limit` bytes, and a handle to it without a token.
    pub fn new(limit: usize) -> Self {
        Self { state: Arc::new(BudgetCounter { used: AtomicUsize::new(0), limit }), bearer: None }
    }

    /// Returns another handle to this budget. Reservations made through that handle also count against this token's
    /// quota.
    pub fn for_token(&self, bearer: Option<Bearer>) -> Self {
        Self { state: Arc::clone(&self.state), bearer }
    }

    /// The number of reserved bytes.
    pub fn used(&self) -> usize {
        self.state.used.load(Ordering::Relaxed)
    }

    /// The maximum number of reserved bytes.
    pub fn limit(&self) -> usize {
        self.state.limit
    }

    /// Returns an empty reservation, which [`grow`](MemoryReservation::grow) can enlarge.
    pub fn empty(&self) -> MemoryReservation {
        MemoryReservation {
            state: Arc::clone(&self.state),
            bytes: 0,
            quota: self.bearer.as_ref().map(Token::reserve_bytes),
        }
    }

    /// Reserves `bytes` until the returned reservation is dropped.
    ///
    /// # Errors
    /// [`Error::MemoryFull`] if the budget has no room, [`Error::Auth`] if the token's quota has none.
    pub fn reserve(&self, bytes: usize) -> Result<MemoryReservation, Error> {
        let mut reservation = self.empty();
        reservation.grow(bytes)?;
        Ok(reservation)
    }
}

/// Reserved bytes of the memory budget. Dropping it releases them.
pub struct MemoryReservation {
    state: Arc<BudgetCounter>,
    bytes: usize,
    /// The part of the token's quota for these bytes, if there is a token.
    quota: Option<QuotaGuard>,
}

impl MemoryReservation {
    /// The number of bytes that this reservation holds.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Reserves `bytes` more.
    ///
    /// # Errors
    /// [`Error::MemoryFull`] if the budget has no room, [`Error::Auth`] if the token's quota has none. The reservation
    /// is unchanged then.
    pub fn grow(&mut self, bytes: usize) -> Result<(), Error> {
        if bytes == 0 {
            return Ok(());
        }
        self.quota.as_mut().map(|quota| quota.grow(bytes)).transpose()?;
        let BudgetCounter { used, limit } = &*self.state;
        let fits = |used: usize| used.checked_add(bytes).filter(|sum| sum <= limit);
        match used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits) {
            Ok(_) => {
                self.bytes += bytes;
                Ok(())
            }
            Err(used) => {
                if let Some(quota) = &mut self.quota {
                    quota.release(bytes);
                }
                Err(Error::MemoryFull { wanted: bytes, used, limit: *limit })
            }
        }
    }

    /// Changes the reservation to `bytes`, even if that exceeds the budget. Call it when a reply's final length is
    /// known.
    pub fn resize(&mut self, bytes: usize) {
        if let Some(quota) = &mut self.quota {
            quota.set(bytes);
        }
        let used = &self.state.used;
        used.fetch_add(bytes, Ordering::Relaxed);
        used.fetch_sub(std::mem::replace(&mut self.bytes, bytes), Ordering::Relaxed);
    }
}

impl Drop for MemoryReservation {
    fn drop(&mut self) {
        self.state.used.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

/// A queue of the reservations of replies that are about to be sent. The transport attaches them to the replies' bytes.
#[derive(Clone, Default)]
pub struct PendingReservations(Arc<Mutex<Vec<MemoryReservation>>>);

impl PendingReservations {
    /// Queues the reservation of a reply.
    pub fn push(&self, reservation: MemoryReservation) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(reservation);
    }

    /// Attaches all queued reservations, and the value that `hold` returns, to the bytes of a reply. The reservations
    /// and the value are released when the last of the bytes has been written or dropped. If no reservation is queued,
    /// returns the bytes unchanged.
    pub fn attach<H: Send + 'static>(&self, bytes: Bytes, hold: impl FnOnce() -> H) -> Bytes {
        let reservations = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        if reservations.is_empty() {
            bytes
        } else {
            Bytes::from_owner(ReservedBytes { bytes, _held: (reservations, hold()) })
        }
    }
}

struct ReservedBytes<H> {
    bytes: Bytes,
    _held: (Vec<MemoryReservation>, H),
}

impl<H> AsRef<[u8]> for ReservedBytes<H> {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reservation_over_the_limit_is_refused_until_one_is_dropped() {
        let budget = Budget::new(100);
        let mut first = budget.reserve(60).unwrap();
        assert_eq!(budget.reserve(41).err(), Some(Error::MemoryFull { wanted: 41, used: 60, limit: 100 }));
        first.grow(40).unwrap();
        assert!(first.grow(1).is_err() && budget.reserve(usize::MAX).is_err());
        first.resize(150);
        assert!(budget.reserve(1).is_err() && budget.reserve(0).is_ok());
        first.resize(10);
        let second = budget.reserve(90).unwrap();
        drop(first);
        assert!(budget.reserve(11).is_err());
        drop(second);
        assert!(budget.reserve(100).is_ok());
    }

    #[test]
    fn a_reservation_is_held_until_the_last_of_its_bytes_is_dropped() {
        let (budget, pending_reservations) = (Budget::new(10), PendingReservations::default());
        pending_reservations.push(budget.reserve(10).unwrap());
        let mut sent = pending_reservations.attach(Bytes::from_static(b"reply"), || ());
        let rest = sent.split_off(2);
        drop(sent);
        assert!(budget.reserve(1).is_err());
        assert_eq!(rest, "ply");
        drop(rest);
        assert!(budget.reserve(10).is_ok());
        assert_eq!(pending_reservations.attach(Bytes::from_static(b"small"), || ()), "small");
    }
}
