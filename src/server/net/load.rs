//! Measures the load of the transport threads, and chooses a thread for each new connection.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
    time::Duration,
};
use tokio::time::Instant;

/// The time constant with which the weight of past work decays. Learners may compute for this long between two batches
/// of steps. With a shorter time constant, their threads would look idle meanwhile.
const WINDOW: Duration = Duration::from_secs(10);
/// The number of bytes that cost as much work as a read or write itself.
const BYTES_PER_UNIT: usize = 16 << 10;
/// The minimum work that is expected of a new connection, in units: the work of its handshake.
const HANDSHAKE_WORK: f64 = 16.0;

/// The work of one transport thread, written by that thread only, and its number of connections. A read or write that
/// moved data counts as one unit of work, plus one unit for each full 16 KiB. Steps that run on the thread itself, for
/// up to 80 µs each, are not counted. CPU time would be a wrong measure, because sessions spin while they wait.
#[derive(Default)]
pub struct ThreadLoad {
    work: AtomicU64,
    connections: AtomicUsize,
}

impl ThreadLoad {
    /// The number of connections that the thread has now.
    pub fn connections(&self) -> usize {
        self.connections.load(Ordering::Relaxed)
    }

    /// Counts a read or write of this many bytes. Must be called on the thread that this load belongs to.
    pub fn count(&self, bytes: usize) {
        let units = (1 + bytes / BYTES_PER_UNIT) as u64;
        self.work.store(self.work.load(Ordering::Relaxed) + units, Ordering::Relaxed); // by one thread only
    }
}

/// A connection's part in the load of its thread. The thread has one connection less when this value is dropped.
pub struct ConnectionLoad(Arc<ThreadLoad>);

impl ConnectionLoad {
    /// Counts a new connection of the thread with this load.
    fn new(thread: Arc<ThreadLoad>) -> Self {
        thread.connections.fetch_add(1, Ordering::Relaxed);
        Self(thread)
    }

    /// Counts a read or write of this many bytes. Must be called on the connection's thread.
    pub fn count(&self, bytes: usize) {
        self.0.count(bytes);
    }
}

impl Drop for ConnectionLoad {
    fn drop(&mut self) {
        self.0.connections.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The balancer of connections: it chooses the thread for each new connection according to the threads' recent work.
pub struct Balance {
    threads: Vec<RecentWork>,
    /// The time of the last choice.
    at: Instant,
}

struct RecentWork {
    load: Arc<ThreadLoad>,
    /// The total work of the thread at the time of the last choice.
    seen: u64,
    /// The work of about the last [`WINDOW`]. Older work counts exponentially less.
    recent: f64,
}

impl Balance {
    /// Makes a balance of `threads` threads that have done no work yet. `now` is the present time.
    pub fn new(threads: usize, now: Instant) -> Self {
        let idle = || RecentWork { load: Arc::default(), seen: 0, recent: 0.0 };
        Self { threads: (0..threads).map(|_| idle()).collect(), at: now }
    }

    /// The number of threads.
    pub fn threads(&self) -> usize {
        self.threads.len()
    }

    /// The load of each thread.
    pub fn loads(&self) -> Vec<Arc<ThreadLoad>> {
        self.threads.iter().map(|thread| Arc::clone(&thread.load)).collect()
    }

    /// Chooses the thread with the least recent work, and among equal threads the thread with the fewest connections.
    /// Returns the index of the thread, and the counter of the new connection's work. The thread's recent work
    /// immediately rises by the average work of a connection, or by `HANDSHAKE_WORK` if that is more. Simultaneous
    /// connections are therefore spread over the threads.
    pub fn choose(&mut self, now: Instant) -> (usize, ConnectionLoad) {
        self.refresh(now);
        let connections: usize = self.threads.iter().map(|thread| thread.load.connections()).sum();
        let work: f64 = self.threads.iter().map(|thread| thread.recent).sum();
        let by_work = |&(_, a): &(usize, &RecentWork), &(_, b): &(usize, &RecentWork)| {
            a.recent.total_cmp(&b.recent).then(a.load.connections().cmp(&b.load.connections()))
        };
        let chosen = self.threads.iter().enumerate().min_by(by_work).map_or(0, |(place, _)| place);
        let thread = &mut self.threads[chosen];
        thread.recent += (work / connections.max(1) as f64).max(HANDSHAKE_WORK);
        (chosen, ConnectionLoad::new(Arc::clone(&thread.load)))
    }

    /// Updates each thread's recent work to the time `now`: reduces the weight of older work, and adds the work since
    /// the last choice of a thread. The added work counts as if the thread had done it at a constant rate.
    fn refresh(&mut self, now: Instant) {
        let windows = (now - self.at).as_secs_f64() / WINDOW.as_secs_f64();
        self.at = now;
        let kept = libm::exp(-windows);
        let counted = if windows > 0.0 { (1.0 - kept) / windows } else { 1.0 };
        for RecentWork { load, seen, recent } in &mut self.threads {
            let work = load.work.load(Ordering::Relaxed);
            *recent = *recent * kept + (work - std::mem::replace(seen, work)) as f64 * counted;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A balance with a clock that only the test advances, and the connections so far.
    struct Clocked {
        balance: Balance,
        now: Instant,
        connections: Vec<(usize, ConnectionLoad)>,
    }

    impl Clocked {
        fn new(threads: usize) -> Self {
            let now = Instant::now();
            Self { balance: Balance::new(threads, now), now, connections: Vec::new() }
        }

        /// Opens another connection. Returns the index of its thread.
        fn connect(&mut self) -> usize {
            let (thread, connection) = self.balance.choose(self.now);
            self.connections.push((thread, connection));
            thread
        }

        /// Advances the clock by `seconds`. In each second, connection number `i` does `units(i)` units of work.
        fn work(&mut self, seconds: u64, units: impl Fn(usize) -> usize) {
            for (place, (_, connection)) in self.connections.iter().enumerate() {
                (0..units(place) * seconds as usize).for_each(|_| connection.count(1));
            }
            self.now += Duration::from_secs(seconds);
        }

        fn connections(&self) -> Vec<usize> {
            self.balance.loads().iter().map(|load| load.connections()).collect()
        }
    }

    #[test]
    fn simultaneous_connections_are_spread() {
        let mut clocked = Clocked::new(4);
        (0..64).for_each(|_| _ = clocked.connect());
        assert_eq!(clocked.connections(), [16; 4]);
        clocked.work(1, |place| if place % 4 == 0 { 1010 } else { 1000 });
        (0..64).for_each(|_| _ = clocked.connect());
        assert_eq!(clocked.connections(), [32; 4], "also beside others that work");
    }

    #[test]
    fn a_busy_connection_has_its_thread_alone_for_long() {
        let mut clocked = Clocked::new(2);
        let busy = clocked.connect();
        clocked.work(30, |_| 10_000);
        for _ in 0..5 {
            assert_ne!(clocked.connect(), busy);
            clocked.work(10, |place| if place == 0 { 10_000 } else { 10 });
        }
    }

    #[test]
    fn work_of_long_ago_does_not_count() {
        let mut clocked = Clocked::new(2);
        let first = clocked.connect();
        clocked.work(10, |_| 10_000);
        assert_ne!(clocked.connect(), first);
        clocked.work(100, |place| place * 100);
        assert_eq!(clocked.connect(), first, "it has rested since");
    }

    #[test]
    fn many_bytes_are_more_work_than_few() {
        let mut clocked = Clocked::new(2);
        let [first, second] = [clocked.connect(), clocked.connect()];
        clocked.connections[0].1.count(1 << 30);
        clocked.connections[1].1.count(1);
        clocked.now += Duration::from_secs(1);
        assert_eq!([first, clocked.connect()], [0, second]);
    }
}
