//! Accepts connections: a limited number at a time, and none that stands still.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::serve::Listener;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use socket2::SockRef;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tower_service::Service;

/// Limits of all connections together, and of each one.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ConnectionLimits {
    /// Number of open connections. A browser opens about six. Further clients wait until a connection is free.
    max_connections: usize,
    /// Time in which a client must send the head of a request. It counts from the connection's start, or from the end
    /// of the previous response.
    head_timeout: Duration,
    /// Time after which the kernel closes a connection whose client takes none of the bytes that wait for it.
    write_timeout: Duration,
}

impl Default for ConnectionLimits {
    fn default() -> Self {
        Self { max_connections: 256, head_timeout: Duration::from_secs(10), write_timeout: Duration::from_secs(120) }
    }
}

/// Answers requests with `router` on every connection of `listener`. Never returns.
pub(crate) async fn serve(mut listener: TcpListener, router: Router, limits: ConnectionLimits) -> Infallible {
    let permits = Arc::new(Semaphore::new(limits.max_connections));
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(limits.head_timeout);
    loop {
        // The semaphore is never closed.
        let permit = Arc::clone(&permits).acquire_owned().await;
        // axum's `accept` retries when the process has no free file descriptors.
        let (stream, _) = Listener::accept(&mut listener).await;
        if let Err(error) = SockRef::from(&stream).set_tcp_user_timeout(Some(limits.write_timeout)) {
            tracing::debug!("cannot set the write timeout of a connection: {error}");
        }
        let router = router.clone();
        let service = service_fn(move |request: hyper::Request<Incoming>| router.clone().call(request.map(Body::new)));
        let connection = http.serve_connection(TokioIo::new(stream), service);
        tokio::spawn(async move {
            let _permit = permit;
            // A client that goes away or exceeds a time limit is no error of this server.
            let _ = connection.await;
        });
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
    /// Upper bound of every wait; the machine may be busy.
    const DEADLINE: Duration = Duration::from_secs(30);

    /// Serves a short page at `/`, one that takes longer than the head's timeout at `/slow`, and a large one at
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
        let first = TcpStream::connect(address).await.unwrap();
        let mut second = TcpStream::connect(address).await.unwrap();
        second.write_all(REQUEST).await.unwrap();
        let mut byte = [0];
        assert!(timeout(LIMITS.head_timeout / 3, second.read(&mut byte)).await.is_err());
        drop(first);
        assert_eq!(timeout(DEADLINE, second.read(&mut byte)).await.unwrap().unwrap(), 1);
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
