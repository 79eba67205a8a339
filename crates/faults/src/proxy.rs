//! A proxy that injects faults into the connections between clients and a server.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

/// The kind of a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FaultKind {
    /// Flips the lowest bit of the byte at the fault's index.
    BitFlip,
    /// Closes both directions of the connection. The byte and all later bytes are lost.
    Close,
    /// Drops the byte and all later bytes of the same direction, without closing the connection.
    Blackhole,
    /// Closes the direction of the byte, and loses the byte and all later bytes. The opposite direction stays open.
    HalfClose,
}

impl FaultKind {
    /// Every kind of fault.
    pub const ALL: [Self; 4] = [Self::BitFlip, Self::Close, Self::Blackhole, Self::HalfClose];
    /// The kinds of faults that lose bytes but do not change any.
    pub const LOSSES: [Self; 3] = [Self::Close, Self::Blackhole, Self::HalfClose];
}

/// A fault in the bytes of one direction of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ByteFault {
    /// The index of the byte at which the fault happens, from 0.
    pub at: usize,
    /// The kind of the fault.
    pub kind: FaultKind,
}

/// The faults of one connection.
#[derive(Clone, Copy, Debug, Default)]
pub struct FaultPlan {
    /// The delay of all bytes, in both directions.
    pub delay: Duration,
    /// The fault in the bytes that the server sends.
    pub from_server: Option<ByteFault>,
    /// The fault in the bytes that the client sends.
    pub from_client: Option<ByteFault>,
}

/// A running proxy. It runs until the process ends.
pub struct FaultyProxy {
    port: u16,
    counts: Arc<ProxyCounts>,
}

#[derive(Default)]
struct ProxyCounts {
    connections: AtomicUsize,
    faults: AtomicUsize,
}

impl FaultyProxy {
    /// Starts a proxy on a free port of this machine. It forwards connections to the server at `address`: `unix:/PATH`,
    /// or `HOST:PORT` with or without a scheme. `plan` returns the faults of each connection; its argument is the
    /// connection's number, from 0.
    ///
    /// # Errors
    /// [`io::Error`] if no port is free.
    pub fn start(address: &str, plan: impl FnMut(usize) -> FaultPlan + Send + 'static) -> io::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let proxy = Self { port: listener.local_addr()?.port(), counts: Arc::default() };
        let server = Upstream::parse(address);
        let counts = Arc::clone(&proxy.counts);
        let mut plan = plan;
        thread::spawn(move || {
            for client in listener.incoming().flatten() {
                let number = counts.connections.fetch_add(1, Ordering::Relaxed);
                // If the server does not accept the connection, this closes the client's connection.
                let _ = server.connect().and_then(|server| connect(client, server, plan(number), &counts));
            }
        });
        Ok(proxy)
    }

    /// Returns the proxy's address, as `HOST:PORT`.
    pub fn address(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }

    /// Returns the number of connections that the proxy has accepted.
    pub fn connections(&self) -> usize {
        self.counts.connections.load(Ordering::Relaxed)
    }

    /// Returns the number of faults that have happened. A planned fault does not happen if too few bytes are sent.
    pub fn faults(&self) -> usize {
        self.counts.faults.load(Ordering::Relaxed)
    }
}

enum Upstream {
    Tcp(String),
    Unix(PathBuf),
}

impl Upstream {
    fn parse(address: &str) -> Self {
        match address.strip_prefix("unix:") {
            Some(path) => Self::Unix(path.into()),
            None => Self::Tcp(address.rsplit_once("//").map_or(address, |(_, authority)| authority).into()),
        }
    }

    fn connect(&self) -> io::Result<Box<dyn Socket>> {
        Ok(match self {
            Self::Tcp(address) => Box::new(TcpStream::connect(address)?),
            Self::Unix(path) => Box::new(UnixStream::connect(path)?),
        })
    }
}

/// A TCP or Unix socket.
trait Socket: Read + Write + Send {
    /// Returns another handle to the same socket.
    fn duplicate(&self) -> io::Result<Box<dyn Socket>>;
    /// Shuts down reading, writing or both. Does nothing if the socket is closed already.
    fn end(&self, how: Shutdown);
}

macro_rules! socket {
    ($kind:ty) => {
        impl Socket for $kind {
            fn duplicate(&self) -> io::Result<Box<dyn Socket>> {
                Ok(Box::new(self.try_clone()?))
            }

            fn end(&self, how: Shutdown) {
                let _ = self.shutdown(how);
            }
        }
    };
}
socket!(TcpStream);
socket!(UnixStream);

/// Forwards both directions of a connection, with the faults of `plan`.
fn connect(client: TcpStream, server: Box<dyn Socket>, plan: FaultPlan, counts: &Arc<ProxyCounts>) -> io::Result<()> {
    client.set_nodelay(true)?;
    let client: Box<dyn Socket> = Box::new(client);
    forward(client.duplicate()?, server.duplicate()?, plan.delay, plan.from_client, counts)?;
    forward(server, client, plan.delay, plan.from_server, counts)
}

/// Forwards the bytes of one direction, each after `delay`, and injects `fault`. Runs on two new threads.
fn forward(
    from: Box<dyn Socket>,
    mut to: Box<dyn Socket>,
    delay: Duration,
    fault: Option<ByteFault>,
    counts: &Arc<ProxyCounts>,
) -> io::Result<()> {
    let (sender, chunks) = mpsc::channel::<(Instant, Vec<u8>)>();
    let mut reader = from.duplicate()?;
    let counts = Arc::clone(counts);
    thread::spawn(move || {
        let mut chunk = vec![0; 1 << 16];
        while let Ok(count @ 1..) = reader.read(&mut chunk) {
            if sender.send((Instant::now() + delay, chunk[..count].to_vec())).is_err() {
                break;
            }
        }
    });
    thread::spawn(move || {
        let mut received = 0;
        for (due, mut chunk) in &chunks {
            thread::sleep(due.saturating_duration_since(Instant::now()));
            let position = fault.and_then(|fault| Some((fault.kind, fault.at.checked_sub(received)?)));
            received += chunk.len();
            let Some((kind, position)) = position.filter(|(_, position)| *position < chunk.len()) else {
                match to.write_all(&chunk) {
                    Ok(()) => continue,
                    Err(_) => return from.end(Shutdown::Both),
                }
            };
            counts.faults.fetch_add(1, Ordering::Relaxed);
            if kind == FaultKind::BitFlip {
                chunk[position] ^= 1;
            } else {
                chunk.truncate(position);
            }
            if to.write_all(&chunk).is_err() {
                return from.end(Shutdown::Both);
            }
            match kind {
                FaultKind::BitFlip => continue,
                FaultKind::Close => {
                    from.end(Shutdown::Both);
                    return to.end(Shutdown::Both);
                }
                FaultKind::HalfClose => to.end(Shutdown::Write),
                FaultKind::Blackhole => {}
            }
            // Reads and drops all later bytes, so that the sender does not notice the fault.
            for _ in &chunks {}
            return;
        }
        to.end(Shutdown::Write);
    });
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Maximal time to wait for delayed bytes.
    const DEADLINE: Duration = Duration::from_secs(60);
    /// Time to wait for more bytes before a test concludes that no more bytes come.
    const SILENCE: Duration = Duration::from_millis(300);

    /// Sends `0123456789` through a proxy to an echo server. Returns the echoed bytes, and whether the connection was
    /// closed.
    fn echoed(plan: FaultPlan) -> (Vec<u8>, bool, FaultyProxy) {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = listener.local_addr().expect("bound").to_string();
        thread::spawn(move || {
            for mut client in listener.incoming().flatten() {
                let mut back = client.try_clone().expect("cloned");
                thread::spawn(move || {
                    let _ = io::copy(&mut client, &mut back);
                    let _ = back.shutdown(Shutdown::Write);
                });
            }
        });
        let proxy = FaultyProxy::start(&format!("http://{address}"), move |_| plan).expect("a proxy");
        let mut client = TcpStream::connect(proxy.address()).expect("connected");
        client.set_read_timeout(Some(if plan.delay.is_zero() { SILENCE } else { DEADLINE })).expect("set");
        client.write_all(b"0123456789").expect("sent");
        let mut echo = Vec::new();
        let mut chunk = [0; 64];
        let closed = loop {
            match client.read(&mut chunk) {
                Ok(0) => break true,
                Ok(count) => echo.extend_from_slice(&chunk[..count]),
                Err(error) => break error.kind() != io::ErrorKind::WouldBlock,
            }
            if echo.len() == 10 {
                client.shutdown(Shutdown::Write).expect("open");
            }
        };
        (echo, closed, proxy)
    }

    fn server_fault(kind: FaultKind) -> FaultPlan {
        FaultPlan { from_server: Some(ByteFault { at: 4, kind }), ..FaultPlan::default() }
    }

    #[test]
    fn bytes_without_faults_pass_unchanged() {
        let (echo, closed, proxy) = echoed(FaultPlan::default());
        assert_eq!((&echo[..], closed, proxy.faults(), proxy.connections()), (&b"0123456789"[..], true, 0, 1));
    }

    #[test]
    fn each_kind_of_fault_happens_once() {
        let (echo, closed, proxy) = echoed(server_fault(FaultKind::BitFlip));
        assert_eq!((&echo[..], closed, proxy.faults()), (&b"0123556789"[..], true, 1));
        let (echo, closed, proxy) = echoed(server_fault(FaultKind::Close));
        assert_eq!((&echo[..], closed, proxy.faults()), (&b"0123"[..], true, 1));
        let (echo, closed, proxy) = echoed(server_fault(FaultKind::HalfClose));
        assert_eq!((&echo[..], closed, proxy.faults()), (&b"0123"[..], true, 1));
        let (echo, closed, proxy) = echoed(server_fault(FaultKind::Blackhole));
        assert_eq!((&echo[..], closed, proxy.faults()), (&b"0123"[..], false, 1), "the connection stays open");
    }

    #[test]
    fn client_faults_leave_the_other_direction_open() {
        let fault = |kind| FaultPlan { from_client: Some(ByteFault { at: 6, kind }), ..FaultPlan::default() };
        let (echo, closed, _) = echoed(fault(FaultKind::HalfClose));
        assert_eq!((&echo[..], closed), (&b"012345"[..], true), "the server saw the end, and its reply arrived");
        assert_eq!(echoed(fault(FaultKind::BitFlip)).0, b"0123457789");
    }

    #[test]
    fn delayed_bytes_arrive_later() {
        let start = Instant::now();
        let (echo, ..) = echoed(FaultPlan { delay: Duration::from_millis(100), ..FaultPlan::default() });
        assert_eq!(echo, b"0123456789");
        assert!(start.elapsed() >= Duration::from_millis(200), "the delay applies to both directions");
    }
}
