//! Listeners at TCP ports and Unix sockets.

use super::{handshake::AcceptedSocket, peer_limiter::Peer};
use crate::config::{ListenAddress, SocketMode};
use std::{
    fs::Permissions,
    io::{self, ErrorKind},
    os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt},
    path::{Path, PathBuf},
};
use tokio::net::{TcpListener, UnixListener, UnixSocket, UnixStream};

/// The maximum number of connections to a Unix socket that the operating system queues until the server accepts them.
const MAX_PENDING_CONNECTIONS: u32 = 1024;

/// A socket that listens at an address.
pub enum Listener {
    /// A TCP port.
    Tcp(TcpListener),
    /// A Unix socket. The socket's file is removed when the listener is dropped.
    Unix(UnixListener, SocketFile),
}

/// Explains why `address` cannot be bound, and suggests a remedy. `flag` is the command-line option that gave the
/// address.
fn explain(address: &ListenAddress, flag: &str, error: &io::Error) -> String {
    let text = address.written();
    match (address, error.kind()) {
        (ListenAddress::Tcp(tcp), ErrorKind::AddrInUse) => {
            let free = ListenAddress::Tcp(std::net::SocketAddr::new(tcp.ip(), 0)).written();
            format!(
                "cannot listen at {text}: another program already listens there; stop it, or choose a free port with \
                 {flag} {free}"
            )
        }
        (_, ErrorKind::AddrInUse) => {
            format!(
                "cannot listen at {text}: another program already listens there, or the file is not a socket; choose \
                 another path for {flag}"
            )
        }
        (_, ErrorKind::AddrNotAvailable) => {
            format!(
                "cannot listen at {text}: this machine has no such address; use {flag} tcp://0.0.0.0:PORT to listen \
                 at all addresses"
            )
        }
        (_, ErrorKind::NotFound) => {
            format!("cannot listen at {text}: its folder does not exist; create it, or correct {flag}")
        }
        _ => format!("cannot listen at {text}: {error}; correct {flag}"),
    }
}

/// The file of a Unix socket. The file is removed when this value is dropped, unless another server has replaced the
/// file.
pub struct SocketFile {
    path: PathBuf,
    /// Device and inode number of the file.
    identity: Option<(u64, u64)>,
}

/// Returns the device and inode number of the file at a path.
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
    /// Listens at an address. The file of a Unix socket gets the permissions `mode` before anybody can connect. A
    /// socket file that a dead server left behind is replaced.
    ///
    /// # Errors
    /// If the address is in use or cannot be bound. The message names the address.
    pub async fn bind(address: &ListenAddress, mode: SocketMode) -> io::Result<Self> {
        Self::bind_as(address, "--listen", mode).await
    }

    /// Listens at an address like [`Listener::bind`]. Errors name `flag`, the command-line option that gave the
    /// address.
    ///
    /// # Errors
    /// See [`Listener::bind`].
    pub async fn bind_as(address: &ListenAddress, flag: &str, mode: SocketMode) -> io::Result<Self> {
        let explain = |error: io::Error| io::Error::new(error.kind(), explain(address, flag, &error));
        match address {
            ListenAddress::Tcp(tcp) => Ok(Self::Tcp(TcpListener::bind(tcp).await.map_err(explain)?)),
            ListenAddress::Unix(path) => {
                let is_socket = std::fs::symlink_metadata(path).is_ok_and(|m| m.file_type().is_socket());
                let refused = |e: io::Error| e.kind() == ErrorKind::ConnectionRefused;
                // Only a refused connection shows that the server is dead. Other errors may come from a running server,
                // for instance if its queue of connections is full.
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

    /// Returns the address at which this listens. If port 0 was given, the address has the port that the system chose.
    ///
    /// # Errors
    /// If the operating system does not report the port.
    pub fn address(&self) -> io::Result<ListenAddress> {
        match self {
            Self::Tcp(listener) => listener.local_addr().map(ListenAddress::Tcp),
            Self::Unix(_, file) => Ok(ListenAddress::Unix(file.path.clone())),
        }
    }

    /// Waits for the next connection. Switches off Nagle's algorithm for TCP, because a step is one small message each
    /// way.
    ///
    /// # Errors
    /// If the operating system cannot accept a connection, usually because the process is out of file descriptors.
    pub async fn accept(&self) -> io::Result<(AcceptedSocket, Peer)> {
        match self {
            Self::Tcp(listener) => {
                let (socket, address) = listener.accept().await?;
                let _ = socket.set_nodelay(true); // fails if the client has already disconnected
                Ok((AcceptedSocket::Tcp(socket.into_std()?), Peer::at(address.ip())))
            }
            Self::Unix(listener, _) => {
                let (socket, _) = listener.accept().await?;
                let user = socket.peer_cred().ok().map(|credentials| credentials.uid());
                Ok((AcceptedSocket::Unix(socket.into_std()?), Peer::User(user)))
            }
        }
    }
}
