//! Polls a perturb-server for its status.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use perturb_protocol::{Address, Connection, Timeouts};

/// Minimum time between two polls of the server.
pub(crate) const POLL_INTERVAL: Duration = Duration::from_secs(2);
/// Number of latest response times whose median and maximum are shown.
const MAX_RESPONSE_TIMES: usize = 30;
/// Maximum time to wait for the server's answer.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(5);

/// Polls a perturb-server, and stores its last answer.
#[derive(Debug)]
pub(crate) struct ServerMonitor {
    address: Address,
    last: Mutex<Option<Result<ServerStatus, String>>>,
    /// The latest response times, most recent first.
    response_times: Mutex<VecDeque<Duration>>,
}

/// The status of a perturb-server at its last answer.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ServerStatus {
    /// Version of the server's program.
    pub(crate) version: String,
    /// Number of environments in the server's catalogue.
    pub(crate) environments: usize,
    /// Maximum number of environments in a session.
    pub(crate) max_batch_size: u32,
    /// Median of the latest response times.
    pub(crate) median_response: Duration,
    /// Maximum of the latest response times.
    pub(crate) max_response: Duration,
}

impl ServerMonitor {
    pub(crate) fn new(address: Address) -> Self {
        Self { address, last: Mutex::default(), response_times: Mutex::default() }
    }

    pub(crate) fn address(&self) -> &Address {
        &self.address
    }

    /// Returns the status from the last poll, or the reason why that poll failed. Returns `None` before the first poll.
    pub(crate) fn last(&self) -> Option<Result<ServerStatus, String>> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Requests the status from the server once, and stores the result.
    pub(crate) async fn poll(self: Arc<Self>) {
        self.poll_within(RESPONSE_TIMEOUT).await;
    }

    async fn poll_within(&self, timeout: Duration) {
        let answer = tokio::time::timeout(timeout, self.request()).await;
        let silent = || Err(format!("it did not answer within {} s", timeout.as_secs_f64()));
        *self.last.lock().unwrap_or_else(PoisonError::into_inner) = Some(answer.unwrap_or_else(|_| silent()));
    }

    async fn request(&self) -> Result<ServerStatus, String> {
        let message = |error: perturb_protocol::ClientError| error.to_string();
        let timeouts = Timeouts { reply: RESPONSE_TIMEOUT, ..Timeouts::default() };
        let connection = Connection::open_with(&self.address, timeouts).await.map_err(message)?;
        let start = Instant::now();
        let catalogue = connection.catalogue().await.map_err(message)?;
        let mut times = self.response_times.lock().unwrap_or_else(PoisonError::into_inner);
        times.push_front(start.elapsed());
        times.truncate(MAX_RESPONSE_TIMES);
        let mut sorted: Vec<Duration> = times.iter().copied().collect();
        sorted.sort_unstable();
        Ok(ServerStatus {
            version: catalogue.server_version,
            environments: catalogue.environments.len(),
            max_batch_size: catalogue.max_batch_size,
            median_response: sorted[sorted.len() / 2],
            max_response: sorted[sorted.len() - 1],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_silent_or_absent_server_has_a_reason() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let monitor = ServerMonitor::new(format!("tcp://{}", listener.local_addr().unwrap()).parse().unwrap());
        assert_eq!(monitor.last(), None, "it was not asked yet");
        monitor.poll_within(Duration::from_millis(300)).await;
        assert_eq!(monitor.last(), Some(Err("it did not answer within 0.3 s".into())));
        drop(listener);
        monitor.poll_within(RESPONSE_TIMEOUT).await;
        let reason = monitor.last().unwrap().unwrap_err();
        assert!(!reason.is_empty() && !reason.contains("did not answer within"), "nobody listens: {reason}");
    }
}
