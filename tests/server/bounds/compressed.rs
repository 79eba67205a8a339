//! Clients that compress their requests. Some gRPC libraries do so by default.

use super::{
    Neighbour,
    client::{Connection, SESSION, framed_compressed},
};
use crate::common::server::{Server, Session, client, open, step};
use flate2::{Compression, write::GzEncoder};
use perturb::proto::{ListEnvironmentsRequest, SessionRequest, SessionResponse, session_request::Request};
use prost::Message;
use rstest::rstest;
use std::io::Write;
use tonic::{Code, codec::CompressionEncoding};

const WINDOW: u32 = 1 << 20;
/// A batch size for which requests are some kB long.
const BATCH: u32 = 256;

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// Opens a session and steps it. Returns its replies.
async fn replies(mut session: Session) -> Vec<SessionResponse> {
    let requests = [Request::from(open("CartPole", BATCH, 7))].into_iter();
    let mut replies = Vec::new();
    for request in requests.chain((0..20).map(|i| step(vec![i % 2; BATCH as usize * 4]))) {
        session.send(request).await;
        replies.push(session.receive().await.unwrap().unwrap());
    }
    replies
}

#[rstest]
#[case::gzip(CompressionEncoding::Gzip)]
#[case::deflate(CompressionEncoding::Deflate)]
#[tokio::test]
async fn compressed_requests_get_the_same_replies(#[case] encoding: CompressionEncoding) {
    let server = Server::start(&[]);
    let mut compressing = client(server.tcp()).await.send_compressed(encoding);
    let listed = compressing.list_environments(ListEnvironmentsRequest::default()).await.unwrap().into_inner();
    let plain = client(server.tcp()).await.list_environments(ListEnvironmentsRequest::default()).await.unwrap();
    assert_eq!(listed, plain.into_inner());
    let compressed = replies(Session::start(&mut compressing).await.unwrap()).await;
    assert_eq!(compressed, replies(Session::connect(server.tcp()).await).await);
}

#[tokio::test]
async fn the_limits_hold_for_the_decompressed_size() {
    let server = Server::start(&[]);
    let neighbour = Neighbour::start(server.unix());
    let bomb = gzip(&vec![0; 200 << 20]);
    assert!(bomb.len() < 1 << 20, "{}", bomb.len());
    let mut connection = Connection::new(server.port(), WINDOW).await;
    let mut call = connection.call_compressed(SESSION, "gzip").await.unwrap();
    call.send(framed_compressed(&bomb)).await;
    let (code, message) = call.status().await.unwrap();
    assert_eq!(code, Code::OutOfRange as i32, "{message}");
    assert!(message.contains("more than 1048576 bytes"), "{message}");
    neighbour.was_not_held_up();
}

#[rstest]
#[case::cut("gzip", gzip(&SessionRequest { request: Some(open("CartPole", 1, 1).into()) }.encode_to_vec())[..12].to_vec(), "is not gzip")]
#[case::other_bytes("deflate", b"no zlib".to_vec(), "is not deflate")]
#[case::no_header("identity", gzip(b""), "grpc-encoding")]
#[tokio::test]
async fn bytes_that_cannot_be_decompressed_are_told(
    #[case] encoding: &str,
    #[case] bytes: Vec<u8>,
    #[case] word: &str,
) {
    let server = Server::start(&[]);
    let mut connection = Connection::new(server.port(), WINDOW).await;
    let mut call = connection.call_compressed(SESSION, encoding).await.unwrap();
    call.send(framed_compressed(&bytes)).await;
    let (code, message) = call.status().await.unwrap();
    assert_eq!(code, Code::Internal as i32, "{message}");
    assert!(message.contains(word), "{message}");
}
