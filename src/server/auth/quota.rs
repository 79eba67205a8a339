//! Quotas: limits on the sessions, environments and bytes in flight that a token may use at the same time.

use super::{Bearer, Error, Token};
use std::sync::atomic::{AtomicUsize, Ordering};

/// The amount of a resource that is in use, and its limit.
#[derive(Default)]
pub(super) struct Quota {
    taken: AtomicUsize,
    limit: AtomicUsize,
}

impl Quota {
    pub(super) fn set_limit(&self, limit: Option<usize>) {
        self.limit.store(limit.unwrap_or(usize::MAX), Ordering::Relaxed);
    }

    pub(super) fn taken(&self) -> usize {
        self.taken.load(Ordering::Relaxed)
    }

    /// Takes `wanted` units. If that would exceed the limit, takes nothing and returns the limit as the error.
    fn take(&self, wanted: usize) -> Result<(), usize> {
        let limit = self.limit.load(Ordering::Relaxed);
        let grown = |taken: usize| taken.checked_add(wanted).filter(|sum| *sum <= limit);
        self.taken.fetch_update(Ordering::Relaxed, Ordering::Relaxed, grown).map(|_| ()).map_err(|_| limit)
    }
}

/// The kinds of resources that have quotas.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum QuotaKind {
    Sessions,
    Environments,
    Bytes,
}

impl QuotaKind {
    fn quota(self, token: &Token) -> &Quota {
        match self {
            Self::Sessions => &token.quotas.sessions,
            Self::Environments => &token.quotas.envs,
            Self::Bytes => &token.quotas.bytes,
        }
    }

    fn label(self) -> &'static str {
        match self {
            Self::Sessions => "sessions",
            Self::Environments => "environments",
            Self::Bytes => "bytes in flight",
        }
    }
}

/// An amount taken from a token's quota. Dropping it returns the amount.
pub struct QuotaGuard {
    token: Bearer,
    count: usize,
    kind: QuotaKind,
}

impl QuotaGuard {
    /// Makes a guard that holds nothing of the token's quota of this kind.
    pub(super) fn empty(token: Bearer, kind: QuotaKind) -> Self {
        Self { token, count: 0, kind }
    }

    /// Takes `count` more from the quota.
    ///
    /// # Errors
    /// [`Error::QuotaExceeded`], if the quota has less left; the held amount is unchanged then.
    pub fn grow(&mut self, count: usize) -> Result<(), Error> {
        self.kind.quota(&self.token).take(count).map_err(|limit| Error::QuotaExceeded {
            name: self.token.name.clone(),
            wanted: count,
            limit,
            what: self.kind.label(),
        })?;
        self.count += count;
        Ok(())
    }

    /// Sets the held amount, even if that exceeds the quota.
    pub fn set(&mut self, count: usize) {
        let taken = &self.kind.quota(&self.token).taken;
        taken.fetch_add(count, Ordering::Relaxed);
        taken.fetch_sub(std::mem::replace(&mut self.count, count), Ordering::Relaxed);
    }

    /// Returns `count` to the quota.
    pub fn release(&mut self, count: usize) {
        self.set(self.count.saturating_sub(count));
    }
}

impl Drop for QuotaGuard {
    fn drop(&mut self) {
        self.set(0);
    }
}
