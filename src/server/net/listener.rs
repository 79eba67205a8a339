//! Binding addresses: TCP ports and Unix sockets.

use super::{
    managed_io::ManagedIo,
    peer_limiter::{Peer, PeerLimiter, PeerPermit},
    tls::Tls,
};
use crate::config::{ListenAddress, SocketMode};
use futures_util::{Stream, stream};
use std::time::Duration;
use std::{
    fs::Permissions,
    io::{self, ErrorKind},
    os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt},
    path::{Path, PathBuf},
};
use tokio::{
    net::{TcpListener, TcpStream, UnixListener, UnixSocket, UnixStream},
    task::JoinSet,
    time::timeout,
};
use tokio_rustls::server::TlsStream;

/// The pause after the system refuses to accept a connection.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(200);
/// The length of the system's queue of connections that are not accepted yet.
const MAX_PENDING_CONNECTIONS: u32 = 1024;

/// A bound address.
pub enum Listener {
    /// A TCP port.
    Tcp(TcpListener),
    /// A Unix socket, whose file is removed when this is dropped.
    Unix(UnixListener, SocketFile),
}

/// The limits for connections.
#[derive(Clone)]
pub struct AcceptLimits {
    /// The limiter of connections.
    pub limiter: PeerLimiter,
    /// The time in which a client must finish its handshake or send its preface.
    pub handshake: Duration,
}

impl AcceptLimits {
    /// The connection, if there is a permit for it.
    fn admit<S>(&self, stream: S, peer: Peer) -> Option<ManagedIo<S>> {
        self.acquire(peer).map(|permit| ManagedIo::new(stream, peer, permit, self.handshake))
    }

    fn acquire(&self, peer: Peer) -> Option<PeerPermit> {
        let full = |full| tracing::debug!(?peer, ?full, "closed a connection for which there is no place");
        self.limiter.acquire(Some(peer)).map_err(full).ok()
    }

    /// The connection, if its client finishes the handshake in time.
    async fn handshake(
        self,
        stream: TcpStream,
        peer: Peer,
        permit: PeerPermit,
        tls: Tls,
    ) -> Option<ManagedIo<TlsStream<TcpStream>>> {
        let refused = |reason: &dyn ToString| {
            tracing::debug!(?peer, reason = reason.to_string(), "closed a connection in its handshake");
        };
        match timeout(self.handshake, tls.accept(stream)).await {
            Ok(Ok(stream)) => return Some(ManagedIo::new(stream, peer, permit, self.handshake)),
            Ok(Err(error)) => refused(&error),
            Err(late) => refused(&late),
        }
        None
    }
}

/// Accepts connections. Nagle's delay is switched off, because a step is one small message each way.
pub fn tcp_connections(
    listener: TcpListener,
    limits: AcceptLimits,
) -> impl Stream<Item = io::Result<ManagedIo<TcpStream>>> {
    stream::unfold((listener, limits), |(listener, limits)| async {
        let connection = loop {
            match listener.accept().await {
                Ok((connection, address)) => {
                    // It fails only for connections that are already closed.
                    let _ = connection.set_nodelay(true);
                    if let Some(connection) = limits.admit(connection, Peer::at(address.ip())) {
                        break connection;
                    }
                }
                Err(error) => pause(&error).await,
            }
        };
        Some((Ok(connection), (listener, limits)))
    })
}

/// Accepts connections and returns them after their TLS handshakes, in the order in which these finish. A slow
/// handshake does not delay the others.
pub fn tls_connections(
    listener: TcpListener,
    limits: AcceptLimits,
    tls: Tls,
) -> impl Stream<Item = io::Result<ManagedIo<TlsStream<TcpStream>>>> {
    stream::unfold((listener, limits, tls, JoinSet::new()), |(listener, limits, tls, mut handshakes)| async {
        let connection = loop {
            tokio::select! {
                accepted = listener.accept() => match accepted {
                    Ok((connection, address)) => {
                        let _ = connection.set_nodelay(true);
                        let peer = Peer::at(address.ip());
                        if let Some(permit) = limits.acquire(peer) {
                            handshakes.spawn(limits.clone().handshake(connection, peer, permit, tls.clone()));
                        }
                    }
                    Err(error) => pause(&error).await,
                },
                Some(done) = handshakes.join_next() => if let Ok(Some(connection)) = done { break connection },
            }
        };
        Some((Ok(connection), (listener, limits, tls, handshakes)))
    })
}

/// Accepts connections. The socket's file is removed when the stream is dropped.
pub fn unix_connections(
    listener: UnixListener,
    file: SocketFile,
    limits: AcceptLimits,
) -> impl Stream<Item = io::Result<ManagedIo<UnixStream>>> {
    stream::unfold((listener, file, limits), |(listener, file, limits)| async {
        let connection = loop {
            match listener.accept().await {
                Ok((connection, _)) => {
                    let user = connection.peer_cred().ok().map(|credentials| credentials.uid());
                    if let Some(connection) = limits.admit(connection, Peer::User(user)) {
                        break connection;
                    }
                }
                Err(error) => pause(&error).await,
            }
        };
        Some((Ok(connection), (listener, file, limits)))
    })
}

/// Returns why an address cannot be bound, and how to change the flag that names it.
fn explain(address: &ListenAddress, flag: &str, error: &io::Error) -> String {
    let text = address.written();
    match (address, error.kind()) {
        (ListenAddress::Tcp(tcp), ErrorKind::AddrInUse) => {
            let free = ListenAddress::Tcp(std::net::SocketAddr::new(tcp.ip(), 0)).written();
            format!("cannot listen at {text}: another program does; end it, or take a free port with {flag} {free}")
        }
        (_, ErrorKind::AddrInUse) => {
            format!("cannot listen at {text}: another program does, or the file is no socket; give {flag} another path")
        }
        (_, ErrorKind::AddrNotAvailable) => {
            format!("cannot listen at {text}: it is no address of this machine; {flag} tcp://0.0.0.0:PORT means all")
        }
        (_, ErrorKind::NotFound) => {
            format!("cannot listen at {text}: its folder is not there; create it, or correct {flag}")
        }
        _ => format!("cannot listen at {text}: {error}; correct {flag}"),
    }
}

/// Logs that the system refuses connections, and waits. The process most likely has no file descriptors left, and
/// retrying at once would keep the thread from its open connections.
async fn pause(error: &io::Error) {
    tracing::warn!(%error, "cannot accept a connection");
    tokio::time::sleep(ACCEPT_RETRY_DELAY).await;
}

/// Removes a socket's file when it is dropped, unless another server's has taken its place.
pub struct SocketFile {
    path: PathBuf,
    /// Device and number of the file.
    identity: Option<(u64, u64)>,
}

/// The device and the number of the file at a path.
fn identity(path: &Path) -> Option<(u64, u64)> {
    std::fs::symlink_metadata(path).ok().map(|file| (file.dev(), file.ino()))
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        if identity(&self.path) == self.identity {
            // The file may already be gone, which is no error.
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

impl Listener {
    /// Binds an address; a Unix socket's file gets this mode before anybody can connect. One that a dead server left
    /// behind is replaced.
    ///
    /// # Errors
    /// If the address is in use or may not be bound; the message names it.
    pub async fn bind(address: &ListenAddress, mode: SocketMode) -> io::Result<Self> {
        Self::bind_as(address, "--listen", mode).await
    }

    /// Binds an address that another flag gives.
    ///
    /// # Errors
    /// As [`Listener::bind`].
    pub async fn bind_as(address: &ListenAddress, flag: &str, mode: SocketMode) -> io::Result<Self> {
        let explain = |error: io::Error| io::Error::new(error.kind(), explain(address, flag, &error));
        match address {
            ListenAddress::Tcp(tcp) => Ok(Self::Tcp(TcpListener::bind(tcp).await.map_err(explain)?)),
            ListenAddress::Unix(path) => {
                let is_socket = std::fs::symlink_metadata(path).is_ok_and(|m| m.file_type().is_socket());
                let refused = |e: io::Error| e.kind() == ErrorKind::ConnectionRefused;
                // The connection is not awaited further: a server that does not accept still holds the address.
                if is_socket && UnixStream::connect(path).await.is_err_and(refused) {
                    std::fs::remove_file(path).map_err(explain)?;
                }
                let socket = UnixSocket::new_stream().and_then(|socket| socket.bind(path).map(|()| socket));
                let socket = socket.map_err(explain)?;
                let file = SocketFile { path: path.clone(), identity: identity(path) };
                std::fs::set_permissions(path, Permissions::from_mode(mode.bits())).map_err(explain)?;
                Ok(Self::Unix(socket.listen(MAX_PENDING_CONNECTIONS).map_err(explain)?, file))
            }
        }
    }

    /// The address that was bound, with the port that the system chose.
    ///
    /// # Errors
    /// If the operating system does not tell the port.
    pub fn address(&self) -> io::Result<ListenAddress> {
        match self {
            Self::Tcp(listener) => listener.local_addr().map(ListenAddress::Tcp),
            Self::Unix(_, file) => Ok(ListenAddress::Unix(file.path.clone())),
        }
    }
}
