//! The transport threads, which serve the clients' connections. Each has a tokio runtime of its own. An accepted
//! connection is passed to one thread and stays there with all its sessions, so no request crosses threads.

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

/// The pause after the operating system could not accept a connection.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(200);

/// A handle to the transport threads, with which accepted connections are passed to them.
#[derive(Clone)]
pub struct TransportThreads {
    threads: Arc<[mpsc::UnboundedSender<Accepted>]>,
    /// The mutex is locked once for each new connection, never for a request.
    balance: Arc<Mutex<Balance>>,
}

impl TransportThreads {
    /// Makes a handle with a channel to each thread of `balance`. Also returns the receiving end of each channel.
    pub fn new(balance: Balance) -> (Self, Vec<mpsc::UnboundedReceiver<Accepted>>) {
        let (threads, connections): (Vec<_>, _) = (0..balance.threads()).map(|_| mpsc::unbounded_channel()).unzip();
        (Self { threads: threads.into(), balance: Arc::new(Mutex::new(balance)) }, connections)
    }

    /// Passes a connection to the thread with the least recent work.
    fn hand_over(&self, socket: AcceptedSocket, peer: Peer, permit: PeerPermit) {
        let (thread, load) = self.balance.lock().unwrap_or_else(PoisonError::into_inner).choose(Instant::now());
        // The send fails if the thread has ended. Then the server is shutting down, and the connection is closed.
        let _ = self.threads[thread].send(Accepted { socket, peer, permit, load });
    }
}

/// Accepts connections and passes them to the transport threads. Never returns. If `listener` is a Unix socket, the
/// socket's file is removed when the future is dropped.
pub async fn accept(listener: Listener, limiter: PeerLimiter, threads: TransportThreads) -> Infallible {
    loop {
        match listener.accept().await {
            Ok((socket, peer)) => match limiter.acquire(Some(peer)) {
                Ok(permit) => threads.hand_over(socket, peer, permit),
                Err(full) => tracing::debug!(?peer, ?full, "refused a connection above the limit"),
            },
            Err(error) => {
                // Most likely the process is out of file descriptors. Retrying at once would keep this thread from
                // serving clients.
                tracing::warn!(%error, "cannot accept a connection");
                tokio::time::sleep(ACCEPT_RETRY_DELAY).await;
            }
        }
    }
}

/// Runs `future` on a new thread with a new runtime. Returns a future of the result. If the returned future is dropped,
/// the thread ends.
///
/// # Errors
/// If the operating system cannot start a thread.
pub fn spawn<T: Send + 'static>(
    name: String,
    future: impl Future<Output = T> + Send + 'static,
) -> io::Result<impl Future<Output = io::Result<T>>> {
    let (mut done, output) = oneshot::channel();
    let run = move || {
        // The runtime is built here, because dropping a runtime in an async context panics, and the caller's context
        // drops `run` if the thread cannot start.
        let runtime = match Builder::new_current_thread().enable_all().build() {
            Ok(runtime) => runtime,
            Err(error) => {
                let _ = done.send(Err(error)); // fails if the result is no longer wanted
                return;
            }
        };
        let ended = runtime.block_on(async {
            tokio::select! {
                output = future => Some(output),
                () = done.closed() => None,
            }
        });
        // The thread does not wait for connections that are still open.
        runtime.shutdown_background();
        if let Some(output) = ended {
            let _ = done.send(Ok(output)); // fails if the result is no longer wanted
        }
    };
    thread::Builder::new().name(name).spawn(run).map_err(|error| explain_no_thread(&error))?;
    Ok(async {
        output.await.map_err(|_| io::Error::other("a transport thread ended because of a defect of the server"))?
    })
}
