//! The rate limit for the steps of a token's environments. Steps are charged after they ran. A client that has exceeded
//! the rate waits before its next request is handled. A client that was idle may run, without waiting, the steps that
//! the rate allows in one second.

use std::{
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};
use tokio::time::{Instant, sleep};

/// The length of a burst, in seconds: a client that was idle may run at once the steps that the rate allows in this
/// time.
const BURST_SECONDS: f64 = 1.0;
/// The maximum wait. A request that would wait longer is refused, because clients wait a minute for a reply.
pub(super) const MAX_WAIT: Duration = Duration::from_secs(30);
/// The minimum sleep. Without it, a wait that is rounded to zero would spin.
const MIN_WAIT: Duration = Duration::from_micros(1);
/// The maximum sleep before a waiting request checks whether the rate has changed.
const RECHECK_INTERVAL: Duration = Duration::from_millis(500);

/// A token's rate limit: a token bucket that is charged after the fact.
#[derive(Default)]
pub(super) struct RateLimiter(Mutex<RateState>);

#[derive(Default)]
struct RateState {
    /// The maximum number of steps per second; `None` for no limit.
    rate: Option<u32>,
    /// The number of steps that were charged so far.
    done: f64,
    /// The number of steps that the rate has allowed until the time `at`. It exceeds `done` by at most the steps that
    /// the rate allows in [`BURST_SECONDS`].
    allowed: f64,
    at: Option<Instant>,
    waited: Duration,
}

/// The error of a request that would have to wait for too long. `ahead` is the wait that it would need.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct TooFast {
    pub(super) rate: u32,
    pub(super) ahead: Duration,
}

impl RateLimiter {
    /// Sets the maximum number of steps per second; `None` for no limit.
    pub(super) fn set_rate(&self, rate: Option<u32>) {
        self.lock().set_rate(rate, Instant::now());
    }

    /// The maximum number of steps per second; `None` for no limit.
    pub(super) fn rate(&self) -> Option<u32> {
        self.lock().rate
    }

    /// The total time that requests have waited so far.
    pub(super) fn waited(&self) -> Duration {
        self.lock().waited
    }

    /// Charges steps that were done.
    pub(super) fn charge(&self, steps: u64) {
        self.lock().done += steps as f64;
    }

    /// Waits until the rate has allowed all steps that were charged before this call. A later call waits for at least
    /// as many steps, so it does not overtake earlier calls.
    ///
    /// # Errors
    /// [`TooFast`], if the wait would be longer than `max_wait`: at once, or during the wait if the rate is lowered.
    pub(super) async fn acquire(&self, max_wait: Duration) -> Result<(), TooFast> {
        let mut ticket = None;
        while let Some(wait) = self.wait(&mut ticket, max_wait)? {
            sleep(wait).await;
        }
        Ok(())
    }

    fn wait(&self, ticket: &mut Option<f64>, max_wait: Duration) -> Result<Option<Duration>, TooFast> {
        self.lock().wait(ticket, max_wait, Instant::now())
    }

    fn lock(&self) -> MutexGuard<'_, RateState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl RateState {
    fn set_rate(&mut self, rate: Option<u32>, now: Instant) {
        self.refill(now);
        self.rate = rate;
    }

    /// Updates `allowed` to the time `now`.
    fn refill(&mut self, now: Instant) {
        let elapsed = self.at.map_or(Duration::ZERO, |at| now.saturating_duration_since(at)).as_secs_f64();
        self.allowed = match self.rate.map(f64::from) {
            Some(rate) => (self.allowed + elapsed * rate).min(self.done + BURST_SECONDS * rate),
            None => self.done,
        };
        self.at = Some(now);
    }

    /// Returns how long to sleep before calling again, or `None` if the caller may proceed. `ticket` must be `None` at
    /// the first call, which sets it to the number of steps charged so far. The wait ends when the rate has allowed
    /// these steps.
    fn wait(
        &mut self,
        ticket: &mut Option<f64>,
        max_wait: Duration,
        now: Instant,
    ) -> Result<Option<Duration>, TooFast> {
        self.refill(now);
        let Some(rate) = self.rate else { return Ok(None) };
        let steps = *ticket.get_or_insert(self.done) - self.allowed;
        if steps <= 0.0 {
            return Ok(None);
        }
        // The rate is at least 1, so this does not divide by 0.
        let ahead = Duration::from_secs_f64(steps / f64::from(rate));
        if ahead > max_wait {
            return Err(TooFast { rate, ahead });
        }
        let wait = ahead.clamp(MIN_WAIT, RECHECK_INTERVAL);
        self.waited += wait;
        Ok(Some(wait))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A rate limiter with a simulated clock, which waiting advances.
    struct Clocked {
        state: RateState,
        now: Instant,
    }

    impl Clocked {
        fn new() -> Self {
            Self { state: RateState::default(), now: Instant::now() }
        }

        fn set_rate(&mut self, rate: u32) {
            self.state.set_rate(Some(rate), self.now);
        }

        /// Waits as a request does. Returns the time that it waited, s.
        fn turn(&mut self) -> Result<f64, TooFast> {
            let (start, mut ticket) = (self.now, None);
            while let Some(wait) = self.state.wait(&mut ticket, MAX_WAIT, self.now)? {
                self.now += wait;
            }
            Ok((self.now - start).as_secs_f64())
        }
    }

    fn is_about(seconds: f64, expected: f64) -> bool {
        // The tolerance covers the minimum sleep of a microsecond.
        (seconds - expected).abs() < 1e-5
    }

    #[test]
    fn charged_steps_are_waited_for_and_idle_clients_may_burst() {
        let mut clocked = Clocked::new();
        clocked.state.done += 1e6;
        assert_eq!(clocked.turn(), Ok(0.0), "there is no rate");
        clocked.set_rate(100);
        assert_eq!(clocked.turn(), Ok(0.0), "what was before is forgotten");
        clocked.state.done += 250.0;
        assert!(is_about(clocked.turn().unwrap(), 2.5));
        assert_eq!(clocked.turn(), Ok(0.0));
        clocked.now += Duration::from_secs(60);
        assert_eq!(clocked.turn(), Ok(0.0));
        clocked.state.done += 300.0;
        assert!(is_about(clocked.turn().unwrap(), 2.0), "not more than a second is made up for");
        assert!(is_about(clocked.state.waited.as_secs_f64(), 4.5), "{:?}", clocked.state.waited);
    }

    #[test]
    fn waiting_sessions_take_turns_at_the_rate() {
        const ROUNDS: usize = 50;
        let mut clocked = Clocked::new();
        clocked.set_rate(1000);
        let start = clocked.now;
        // For each session: the time of its next call, its ticket, and the number of its requests that proceeded.
        let mut sessions = [(start, None, 0); 4];
        while let Some((at, ticket, turns)) =
            sessions.iter_mut().filter(|session| session.2 < ROUNDS).min_by_key(|session| session.0)
        {
            match clocked.state.wait(ticket, MAX_WAIT, *at).unwrap() {
                Some(wait) => *at += wait,
                None => {
                    clocked.state.done += 100.0;
                    (*ticket, *turns) = (None, *turns + 1);
                }
            }
            clocked.now = *at;
            // Sessions that call at the same time proceed in any order, so the numbers may differ by 2.
            let turns = sessions.map(|session| session.2);
            assert!(turns.iter().max().unwrap() - turns.iter().min().unwrap() <= 2, "{turns:?}");
        }
        // 20 000 steps at 1000 a second take 20 s, but nobody waits for the last steps.
        let seconds = (clocked.now - start).as_secs_f64();
        assert!((19.5..20.0).contains(&seconds), "{seconds} s");
    }

    #[test]
    fn a_wait_of_more_than_half_a_minute_is_refused() {
        let mut clocked = Clocked::new();
        clocked.set_rate(10);
        clocked.state.done += 400.0;
        assert_eq!(clocked.turn(), Err(TooFast { rate: 10, ahead: Duration::from_secs(40) }));
        clocked.now += Duration::from_secs(20);
        assert!(is_about(clocked.turn().unwrap(), 20.0));
    }

    #[test]
    fn a_new_rate_applies_to_waiting_requests() {
        let mut clocked = Clocked::new();
        clocked.set_rate(10);
        clocked.state.done += 200.0;
        let mut ticket = None;
        let wait = clocked.state.wait(&mut ticket, MAX_WAIT, clocked.now).unwrap().unwrap();
        clocked.now += wait;
        clocked.set_rate(1000);
        let wait = clocked.state.wait(&mut ticket, MAX_WAIT, clocked.now).unwrap().unwrap();
        assert!(is_about(wait.as_secs_f64(), 0.195), "{wait:?}");
    }

    #[test]
    fn lowered_rate_also_refuses_waiting_requests() {
        let mut clocked = Clocked::new();
        clocked.set_rate(1000);
        clocked.state.done += 20_000.0;
        let mut ticket = None;
        assert!(clocked.state.wait(&mut ticket, MAX_WAIT, clocked.now).is_ok_and(|wait| wait.is_some()));
        clocked.set_rate(100);
        let refused = clocked.state.wait(&mut ticket, MAX_WAIT, clocked.now);
        assert!(refused.is_err_and(|error| error.rate == 100), "some 200 s are half a minute at most for nobody");
    }
}
