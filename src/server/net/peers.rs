//! Who is at the other end: places by peer, the time that a connection has to begin, and how one is ended.

use futures_util::task::AtomicWaker;
use std::{
    collections::BTreeMap,
    fmt,
    future::Future,
    io::{self, ErrorKind, IoSlice},
    net::{IpAddr, Ipv6Addr},
    pin::Pin,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::Notify,
    time::{Sleep, sleep},
};
use tonic::transport::server::Connected;

/// What a client of HTTP/2 sends first, in bytes.
const PREFACE: usize = 24;

/// Whom a connection is from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Peer {
    /// A machine, or a network of them that one may have for itself.
    Machine(IpAddr),
    /// A user of this machine, by a Unix socket; none where the system does not tell.
    User(Option<u32>),
}

impl Peer {
    /// Whoever has this address: of IPv6 its network of 64 bits, which is the least that a machine is given.
    pub fn at(address: IpAddr) -> Self {
        Self::Machine(match address.to_canonical() {
            IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)).into(),
            address => address,
        })
    }
}

impl fmt::Display for Peer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Machine(address) => address.fmt(f),
            Self::User(Some(user)) => write!(f, "user {user}"),
            Self::User(None) => f.write_str("a user"),
        }
    }
}

/// Places, of which there are so many in all and for each peer.
#[derive(Clone)]
pub struct Places(Arc<State>);

struct State {
    all: usize,
    each: usize,
    taken: Mutex<(usize, BTreeMap<Peer, usize>)>,
    /// Told whenever `taken` has changed.
    changed: Notify,
}

/// Why there is no place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Full {
    /// All are taken.
    All(usize),
    /// The peer has as many as it may.
    Peer(usize),
}

/// A place, until it is dropped.
pub struct Place {
    places: Places,
    peer: Option<Peer>,
}

impl Places {
    /// So many in all, and for each peer.
    pub fn new(all: usize, each: usize) -> Self {
        Self(Arc::new(State { all, each, taken: Mutex::default(), changed: Notify::new() }))
    }

    /// A place for a peer. One that is not known has no quota of its own.
    ///
    /// # Errors
    /// [`Full`].
    pub fn take(&self, peer: Option<Peer>) -> Result<Place, Full> {
        let mut taken = self.lock();
        let (all, by_peer) = &mut *taken;
        if *all >= self.0.all {
            return Err(Full::All(self.0.all));
        }
        if let Some(peer) = peer {
            let its = by_peer.entry(peer).or_default();
            if *its >= self.0.each {
                return Err(Full::Peer(self.0.each));
            }
            *its += 1;
        }
        *all += 1;
        self.0.changed.notify_one();
        Ok(Place { places: self.clone(), peer })
    }

    /// How many are taken.
    pub fn taken(&self) -> usize {
        self.lock().0
    }

    /// How many there are.
    pub fn limit(&self) -> usize {
        self.0.all
    }

    /// Waits until some were taken or given back since this was last waited for, by one caller.
    pub async fn changed(&self) {
        self.0.changed.notified().await;
    }

    fn lock(&self) -> MutexGuard<'_, (usize, BTreeMap<Peer, usize>)> {
        self.0.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.lock();
        let (all, by_peer) = &mut *taken;
        *all -= 1;
        self.places.0.changed.notify_one();
        if let Some(peer) = self.peer
            && let Some(its) = by_peer.get_mut(&peer)
        {
            *its -= 1;
            if *its == 0 {
                by_peer.remove(&peer);
            }
        }
    }
}

/// A connection, as its calls see it.
#[derive(Clone)]
pub struct Connection {
    /// Whom it is from.
    pub peer: Peer,
    end: Arc<End>,
}

#[derive(Default)]
struct End {
    came: AtomicBool,
    waker: AtomicWaker,
}

impl Connection {
    /// Ends it, with all its calls.
    pub fn end(&self) {
        self.end.came.store(true, Ordering::Release);
        self.end.waker.wake();
    }
}

/// A connection's bytes. It fails if its client's first do not come in time, and once it is ended.
pub struct Guarded<S> {
    stream: S,
    connection: Connection,
    /// The bytes of the preface that have not come, and until when they may.
    preface: Option<(usize, Pin<Box<Sleep>>)>,
    _place: Place,
}

impl<S> Guarded<S> {
    /// Gives the client so long to begin.
    pub fn new(stream: S, peer: Peer, place: Place, limit: Duration) -> Self {
        let preface = Some((PREFACE, Box::pin(sleep(limit))));
        Self { stream, connection: Connection { peer, end: Arc::default() }, preface, _place: place }
    }

    fn check(&self, context: &Context<'_>) -> io::Result<()> {
        self.connection.end.waker.register(context.waker());
        let ended = self.connection.end.came.load(Ordering::Acquire);
        if ended { Err(ErrorKind::ConnectionAborted.into()) } else { Ok(()) }
    }
}

impl<S> Drop for Guarded<S> {
    /// Nobody needs to be woken any more; the waker would keep the connection's memory as long as a call knows of it.
    fn drop(&mut self) {
        self.connection.end.waker.take();
    }
}

impl<S> Connected for Guarded<S> {
    type ConnectInfo = Connection;

    fn connect_info(&self) -> Connection {
        self.connection.clone()
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Guarded<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(context)?;
        let before = buffer.filled().len();
        let polled = Pin::new(&mut self.stream).poll_read(context, buffer);
        if let Some((left, limit)) = &mut self.preface {
            *left = left.saturating_sub(buffer.filled().len() - before);
            if *left == 0 {
                self.preface = None;
            } else if limit.as_mut().poll(context).is_ready() {
                return Poll::Ready(Err(ErrorKind::TimedOut.into()));
            }
        }
        polled
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Guarded<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.check(context)?;
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        Pin::new(&mut self.stream).poll_write_vectored(context, parts)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_one_machine_are_one_peer() {
        let [same, other] = ["2001:db8::1", "2001:db8:0:1::1"].map(|text| Peer::at(text.parse().unwrap()));
        assert_eq!(Peer::at("2001:db8::ffff:0:0:2".parse().unwrap()), same);
        assert_ne!(same, other);
        let [old, mapped] = ["192.0.2.1", "::ffff:192.0.2.1"].map(|text| Peer::at(text.parse().unwrap()));
        assert_eq!(old, mapped);
        assert_ne!(old, Peer::at("192.0.2.2".parse().unwrap()));
    }

    #[test]
    fn a_peer_takes_its_own_places_and_no_more() {
        let [one, other] = [1, 2].map(|user| Some(Peer::User(Some(user))));
        let places = Places::new(4, 2);
        let [first, _second] = [places.take(one), places.take(one)].map(Result::unwrap);
        assert_eq!(places.take(one).err(), Some(Full::Peer(2)));
        let _others = [places.take(other), places.take(None)].map(Result::unwrap);
        assert_eq!(places.take(other).err(), Some(Full::All(4)));
        drop(first);
        assert!(places.take(one).is_ok());
        assert!(places.take(one).is_ok(), "that place was given back");
    }
}
