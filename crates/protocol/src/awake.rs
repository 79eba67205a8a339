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

/// Waits of one kind, each of which tells how the next one is spent. To put a thread to sleep and to wake it takes tens of
/// microseconds, as long as a round trip with 256 steps of CartPole.
#[derive(Debug, Default)]
pub struct Awake {
    was_short: bool,
}

impl Awake {
    /// Waits for `event`. While it stays awake, the thread's other tasks have their turns, and so have other threads: it
    /// offers them its core again and again, but not before these tasks, one of which may send what is answered.
    pub async fn until<F: Future>(&mut self, event: F) -> F::Output {
        let begun = Instant::now();
        let mut event = pin!(event);
        let output = if self.was_short {
            tokio::select! {
                biased;
                output = &mut event => output,
                () = stay_awake(begun) => event.await,
            }
        } else {
            event.await
        };
        self.was_short = begun.elapsed() <= SHORT;
        output
    }
}

async fn stay_awake(since: Instant) {
    while since.elapsed() < AWAKE {
        yield_now().await;
        thread::yield_now();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::future::poll_fn;
    use std::task::Poll;

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

    #[tokio::test]
    async fn other_tasks_of_the_thread_have_their_turns() {
        let mut awake = Awake { was_short: true };
        let (sender, receiver) = tokio::sync::oneshot::channel();
        tokio::spawn(async move {
            yield_now().await;
            sender.send(7)
        });
        assert_eq!(awake.until(receiver).await, Ok(7));
    }
}
