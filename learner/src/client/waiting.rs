//! Waiting for servers that were lost.

use std::time::{Duration, Instant};

use perturb_files::interrupt::StopFlag;
use perturb_protocol::{Address, ClientError};
use perturb_text::duration;
use tokio::time::sleep;

use super::options::ServerWait;
use super::servers::Servers;

/// After the first look, which is at once, the pause before the next; it doubles with each look …
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// … up to this.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);
/// How long some of several servers may stay away before the others go on without them.
const STAYS_AWAY: Duration = Duration::from_secs(5);
/// How often it is looked whether the program is to end.
const TICK: Duration = Duration::from_millis(20);

/// The losses of something that goes on after them.
#[derive(Debug, Default)]
pub struct Waiting {
    waited: Duration,
    looks: u32,
    /// Whether anything was gained: then there was room once.
    has_begun: bool,
}

/// How a loss ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum After {
    /// There are servers again.
    Again,
    /// It is none, or the time is up.
    GivenUp,
    /// The program is to end.
    Stopped {
        /// The signal.
        signal: i32,
    },
}

impl Waiting {
    /// Something was gained: what is lost from now on is not lost in a row.
    pub fn progressed(&mut self) {
        *self = Self { has_begun: true, ..Self::default() };
    }

    /// Waits for the servers that `error` speaks of, as long as [`ServerWait`] says: for all of them for some seconds, then
    /// for any. One that has no room for what is under way, on another server before for instance, is waited for, too.
    pub fn wait(&mut self, servers: &Servers, error: &ClientError, stop: &StopFlag) -> After {
        let ServerWait { limit, tell } = servers.wait();
        if !self.is_passing(error) || self.waited >= limit {
            return After::GivenUp;
        }
        let wait = || format!("waiting for it, at most {}", duration((limit - self.waited).as_secs_f64()));
        let remedy = if servers.is_private() { "starting it again".into() } else { wait() };
        tell(&format!("{error}; {remedy}"));
        servers.block_on(async {
            tokio::select! {
                biased;
                signal = raised(stop) => After::Stopped { signal },
                after = self.look(servers) => after,
            }
        })
    }

    /// Whether the same may go well later: not what is refused, unless it is for want of room where there was some.
    fn is_passing(&self, error: &ClientError) -> bool {
        error.is_absence() || ((self.looks > 0 || self.has_begun) && is_full(error))
    }

    async fn look(&mut self, servers: &Servers) -> After {
        let ServerWait { limit, tell } = servers.wait();
        let (begun, before) = (Instant::now(), self.waited);
        loop {
            sleep(pause(self.looks).min(limit.saturating_sub(self.waited))).await;
            self.looks += 1;
            let reached = servers.reconnect().await;
            self.waited = before + begun.elapsed();
            match reached {
                Ok(away) if away.is_empty() => return After::Again,
                Ok(_) if begun.elapsed() >= STAYS_AWAY.min(limit) => {
                    let there: Vec<String> = servers.addresses().iter().map(Address::to_string).collect();
                    tell(&format!("going on with {} alone", there.join(" and ")));
                    return After::Again;
                }
                Err(error @ ClientError::Unsafe { .. }) => {
                    tell(&error.to_string());
                    return After::GivenUp;
                }
                _ if self.waited >= limit => return After::GivenUp,
                _ => {}
            }
        }
    }
}

/// Before the next look.
fn pause(looks: u32) -> Duration {
    let doubled = |times: u32| FIRST_PAUSE * (1 << times.min(16));
    looks.checked_sub(1).map_or(Duration::ZERO, doubled).min(LONGEST_PAUSE)
}

/// Whether a server has no room.
fn is_full(error: &ClientError) -> bool {
    let (ClientError::Refused { code, .. } | ClientError::Lost { code, .. }) = error else { return false };
    *code == tonic::Code::ResourceExhausted
}

/// The signal that asks the program to end, when it comes.
async fn raised(stop: &StopFlag) -> i32 {
    loop {
        match stop.signal() {
            Some(signal) => return signal,
            None => sleep(TICK).await,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_refused_is_not_waited_for() {
        let address = || "unix:/x".parse::<Address>().unwrap();
        let lost = |code| ClientError::Lost { address: address(), request: "a step", code, reason: "gone".into() };
        let refused = |code| ClientError::Refused { address: address(), request: "a step", code, message: "no".into() };
        use tonic::Code::{
            Internal, InvalidArgument, NotFound, PermissionDenied, ResourceExhausted, Unavailable, Unknown,
        };
        assert!([Internal, Unavailable, Unknown].map(lost).iter().all(ClientError::is_absence));
        assert!(![InvalidArgument, PermissionDenied, ResourceExhausted].map(lost).iter().any(ClientError::is_absence));
        assert!(![InvalidArgument, NotFound, Unavailable].map(refused).iter().any(ClientError::is_absence));
        let [new, mut begun] = [Waiting::default(), Waiting::default()];
        begun.progressed();
        let looked = Waiting { looks: 1, ..Waiting::default() };
        assert_eq!([&new, &begun, &looked].map(|one| one.is_passing(&refused(ResourceExhausted))), [false, true, true]);
        assert!(![new, begun, looked].iter().any(|one| one.is_passing(&refused(InvalidArgument))));
    }

    #[test]
    fn looks_come_at_once_and_then_less_and_less_often() {
        let pauses: Vec<u64> = (0..10).map(|looks| pause(looks).as_millis() as u64).collect();
        assert_eq!(pauses, [0, 100, 200, 400, 800, 1600, 3200, 6400, 10_000, 10_000]);
        assert_eq!(pause(u32::MAX), LONGEST_PAUSE);
    }
}
