//! Faulty clients: invalid bytes, sudden ends, unread replies.

use super::Bystander;
use crate::common::server::{self, Actor, Server, Session, environment, open, step, until, within};
use perturb::proto::{SessionRequest, session_response::Response};
use std::{
    io::{Read, Write},
    net::TcpStream,
    os::unix::net::UnixStream,
    process::{Child, Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};
use tonic::Code;

const CLIENT: &str = "PERTURB_TEST_CLIENT_OF";

#[tokio::test]
async fn garbage_bytes_on_the_port_harm_nobody() {
    const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
    let server = Server::start(&["--workers", "1"]);
    let (tcp, unix) = (Bystander::start(server.tcp()).await, Bystander::start(server.unix()).await);
    let noise: Vec<u8> = (0..100_000).map(|i| server::mixed(i) as u8).collect();
    let settings = [0, 0, 0, 4, 0, 0, 0, 0, 0];
    let pieces: Vec<Vec<u8>> = vec![
        noise.clone(),
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n".to_vec(),
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".to_vec(), // a TLS handshake
        b"\n".to_vec(),
        Vec::new(),
        PREFACE[..11].to_vec(),
        [PREFACE, &noise].concat(),
        [PREFACE, &settings, &noise].concat(),
        [PREFACE, &[0xFF; 9]].concat(),
        [PREFACE, &settings, &[0, 0, 5, 1, 4, 0, 0, 0, 1], b"\xFF\xFF\xFF\xFF\xFF"].concat(), // invalid headers
    ];
    let mut open_connections: Vec<Box<dyn Read>> = Vec::new();
    for piece in &pieces {
        let mut connections: Vec<Box<dyn ReadWrite>> = vec![
            Box::new(TcpStream::connect(server.port()).unwrap()),
            Box::new(UnixStream::connect(server.socket()).unwrap()),
        ];
        for connection in &mut connections {
            // Errors are ignored, because the server may close the connection before it has read everything.
            let _ = connection.write_all(piece);
            let _ = connection.flush();
        }
        // Some clients disconnect, and some stay connected.
        drop(connections.swap_remove(0));
        open_connections.push(Box::new(connections.remove(0)));
        tcp.goes_on().await;
    }
    unix.ends_unharmed().await;
    tcp.ends_unharmed().await;
    drop(open_connections);
}

trait ReadWrite: Read + Write {}
impl<T: Read + Write> ReadWrite for T {}

/// A client that other tests start as a process in order to kill it. This function is not a test.
#[test]
#[ignore = "a process for other tests"]
fn client_that_steps_for_ever() {
    let Ok(address) = std::env::var(CLIENT) else { return };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let environment = environment(&address, "Acrobot").await;
        let mut session = Session::connect(&address).await;
        until("there is room", async || matches!(session.answer(open("Acrobot", 2_000, 1)).await, Response::Opened(_)))
            .await;
        let actor = Actor::new(&environment, 2_000);
        session.play(actor, 0, 1).await;
        println!("\nstepping");
        session.play(actor, 1, u64::MAX).await;
    });
}

/// The client as a process, which is killed when this value is dropped.
struct ClientProcess(Child);

impl ClientProcess {
    /// Starts the process, and waits until it steps.
    async fn start(address: &str) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args(["--ignored", "--exact", "--nocapture", "faults::clients::client_that_steps_for_ever"])
            .env(CLIENT, address);
        let mut client = Self(command.stdout(Stdio::piped()).spawn().unwrap());
        let lines = server::lines(client.0.stdout.take().unwrap());
        until("the client steps", async || lines.try_iter().any(|line| line == "stepping")).await;
        // Continues reading, because a closed pipe would end the process.
        std::thread::spawn(move || lines.iter().count());
        client
    }
}

impl Drop for ClientProcess {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits until a session with `n` environments can be opened.
pub(super) async fn room_for(address: &str, n: u32) {
    until("the environments are free again", async || {
        let mut session = Session::connect(address).await;
        match session.answer(open("Acrobot", n, 1)).await {
            Response::Opened(_) => true,
            Response::Error(error) if error.code == Code::ResourceExhausted as i32 => false,
            other => panic!("{other:?}"),
        }
    })
    .await;
}

#[tokio::test]
async fn a_client_killed_in_mid_step_frees_its_environments() {
    let server = Server::start(&["--max-envs", "2003"]);
    let bystander = Bystander::start(server.tcp()).await;
    for address in [server.tcp(), server.unix()] {
        let client = ClientProcess::start(address).await;
        let (code, message) = Session::connect(address).await.refused(open("Acrobot", 1, 1)).await;
        assert_eq!(code, Code::ResourceExhausted, "{message}");
        drop(client);
        room_for(address, 2_000).await;
    }
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn a_client_that_hangs_is_found_out_by_keepalive() {
    let server = Server::start(&["--max-envs", "2003", "--keepalive-seconds", "1"]);
    let bystander = Bystander::start(server.tcp()).await;
    let client = ClientProcess::start(server.tcp()).await;
    server::signal(client.0.id(), "STOP");
    room_for(server.unix(), 2_000).await;
    drop(client);
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn two_hundred_sessions_opened_and_dropped_leave_nothing_behind() {
    const EACH: u32 = 5;
    let server = Server::start(&["--max-envs", "1003", "--max-sessions", "250"]);
    let bystander = Bystander::start(server.tcp()).await;
    // Drops concurrent sessions during a step, once with one connection for all and once with a connection for each.
    let mut client = server::client(server.unix()).await;
    for own_connection in [false, true] {
        let mut sessions = Vec::new();
        for seed in 0..200 {
            let mut session = match own_connection {
                true => Session::connect(server.tcp()).await,
                false => Session::start(&mut client).await.unwrap(),
            };
            // At first, the session of `room_for` may still hold the environments.
            until("there is room", async || {
                matches!(session.answer(open("CartPole", EACH, seed)).await, Response::Opened(_))
            })
            .await;
            session.send(step(vec![0; 4 * EACH as usize])).await;
            sessions.push(session);
        }
        let mut one_more = Session::connect(server.tcp()).await;
        assert_eq!(one_more.refused(open("CartPole", 1, 1)).await.0, Code::ResourceExhausted);
        drop((sessions, one_more));
        room_for(server.tcp(), 200 * EACH).await;
    }
    // Opens sessions one after the other, and drops each without waiting for a reply.
    for seed in 0..200 {
        let session = Session::connect(server.tcp()).await;
        session.send(open("CartPole", 1000, seed)).await;
    }
    room_for(server.tcp(), 200 * EACH).await;
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn sessions_beyond_the_limit_are_refused_until_one_ends() {
    let server = Server::start(&["--max-sessions", "3"]);
    let bystander = Bystander::start(server.tcp()).await;
    let (first, _second) = (Session::connect(server.tcp()).await, Session::connect(server.unix()).await);
    let mut client = server::client(server.tcp()).await;
    let status = Session::start(&mut client).await.err().expect("a fourth session is refused");
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    assert!(status.message().contains("all of this server's 3 sessions"), "{status:?}");
    drop(first);
    until("there is room for a session", async || Session::start(&mut client).await.is_ok()).await;
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn client_that_never_reads_costs_bounded_memory() {
    const N: usize = 2_000;
    let server = Server::start(&["--workers", "1"]);
    let bystander = Bystander::start(server.tcp()).await;
    let (mut session, opened) = Session::open(server.tcp(), open("CartPole", N as u32, 1)).await;
    let environment = opened.environment.unwrap();
    let before = server.memory();
    let (sent, stop) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
    let sender = session.sender();
    let sending = tokio::spawn({
        let (sent, stop, environment) = (Arc::clone(&sent), Arc::clone(&stop), environment.clone());
        async move {
            // The client sends up to 800 MB of requests in total, with 5 GB of replies.
            for t in 0..100_000 {
                let request = Some(step(Actor::new(&environment, N).actions(t)));
                if stop.load(Ordering::Relaxed) || sender.send(SessionRequest { request }).await.is_err() {
                    return;
                }
                sent.store(t + 1, Ordering::Relaxed);
            }
        }
    });
    let mut last = u64::MAX;
    until("the server takes no more", async || {
        tokio::time::sleep(Duration::from_millis(500)).await;
        let stalled = sent.load(Ordering::Relaxed) == last;
        last = sent.load(Ordering::Relaxed);
        stalled
    })
    .await;
    assert!(!sending.is_finished(), "the server took {last} requests without a reader of its replies");
    let grown = server.memory().saturating_sub(before);
    assert!(grown < 64 << 20, "the server grew by {grown} bytes");
    bystander.goes_on().await;
    // Finally the client reads, and every reply arrives, in order.
    stop.store(true, Ordering::Relaxed);
    session.close();
    let mut replies = Vec::new();
    while let Some(reply) = session.receive().await.unwrap() {
        replies.push(reply);
    }
    within(sending).await.unwrap();
    assert!(replies.len() as u64 >= last, "{} replies to {last} requests", replies.len());
    let (mut reference, _) = Session::open(server.tcp(), open("CartPole", N as u32, 1)).await;
    assert!(reference.play(Actor::new(&environment, N), 0, replies.len() as u64).await == replies);
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn an_idle_session_is_ended_and_a_busy_one_is_not() {
    let server = Server::start(&["--idle-seconds", "1", "--max-envs", "103"]);
    let bystander = Bystander::start(server.tcp()).await;
    let (mut idle, _) = Session::open(server.tcp(), open("CartPole", 100, 1)).await;
    let mut never_opened = Session::connect(server.unix()).await;
    for session in [&mut idle, &mut never_opened] {
        let status = session.end().await;
        assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
        assert!(status.message().contains("idle for 1 s"), "{status:?}");
    }
    room_for(server.tcp(), 100).await;
    bystander.ends_unharmed().await;
}
