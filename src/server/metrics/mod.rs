//! The server's metrics, in the text format of OpenMetrics, which Prometheus scrapes.
//!
//! - [`endpoint`]: the HTTP endpoint for scrapers.
//! - [`mod@format`]: the two text formats, and which one a scraper asks for.
//! - [`page`]: the metrics, each with its name, labels and sentence.
//! - [`process`]: resources of the process, as the system tells them.

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

/// The interval at which the wake-up delay of a transport thread is measured.
const LAG_CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// A protocol, and its requests by kind.
pub type RequestCounts = (&'static str, Arc<RequestCounters>);

/// The counters of the other layers, which the page reads.
pub struct MetricsSources {
    /// The pool, with the counters of environments.
    pub pool: Arc<Pool>,
    /// The limiter of sessions.
    pub sessions: PeerLimiter,
    /// The counters of leases.
    pub leases: LeaseCounters,
    /// The limiter of connections.
    pub connections: PeerLimiter,
    /// Bytes in flight.
    pub budget: Budget,
    /// Requests of each protocol.
    pub requests: [RequestCounts; 2],
    /// Why requests were refused.
    pub errors: ErrorCounters,
    /// The counts of ended sessions.
    pub access: AccessLog,
    /// The tokens, if the server requires one.
    pub tokens: Option<Tokens>,
    /// The ledger, if the server writes one.
    pub ledger: Option<Ledger>,
    /// The drawing times of pictures.
    pub pictures: Arc<Histogram>,
    /// The transport threads.
    pub threads: Vec<TransportMeter>,
}

/// The measurements of a transport thread.
pub struct TransportMeter {
    /// The connections of the thread.
    pub load: Arc<ThreadLoad>,
    /// The wake-up delays of the thread.
    pub lag: Histogram,
}

impl TransportMeter {
    /// Makes a meter without measurements of the wake-up delay.
    pub fn new(load: Arc<ThreadLoad>) -> Self {
        Self { load, lag: Histogram::default() }
    }

    /// Measures, for ever, how late the thread that runs this wakes up.
    pub async fn watch_lag(&self) {
        loop {
            let due = Instant::now() + LAG_CHECK_INTERVAL;
            sleep_until(due).await;
            self.lag.observe(due.elapsed());
        }
    }
}
