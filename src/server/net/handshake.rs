//! Does the handshakes of accepted connections on the thread that will serve them.

use super::{
    load::ConnectionLoad,
    managed_io::ManagedIo,
    peer_limiter::{Peer, PeerPermit},
    tls::Tls,
};
use futures_util::{Stream, stream};
use std::{io, time::Duration};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::{TcpStream, UnixStream},
    sync::mpsc,
    task::JoinSet,
    time::timeout,
};

/// An accepted connection, to be passed to the thread that will serve it.
pub struct Accepted {
    /// The socket of the connection.
    pub socket: AcceptedSocket,
    /// The peer of the connection.
    pub peer: Peer,
    /// The permit for the connection.
    pub permit: PeerPermit,
    /// The counter that adds the connection's work to the load of its thread.
    pub load: ConnectionLoad,
}

/// The socket of an accepted connection. It is not registered with a tokio runtime, so any thread can serve it.
pub enum AcceptedSocket {
    /// A TCP connection.
    Tcp(std::net::TcpStream),
    /// A connection over a Unix socket.
    Unix(std::os::unix::net::UnixStream),
}

/// The byte stream of a connection over TCP, TLS or a Unix socket.
pub trait ByteStream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<S: AsyncRead + AsyncWrite + Unpin + Send> ByteStream for S {}

/// The I/O of a connection whose handshake is complete.
pub type ServedConnection = ManagedIo<Box<dyn ByteStream>>;

/// Settings for the handshakes of a transport thread's connections.
#[derive(Clone)]
pub struct Handshakes {
    /// The maximum time for the TLS handshake. After the handshake, the client's HTTP/2 preface must arrive within the
    /// same time.
    pub limit: Duration,
    /// The TLS settings for TCP connections; `None` for connections without TLS.
    pub tls: Option<Tls>,
}

impl Handshakes {
    /// Does the handshake. Returns the connection, or `None` if the handshake failed or took too long.
    async fn begin(self, accepted: Accepted) -> Option<ServedConnection> {
        let Accepted { socket, peer, permit, load } = accepted;
        let refused = |reason: &dyn ToString| {
            tracing::debug!(?peer, reason = reason.to_string(), "closed a connection in its handshake");
        };
        let opened = async {
            Ok::<Box<dyn ByteStream>, io::Error>(match (socket, self.tls) {
                (AcceptedSocket::Tcp(socket), Some(tls)) => Box::new(tls.accept(TcpStream::from_std(socket)?).await?),
                (AcceptedSocket::Tcp(socket), None) => Box::new(TcpStream::from_std(socket)?),
                (AcceptedSocket::Unix(socket), _) => Box::new(UnixStream::from_std(socket)?),
            })
        };
        match timeout(self.limit, opened).await {
            Ok(Ok(socket)) => return Some(ManagedIo::new(socket, peer, permit, self.limit).counted(load)),
            Ok(Err(error)) => refused(&error),
            Err(late) => refused(&late),
        }
        None
    }
}

/// Does the handshakes of a transport thread's `accepted` connections concurrently. Returns the connections in the
/// order in which their handshakes finish.
pub fn connections(
    accepted: mpsc::UnboundedReceiver<Accepted>,
    handshakes: Handshakes,
) -> impl Stream<Item = io::Result<ServedConnection>> {
    stream::unfold((accepted, handshakes, JoinSet::new()), |(mut accepted, handshakes, mut begun)| async {
        let connection = loop {
            tokio::select! {
                Some(connection) = accepted.recv() => drop(begun.spawn(handshakes.clone().begin(connection))),
                Some(done) = begun.join_next() => if let Ok(Some(connection)) = done { break connection },
                else => return None,
            }
        };
        Some((Ok(connection), (accepted, handshakes, begun)))
    })
}
