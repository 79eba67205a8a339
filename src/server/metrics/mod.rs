//! The server's metrics page for Prometheus, in the OpenMetrics text format.
//!
//! - [`endpoint`]: the HTTP endpoint that serves the page.
//! - [`mod@format`]: the two text formats, and the choice between them for a request.
//! - [`page`]: the metrics with their names, labels and descriptions.
//! - [`process`]: CPU time, memory and file descriptors of the process.

pub mod endpoint;
pub mod format;
pub mod page;
pub mod process;

use super::{
    audit::ledger::Ledger,
    auth::Tokens,
    error::ErrorCounters,
    net::{access_log::AccessLog, load::ThreadLoad, peer_limiter::PeerLimiter},
    session::{instrumented::RequestCounters, lease::LeaseCounters},
    transport::budget::Budget,
};
use crate::{meters::Histogram, pool::Pool};
use std::{sync::Arc, time::Duration};
use tokio::time::{Instant, sleep_until};

/// The interval at which a transport thread's wake-up delay is measured.
const LAG_CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// The name of a protocol, and the counters of its requests.
pub type RequestCounts = (&'static str, Arc<RequestCounters>);

/// The counters of all layers of the server, which the metrics page reads.
pub struct MetricsSources {
    /// The pool, with the counters of environments.
    pub pool: Arc<Pool>,
    /// The limiter of sessions; the page shows their number and their limit.
    pub sessions: PeerLimiter,
    /// The counters of leases.
    pub leases: LeaseCounters,
    /// The limiter of connections; the page shows their number.
    pub connections: PeerLimiter,
    /// The memory budget; the page shows the bytes in flight and their limit.
    pub budget: Budget,
    /// The counters of requests, for each protocol.
    pub requests: [RequestCounts; 2],
    /// The counters of errors, by class.
    pub errors: ErrorCounters,
    /// The access log; the page shows its counts of ended sessions.
    pub access: AccessLog,
    /// The tokens, if the server requires tokens.
    pub tokens: Option<Tokens>,
    /// The ledger, if the server has one.
    pub ledger: Option<Ledger>,
    /// The times that pictures took to draw.
    pub pictures: Arc<Histogram>,
    /// The measurements of each transport thread.
    pub threads: Vec<TransportMeter>,
}

/// The measurements of a transport thread.
pub struct TransportMeter {
    /// The load of the thread; the page shows its number of connections.
    pub load: Arc<ThreadLoad>,
    /// The delays with which the thread woke up.
    pub lag: Histogram,
}

impl TransportMeter {
    /// Makes the meter of the thread with this load.
    pub fn new(load: Arc<ThreadLoad>) -> Self {
        Self { load, lag: Histogram::default() }
    }

    /// Repeatedly measures how late the current thread wakes up. Must run on the thread that is measured. Never
    /// returns.
    pub async fn watch_lag(&self) {
        loop {
            let due = Instant::now() + LAG_CHECK_INTERVAL;
            sleep_until(due).await;
            self.lag.observe(due.elapsed());
        }
    }
}
