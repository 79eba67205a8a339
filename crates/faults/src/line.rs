//! A line between a client and a server that has faults.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

/// What happens to a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The lowest bit of the byte is another one.
    Change,
    /// The connection ends, both ways, before the byte.
    End,
    /// Nothing passes from the byte on, and nobody is told.
    Halve,
    /// This direction ends before the byte, and the other goes on.
    HalfClose,
}

impl Kind {
    /// Every kind.
    pub const ALL: [Self; 4] = [Self::Change, Self::End, Self::Halve, Self::HalfClose];
    /// Those that leave no wrong byte.
    pub const LOSSES: [Self; 3] = [Self::End, Self::Halve, Self::HalfClose];
}

/// A fault of one direction of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The place of the byte at which it happens, from 0.
    pub at: usize,
    /// What happens.
    pub kind: Kind,
}

/// What a connection goes through.
#[derive(Clone, Copy, Debug, Default)]
pub struct Course {
    /// How long each piece is held back, both ways.
    pub delay: Duration,
    /// What happens to the server's bytes.
    pub from_server: Option<Fault>,
    /// What happens to the client's.
    pub from_client: Option<Fault>,
}

/// A line to a server, until the process ends.
pub struct Line {
    port: u16,
    counts: Arc<Counts>,
}

#[derive(Default)]
struct Counts {
    connections: AtomicUsize,
    faults: AtomicUsize,
}

impl Line {
    /// Listens at a port of this machine for the server at `address`: `unix:/PATH`, or host and port behind whatever scheme.
    /// The course of each connection, which are counted from 0, is asked for when it comes.
    ///
    /// # Errors
    /// Where there is no port.
    pub fn start(address: &str, course: impl FnMut(usize) -> Course + Send + 'static) -> io::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let line = Self { port: listener.local_addr()?.port(), counts: Arc::default() };
        let (server, counts, mut course) = (Server::at(address), Arc::clone(&line.counts), course);
        thread::spawn(move || {
            for client in listener.incoming().flatten() {
                let number = counts.connections.fetch_add(1, Ordering::Relaxed);
                // A connection that cannot be is closed, as by a server that is not there.
                let _ = server.connect().and_then(|server| join(client, server, course(number), &counts));
            }
        });
        Ok(line)
    }

    /// Where it listens, as host and port.
    pub fn address(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }

    /// How many connections came.
    pub fn connections(&self) -> usize {
        self.counts.connections.load(Ordering::Relaxed)
    }

    /// How many faults happened: a place that no byte came to has none.
    pub fn faults(&self) -> usize {
        self.counts.faults.load(Ordering::Relaxed)
    }
}

enum Server {
    Tcp(String),
    Unix(PathBuf),
}

impl Server {
    fn at(address: &str) -> Self {
        match address.strip_prefix("unix:") {
            Some(path) => Self::Unix(path.into()),
            None => Self::Tcp(address.rsplit_once("//").map_or(address, |(_, behind)| behind).into()),
        }
    }

    fn connect(&self) -> io::Result<Box<dyn Socket>> {
        Ok(match self {
            Self::Tcp(address) => Box::new(TcpStream::connect(address)?),
            Self::Unix(path) => Box::new(UnixStream::connect(path)?),
        })
    }
}

/// One end of a connection.
trait Socket: Read + Write + Send {
    /// The same end again.
    fn again(&self) -> io::Result<Box<dyn Socket>>;
    /// Ends what passes; it may have ended before.
    fn end(&self, how: Shutdown);
}

macro_rules! socket {
    ($kind:ty) => {
        impl Socket for $kind {
            fn again(&self) -> io::Result<Box<dyn Socket>> {
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

fn join(client: TcpStream, server: Box<dyn Socket>, course: Course, counts: &Arc<Counts>) -> io::Result<()> {
    client.set_nodelay(true)?;
    let client: Box<dyn Socket> = Box::new(client);
    pass(client.again()?, server.again()?, course.delay, course.from_client, counts)?;
    pass(server, client, course.delay, course.from_server, counts)
}

/// Passes on what comes, in order, each piece so long after it came.
fn pass(
    from: Box<dyn Socket>,
    mut to: Box<dyn Socket>,
    delay: Duration,
    fault: Option<Fault>,
    counts: &Arc<Counts>,
) -> io::Result<()> {
    let (sender, pieces) = mpsc::channel::<(Instant, Vec<u8>)>();
    let (mut reader, counts) = (from.again()?, Arc::clone(counts));
    thread::spawn(move || {
        let mut piece = vec![0; 1 << 16];
        while let Ok(count @ 1..) = reader.read(&mut piece) {
            if sender.send((Instant::now() + delay, piece[..count].to_vec())).is_err() {
                break;
            }
        }
    });
    thread::spawn(move || {
        let mut come = 0;
        for (due, mut piece) in &pieces {
            thread::sleep(due.saturating_duration_since(Instant::now()));
            let place = fault.and_then(|fault| Some((fault.kind, fault.at.checked_sub(come)?)));
            come += piece.len();
            let Some((kind, place)) = place.filter(|(_, place)| *place < piece.len()) else {
                match to.write_all(&piece) {
                    Ok(()) => continue,
                    Err(_) => return from.end(Shutdown::Both),
                }
            };
            counts.faults.fetch_add(1, Ordering::Relaxed);
            if kind == Kind::Change {
                piece[place] ^= 1;
            } else {
                piece.truncate(place);
            }
            if to.write_all(&piece).is_err() {
                return from.end(Shutdown::Both);
            }
            match kind {
                Kind::Change => continue,
                Kind::End => {
                    from.end(Shutdown::Both);
                    return to.end(Shutdown::Both);
                }
                Kind::HalfClose => to.end(Shutdown::Write),
                Kind::Halve => {}
            }
            // Whoever sends need not notice.
            for _ in &pieces {}
            return;
        }
        to.end(Shutdown::Write);
    });
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: Duration = Duration::from_secs(60);
    const SILENCE: Duration = Duration::from_millis(300);

    /// What comes back of `0123456789` from a server that sends everything back, and how it ends: by an end or by silence.
    fn echoed(course: Course) -> (Vec<u8>, bool, Line) {
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
        let line = Line::start(&format!("http://{address}"), move |_| course).expect("a line");
        let mut client = TcpStream::connect(line.address()).expect("connected");
        client.set_read_timeout(Some(if course.delay.is_zero() { SILENCE } else { LIMIT })).expect("set");
        client.write_all(b"0123456789").expect("sent");
        let (mut came, mut piece) = (Vec::new(), [0; 64]);
        let ended = loop {
            match client.read(&mut piece) {
                Ok(0) => break true,
                Ok(count) => came.extend_from_slice(&piece[..count]),
                Err(error) => break error.kind() != io::ErrorKind::WouldBlock,
            }
            if came.len() == 10 {
                client.shutdown(Shutdown::Write).expect("open");
            }
        };
        (came, ended, line)
    }

    fn with(kind: Kind) -> Course {
        Course { from_server: Some(Fault { at: 4, kind }), ..Course::default() }
    }

    #[test]
    fn what_is_not_touched_passes_whole() {
        let (came, ended, line) = echoed(Course::default());
        assert_eq!((&came[..], ended, line.faults(), line.connections()), (&b"0123456789"[..], true, 0, 1));
    }

    #[test]
    fn each_fault_does_what_it_says() {
        let (came, ended, line) = echoed(with(Kind::Change));
        assert_eq!((&came[..], ended, line.faults()), (&b"0123556789"[..], true, 1));
        let (came, ended, line) = echoed(with(Kind::End));
        assert_eq!((&came[..], ended, line.faults()), (&b"0123"[..], true, 1));
        let (came, ended, line) = echoed(with(Kind::HalfClose));
        assert_eq!((&came[..], ended, line.faults()), (&b"0123"[..], true, 1));
        let (came, ended, line) = echoed(with(Kind::Halve));
        assert_eq!((&came[..], ended, line.faults()), (&b"0123"[..], false, 1), "nobody is told");
    }

    #[test]
    fn the_clients_bytes_have_faults_too_and_a_half_closed_line_passes_the_other_way() {
        let fault = |kind| Course { from_client: Some(Fault { at: 6, kind }), ..Course::default() };
        let (came, ended, _) = echoed(fault(Kind::HalfClose));
        assert_eq!((&came[..], ended), (&b"012345"[..], true), "the server heard the end, and was heard");
        assert_eq!(echoed(fault(Kind::Change)).0, b"0123457789");
    }

    #[test]
    fn what_is_delayed_comes_later() {
        let start = Instant::now();
        let (came, ..) = echoed(Course { delay: Duration::from_millis(100), ..Course::default() });
        assert_eq!(came, b"0123456789");
        assert!(start.elapsed() >= Duration::from_millis(200), "both ways");
    }
}
