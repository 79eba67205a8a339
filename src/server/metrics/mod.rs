//! What the server says of itself: numbers, in the text format of OpenMetrics, which Prometheus scrapes.
//!
//! - [`endpoint`]: HTTP, for whoever scrapes.
//! - [`page`]: the metrics, each with its name, labels and sentence.
//! - [`process`]: what the system says of the process.

pub mod endpoint;
pub mod page;
pub mod process;

use super::{
    auth::Tokens,
    error::ErrorCounters,
    net::{access_log::AccessLog, peer_limiter::PeerLimiter},
    session::{instrumented::RequestCounters, lease::LeaseCounters},
    transport::budget::Budget,
};
use crate::{meters::Histogram, pool::Pool};
use std::{sync::Arc, time::Duration};
use tokio::time::{Instant, sleep_until};

/// The interval at which the wake-up delay of the transport's thread is measured.
const LAG_CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// A protocol, and its requests by kind.
pub type RequestCounts = (&'static str, Arc<RequestCounters>);

/// Where the numbers are, which others count.
pub struct Sources {
    /// Environments, and what happens in them.
    pub pool: Arc<Pool>,
    /// Those of sessions.
    pub sessions: PeerLimiter,
    /// Which of them have leases.
    pub leases: LeaseCounters,
    /// Those of connections.
    pub connections: PeerLimiter,
    /// Bytes in flight.
    pub budget: Budget,
    /// Requests of each protocol.
    pub requests: [RequestCounts; 2],
    /// Why requests were refused.
    pub errors: ErrorCounters,
    /// How sessions ended.
    pub access: AccessLog,
    /// Whose sessions there are.
    pub tokens: Option<Tokens>,
    /// How long pictures were drawn.
    pub pictures: Arc<Histogram>,
    /// How late the transport's thread wakes.
    pub lag: Histogram,
}

impl Sources {
    /// Watches how late the thread wakes that runs this, for ever.
    pub async fn watch_lag(&self) {
        loop {
            let due = Instant::now() + LAG_CHECK_INTERVAL;
            sleep_until(due).await;
            self.lag.observe(due.elapsed());
        }
    }
}
