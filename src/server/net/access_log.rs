//! The access log, which has a line for each ended session. The number of lines per second is limited, so clients that
//! connect and disconnect in a loop cannot fill the disk.

use super::peer_limiter::Peer;
use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};
use tokio::{runtime::Handle, time::Instant};

/// The maximum number of lines in one window of time. One more line says how many sessions were omitted.
const MAX_LINES_PER_WINDOW: u64 = 20;
/// The length of the window of time to which the maximum applies.
const WINDOW: Duration = Duration::from_secs(1);

/// Logged ending of a session whose client or connection disappeared.
pub const GONE: &str = "gone";
/// Logged ending of a session that its client closed.
pub const CLOSED: &str = "closed";
/// Logged ending of a session whose stream broke, because its bytes could not be decoded, the connection failed, or the
/// server has a defect.
pub const BROKEN: &str = "broken";
/// Logged ending of a session whose lease expired. Any ending other than these four is the word of an error class
/// ([`ErrorKind::reason`](crate::server::error::ErrorKind::reason)).
pub const LEASE_OVER: &str = "lease_over";

/// A session's environment, batch size and steps so far.
#[derive(Debug, Clone, Copy, Default)]
pub struct SessionStats {
    /// The name of the environment that the session was opened with; `None` if it was never opened.
    pub environment: Option<&'static str>,
    /// The number of environments that the session was opened with.
    pub envs: usize,
    /// The number of steps, summed over the session's environments.
    pub steps: u64,
}

/// The facts about an ended session that the access log states.
pub struct SessionRecord<'a> {
    /// The peer of the session, if it is known.
    pub peer: Option<Peer>,
    /// The name of the session's token, if it had one.
    pub token: Option<&'a str>,
    /// The protocol of the session.
    pub protocol: &'static str,
    /// The environment, batch size and steps of the session.
    pub stats: SessionStats,
    /// The duration of the session.
    pub time: Duration,
    /// The number of times that the session was resumed; `None` if it never was.
    pub resumed: Option<u32>,
    /// Why the session ended: one of a fixed set of words.
    pub ending: &'static str,
}

/// The access log, and the counts of ended sessions by protocol and ending.
#[derive(Clone, Default)]
pub struct AccessLog(Arc<Mutex<LogState>>);

#[derive(Default)]
struct LogState {
    /// The number of ended sessions by protocol and ending.
    endings: BTreeMap<(&'static str, &'static str), u64>,
    /// The start of the current window, and the number of sessions that have ended in it.
    window: Option<(Instant, u64)>,
}

impl AccessLog {
    /// Adds counts of 0 for this protocol, so that [`endings`](Self::endings) includes them before a session ends.
    pub fn register_protocol(&self, protocol: &'static str) {
        let mut state = self.lock();
        for ending in [GONE, CLOSED, BROKEN, LEASE_OVER] {
            state.endings.entry((protocol, ending)).or_default();
        }
    }

    /// Counts and logs an ended session.
    pub fn record(&self, ended: &SessionRecord<'_>) {
        if !self.count(ended.protocol, ended.ending) {
            return;
        }
        let SessionRecord {
            peer,
            token,
            protocol,
            stats: SessionStats { environment, envs, steps },
            time,
            resumed,
            ending,
        } = ended;
        let (peer, seconds) = (peer.map(tracing::field::display), (time.as_secs_f64() * 1e3).round() / 1e3);
        tracing::info!(
            target: "perturb::access",
            peer, token, protocol, environment, envs, steps, seconds, resumed, ending, "a session ended"
        );
    }

    /// Returns the number of ended sessions for each protocol and ending.
    pub fn endings(&self) -> Vec<((&'static str, &'static str), u64)> {
        self.lock().endings.iter().map(|(key, count)| (*key, *count)).collect()
    }

    /// Counts an ended session. Returns whether it gets a line in the log.
    fn count(&self, protocol: &'static str, ending: &'static str) -> bool {
        let mut state = self.lock();
        *state.endings.entry((protocol, ending)).or_default() += 1;
        let now = Instant::now();
        let (since, n_ended) = state.window.get_or_insert((now, 0));
        // Once more sessions than the maximum have ended in a window, the task below ends the window. That task logs
        // how many sessions were omitted.
        if *n_ended <= MAX_LINES_PER_WINDOW && since.elapsed() >= WINDOW {
            (*since, *n_ended) = (now, 0);
        }
        *n_ended += 1;
        if *n_ended == MAX_LINES_PER_WINDOW + 1
            && let Ok(runtime) = Handle::try_current()
        {
            let (access, end) = (self.clone(), *since + WINDOW);
            runtime.spawn(async move {
                tokio::time::sleep_until(end).await;
                access.log_left_out();
            });
        }
        *n_ended <= MAX_LINES_PER_WINDOW
    }

    fn log_left_out(&self) {
        let window = self.lock().window.take();
        let left_out = window.map_or(0, |(_, n_ended)| n_ended.saturating_sub(MAX_LINES_PER_WINDOW));
        tracing::info!(target: "perturb::access", left_out, "omitted lines for further ended sessions");
    }

    fn lock(&self) -> MutexGuard<'_, LogState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
