//! Connections: so many at a time, and none that stands still.

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, Sleep, sleep};

/// What ends the head of a request.
const END: &[u8] = b"\r\n\r\n";

/// Takes connections.
pub(crate) struct Connections {
    listener: TcpListener,
    room: Arc<Semaphore>,
    limits: Limits,
}

/// How many connections there are at a time, and for how long.
#[derive(Clone, Copy, Debug)]
struct Limits {
    /// Browsers keep some six connections each. Others wait.
    most: usize,
    /// A connection on which nothing has moved for so long is closed: that of a reader who takes nothing. Event streams say
    /// something more often.
    patience: Duration,
    /// So long the head of a request may take from its first byte, that of the first request from the beginning: who sends
    /// it byte by byte would otherwise keep others out.
    head: Duration,
}

const LIMITS: Limits = Limits { most: 256, patience: Duration::from_secs(120), head: Duration::from_secs(10) };

impl Connections {
    pub(crate) fn of(listener: TcpListener) -> Self {
        Self::within(LIMITS, listener)
    }

    fn within(limits: Limits, listener: TcpListener) -> Self {
        Self { listener, room: Arc::new(Semaphore::new(limits.most)), limits }
    }
}

impl Listener for Connections {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        let room = Arc::clone(&self.room).acquire_owned().await.ok(); // nobody closes it
        // axum's own listener waits and tries again when there are no file descriptors left.
        let (stream, address) = Listener::accept(&mut self.listener).await;
        let head = Head { until: Some(Instant::now() + self.limits.head), matched: 0 };
        let idle = Box::pin(sleep(self.limits.patience.min(self.limits.head)));
        (Connection { stream, idle, head, limits: self.limits, _room: room }, address)
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

/// A connection that ends when nothing moves.
pub(crate) struct Connection {
    stream: TcpStream,
    idle: Pin<Box<Sleep>>,
    head: Head,
    limits: Limits,
    _room: Option<OwnedSemaphorePermit>,
}

/// The head of a request that is being read.
#[derive(Debug)]
struct Head {
    /// When it must have ended; `None` between two.
    until: Option<Instant>,
    /// So much of its [`END`] was read.
    matched: usize,
}

impl Head {
    /// Takes note of what was read.
    fn read(&mut self, bytes: &[u8], limit: Duration) {
        for byte in bytes {
            self.until.get_or_insert_with(|| Instant::now() + limit);
            self.matched = match *byte {
                byte if byte == END[self.matched] => self.matched + 1,
                b'\r' => 1,
                _ => 0,
            };
            if self.matched == END.len() {
                (self.until, self.matched) = (None, 0);
            }
        }
    }
}

impl Connection {
    /// What came of trying to move something.
    fn moved<T>(&mut self, context: &mut Context<'_>, result: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        let late = self.head.until.is_some_and(|until| until <= Instant::now());
        if result.is_ready() && !late {
            let idle = Instant::now() + self.limits.patience;
            self.idle.as_mut().reset(self.head.until.map_or(idle, |until| until.min(idle)));
            return result;
        }
        if !late {
            ready!(self.idle.as_mut().poll(context));
        }
        Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for Connection {
    fn poll_read(self: Pin<&mut Self>, context: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        let before = buffer.filled().len();
        let result = Pin::new(&mut this.stream).poll_read(context, buffer);
        this.head.read(&buffer.filled()[before..], this.limits.head);
        this.moved(context, result)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let result = Pin::new(&mut this.stream).poll_write(context, bytes);
        this.moved(context, result)
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    const SHORT: Limits = Limits { most: 1, patience: Duration::from_secs(5), head: Duration::from_millis(150) };
    const TICK: Duration = Duration::from_millis(20);

    async fn connected() -> (Connections, Connection, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let client = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let mut connections = Connections::within(SHORT, listener);
        let (connection, _) = connections.accept().await;
        (connections, connection, client)
    }

    /// How long it takes until the connection ends, if `then` is sent again and again after `first`.
    async fn ends(first: &'static [u8], then: &'static [u8]) -> Duration {
        let (_connections, mut connection, mut client) = connected().await;
        let begun = Instant::now();
        tokio::spawn(async move {
            client.write_all(first).await.unwrap();
            while client.write_all(then).await.is_ok() {
                tokio::time::sleep(TICK).await;
            }
        });
        let mut buffer = [0; 64];
        loop {
            match connection.read(&mut buffer).await {
                Ok(_) => assert!(begun.elapsed() < Duration::from_secs(20), "it does not end"),
                Err(error) => {
                    assert_eq!(error.kind(), io::ErrorKind::TimedOut);
                    return begun.elapsed();
                }
            }
        }
    }

    #[tokio::test]
    async fn who_sends_a_request_byte_by_byte_is_not_waited_for() {
        assert!(ends(b"", b"").await >= SHORT.head);
        assert!(ends(b"GET / HTTP/1.1\r\n", b"x").await < SHORT.patience, "although something moves");
        let whole = ends(b"GET / HTTP/1.1\r\nHost: a\r\n\r\n", b"").await;
        assert!(whole >= SHORT.patience, "the answer may take longer: {whole:?}");
        let second = ends(b"GET / HTTP/1.1\r\r\n\r\nGET", b"x").await;
        assert!((SHORT.head..SHORT.patience).contains(&second), "each request has a limit: {second:?}");
    }

    #[tokio::test]
    async fn others_wait_until_there_is_room() {
        let (mut connections, connection, _client) = connected().await;
        let _second = TcpStream::connect(connections.local_addr().unwrap()).await.unwrap();
        assert!(tokio::time::timeout(TICK, connections.accept()).await.is_err());
        drop(connection);
        connections.accept().await;
    }
}
