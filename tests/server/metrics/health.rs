//! The health service tells load balancers whether the server has room.

use crate::common::server::{Server, Session, channel, open, until, within};
use perturb::server::net::capacity_health::NEW_SESSIONS;
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};

async fn health(server: &Server, service: &str) -> ServingStatus {
    let mut client = HealthClient::new(channel(server.unix()).await);
    within(client.check(HealthCheckRequest { service: service.into() })).await.unwrap().into_inner().status()
}

async fn until_room(server: &Server, room: bool) {
    let status = if room { ServingStatus::Serving } else { ServingStatus::NotServing };
    until("health tells of the room", async || health(server, NEW_SESSIONS).await == status).await;
    assert_eq!(health(server, "").await, ServingStatus::Serving, "the server serves all the same");
    assert_eq!(health(server, "perturb.v1.Perturb").await, ServingStatus::Serving);
}

#[tokio::test]
async fn a_server_whose_sessions_are_all_taken_says_so() {
    let server = Server::start(&["--max-sessions", "2"]);
    until_room(&server, true).await;
    let _first = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    until_room(&server, true).await;
    let second = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    until_room(&server, false).await;
    drop(second);
    until_room(&server, true).await;
}

#[tokio::test]
async fn a_server_whose_environments_are_all_taken_says_so() {
    let server = Server::start(&["--max-envs", "8"]);
    let (mut session, _) = Session::open(server.tcp(), open("CartPole", 8, 1)).await;
    until_room(&server, false).await;
    session.ask(perturb::proto::Release { mask: vec![1, 0, 0, 0, 0, 0, 0, 0].into() }).await;
    until_room(&server, true).await;
    let other = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    until_room(&server, false).await;
    drop(other);
    until_room(&server, true).await;
}

#[tokio::test]
async fn a_server_that_drains_takes_no_new_sessions() {
    let server = Server::start(&[]);
    let _session = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    until_room(&server, true).await;
    server.signal("TERM");
    let drains = async || health(&server, NEW_SESSIONS).await == ServingStatus::NotServing;
    until("health tells of the end", drains).await;
    until("the whole server drains", async || health(&server, "").await == ServingStatus::NotServing).await;
}
