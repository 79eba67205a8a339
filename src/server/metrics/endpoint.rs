//! The HTTP endpoint for scrapers: one page, small requests, few connections at a time.

use super::{MetricsSources, page};
use crate::server::net::listener::Listener;
use bytes::Bytes;
use http_body_util::Full;
use hyper::{
    Method, Request, Response, StatusCode, body::Incoming, header::CONTENT_TYPE, server::conn::http1,
    service::service_fn,
};
use hyper_util::rt::{TokioIo, TokioTimer};
use std::{convert::Infallible, io, sync::Arc, time::Duration};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    sync::Semaphore,
    time::{sleep, timeout},
};

/// The path of the page.
pub const PATH: &str = "/metrics";
/// The maximum number of connections; others wait to be accepted.
const MAX_CONNECTIONS: usize = 16;
/// The time in which a connection must send its request and take the reply.
const CONNECTION_TIMEOUT: Duration = Duration::from_secs(5);
/// The pause after the system refuses to accept a connection.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(200);
/// The maximum length of a request's head.
const MAX_HEAD_BYTES: usize = 16 << 10;
const CONTENT_TYPE_OPENMETRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Answers scrapers, for ever.
pub async fn serve(listener: Listener, sources: Arc<MetricsSources>) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let Ok(place) = Arc::clone(&places).acquire_owned().await else { return };
        let sources = Arc::clone(&sources);
        let accepted = match &listener {
            Listener::Tcp(listener) => listener.accept().await.map(|(stream, _)| {
                tokio::spawn(async move { (converse(stream, sources).await, drop(place)) });
            }),
            Listener::Unix(listener, _) => listener.accept().await.map(|(stream, _)| {
                tokio::spawn(async move { (converse(stream, sources).await, drop(place)) });
            }),
        };
        if let Err(error) = accepted {
            pause(&error).await;
        }
    }
}

async fn pause(error: &io::Error) {
    tracing::warn!(%error, "cannot accept a connection for metrics");
    sleep(ACCEPT_RETRY_DELAY).await;
}

/// Answers the one request of a connection.
async fn converse(stream: impl AsyncRead + AsyncWrite + Unpin, sources: Arc<MetricsSources>) {
    let answer = service_fn(|request| {
        let response = answer(&request, &sources);
        async move { Ok::<_, Infallible>(response) }
    });
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new())
        .header_read_timeout(CONNECTION_TIMEOUT)
        .keep_alive(false)
        .max_buf_size(MAX_HEAD_BYTES);
    // A client that leaves early or does not send HTTP gets nothing, and no other client is affected.
    let _ = timeout(CONNECTION_TIMEOUT, http.serve_connection(TokioIo::new(stream), answer)).await;
}

fn answer(request: &Request<Incoming>, sources: &Arc<MetricsSources>) -> Response<Full<Bytes>> {
    let (status, format, text) = match (request.uri().path(), request.method()) {
        (PATH, &Method::GET) => match page::page(sources) {
            Ok(text) => (StatusCode::OK, CONTENT_TYPE_OPENMETRICS, text),
            Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, "text/plain", format!("{error}\n")),
        },
        (PATH, _) => (StatusCode::METHOD_NOT_ALLOWED, "text/plain", "ask with GET\n".into()),
        _ => (StatusCode::NOT_FOUND, "text/plain", format!("ask for {PATH}\n")),
    };
    let mut response = Response::new(Full::new(text.into()));
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_TYPE, hyper::header::HeaderValue::from_static(format));
    response
}
