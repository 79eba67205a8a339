//! A cache that drops entries that were not used for ten minutes.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Time after which an unused entry is dropped.
const IDLE_TIMEOUT: Duration = Duration::from_secs(600);

/// A cache of values by key. It stores the time of each value's last use.
#[derive(Debug)]
pub(crate) struct KeyedCache<K, V>(Mutex<HashMap<K, (V, Instant)>>);

impl<K, V> Default for KeyedCache<K, V> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<K: Eq + Hash, V: Clone> KeyedCache<K, V> {
    /// Returns the value of `key`. If there is none, inserts the result of `new`.
    pub(crate) fn get_or_insert_with(&self, key: K, new: impl FnOnce() -> V) -> V {
        let mut entries = self.entries();
        let (value, used) = entries.entry(key).or_insert_with(|| (new(), Instant::now()));
        *used = Instant::now();
        value.clone()
    }

    /// Drops the value of `key`.
    pub(crate) fn remove(&self, key: &K) {
        self.entries().remove(key);
    }

    /// Drops the values that were not used for [`IDLE_TIMEOUT`], except those for which `is_busy` returns true.
    pub(crate) fn remove_idle(&self, is_busy: impl Fn(&V) -> bool) {
        self.remove_unused_for(IDLE_TIMEOUT, is_busy);
    }

    fn remove_unused_for(&self, timeout: Duration, is_busy: impl Fn(&V) -> bool) {
        self.entries().retain(|_, (value, used)| used.elapsed() < timeout || is_busy(value));
    }

    fn entries(&self) -> MutexGuard<'_, HashMap<K, (V, Instant)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unused_values_are_dropped_unless_they_are_busy() {
        let cache = KeyedCache::default();
        let get = |key: &'static str, new: u8| cache.get_or_insert_with(key, || new);
        assert_eq!((get("a", 1), get("b", 2), get("a", 3)), (1, 2, 1));
        cache.remove_idle(|_| false);
        assert_eq!((get("a", 4), get("b", 4)), (1, 2), "both were used just now");
        cache.remove_unused_for(Duration::ZERO, |value| *value == 2);
        assert_eq!((get("a", 5), get("b", 5)), (5, 2));
        cache.remove(&"b");
        assert_eq!(get("b", 6), 6);
    }
}
