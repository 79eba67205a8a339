//! What is known of the runs in some folders, each under a lock of its own: who looks at one waits for no other.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What nobody has looked at for so long is forgotten.
pub(crate) const FORGET: Duration = Duration::from_secs(600);

/// Things by their folders.
#[derive(Debug)]
pub(crate) struct Shelf<T>(Mutex<HashMap<PathBuf, Kept<T>>>);

/// Something, and when it was last used.
type Kept<T> = (Arc<Mutex<T>>, Instant);

impl<T> Default for Shelf<T> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<T> Shelf<T> {
    /// What `with` says of the one in `folder`, a `new` one if there is none.
    pub(crate) fn with<R>(&self, folder: &Path, new: impl Fn() -> T, with: impl FnOnce(&mut T) -> R) -> R {
        let one = {
            let mut known = self.known();
            let (one, used) =
                known.entry(folder.to_owned()).or_insert_with(|| (Arc::new(Mutex::new(new())), Instant::now()));
            *used = Instant::now();
            Arc::clone(one)
        };
        let mut guard = one.lock().unwrap_or_else(|broken| {
            // Whoever had it has panicked: what is in it may be anything.
            let mut guard = broken.into_inner();
            *guard = new();
            one.clear_poison();
            guard
        });
        with(&mut guard)
    }

    /// Forgets what was not used lately.
    pub(crate) fn forget(&self) {
        self.known().retain(|_, (_, used)| used.elapsed() < FORGET);
    }

    fn known(&self) -> MutexGuard<'_, HashMap<PathBuf, Kept<T>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_that_is_looked_at_holds_up_no_other() {
        let (shelf, [a, b]) = (Shelf::<u8>::default(), ["a", "b"].map(Path::new));
        shelf.with(
            a,
            || 1,
            |one| {
                *one = 2;
                assert_eq!(shelf.with(b, || 3, |other| *other), 3);
            },
        );
        assert_eq!(shelf.with(a, || 1, |one| *one), 2);
        shelf.forget();
        assert_eq!(shelf.with(a, || 1, |one| *one), 2, "it was used just now");
    }

    #[test]
    fn after_a_panic_it_is_a_new_one() {
        let (shelf, a) = (Shelf::<u8>::default(), Path::new("a"));
        let panics = std::panic::AssertUnwindSafe(|| {
            shelf.with(
                a,
                || 1,
                |one| {
                    *one = 2;
                    panic!("as intended");
                },
            );
        });
        assert!(std::panic::catch_unwind(panics).is_err());
        assert_eq!(shelf.with(a, || 1, |one| *one), 1);
        assert_eq!(shelf.with(a, || 3, |one| *one), 1);
    }
}
