//! Begins connections on the thread that serves them.

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

/// A connection that was accepted, on its way to the thread that serves it.
pub struct Accepted {
    /// The socket of the connection.
    pub socket: AcceptedSocket,
    /// The peer of the connection.
    pub peer: Peer,
    /// The permit for the connection.
    pub permit: PeerPermit,
    /// The work of the connection, which counts for its thread.
    pub load: ConnectionLoad,
}

/// The socket of a connection, which belongs to no runtime.
pub enum AcceptedSocket {
    /// A TCP connection.
    Tcp(std::net::TcpStream),
    /// A connection of a Unix socket.
    Unix(std::os::unix::net::UnixStream),
}

/// The bytes of a connection, whatever its transport.
pub trait ByteStream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<S: AsyncRead + AsyncWrite + Unpin + Send> ByteStream for S {}

/// A connection that is served.
pub type ServedConnection = ManagedIo<Box<dyn ByteStream>>;

/// The settings with which a transport thread begins connections.
#[derive(Clone)]
pub struct Handshakes {
    /// The time in which a client must begin.
    pub limit: Duration,
    /// The TLS settings of TCP connections.
    pub tls: Option<Tls>,
}

impl Handshakes {
    /// The connection on this thread, if its client finishes the handshake in time.
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

/// The connections of a transport thread whose clients have finished the handshake, in the order in which they finish:
/// none waits for another.
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
