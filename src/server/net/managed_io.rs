//! The I/O of a connection, with a timeout for the client's first bytes, and a switch to close the connection from
//! outside.

use super::{
    load::ConnectionLoad,
    peer_limiter::{Peer, PeerPermit},
};
use futures_util::task::AtomicWaker;
use std::{
    future::Future,
    io::{self, ErrorKind, IoSlice},
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    time::{Sleep, sleep},
};
use tonic::transport::server::Connected;

/// The length of the connection preface with which every HTTP/2 client begins, bytes.
const PREFACE_BYTES: usize = 24;

/// A handle to a connection, for the calls that it carries.
#[derive(Clone)]
pub struct ConnectionHandle {
    /// The peer of the connection.
    pub peer: Peer,
    kill_switch: Arc<KillSwitch>,
}

#[derive(Default)]
struct KillSwitch {
    requested: AtomicBool,
    waker: AtomicWaker,
}

impl ConnectionHandle {
    /// Closes the connection, which ends all its calls.
    pub fn close(&self) {
        self.kill_switch.requested.store(true, Ordering::Release);
        self.kill_switch.waker.wake();
    }
}

/// The I/O of a connection. It fails if the client's HTTP/2 preface does not arrive in time, and after
/// [`ConnectionHandle::close`].
pub struct ManagedIo<S> {
    stream: S,
    connection: ConnectionHandle,
    /// The number of bytes of the preface that have not arrived yet, and the timer of their deadline. `None` once the
    /// preface has arrived.
    preface: Option<(usize, Pin<Box<Sleep>>)>,
    _permit: PeerPermit,
    load: Option<ConnectionLoad>,
}

impl<S> ManagedIo<S> {
    /// Wraps a connection whose client must send the HTTP/2 preface within `limit`.
    pub fn new(stream: S, peer: Peer, permit: PeerPermit, limit: Duration) -> Self {
        let preface = Some((PREFACE_BYTES, Box::pin(sleep(limit))));
        Self {
            stream,
            connection: ConnectionHandle { peer, kill_switch: Arc::default() },
            preface,
            _permit: permit,
            load: None,
        }
    }

    /// Counts reads and writes of this connection as work of its thread.
    pub fn counted(mut self, load: ConnectionLoad) -> Self {
        self.load = Some(load);
        self
    }

    /// Counts a read or write, if it moved bytes.
    fn count(&self, bytes: usize) {
        if let Some(load) = self.load.as_ref().filter(|_| bytes > 0) {
            load.count(bytes);
        }
    }

    fn check(&self, context: &Context<'_>) -> io::Result<()> {
        self.connection.kill_switch.waker.register(context.waker());
        let ended = self.connection.kill_switch.requested.load(Ordering::Acquire);
        if ended { Err(ErrorKind::ConnectionAborted.into()) } else { Ok(()) }
    }
}

impl<S> Drop for ManagedIo<S> {
    /// Drops the waker. Otherwise every call's [`ConnectionHandle`] would keep the memory of this connection alive.
    fn drop(&mut self) {
        self.connection.kill_switch.waker.take();
    }
}

impl<S> Connected for ManagedIo<S> {
    type ConnectInfo = ConnectionHandle;

    fn connect_info(&self) -> ConnectionHandle {
        self.connection.clone()
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for ManagedIo<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(context)?;
        let before = buffer.filled().len();
        let polled = Pin::new(&mut self.stream).poll_read(context, buffer);
        let bytes = buffer.filled().len() - before;
        self.count(bytes);
        if let Some((left, limit)) = &mut self.preface {
            *left = left.saturating_sub(bytes);
            if *left == 0 {
                self.preface = None;
            } else if limit.as_mut().poll(context).is_ready() {
                return Poll::Ready(Err(ErrorKind::TimedOut.into()));
            }
        }
        polled
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for ManagedIo<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.check(context)?;
        Pin::new(&mut self.stream).poll_write(context, bytes).map_ok(|written| {
            self.count(written);
            written
        })
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        Pin::new(&mut self.stream).poll_write_vectored(context, parts).map_ok(|written| {
            self.count(written);
            written
        })
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
