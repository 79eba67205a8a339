//! The limit of concurrent streams of a connection.

use crate::common::server::{Server, Session, channel, open, until, within};
use std::time::Duration;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
};
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};

/// The expected limit: the maximum number of sessions, plus sixteen other calls, such as watches of the health.
const STREAMS: u32 = 4 + 16;
const FLAGS: [&str; 2] = ["--max-sessions", "4"];

/// Types of HTTP/2 frames.
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
/// Flags of HTTP/2 frames.
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;
/// The HTTP/2 setting with the maximum number of concurrent streams.
const MAX_CONCURRENT_STREAMS: u16 = 3;
/// The HTTP/2 error code with which a server refuses a stream.
const REFUSED_STREAM: u32 = 7;
const CANCEL: u32 = 8;

/// A client that ignores the limit of concurrent streams. gRPC libraries keep the limit: they wait until a stream ends.
struct Greedy {
    tcp: TcpStream,
    next: u32,
}

/// A frame that was received.
struct Frame {
    kind: u8,
    stream: u32,
    payload: Vec<u8>,
}

impl Greedy {
    async fn connect(port: &str) -> Self {
        let mut greedy = Self { tcp: TcpStream::connect(port).await.unwrap(), next: 1 };
        greedy.tcp.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").await.unwrap();
        greedy.send(SETTINGS, 0, 0, &[]).await;
        greedy
    }

    async fn send(&mut self, kind: u8, flags: u8, stream: u32, payload: &[u8]) {
        let length = (payload.len() as u32).to_be_bytes();
        let head = [&length[1..], &[kind, flags], &stream.to_be_bytes()].concat();
        self.tcp.write_all(&[&head, payload].concat()).await.unwrap();
    }

    async fn receive(&mut self) -> Frame {
        let mut head = [0; 9];
        within(self.tcp.read_exact(&mut head)).await.expect("the connection ended");
        let number = |bytes: &[u8]| bytes.iter().fold(0, |number, &byte| number << 8 | u32::from(byte));
        let mut payload = vec![0; number(&head[..3]) as usize];
        within(self.tcp.read_exact(&mut payload)).await.expect("a whole frame");
        Frame { kind: head[3], stream: number(&head[5..]), payload }
    }

    /// Reads the server's first frame, its settings. Returns the maximum number of streams in these settings.
    async fn announced(&mut self) -> Option<u32> {
        let frame = self.receive().await;
        assert_eq!(frame.kind, SETTINGS);
        let settings = frame.payload.as_chunks::<6>().0.iter();
        let mut named = settings.map(|&[a, b, number @ ..]| (u16::from_be_bytes([a, b]), u32::from_be_bytes(number)));
        named.find_map(|(name, number)| (name == MAX_CONCURRENT_STREAMS).then_some(number))
    }

    /// Starts an endless call that watches the server's health. Returns the stream's number, or the error code with
    /// which it was reset.
    async fn watch(&mut self) -> Result<u32, u32> {
        let (stream, mut head) = (self.next, Vec::new());
        self.next += 2;
        for (name, value) in [
            (":method", "POST"),
            (":scheme", "http"),
            (":path", "/grpc.health.v1.Health/Watch"),
            (":authority", "localhost"),
            ("content-type", "application/grpc"),
            ("te", "trailers"),
        ] {
            // The name and the value of the header are written uncompressed, each after its length.
            head.push(0);
            for text in [name, value] {
                head.push(text.len() as u8);
                head.extend(text.bytes());
            }
        }
        self.send(HEADERS, END_HEADERS, stream, &head).await;
        self.send(DATA, END_STREAM, stream, &[0; 5]).await; // an empty message
        loop {
            let frame = self.receive().await;
            match frame.kind {
                HEADERS if frame.stream == stream => return Ok(stream),
                RST_STREAM if frame.stream == stream => {
                    return Err(u32::from_be_bytes(frame.payload.try_into().unwrap()));
                }
                _ => {}
            }
        }
    }
}

async fn can_step(address: &str) {
    let (mut session, _) = Session::open(address, open("CartPole", 1, 1)).await;
    for _ in 0..5 {
        session.step(vec![0; 4].into()).await;
    }
}

#[tokio::test]
async fn stream_over_the_limit_is_refused_until_another_ends() {
    let server = Server::start(&FLAGS);
    let mut greedy = Greedy::connect(server.port()).await;
    assert_eq!(greedy.announced().await, Some(STREAMS));
    let mut streams = Vec::new();
    for _ in 0..STREAMS {
        streams.push(greedy.watch().await.expect("there is a place"));
    }
    for _ in 0..3 {
        assert_eq!(greedy.watch().await, Err(REFUSED_STREAM));
    }
    can_step(server.tcp()).await;
    for stream in streams.drain(..2) {
        greedy.send(RST_STREAM, 0, stream, &CANCEL.to_be_bytes()).await;
        until("there is a place again", async || greedy.watch().await.is_ok()).await;
        assert_eq!(greedy.watch().await, Err(REFUSED_STREAM), "for one");
    }
    can_step(server.tcp()).await;
}

#[tokio::test]
async fn who_heeds_a_connections_limit_waits_until_a_stream_is_over() {
    let server = Server::start(&FLAGS);
    let mut health = HealthClient::new(channel(server.tcp()).await);
    let mut watches = Vec::new();
    for _ in 0..STREAMS {
        let mut watch = within(health.watch(HealthCheckRequest::default())).await.unwrap().into_inner();
        assert!(within(watch.message()).await.unwrap().is_some(), "it begins with how things are");
        watches.push(watch);
    }
    let waiting = tokio::spawn(async move { health.check(HealthCheckRequest::default()).await });
    can_step(server.tcp()).await;
    assert!(!waiting.is_finished(), "it had no stream");
    drop(watches.pop());
    within(waiting).await.unwrap().unwrap();
    for watch in &mut watches {
        let next = tokio::time::timeout(Duration::from_millis(1), watch.message()).await;
        assert!(next.is_err(), "the others are still there, and nothing has changed: {next:?}");
    }
}
