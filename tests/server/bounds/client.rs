//! A client that can send any bytes as messages of a stream, and reads replies only when told to.

use crate::common::server::within;
use bytes::Bytes;
use h2::{
    RecvStream, SendStream,
    client::{ResponseFuture, SendRequest},
};
use http::{Method, Request, Version};
use tokio::{net::TcpStream, task::JoinHandle};

pub const SESSION: &str = "/perturb.v1.Perturb/Session";
pub const LIST: &str = "/perturb.v1.Perturb/ListEnvironments";

/// An HTTP/2 connection. Dropping it closes the connection.
pub struct Connection {
    requests: SendRequest<Bytes>,
    task: JoinHandle<()>,
}

/// A running gRPC call.
pub struct Call {
    sending: SendStream<Bytes>,
    head: Option<ResponseFuture>,
    receiving: Option<RecvStream>,
}

impl Connection {
    /// Connects to `port`, "host:port". `window` is the flow-control window in bytes of each stream and of the
    /// connection.
    pub async fn new(port: &str, window: u32) -> Self {
        let tcp = TcpStream::connect(port).await.unwrap();
        let mut builder = h2::client::Builder::new();
        builder.initial_window_size(window).initial_connection_window_size(window.max(65_535));
        let (requests, connection) = within(builder.handshake(tcp)).await.unwrap();
        let task = tokio::spawn(async move { _ = connection.await });
        Self { requests, task }
    }

    /// Starts a call. Returns `None` if the server accepts no more calls or has closed the connection.
    pub async fn call(&mut self, path: &str) -> Option<Call> {
        self.call_compressed(path, "identity").await
    }

    /// Starts a call whose header announces this compression of its messages.
    pub async fn call_compressed(&mut self, path: &str, encoding: &str) -> Option<Call> {
        let request = Request::builder()
            .method(Method::POST)
            .version(Version::HTTP_2)
            .uri(format!("http://localhost{path}"))
            .header("content-type", "application/grpc")
            .header("te", "trailers")
            .header("grpc-encoding", encoding)
            .body(())
            .unwrap();
        self.requests = within(self.requests.clone().ready()).await.ok()?;
        let (head, sending) = self.requests.send_request(request, false).ok()?;
        Some(Call { sending, head: Some(head), receiving: None })
    }

    /// Whether the server has closed the connection.
    pub fn is_closed(&self) -> bool {
        self.task.is_finished()
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Call {
    /// Sends raw bytes. Returns whether the server accepted all of them.
    pub async fn send(&mut self, mut bytes: Bytes) -> bool {
        while !bytes.is_empty() {
            self.sending.reserve_capacity(bytes.len());
            match within(std::future::poll_fn(|context| self.sending.poll_capacity(context))).await {
                Some(Ok(room)) => {
                    let part = bytes.split_to(room.min(bytes.len()));
                    if self.sending.send_data(part, false).is_err() {
                        return false;
                    }
                }
                _ => return false,
            }
        }
        true
    }

    /// Sends a message. Returns whether the server accepted all of it.
    pub async fn send_message(&mut self, message: &[u8]) -> bool {
        self.send(framed(message.len(), message)).await
    }

    /// Closes the sending half of the call.
    pub fn close(&mut self) {
        let _ = self.sending.send_data(Bytes::new(), true);
    }

    /// Returns the next bytes of the reply, or `None` at its end.
    pub async fn receive(&mut self) -> Option<Bytes> {
        if let Some(head) = self.head.take() {
            self.receiving = Some(within(head).await.ok()?.into_body());
        }
        let receiving = self.receiving.as_mut()?;
        let bytes = within(receiving.data()).await?.ok()?;
        let _ = receiving.flow_control().release_capacity(bytes.len());
        Some(bytes)
    }

    /// Returns the gRPC status and the message with which the call ends, or `None` if the connection ended first.
    pub async fn status(&mut self) -> Option<(i32, String)> {
        if let Some(head) = self.head.take() {
            let response = within(head).await.ok()?;
            if let Some(status) = status(response.headers()) {
                return Some(status);
            }
            self.receiving = Some(response.into_body());
        }
        while self.receive().await.is_some() {}
        status(&within(self.receiving.as_mut()?.trailers()).await.ok()??)
    }
}

/// Returns the header of a message of `length` bytes, followed by `bytes`.
pub fn framed(length: usize, bytes: &[u8]) -> Bytes {
    [&[0], &(length as u32).to_be_bytes()[..], bytes].concat().into()
}

/// Returns a message whose header says that it is compressed.
pub fn framed_compressed(bytes: &[u8]) -> Bytes {
    [&[1], &(bytes.len() as u32).to_be_bytes()[..], bytes].concat().into()
}

fn status(headers: &http::HeaderMap) -> Option<(i32, String)> {
    let text = |name| headers.get(name).map(|value: &http::HeaderValue| value.to_str().unwrap().to_owned());
    Some((text("grpc-status")?.parse().unwrap(), text("grpc-message").unwrap_or_default().replace("%20", " ")))
}
