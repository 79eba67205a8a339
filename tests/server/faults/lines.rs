//! Many clients over faulty connections, and one client over a connection without faults.

use super::{Bystander, clients::room_for};
use crate::common::server::{self, Server, within};
use perturb::proto::{Step, Stepped};
use perturb_faults::{FaultKind, FaultPlan, FaultyProxy, SeededRng};
use perturb_protocol::{Address, ClientError, Connection, Stream, Timeouts};
use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

const CLIENTS: usize = 60;
const ENVS: usize = 5;
const STEPS: usize = 40;
/// The maximum number of bytes before a fault of a connection: about the length of a client's whole session.
const MOST: u64 = 20_000;
/// Short timeouts, so that half-open connections are given up soon.
const PATIENCE: Timeouts = Timeouts {
    reply: Duration::from_secs(3),
    keepalive_interval: Duration::from_secs(1),
    keepalive_limit: Duration::from_secs(2),
};

/// Plays a client's session. Stores its step results in `seen`, until the last step or an error.
async fn play(address: &str, seen: &mut Vec<Stepped>) -> Result<(), ClientError> {
    let address: Address = address.parse().unwrap();
    let connection = Connection::open_with(&address, PATIENCE).await?;
    let (mut stream, _) = Stream::open(&connection, server::open("CartPole", ENVS as u32, 1)).await?;
    for _ in 0..STEPS {
        seen.push(stream.ask(Step { actions: vec![0; 4 * ENVS].into() }).await?);
    }
    Ok(())
}

#[tokio::test]
async fn faults_of_lines_end_sessions_and_change_none() {
    let flags = ["--max-envs", "2003", "--keepalive-seconds", "1", "--stall-seconds", "2", "--handshake-seconds", "3"];
    let server = Server::start(&flags);
    let bystander = Bystander::start(server.unix()).await;
    let mut truth = Vec::new();
    play(server.unix(), &mut truth).await.unwrap();
    let (mut dice, courses) = (SeededRng::new(), Arc::new(Mutex::new(Vec::new())));
    let drawn: Vec<FaultPlan> = (0..CLIENTS)
        .map(|_| {
            let (fault, is_servers) = (Some(dice.fault(&FaultKind::ALL, MOST)), dice.below(2) == 0);
            let delay = Duration::from_micros(dice.below(3000));
            let [from_server, from_client] = if is_servers { [fault, None] } else { [None, fault] };
            FaultPlan { delay, from_server, from_client }
        })
        .collect();
    let clients = drawn.into_iter().map(|course| {
        let line = FaultyProxy::start(server.tcp(), move |_| course).unwrap();
        let courses = Arc::clone(&courses);
        tokio::spawn(async move {
            let mut seen = Vec::new();
            let end = play(&line.address(), &mut seen).await;
            courses.lock().unwrap().push((course, line.faults(), seen, end.err()));
        })
    });
    for client in clients.collect::<Vec<_>>() {
        within(client).await.unwrap();
    }
    let (mut happened, mut noticed) = (0, 0);
    for (course, faults, seen, error) in courses.lock().unwrap().iter() {
        let kind = course.from_server.or(course.from_client).map(|fault| fault.kind);
        // Connections without TLS do not protect bytes against changes, so a flipped bit may change a result.
        assert!(kind == Some(FaultKind::BitFlip) || truth.starts_with(seen), "{course:?} changed what was seen");
        assert!(*faults > 0 || error.is_none(), "{course:?}: nothing happened, but {error:?}");
        (happened, noticed) = (happened + faults, noticed + usize::from(error.is_some()));
    }
    println!("{happened} faults on {CLIENTS} lines, {noticed} noticed");
    assert!(happened > CLIENTS / 4 && noticed > CLIENTS / 8, "{happened} happened, {noticed} were noticed");
    room_for(server.unix(), 2_000).await;
    bystander.ends_unharmed().await;
}
