//! The access log has a line for each session that ended. The number of lines in a second is limited, so that clients
//! that come and go do not fill the disk.

use super::peer_limiter::Peer;
use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};
use tokio::{runtime::Handle, time::Instant};

/// The access log has at most this many lines in a window. One more line says how many sessions were left out.
const MAX_LINES_PER_WINDOW: u64 = 20;
/// The length of a window.
const WINDOW: Duration = Duration::from_secs(1);

/// The ending of a session whose client or connection is gone.
pub const GONE: &str = "gone";
/// The ending of a session that its client has closed.
pub const CLOSED: &str = "closed";
/// The ending of a session whose requests cannot be decoded.
pub const BROKEN: &str = "broken";
/// The ending of a session whose lease is over. All other endings are the reasons of errors.
pub const LEASE_OVER: &str = "lease_over";

/// The environment of a session, and its steps.
#[derive(Debug, Clone, Copy, Default)]
pub struct SessionStats {
    /// The environment that the session was opened with.
    pub environment: Option<&'static str>,
    /// The number of environments that it was opened with.
    pub envs: usize,
    /// The number of steps, summed over its environments.
    pub steps: u64,
}

/// A session that ended.
pub struct SessionRecord<'a> {
    /// The peer of the session, if it is known.
    pub peer: Option<Peer>,
    /// The name of the session's token.
    pub token: Option<&'a str>,
    /// The protocol of the session.
    pub protocol: &'static str,
    /// The environment, and the steps that were taken.
    pub stats: SessionStats,
    /// The duration of the session.
    pub time: Duration,
    /// The number of streams that resumed it; `None` if there were none.
    pub resumed: Option<u32>,
    /// The ending: one of a few words.
    pub ending: &'static str,
}

/// The log, and the number of ended sessions by ending.
#[derive(Clone, Default)]
pub struct AccessLog(Arc<Mutex<LogState>>);

#[derive(Default)]
struct LogState {
    /// The number of ended sessions by protocol and ending.
    endings: BTreeMap<(&'static str, &'static str), u64>,
    /// The window's beginning, and the number of sessions that ended in it.
    window: Option<(Instant, u64)>,
}

impl AccessLog {
    /// Makes [`endings`](Self::endings) list this protocol, with counts of 0, before its first session ends.
    pub fn register_protocol(&self, protocol: &'static str) {
        let mut state = self.lock();
        for ending in [GONE, CLOSED, BROKEN, LEASE_OVER] {
            state.endings.entry((protocol, ending)).or_default();
        }
    }

    /// Adds a session's end.
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

    /// The counts of ended sessions, by protocol and ending.
    pub fn endings(&self) -> Vec<((&'static str, &'static str), u64)> {
        self.lock().endings.iter().map(|(key, count)| (*key, *count)).collect()
    }

    /// Counts a session. Returns whether it gets a line.
    fn count(&self, protocol: &'static str, ending: &'static str) -> bool {
        let mut state = self.lock();
        *state.endings.entry((protocol, ending)).or_default() += 1;
        let now = Instant::now();
        let (since, wanted) = state.window.get_or_insert((now, 0));
        // A window that has left out lines ends with the line that tells their number.
        if *wanted <= MAX_LINES_PER_WINDOW && since.elapsed() >= WINDOW {
            (*since, *wanted) = (now, 0);
        }
        *wanted += 1;
        if *wanted == MAX_LINES_PER_WINDOW + 1
            && let Ok(runtime) = Handle::try_current()
        {
            let (access, end) = (self.clone(), *since + WINDOW);
            runtime.spawn(async move {
                tokio::time::sleep_until(end).await;
                access.log_left_out();
            });
        }
        *wanted <= MAX_LINES_PER_WINDOW
    }

    fn log_left_out(&self) {
        let window = self.lock().window.take();
        let left_out = window.map_or(0, |(_, wanted)| wanted.saturating_sub(MAX_LINES_PER_WINDOW));
        tracing::info!(target: "perturb::access", left_out, "more sessions ended than there are lines for");
    }

    fn lock(&self) -> MutexGuard<'_, LogState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
