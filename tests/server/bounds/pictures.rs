//! Drawing pictures does not delay other sessions.

use crate::common::server::{Server, Session, open};
use perturb::proto::Render;
use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

#[tokio::test]
async fn a_small_picture_does_not_wait_for_all_the_large_ones() {
    const LARGE: usize = 40;
    let server = Server::start(&[]);
    let drawn = Arc::new(AtomicUsize::new(0));
    let mut sessions = Vec::new();
    for seed in 0..LARGE {
        sessions.push(Session::open(server.tcp(), open("MountainCar", 1, seed as u64)).await.0);
    }
    let (mut small, _) = Session::open(server.tcp(), open("MountainCar", 1, 1)).await;
    for session in &sessions {
        session.send(Render { slot: 0, width: 2048, height: 2048 }).await;
    }
    // The small picture is requested before this thread is busy with reading the large pictures.
    small.send(Render { slot: 0, width: 64, height: 64 }).await;
    let mut reading = tokio::task::JoinSet::new();
    for mut session in sessions {
        let drawn = Arc::clone(&drawn);
        reading.spawn(async move {
            session.receive().await.unwrap().unwrap();
            drawn.fetch_add(1, Ordering::Relaxed);
        });
    }
    small.receive().await.unwrap().unwrap();
    let before = drawn.load(Ordering::Relaxed);
    println!("{before} large pictures came before the small one");
    assert!(before < LARGE / 2, "{before} large pictures came before the small one");
    while let Some(read) = reading.join_next().await {
        read.unwrap();
    }
}

#[cfg(feature = "mujoco")]
#[tokio::test]
async fn robot_can_be_drawn_when_descriptors_are_free_again() {
    use crate::common::server::{command, until};
    use perturb::proto::session_response::Response;
    use std::net::TcpStream;

    let mut limited = std::process::Command::new("sh");
    limited.args(["-c", "ulimit -n 48; exec \"$@\"", "sh"]).arg(command().get_program());
    limited.args(["--listen", "tcp://127.0.0.1:0"]);
    let server = Server::spawn(limited, tempfile::tempdir().unwrap(), 1);
    let (mut session, _) = Session::open(server.tcp(), open("Hopper", 1, 1)).await;
    let connections: Vec<TcpStream> = (0..60).map(|_| TcpStream::connect(server.port()).unwrap()).collect();
    until("no descriptor is left", async || server.log().contains("cannot accept")).await;
    let picture = Render { slot: 0, width: 64, height: 64 };
    let (_, message) = session.refused(picture).await;
    println!("{message}");
    drop(connections);
    until("the robot is drawn", async || matches!(session.answer(picture).await, Response::Render(_))).await;
}
