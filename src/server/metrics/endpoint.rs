//! The HTTP endpoint from which Prometheus reads the metrics. It serves one page, to few connections at a time.

use super::{MetricsSources, format::TextFormat, page};
use crate::server::net::listener::Listener;
use bytes::Bytes;
use http_body_util::Full;
use hyper::{
    Method, Request, Response, StatusCode,
    body::Incoming,
    header::{ACCEPT, CONTENT_TYPE, HeaderValue},
    server::conn::http1,
    service::service_fn,
};
use hyper_util::rt::{TokioIo, TokioTimer};
use std::{collections::VecDeque, convert::Infallible, io, sync::Arc, time::Duration};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    task::AbortHandle,
    time::{sleep, timeout},
};

/// The path of the metrics page.
pub const PATH: &str = "/metrics";
/// The maximum number of connections. A further connection ends the oldest. A scrape takes milliseconds, so the oldest
/// most likely belongs to a client that does not send its request.
const MAX_CONNECTIONS: usize = 16;
/// The maximum time for a connection to send its request and receive the reply.
const CONNECTION_TIMEOUT: Duration = Duration::from_secs(5);
/// The pause after the operating system could not accept a connection.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(200);
/// The maximum length of a request's headers, bytes.
const MAX_HEAD_BYTES: usize = 16 << 10;

/// Serves the metrics page. Never returns.
pub async fn serve(listener: Listener, sources: Arc<MetricsSources>) {
    let mut connections = VecDeque::<AbortHandle>::new();
    loop {
        let sources = Arc::clone(&sources);
        let accepted = match &listener {
            Listener::Tcp(listener) => listener
                .accept()
                .await
                .map(|(stream, _)| tokio::spawn(serve_connection(stream, sources)).abort_handle()),
            Listener::Unix(listener, _) => listener
                .accept()
                .await
                .map(|(stream, _)| tokio::spawn(serve_connection(stream, sources)).abort_handle()),
        };
        match accepted {
            Ok(connection) => {
                connections.retain(|connection| !connection.is_finished());
                if connections.len() >= MAX_CONNECTIONS
                    && let Some(oldest) = connections.pop_front()
                {
                    oldest.abort();
                }
                connections.push_back(connection);
            }
            Err(error) => pause(&error).await,
        }
    }
}

async fn pause(error: &io::Error) {
    tracing::warn!(%error, "cannot accept a connection for metrics");
    sleep(ACCEPT_RETRY_DELAY).await;
}

/// Answers the only request of a connection.
async fn serve_connection(stream: impl AsyncRead + AsyncWrite + Unpin, sources: Arc<MetricsSources>) {
    let answer = service_fn(|request| {
        let response = answer(&request, &sources);
        async move { Ok::<_, Infallible>(response) }
    });
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new())
        .header_read_timeout(CONNECTION_TIMEOUT)
        .keep_alive(false)
        .max_buf_size(MAX_HEAD_BYTES);
    // Ignores errors: a client that disconnects early or does not speak HTTP gets no reply.
    let _ = timeout(CONNECTION_TIMEOUT, http.serve_connection(TokioIo::new(stream), answer)).await;
}

fn answer(request: &Request<Incoming>, sources: &Arc<MetricsSources>) -> Response<Full<Bytes>> {
    let (status, content_type, text) = match (request.uri().path(), request.method()) {
        // For HEAD, the HTTP library omits the body.
        (PATH, &Method::GET | &Method::HEAD) => match page::page(sources) {
            Ok(text) => {
                let format = TextFormat::negotiated(accept(request).as_deref());
                (StatusCode::OK, format.content_type(), format.convert(text))
            }
            Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, "text/plain", format!("{error}\n")),
        },
        (PATH, _) => (StatusCode::METHOD_NOT_ALLOWED, "text/plain", "use GET or HEAD\n".into()),
        _ => (StatusCode::NOT_FOUND, "text/plain", format!("the metrics are at {PATH}\n")),
    };
    let mut response = Response::new(Full::new(text.into()));
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(content_type));
    response
}

/// Joins the values of all `Accept` headers of a request. Returns `None` if the request has no such header.
fn accept(request: &Request<Incoming>) -> Option<String> {
    let values: Vec<_> = request.headers().get_all(ACCEPT).iter().filter_map(|value| value.to_str().ok()).collect();
    (!values.is_empty()).then(|| values.join(","))
}
