//! Limits of the size of requests and of their number of entries, before and after `open`.

use super::{
    Neighbour,
    client::{Connection, LIST, SESSION, framed},
};
use crate::common::server::{Server, Session, open};
use bytes::Bytes;
use perturb::proto::{AutoresetMode, Open, Restore, SessionRequest, SlotGroup, session_request::Request};
use prost::Message;
use tonic::Code;

const WINDOW: u32 = 1 << 20;

/// Encodes a request whose field `number` contains `bytes`.
fn request(number: u8, bytes: &[u8]) -> Vec<u8> {
    let mut message = vec![number << 3 | 2];
    prost::encode_length_delimiter(bytes.len(), &mut message).unwrap();
    message.extend_from_slice(bytes);
    message
}

/// Encodes `count` empty entries of the repeated field `number`.
fn empty_entries(number: u8, count: usize) -> Vec<u8> {
    [number << 3 | 2, 0].repeat(count)
}

fn opened(environment: &str, n: u32) -> Vec<u8> {
    let open = Open { autoreset_mode: AutoresetMode::SameStep.into(), ..open(environment, n, 1) };
    SessionRequest { request: Some(Request::Open(open)) }.encode_to_vec()
}

#[tokio::test]
async fn request_over_1_mib_before_open_is_refused_unread() {
    let server = Server::start(&[]);
    let neighbour = Neighbour::start(server.unix());
    for length in [(1 << 20) + 1, 60 << 20] {
        let mut connection = Connection::new(server.port(), WINDOW).await;
        let mut call = connection.call(SESSION).await.unwrap();
        call.send(framed(length, &[])).await;
        let (code, message) = call.status().await.unwrap();
        assert_eq!(code, Code::OutOfRange as i32, "{message}");
        assert!(message.contains("1048576"), "the limit is told: {message}");
    }
    // A request of exactly the maximum length is read.
    let (mut session, _) = (Session::connect(server.tcp()).await, ());
    let padding = "x".repeat((1 << 20) - 40);
    let (code, _) = session.refused(Open { environment: padding, ..open("CartPole", 1, 1) }).await;
    assert_eq!(code, Code::NotFound);
    neighbour.was_not_held_up();
}

#[tokio::test]
async fn an_open_of_millions_of_empty_entries_holds_nobody_up() {
    let server = Server::start(&[]);
    let neighbour = Neighbour::start(server.unix());
    let request = request(1, &empty_entries(3, 15 << 20));
    for _ in 0..4 {
        let mut connection = Connection::new(server.port(), WINDOW).await;
        let mut call = connection.call(SESSION).await.unwrap();
        call.send_message(&request).await;
        call.close();
        call.status().await;
    }
    neighbour.was_not_held_up();
}

#[tokio::test]
async fn counts_are_bounded_while_a_large_request_is_decoded() {
    let server = Server::start(&[]);
    let neighbour = Neighbour::start(server.unix());
    let before = server.memory();
    let many = 15 << 20;
    // Each request has too many entries in one field: snapshots, seeds, distributions, widths of a policy, or a field
    // of an `open`.
    for request in [
        request(5, &empty_entries(2, many)),
        request(3, &[0x10, 1].repeat(many)),
        request(3, &empty_entries(3, many)),
        request(8, &request(1, &[0x08, 1].repeat(many))),
        [2 << 3 | 2, 0].repeat(many),
    ] {
        let mut connection = Connection::new(server.port(), WINDOW).await;
        let mut call = connection.call(SESSION).await.unwrap();
        assert!(call.send_message(&opened("CartPole", 2)).await);
        assert!(call.receive().await.is_some());
        call.send_message(&request).await;
        call.close();
        call.status().await;
    }
    let peak = server.peak_memory() - before;
    println!("the server took {} MB more", peak >> 20);
    assert!(peak < 200 << 20, "the server took {peak} bytes more");
    neighbour.was_not_held_up();
}

#[tokio::test]
async fn request_with_too_many_parts_is_refused_in_its_place() {
    let server = Server::start(&[]);
    let (mut session, _) = Session::open(server.tcp(), open("CartPole", 2, 1)).await;
    let snapshots = session.snapshot(&[]).await;
    let many = Restore { mask: Bytes::new(), snapshots: vec![Bytes::new(); 5_000] };
    let (code, message) = session.refused(many).await;
    assert_eq!(code, Code::InvalidArgument, "{message}");
    session.restore(&[], snapshots).await;
}

#[tokio::test]
async fn thousands_of_groups_fit_into_an_open() {
    let server = Server::start(&[]);
    let group = SlotGroup { size: 1, version: 1, ..SlotGroup::default() };
    let groups = Open {
        environment: "CartPole".into(),
        autoreset_mode: AutoresetMode::SameStep.into(),
        groups: vec![group; 8_000],
        ..Open::default()
    };
    let (mut session, _) = Session::open(server.tcp(), groups).await;
    assert_eq!(session.step(vec![0; 32_000].into()).await.rewards.len(), 32_000);
}

#[tokio::test]
async fn the_catalogue_is_asked_for_with_a_few_bytes() {
    let server = Server::start(&[]);
    let mut connection = Connection::new(server.port(), WINDOW).await;
    let mut call = connection.call(LIST).await.unwrap();
    call.send(framed(60 << 20, &[])).await;
    let (code, message) = call.status().await.unwrap();
    assert_eq!(code, Code::OutOfRange as i32, "{message}");
    let mut call = connection.call(LIST).await.unwrap();
    assert!(call.send_message(&[]).await);
    call.close();
    assert_eq!(call.status().await.unwrap().0, Code::Ok as i32);
}
