//! Reconnects to lost servers, with growing pauses between attempts.

use std::time::{Duration, Instant};

use perturb_files::interrupt::StopFlag;
use perturb_protocol::{Address, ClientError};
use perturb_text::duration;
use tokio::time::sleep;

use super::options::ServerWait;
use super::servers::Servers;

/// Pause before the second attempt; the first one is immediate. The pause doubles with each further attempt.
const MIN_PAUSE: Duration = Duration::from_millis(100);
/// Maximum pause between two attempts.
const MAX_PAUSE: Duration = Duration::from_secs(10);
/// Time to wait for all lost servers. After that, the run continues with the servers that answer.
const PARTIAL_RECONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Reconnects to lost servers with growing pauses, and counts the time spent waiting since the run last made progress.
#[derive(Debug, Default)]
pub struct Backoff {
    waited: Duration,
    attempts: u32,
    /// Whether the run has made any progress. If so, the servers once had room for its environments, so a server that
    /// is full now may have room again.
    has_begun: bool,
}

/// The result of [`Backoff::reconnect`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reconnect {
    /// At least one server answers again.
    Connected,
    /// The error is permanent, or the time limit is reached.
    TimedOut,
    /// A signal asked the program to stop.
    Stopped {
        /// The signal's number.
        signal: i32,
    },
}

impl Backoff {
    /// Records that the run made progress: the next loss of a server gets the full time limit again.
    pub fn reset(&mut self) {
        *self = Self { has_begun: true, ..Self::default() };
    }

    /// Reconnects after `error`, within the time limit of [`ServerWait`]. First waits some seconds for all servers,
    /// then continues with those that answer. A full server counts as lost only if the run had already started.
    pub fn reconnect(&mut self, servers: &Servers, error: &ClientError, stop: &StopFlag) -> Reconnect {
        let ServerWait { limit, tell } = servers.wait();
        if let Some(signal) = stop.signal() {
            return Reconnect::Stopped { signal };
        }
        if !self.is_passing(error) || self.waited >= limit {
            return Reconnect::TimedOut;
        }
        let wait = || format!("waiting for it, at most {}", duration((limit - self.waited).as_secs_f64()));
        let remedy = if servers.is_private() { "starting it again".into() } else { wait() };
        tell(&format!("{error}; {remedy}"));
        servers.block_on(async {
            tokio::select! {
                biased;
                signal = stop.raised() => Reconnect::Stopped { signal },
                reconnect = self.retry(servers) => reconnect,
            }
        })
    }

    /// Returns whether the error may be temporary: the server does not answer, or it is full although it had room
    /// before.
    fn is_passing(&self, error: &ClientError) -> bool {
        error.is_absence() || ((self.attempts > 0 || self.has_begun) && is_full(error))
    }

    /// Tries to reconnect until it succeeds or the time limit is reached.
    async fn retry(&mut self, servers: &Servers) -> Reconnect {
        let ServerWait { limit, tell } = servers.wait();
        let begun = Instant::now();
        let before = self.waited;
        loop {
            sleep(pause(self.attempts).min(limit.saturating_sub(self.waited))).await;
            self.attempts += 1;
            let reached = servers.reconnect().await;
            self.waited = before + begun.elapsed();
            match reached {
                Ok(away) if away.is_empty() => return Reconnect::Connected,
                Ok(_) if begun.elapsed() >= PARTIAL_RECONNECT_TIMEOUT.min(limit) => {
                    let there: Vec<String> = servers.addresses().iter().map(Address::to_string).collect();
                    tell(&format!("going on with {} alone", there.join(" and ")));
                    return Reconnect::Connected;
                }
                Err(error @ ClientError::Unsafe { .. }) => {
                    tell(&error.to_string());
                    return Reconnect::TimedOut;
                }
                _ if self.waited >= limit => return Reconnect::TimedOut,
                _ => {}
            }
        }
    }
}

/// Returns the pause before the next attempt, after this number of `attempts`.
fn pause(attempts: u32) -> Duration {
    let doubled = |times: u32| MIN_PAUSE * (1 << times.min(16));
    attempts.checked_sub(1).map_or(Duration::ZERO, doubled).min(MAX_PAUSE)
}

/// Returns whether the error is that a server has no room for more environments.
fn is_full(error: &ClientError) -> bool {
    let (ClientError::Refused { code, .. } | ClientError::Lost { code, .. }) = error else { return false };
    *code == tonic::Code::ResourceExhausted
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refused_requests_are_not_retried() {
        let address = || "unix:/x".parse::<Address>().unwrap();
        let lost = |code| ClientError::Lost { address: address(), request: "a step", code, reason: "gone".into() };
        let refused = |code| ClientError::Refused { address: address(), request: "a step", code, message: "no".into() };
        use tonic::Code::{
            Internal, InvalidArgument, NotFound, PermissionDenied, ResourceExhausted, Unavailable, Unknown,
        };
        assert!([Internal, Unavailable, Unknown].map(lost).iter().all(ClientError::is_absence));
        assert!(![InvalidArgument, PermissionDenied, ResourceExhausted].map(lost).iter().any(ClientError::is_absence));
        assert!(![InvalidArgument, NotFound, Unavailable].map(refused).iter().any(ClientError::is_absence));
        let [new, mut begun] = [Backoff::default(), Backoff::default()];
        begun.reset();
        let looked = Backoff { attempts: 1, ..Backoff::default() };
        assert_eq!([&new, &begun, &looked].map(|one| one.is_passing(&refused(ResourceExhausted))), [false, true, true]);
        assert!(![new, begun, looked].iter().any(|one| one.is_passing(&refused(InvalidArgument))));
    }

    #[test]
    fn attempts_start_at_once_and_become_rarer() {
        let pauses: Vec<u64> = (0..10).map(|attempts| pause(attempts).as_millis() as u64).collect();
        assert_eq!(pauses, [0, 100, 200, 400, 800, 1600, 3200, 6400, 10_000, 10_000]);
        assert_eq!(pause(u32::MAX), MAX_PAUSE);
    }
}
