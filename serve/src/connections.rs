//! Accepts connections. It limits their number, and closes connections whose clients send or read nothing.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes, HttpBody};
use axum::serve::Listener;
use hyper::body::{Frame, Incoming, SizeHint};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use socket2::SockRef;
use tokio::net::TcpListener;
use tokio::sync::{Notify, Semaphore};
use tower_service::Service;

/// The limit of the number of connections, and the time limits of each connection.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ConnectionLimits {
    /// Maximum number of open connections. A browser opens about six. When the maximum is reached, a new connection
    /// replaces the oldest connection that has no request in progress. If every connection has a request in progress,
    /// the new connection waits.
    max_connections: usize,
    /// Maximum time for a client to send the head of a request. It counts from the start of the connection, or from the
    /// end of the last response.
    head_timeout: Duration,
    /// Time after which the kernel closes a connection whose client acknowledges no sent data.
    write_timeout: Duration,
}

impl Default for ConnectionLimits {
    fn default() -> Self {
        Self { max_connections: 256, head_timeout: Duration::from_secs(10), write_timeout: Duration::from_secs(120) }
    }
}

/// The address of a client. It is attached to the client's requests as an extension.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ClientAddress(pub(crate) IpAddr);

/// An open connection. It may be closed in favour of a new connection while it has no request in progress.
#[derive(Debug, Default)]
struct OpenConnection {
    /// Number of requests in progress.
    requests: AtomicUsize,
    closing: Notify,
}

/// The open connections, oldest first.
#[derive(Debug, Default)]
struct OpenConnections(Mutex<VecDeque<Arc<OpenConnection>>>);

impl OpenConnections {
    fn add(&self) -> Arc<OpenConnection> {
        let connection = Arc::new(OpenConnection::default());
        self.lock().push_back(Arc::clone(&connection));
        connection
    }

    fn remove(&self, connection: &Arc<OpenConnection>) {
        self.lock().retain(|other| !Arc::ptr_eq(other, connection));
    }

    /// Closes the oldest connection without a request in progress, if there is one. Clients that send no requests
    /// therefore cannot block other clients.
    fn close_waiting(&self) {
        let mut all = self.lock();
        let waiting = all.iter().position(|connection| connection.requests.load(Ordering::Relaxed) == 0);
        if let Some(connection) = waiting.and_then(|place| all.remove(place)) {
            connection.closing.notify_one();
        }
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<Arc<OpenConnection>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A guard for a request in progress, which ends when its response was sent or dropped. Dropping the guard decreases
/// [`OpenConnection::requests`].
struct RequestGuard(Arc<OpenConnection>);

impl Drop for RequestGuard {
    fn drop(&mut self) {
        self.0.requests.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Accepts the connections of `listener`, and answers their requests with `router`. Never returns.
pub(crate) async fn serve(mut listener: TcpListener, router: Router, limits: ConnectionLimits) -> Infallible {
    let permits = Arc::new(Semaphore::new(limits.max_connections));
    let all = Arc::new(OpenConnections::default());
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(limits.head_timeout);
    loop {
        // axum's `accept` retries when the process has no free file descriptors.
        let (stream, address) = Listener::accept(&mut listener).await;
        let permit = match Arc::clone(&permits).try_acquire_owned() {
            Ok(permit) => Ok(permit),
            Err(_) => {
                all.close_waiting();
                Arc::clone(&permits).acquire_owned().await // the semaphore is never closed
            }
        };
        if let Err(error) = SockRef::from(&stream).set_tcp_user_timeout(Some(limits.write_timeout)) {
            tracing::debug!("cannot set the write timeout of a connection: {error}");
        }
        let open = all.add();
        let (router, own) = (router.clone(), Arc::clone(&open));
        let service = service_fn(move |mut request: hyper::Request<Incoming>| {
            own.requests.fetch_add(1, Ordering::Relaxed);
            let guard = RequestGuard(Arc::clone(&own));
            request.extensions_mut().insert(ClientAddress(address.ip()));
            let response = router.clone().call(request.map(Body::new));
            async move { Ok::<_, Infallible>(response.await?.map(|body| GuardedBody { body, _guard: guard })) }
        });
        let connection = http.serve_connection(TokioIo::new(stream), service);
        let all = Arc::clone(&all);
        tokio::spawn(async move {
            let _permit = permit;
            tokio::select! {
                // Errors of a client that disconnects or exceeds a time limit are ignored.
                _ = connection => {}
                () = open.closing.notified() => {}
            }
            all.remove(&open);
        });
    }
}

/// A response body. It holds the guard of its request until the body was sent or dropped.
struct GuardedBody {
    body: Body,
    _guard: RequestGuard,
}

impl HttpBody for GuardedBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use axum::routing::get;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;
    use tokio::time::{Instant, sleep, timeout};

    use super::*;

    const LIMITS: ConnectionLimits = ConnectionLimits {
        max_connections: 1,
        head_timeout: Duration::from_millis(300),
        write_timeout: Duration::from_millis(500),
    };
    const REQUEST: &[u8] = b"GET / HTTP/1.1\r\nHost: a\r\n\r\n";
    /// Maximum time for which a test waits for something. It is long, because the machine may be busy.
    const DEADLINE: Duration = Duration::from_secs(30);

    /// Serves a short page at `/`, a page that takes longer than `head_timeout` at `/slow`, and a large page at
    /// `/large`.
    async fn start() -> SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let slow = || async {
            sleep(2 * LIMITS.head_timeout).await;
            "slow"
        };
        let router = Router::new()
            .route("/", get(|| async { "short" }))
            .route("/slow", get(slow))
            .route("/large", get(|| async { vec![b'x'; 64 << 20] }));
        tokio::spawn(serve(listener, router, LIMITS));
        address
    }

    /// Returns how long the server keeps a connection on which `first` is sent and then a byte every 20 ms.
    async fn time_until_closed(address: SocketAddr, first: &'static [u8]) -> Duration {
        let mut client = TcpStream::connect(address).await.unwrap();
        let start = Instant::now();
        client.write_all(first).await.unwrap();
        loop {
            assert!(start.elapsed() < DEADLINE, "the connection stays open");
            match timeout(Duration::from_millis(20), client.read(&mut [0; 1024])).await {
                Ok(Ok(0) | Err(_)) => return start.elapsed(),
                Ok(Ok(_)) => {}
                Err(_) => _ = client.write_all(b"x").await,
            }
        }
    }

    #[tokio::test]
    async fn a_head_sent_byte_by_byte_ends_the_connection() {
        let address = start().await;
        assert!(time_until_closed(address, b"").await >= LIMITS.head_timeout);
        assert!(time_until_closed(address, b"GET / HTTP/1.1\r\nx: ").await >= LIMITS.head_timeout);
        let second_request =
            time_until_closed(address, b"GET / HTTP/1.1\r\nHost: a\r\n\r\nGET / HTTP/1.1\r\nx: ").await;
        assert!(second_request >= LIMITS.head_timeout, "{second_request:?}");
    }

    #[tokio::test]
    async fn a_response_may_take_longer_than_a_head() {
        let mut client = TcpStream::connect(start().await).await.unwrap();
        client.write_all(b"GET /slow HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n").await.unwrap();
        let mut response = String::new();
        client.read_to_string(&mut response).await.unwrap();
        assert!(response.ends_with("slow"), "{response}");
    }

    #[tokio::test]
    async fn further_clients_wait_for_a_free_connection() {
        let address = start().await;
        let mut first = TcpStream::connect(address).await.unwrap();
        first.write_all(b"GET /slow HTTP/1.1\r\nHost: a\r\n\r\n").await.unwrap();
        sleep(LIMITS.head_timeout / 3).await; // the request arrives
        let mut second = TcpStream::connect(address).await.unwrap();
        second.write_all(REQUEST).await.unwrap();
        let mut byte = [0];
        assert!(timeout(LIMITS.head_timeout / 3, second.read(&mut byte)).await.is_err());
        drop(first);
        assert_eq!(timeout(DEADLINE, second.read(&mut byte)).await.unwrap().unwrap(), 1);
    }

    #[tokio::test]
    async fn connections_without_a_request_shut_out_nobody() {
        let address = start().await;
        let mut idle = Vec::new();
        for _ in 0..20 {
            idle.push(TcpStream::connect(address).await.unwrap());
        }
        let mut client = TcpStream::connect(address).await.unwrap();
        client.write_all(REQUEST).await.unwrap();
        let read = timeout(LIMITS.head_timeout, client.read(&mut [0])).await;
        assert_eq!(read.expect("at once").unwrap(), 1);
        drop(idle);
    }

    #[tokio::test]
    async fn a_client_that_reads_nothing_loses_its_connection() {
        let address = start().await;
        let mut stuck = TcpStream::connect(address).await.unwrap();
        stuck.write_all(b"GET /large HTTP/1.1\r\nHost: a\r\n\r\n").await.unwrap();
        let mut next = TcpStream::connect(address).await.unwrap();
        next.write_all(REQUEST).await.unwrap();
        assert_eq!(timeout(DEADLINE, next.read(&mut [0])).await.unwrap().unwrap(), 1);
        drop(stuck);
    }
}
