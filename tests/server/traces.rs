//! Spans are sent to a collector, in builds with the feature `otel`.

use crate::common::server::{DEADLINE, Server, Session, command, open, step, within};
use bytes::Bytes;
use std::time::Duration;
use tokio::{net::TcpListener, sync::mpsc};

/// Starts a collector. Returns its address, and a receiver of the requests that it gets, each with its path.
async fn collector() -> (String, mpsc::UnboundedReceiver<(String, Vec<u8>)>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    let (tell, told) = mpsc::unbounded_channel();
    tokio::spawn(async move {
        let (stream, _) = listener.accept().await.unwrap();
        let mut connection = h2::server::handshake(stream).await.unwrap();
        while let Some(Ok((request, mut reply))) = connection.accept().await {
            let tell = tell.clone();
            tokio::spawn(async move {
                let (head, mut body) = request.into_parts();
                let mut bytes = Vec::new();
                while let Some(Ok(data)) = body.data().await {
                    let _ = body.flow_control().release_capacity(data.len());
                    bytes.extend_from_slice(&data);
                }
                let _ = tell.send((head.uri.path().to_owned(), bytes));
                let response = http::Response::builder().header("content-type", "application/grpc").body(()).unwrap();
                let mut sending = reply.send_response(response, false).unwrap();
                sending.send_data(Bytes::from_static(&[0; 5]), false).unwrap();
                let mut end = http::HeaderMap::new();
                end.insert("grpc-status", "0".parse().unwrap());
                sending.send_trailers(end).unwrap();
            });
        }
    });
    (address, told)
}

#[tokio::test]
async fn each_request_is_a_span_for_the_collector() {
    let (address, mut told) = collector().await;
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0"]).env("OTEL_EXPORTER_OTLP_ENDPOINT", &address);
    let mut server = Server::spawn(command, tempfile::tempdir().unwrap(), 1);
    let (mut session, _) = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    session.step(vec![0; 4].into()).await;
    session.refused(step(vec![0; 3])).await;
    drop(session);
    server.signal("TERM");
    assert!(within(server.ended()).await.success());
    let mut all = Vec::new();
    while let Ok(Some((path, bytes))) = tokio::time::timeout(Duration::from_secs(1), told.recv()).await {
        assert_eq!(path, "/opentelemetry.proto.collector.trace.v1.TraceService/Export");
        all.extend(bytes);
    }
    for part in ["perturb-server", "request", "kind", "open", "step", "step.actions is 3 bytes"] {
        let has = all.windows(part.len()).any(|bytes| bytes == part.as_bytes());
        assert!(has, "no {part:?} in {:?}", String::from_utf8_lossy(&all));
    }
}

#[tokio::test]
async fn without_a_collector_everything_is_as_ever() {
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0"]).env("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:9");
    let mut server = Server::spawn(command, tempfile::tempdir().unwrap(), 1);
    let (mut session, _) = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    session.step(vec![0; 4].into()).await;
    drop(session);
    server.signal("TERM");
    let ended = tokio::time::timeout(DEADLINE, server.ended()).await.unwrap();
    assert!(ended.success(), "{ended}");
}
