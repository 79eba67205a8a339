//! Low-latency waiting for the other side of a session: a wait spins first if the previous wait was short.

use std::future::Future;
use std::pin::pin;
use std::thread;
use std::time::{Duration, Instant};

use tokio::task::yield_now;

/// Maximal time for which one wait spins before it blocks.
const SPIN_MAX: Duration = Duration::from_micros(400);
/// A wait spins if the previous wait took at most this long. The limit is above [`SPIN_MAX`], so that an event just
/// after the end of a spin does not stop the next wait from spinning.
const SHORT_WAIT_MAX: Duration = Duration::from_micros(500);

/// Longest duration of a `yield_now` on a free core. If it takes longer, another thread ran on the core in between.
const YIELD_MAX: Duration = Duration::from_micros(5);
/// Number of waits that block at once after two contended waits in a row, if [`AdaptiveSpin::back_off_when_contended`]
/// was called. Spinning on a contended core may delay the very answer that it waits for.
const BLOCKING_WAITS: u32 = 100;

/// Decides for successive waits of the same kind whether to spin before blocking. Blocking and waking a thread takes
/// tens of microseconds, as long as a whole round trip with a step of 256 CartPoles.
#[derive(Debug, Default)]
pub struct AdaptiveSpin {
    was_short: bool,
    backs_off: bool,
    /// Whether another thread wanted the core during the last spin.
    was_contended: bool,
    /// Number of coming waits that block without spinning.
    blocking_waits: u32,
}

impl AdaptiveSpin {
    /// Makes later waits spin less if other threads want the core.
    pub fn back_off_when_contended(&mut self) {
        self.backs_off = true;
    }

    /// Waits for `event`, and returns its output. A spinning wait yields repeatedly, first to the other async tasks of
    /// the thread, then to other threads. It must yield to tasks, because the task that sends the request may run in
    /// the same thread.
    pub async fn until<F: Future>(&mut self, event: F) -> F::Output {
        let begun = Instant::now();
        let mut event = pin!(event);
        let output = if self.blocking_waits > 0 {
            self.blocking_waits -= 1;
            event.await
        } else if self.was_short {
            let mut is_contended = false;
            let output = tokio::select! {
                biased;
                output = &mut event => output,
                () = spin(begun, &mut is_contended) => event.await,
            };
            if self.backs_off && is_contended && self.was_contended {
                self.blocking_waits = BLOCKING_WAITS;
            }
            self.was_contended = is_contended;
            output
        } else {
            event.await
        };
        self.was_short = begun.elapsed() <= SHORT_WAIT_MAX;
        output
    }
}

/// Spins until [`SPIN_MAX`] after `since`. Sets `is_contended` if another thread wants the core.
async fn spin(since: Instant, is_contended: &mut bool) {
    while since.elapsed() < SPIN_MAX {
        yield_now().await;
        let yielded = Instant::now();
        thread::yield_now();
        *is_contended |= yielded.elapsed() > YIELD_MAX;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::future::poll_fn;
    use std::sync::Arc;
    use std::task::Poll;

    /// Makes tests run one after the other, because the busy threads of `spin_backs_off_when_contended` change the
    /// timing of other tests.
    static ALONE: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());

    /// Waits for an event that occurs after `time`. Returns how often it was polled.
    async fn polls(spin: &mut AdaptiveSpin, time: Duration) -> usize {
        let mut polls = 0;
        let mut timer = pin!(tokio::time::sleep(time));
        let event = poll_fn(|context| {
            polls += 1;
            if time.is_zero() { Poll::Ready(()) } else { timer.as_mut().poll(context) }
        });
        spin.until(event).await;
        polls
    }

    #[tokio::test]
    async fn waits_spin_after_a_short_wait_only() {
        let _alone = ALONE.lock().await;
        let mut spin = AdaptiveSpin::default();
        let long = Duration::from_millis(20);
        assert!(polls(&mut spin, long).await <= 2, "the first blocks until it is woken");
        assert!(!spin.was_short);
        polls(&mut spin, Duration::ZERO).await;
        assert!(spin.was_short);
        // A select polls both of its futures whenever one of them is woken.
        assert!(polls(&mut spin, long).await > 2, "spins");
        assert!(!spin.was_short, "and has learned that the event comes late");
    }

    /// An event that occurs at `time`, and asks to be polled again and again until then.
    async fn at(time: Instant) {
        poll_fn(|context| {
            context.waker().wake_by_ref();
            if Instant::now() < time { Poll::Pending } else { Poll::Ready(()) }
        })
        .await;
    }

    #[tokio::test]
    async fn spin_backs_off_when_contended() {
        let _alone = ALONE.lock().await;
        let busy = Arc::new(());
        // More threads than cores: sooner or later a yield takes long.
        for _ in 0..2 * thread::available_parallelism().map_or(1, usize::from) {
            let busy = Arc::downgrade(&busy);
            thread::spawn(move || while busy.strong_count() > 0 {});
        }
        let mut polite = AdaptiveSpin::default();
        let mut other = AdaptiveSpin::default();
        polite.back_off_when_contended();
        let begun = Instant::now();
        while polite.blocking_waits == 0 || !other.was_contended {
            assert!(begun.elapsed() < Duration::from_secs(60), "no yield ever took long");
            for spin in [&mut polite, &mut other] {
                spin.was_short = true;
                spin.until(at(Instant::now() + Duration::from_micros(200))).await;
            }
        }
        assert_eq!(other.blocking_waits, 0, "others do not back off");
        drop(busy);
        for left in (0..polite.blocking_waits).rev() {
            polite.was_short = true;
            let polled = polls(&mut polite, Duration::from_millis(2)).await;
            assert!(polled < 10, "{polled} polls: spinning it would be hundreds");
            assert_eq!(polite.blocking_waits, left);
        }
    }

    #[tokio::test]
    async fn other_tasks_run_while_spinning() {
        let mut spin = AdaptiveSpin { was_short: true, ..AdaptiveSpin::default() };
        let (sender, receiver) = tokio::sync::oneshot::channel();
        tokio::spawn(async move {
            yield_now().await;
            sender.send(7)
        });
        assert_eq!(spin.until(receiver).await, Ok(7));
    }
}
