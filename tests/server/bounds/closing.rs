//! The end of a large session does not block the transport thread.

use crate::common::server::{Server, Session, open, until};
use std::time::Duration;

/// Returns the CPU time of the server's first transport thread.
fn transport_time(server: &Server) -> Duration {
    let id = server.child.id();
    let schedule = std::fs::read_to_string(format!("/proc/{id}/task/{id}/schedstat")).unwrap();
    Duration::from_nanos(schedule.split(' ').next().unwrap().parse().unwrap())
}

#[tokio::test]
async fn transport_does_not_free_thousands_of_hoppers() {
    const HOPPERS: u32 = 8_192;
    let server = Server::start(&["--max-envs", "8192", "--workers", "2"]);
    let (session, _) = Session::open(server.tcp(), open("Hopper", HOPPERS, 1)).await;
    let before = transport_time(&server);
    drop(session);
    until("they are free", async || {
        tokio::time::sleep(Duration::from_millis(50)).await;
        let mut other = Session::connect(server.unix()).await;
        matches!(
            other.answer(open("CartPole", HOPPERS, 1)).await,
            perturb::proto::session_response::Response::Opened(_)
        )
    })
    .await;
    let took = transport_time(&server) - before;
    println!("the transport took {took:?} of a processor");
    // An earlier server freed environments on the transport thread, which took 155 ms for the Hoppers alone. Now the
    // thread needs time only for connections and for opening the CartPoles.
    assert!(took < Duration::from_millis(100), "{took:?}");
}
