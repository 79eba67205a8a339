//! The threads that talk to clients. Each has a runtime of its own. A connection is handed to one of them when it is
//! accepted and stays there, with all its sessions, so that no request crosses threads.

use super::{
    handshake::{Accepted, AcceptedSocket},
    listener::Listener,
    load::Balance,
    peer_limiter::{Peer, PeerLimiter, PeerPermit},
};
use perturb_system::explain_no_thread;
use std::{
    convert::Infallible,
    future::Future,
    io,
    sync::{Arc, Mutex, PoisonError},
    thread,
    time::Duration,
};
use tokio::{
    runtime::Builder,
    sync::{mpsc, oneshot},
    time::Instant,
};

/// The pause after the system refuses to accept a connection.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(200);

/// Hands connections to the threads.
#[derive(Clone)]
pub struct TransportThreads {
    threads: Arc<[mpsc::UnboundedSender<Accepted>]>,
    /// It is locked for each connection, never for a request.
    balance: Arc<Mutex<Balance>>,
}

impl TransportThreads {
    /// Threads with this balance of their load, and the connections that come to each of them.
    pub fn new(balance: Balance) -> (Self, Vec<mpsc::UnboundedReceiver<Accepted>>) {
        let (threads, connections): (Vec<_>, _) = (0..balance.threads()).map(|_| mpsc::unbounded_channel()).unzip();
        (Self { threads: threads.into(), balance: Arc::new(Mutex::new(balance)) }, connections)
    }

    /// Hands a connection to the thread that did the least work lately.
    fn hand_over(&self, socket: AcceptedSocket, peer: Peer, permit: PeerPermit) {
        let (thread, load) = self.balance.lock().unwrap_or_else(PoisonError::into_inner).choose(Instant::now());
        // A thread that has ended takes no connections: the server shuts down, and the connection is closed.
        let _ = self.threads[thread].send(Accepted { socket, peer, permit, load });
    }
}

/// Accepts connections, for ever, and hands them to the threads. A Unix socket's file is removed when the future is
/// dropped.
pub async fn accept(listener: Listener, limiter: PeerLimiter, threads: TransportThreads) -> Infallible {
    loop {
        match listener.accept().await {
            Ok((socket, peer)) => match limiter.acquire(Some(peer)) {
                Ok(permit) => threads.hand_over(socket, peer, permit),
                Err(full) => tracing::debug!(?peer, ?full, "closed a connection for which there is no place"),
            },
            Err(error) => {
                // Out of file descriptors, most likely: trying again at once would keep the thread from those it serves.
                tracing::warn!(%error, "cannot accept a connection");
                tokio::time::sleep(ACCEPT_RETRY_DELAY).await;
            }
        }
    }
}

/// Runs a future on a thread of its own, with a runtime of its own. Both end with the future, or when what this returns
/// is dropped.
///
/// # Errors
/// If the operating system starts no thread.
pub fn spawn<T: Send + 'static>(
    name: String,
    future: impl Future<Output = T> + Send + 'static,
) -> io::Result<impl Future<Output = io::Result<T>>> {
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let (mut done, output) = oneshot::channel();
    let run = move || {
        let ended = runtime.block_on(async {
            tokio::select! {
                output = future => Some(output),
                () = done.closed() => None,
            }
        });
        // Connections that did not close by themselves must not delay the end.
        runtime.shutdown_background();
        if let Some(output) = ended {
            let _ = done.send(output); // nobody may wait for it any more
        }
    };
    thread::Builder::new().name(name).spawn(run).map_err(|error| explain_no_thread(&error))?;
    Ok(async { output.await.map_err(|_| io::Error::other("a transport thread ended from a defect of the server")) })
}
