//! The rate limit for the steps of a token's environments. Steps are charged after they ran. A client that is ahead of
//! the rate waits before its next request is handled, and only the request is kept in memory meanwhile. An idle client
//! may catch up on the steps of one second.

use std::{
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};
use tokio::time::{Instant, sleep};

/// A token that was idle may catch up on the steps of this time, in seconds.
const BURST_SECONDS: f64 = 1.0;
/// A request that would wait longer is refused. Clients wait a minute for a reply.
pub(super) const MAX_WAIT: Duration = Duration::from_secs(30);
/// The minimum sleep; without it a wait that is rounded to zero would spin.
const MIN_WAIT: Duration = Duration::from_micros(1);
/// The interval at which a waiting request checks whether the rate has changed.
const RECHECK_INTERVAL: Duration = Duration::from_millis(500);

/// A token's rate limit, with the numbers of steps that it has allowed and that were done.
#[derive(Default)]
pub(super) struct RateLimiter(Mutex<RateState>);

#[derive(Default)]
struct RateState {
    /// The steps per second; `None` for no limit.
    rate: Option<u32>,
    /// Steps so far.
    done: f64,
    /// The steps that the rate has allowed until `at`, at most those of [`BURST_SECONDS`] more than were done.
    allowed: f64,
    at: Option<Instant>,
    waited: Duration,
}

/// The error of a client that is so far ahead of the rate that it should not wait.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct TooFast {
    pub(super) rate: u32,
    pub(super) ahead: Duration,
}

impl RateLimiter {
    /// Sets the steps per second; `None` for no limit.
    pub(super) fn set_rate(&self, rate: Option<u32>) {
        self.lock().set_rate(rate, Instant::now());
    }

    /// The most steps a second.
    pub(super) fn rate(&self) -> Option<u32> {
        self.lock().rate
    }

    /// The time that requests waited so far.
    pub(super) fn waited(&self) -> Duration {
        self.lock().waited
    }

    /// Counts steps that were done.
    pub(super) fn charge(&self, steps: u64) {
        self.lock().done += steps as f64;
    }

    /// Waits until the rate has allowed all steps that were charged before this call. Later calls wait for the steps of
    /// earlier ones, so callers proceed one after the other.
    ///
    /// # Errors
    /// [`TooFast`], without waiting, if it would take longer than `max_wait`.
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

    /// Adds the steps that the rate allows for the time since the last call.
    fn refill(&mut self, now: Instant) {
        let elapsed = self.at.map_or(Duration::ZERO, |at| now.saturating_duration_since(at)).as_secs_f64();
        self.allowed = match self.rate.map(f64::from) {
            Some(rate) => (self.allowed + elapsed * rate).min(self.done + BURST_SECONDS * rate),
            None => self.done,
        };
        self.at = Some(now);
    }

    /// Returns how long to sleep before calling again, or `None` when the caller may proceed. Pass an empty `ticket` on
    /// the first call.
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
        // A rate is at least 1, so this does not divide by 0.
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

    /// A rate's state, and a clock that only waiting moves.
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

        /// The duration of the next turn, s.
        fn turn(&mut self) -> Result<f64, TooFast> {
            let (start, mut ticket) = (self.now, None);
            while let Some(wait) = self.state.wait(&mut ticket, MAX_WAIT, self.now)? {
                self.now += wait;
            }
            Ok((self.now - start).as_secs_f64())
        }
    }

    fn is_about(seconds: f64, expected: f64) -> bool {
        // A wait is of a microsecond at least.
        (seconds - expected).abs() < 1e-5
    }

    #[test]
    fn what_was_done_is_waited_for_and_a_second_can_be_made_up_for() {
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
    fn those_who_wait_go_one_after_the_other_at_the_rate() {
        const ROUNDS: usize = 50;
        let mut clocked = Clocked::new();
        clocked.set_rate(1000);
        let start = clocked.now;
        // When each asks next, with which ticket, and how often it had its turn.
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
            // Of those who ask at the same moment any is the first.
            let turns = sessions.map(|session| session.2);
            assert!(turns.iter().max().unwrap() - turns.iter().min().unwrap() <= 2, "{turns:?}");
        }
        // 20 000 steps at 1000 a second, but that nobody waits for the last.
        let seconds = (clocked.now - start).as_secs_f64();
        assert!((19.5..20.0).contains(&seconds), "{seconds} s");
    }

    #[test]
    fn who_is_half_a_minute_ahead_is_refused() {
        let mut clocked = Clocked::new();
        clocked.set_rate(10);
        clocked.state.done += 400.0;
        assert_eq!(clocked.turn(), Err(TooFast { rate: 10, ahead: Duration::from_secs(40) }));
        clocked.now += Duration::from_secs(20);
        assert!(is_about(clocked.turn().unwrap(), 20.0));
    }

    #[test]
    fn another_rate_counts_for_those_who_wait_already() {
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
