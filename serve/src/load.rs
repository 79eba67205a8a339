//! A server of environments, as it tells of itself.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use perturb_protocol::{Address, Connection, Patience};

/// How often it is asked.
pub(crate) const INTERVAL: Duration = Duration::from_secs(2);
/// So many answers say how long one takes.
const MOST_TIMES: usize = 30;
/// How long an answer may take.
const LIMIT: Duration = Duration::from_secs(5);

/// A server that is asked now and then.
#[derive(Debug)]
pub(crate) struct Asked {
    address: Address,
    last: Mutex<Option<Result<Answer, String>>>,
    /// How long the last answers took.
    times: Mutex<VecDeque<Duration>>,
}

/// What it says.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Answer {
    /// Of its program.
    pub(crate) version: String,
    /// In its catalogue.
    pub(crate) environments: usize,
    /// That a session may open.
    pub(crate) most: u32,
    /// How long the answer took: of the last ones, …
    pub(crate) usual: Duration,
    /// … and the slowest of them.
    pub(crate) slowest: Duration,
}

impl Asked {
    pub(crate) fn at(address: Address) -> Self {
        Self { address, last: Mutex::default(), times: Mutex::default() }
    }

    pub(crate) fn address(&self) -> &Address {
        &self.address
    }

    /// The last answer, or why there is none; `None` before the first.
    pub(crate) fn last(&self) -> Option<Result<Answer, String>> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Asks.
    pub(crate) async fn ask(self: Arc<Self>) {
        self.ask_within(LIMIT).await;
    }

    async fn ask_within(&self, limit: Duration) {
        let answer = tokio::time::timeout(limit, self.answer()).await;
        let silent = || Err(format!("it did not answer within {} s", limit.as_secs_f64()));
        *self.last.lock().unwrap_or_else(PoisonError::into_inner) = Some(answer.unwrap_or_else(|_| silent()));
    }

    async fn answer(&self) -> Result<Answer, String> {
        let words = |error: perturb_protocol::ClientError| error.to_string();
        let patience = Patience { reply: LIMIT, ..Patience::default() };
        let connection = Connection::open_with(&self.address, patience).await.map_err(words)?;
        let begun = Instant::now();
        let catalogue = connection.catalogue().await.map_err(words)?;
        let mut times = self.times.lock().unwrap_or_else(PoisonError::into_inner);
        times.push_front(begun.elapsed());
        times.truncate(MOST_TIMES);
        let mut sorted: Vec<Duration> = times.iter().copied().collect();
        sorted.sort_unstable();
        Ok(Answer {
            version: catalogue.server_version,
            environments: catalogue.environments.len(),
            most: catalogue.max_batch_size,
            usual: sorted[sorted.len() / 2],
            slowest: sorted[sorted.len() - 1],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_server_that_does_not_answer_is_told() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let asked = Asked::at(format!("tcp://{}", listener.local_addr().unwrap()).parse().unwrap());
        assert_eq!(asked.last(), None, "it was not asked yet");
        asked.ask_within(Duration::from_millis(300)).await;
        assert_eq!(asked.last(), Some(Err("it did not answer within 0.3 s".into())));
        drop(listener);
        asked.ask_within(LIMIT).await;
        let reason = asked.last().unwrap().unwrap_err();
        assert!(!reason.is_empty() && !reason.contains("did not answer within"), "nobody is there: {reason}");
    }
}
