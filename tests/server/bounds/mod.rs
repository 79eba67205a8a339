//! Limits of what one client can take from the server. Each attack runs while another session steps, which must not be
//! delayed.

pub mod client;
#[cfg(feature = "mujoco")]
mod closing;
mod compressed;
mod memory;
mod messages;
mod pictures;
mod places;
mod streams;

use crate::common::server::{Session, environment, open, step, within};
use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

/// The maximum time of a neighbour's step, on a machine that may be busy. The measured time is printed.
const PATIENCE: Duration = Duration::from_secs(10);
/// The environment variable with the maximum of the 99th percentile of a neighbour's step times, ms. `make bounds-test`
/// sets it, on an idle machine.
const P99_MS: &str = "PERTURB_TEST_NEIGHBOUR_P99_MS";
/// The minimum number of measured steps.
const FEWEST: usize = 100;
/// The maximum time of a neighbour's step on an idle machine.
const LONGEST: Duration = Duration::from_secs(1);

/// A session that steps continuously on a thread of its own, and measures the time of each step.
struct Neighbour {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Vec<Duration>>,
}

impl Neighbour {
    fn start(address: &str) -> Self {
        let (address, stop) = (address.to_owned(), Arc::new(AtomicBool::new(false)));
        let stopped = Arc::clone(&stop);
        let thread = thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async {
                let environment = environment(&address, "CartPole").await;
                let (mut session, _) = Session::open(&address, open(&environment.name, 4, 1)).await;
                let mut times = Vec::new();
                while !stopped.load(Ordering::Relaxed) || times.len() < FEWEST {
                    let start = Instant::now();
                    session.send(step(vec![0; 16])).await;
                    within(session.receive()).await.unwrap().expect("the stream ended");
                    times.push(start.elapsed());
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
                times
            })
        });
        Self { stop, thread }
    }

    /// Ends the session, and asserts that no step took too long.
    fn was_not_held_up(self) {
        self.stop.store(true, Ordering::Relaxed);
        let mut times = self.thread.join().expect("the neighbour's session failed");
        times.sort_unstable();
        let at = |percent: usize| times[(times.len() - 1) * percent / 100];
        let (median, p99, longest) = (at(50), at(99), at(100));
        println!("{} steps of a neighbour: median {median:?}, p99 {p99:?}, longest {longest:?}", times.len());
        assert!(longest < PATIENCE, "a neighbour's step took {longest:?}");
        if let Ok(most) = std::env::var(P99_MS) {
            let most = Duration::from_millis(most.parse().expect("a number of ms"));
            assert!(p99 < most, "one of a hundred steps of a neighbour took {p99:?} or longer");
            assert!(longest < LONGEST, "a neighbour's step took {longest:?}");
        }
    }
}
