//! Waiting for the other side of a session, awake if it answers at once.

use std::future::Future;
use std::pin::pin;
use std::thread;
use std::time::{Duration, Instant};

use tokio::task::yield_now;

/// How long a wait is spent awake …
const AWAKE: Duration = Duration::from_micros(400);
/// … if the one before took no longer than this: whoever just misses the first is still worth it.
const SHORT: Duration = Duration::from_micros(500);

/// A core that is offered to other threads comes back at once if none wants it. If it does not come back within this in two
/// waits, one after the other, …
const OFFERED: Duration = Duration::from_micros(5);
/// … so many of a considerate kind are spent asleep: it stands in somebody's way, maybe the other side's.
const ASLEEP: u32 = 100;

/// Waits of one kind, each of which tells how the next one is spent. To put a thread to sleep and to wake it takes tens of
/// microseconds, as long as a round trip with 256 steps of CartPole.
#[derive(Debug, Default)]
pub struct Awake {
    was_short: bool,
    considerate: bool,
    /// In the last wait that was spent awake somebody wanted the core.
    was_wanted: bool,
    /// Waits that are to be spent asleep.
    asleep: u32,
}

impl Awake {
    /// From now on stays awake less where other threads want the core.
    pub fn be_considerate(&mut self) {
        self.considerate = true;
    }

    /// Waits for `event`. While it stays awake, the thread's other tasks have their turns, and so have other threads: it
    /// offers them its core again and again, but not before these tasks, one of which may send what is answered.
    pub async fn until<F: Future>(&mut self, event: F) -> F::Output {
        let begun = Instant::now();
        let mut event = pin!(event);
        let output = if self.asleep > 0 {
            self.asleep -= 1;
            event.await
        } else if self.was_short {
            let mut is_wanted = false;
            let output = tokio::select! {
                biased;
                output = &mut event => output,
                () = stay_awake(begun, &mut is_wanted) => event.await,
            };
            if self.considerate && is_wanted && self.was_wanted {
                self.asleep = ASLEEP;
            }
            self.was_wanted = is_wanted;
            output
        } else {
            event.await
        };
        self.was_short = begun.elapsed() <= SHORT;
        output
    }
}

/// Notes whether another thread wants the core.
async fn stay_awake(since: Instant, is_wanted: &mut bool) {
    while since.elapsed() < AWAKE {
        yield_now().await;
        let offered = Instant::now();
        thread::yield_now();
        *is_wanted |= offered.elapsed() > OFFERED;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::future::poll_fn;
    use std::sync::Arc;
    use std::task::Poll;

    /// Threads that keep all cores busy make every wait of other tests long.
    static ALONE: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());

    /// How often an event was looked at that comes after `time`, when the thread has slept or after some looks.
    async fn looks(awake: &mut Awake, time: Duration) -> usize {
        let (mut looks, mut timer) = (0, pin!(tokio::time::sleep(time)));
        let event = poll_fn(|context| {
            looks += 1;
            if time.is_zero() { Poll::Ready(()) } else { timer.as_mut().poll(context) }
        });
        awake.until(event).await;
        looks
    }

    #[tokio::test]
    async fn a_wait_after_a_short_one_is_awake_for_a_while_and_one_after_a_long_one_is_not() {
        let _alone = ALONE.lock().await;
        let mut awake = Awake::default();
        let long = Duration::from_millis(20);
        assert!(looks(&mut awake, long).await <= 2, "the first sleeps until it is woken");
        assert!(!awake.was_short);
        looks(&mut awake, Duration::ZERO).await;
        assert!(awake.was_short);
        // A select looks at both whenever either is woken.
        assert!(looks(&mut awake, long).await > 2, "stays awake and looks");
        assert!(!awake.was_short, "and has learned that it comes late");
    }

    /// An event that comes at this time, for whoever looks; nobody sleeps until then.
    async fn at(time: Instant) {
        poll_fn(|context| {
            context.waker().wake_by_ref();
            if Instant::now() < time { Poll::Pending } else { Poll::Ready(()) }
        })
        .await;
    }

    #[tokio::test]
    async fn a_considerate_wait_leaves_the_core_to_a_thread_that_wants_it_and_so_do_those_after_it() {
        let _alone = ALONE.lock().await;
        let busy = Arc::new(());
        // More threads than cores: sooner or later an offer is taken.
        for _ in 0..2 * thread::available_parallelism().map_or(1, usize::from) {
            let busy = Arc::downgrade(&busy);
            thread::spawn(move || while busy.strong_count() > 0 {});
        }
        let (mut awake, mut other) = (Awake::default(), Awake::default());
        awake.be_considerate();
        let begun = Instant::now();
        while awake.asleep == 0 || !other.was_wanted {
            assert!(begun.elapsed() < Duration::from_secs(60), "nobody has ever taken a core");
            for awake in [&mut awake, &mut other] {
                awake.was_short = true;
                awake.until(at(Instant::now() + Duration::from_micros(200))).await;
            }
        }
        assert_eq!(other.asleep, 0, "others are not");
        drop(busy);
        for left in (0..awake.asleep).rev() {
            awake.was_short = true;
            let looked = looks(&mut awake, Duration::from_millis(2)).await;
            assert!(looked < 10, "{looked} looks: awake it would be hundreds");
            assert_eq!(awake.asleep, left);
        }
    }

    #[tokio::test]
    async fn other_tasks_of_the_thread_have_their_turns() {
        let mut awake = Awake { was_short: true, ..Awake::default() };
        let (sender, receiver) = tokio::sync::oneshot::channel();
        tokio::spawn(async move {
            yield_now().await;
            sender.send(7)
        });
        assert_eq!(awake.until(receiver).await, Ok(7));
    }
}
