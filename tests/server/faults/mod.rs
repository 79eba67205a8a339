//! Invalid requests, faulty clients and faulty connections. Each fault happens while another session steps. The bytes
//! of this session must equal the bytes of an undisturbed run.

mod clients;
mod lines;
mod processes;
mod requests;
mod strings;

use crate::common::server::{Actor, Session, environment, open, until, within};
use perturb::proto::{Environment, SessionResponse};
use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};
use tokio::task::JoinHandle;

/// A session that steps continuously while a test runs.
struct Bystander {
    address: String,
    environment: Environment,
    steps: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
    task: JoinHandle<(Session, Vec<SessionResponse>)>,
}

impl Bystander {
    const N: u32 = 3;

    async fn start(address: &str) -> Self {
        let environment = environment(address, "Pendulum").await;
        let (mut session, _) = Session::open(address, open("Pendulum", Self::N, 99)).await;
        let (steps, stop) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let task = tokio::spawn({
            let (environment, steps, stop) = (environment.clone(), Arc::clone(&steps), Arc::clone(&stop));
            async move {
                let (actor, mut replies) = (Actor::new(&environment, Self::N as usize), Vec::new());
                while !stop.load(Ordering::Relaxed) {
                    let t = replies.len() as u64;
                    replies.extend(session.play(actor, t, t + 1).await);
                    steps.store(t + 1, Ordering::Relaxed);
                    tokio::time::sleep(Duration::from_micros(300)).await;
                }
                (session, replies)
            }
        });
        let bystander = Self { address: address.into(), environment, steps, stop, task };
        bystander.goes_on().await;
        bystander
    }

    /// Waits until the session has taken more steps.
    async fn goes_on(&self) {
        let before = self.steps.load(Ordering::Relaxed);
        until("the other session goes on", async || {
            assert!(!self.task.is_finished(), "the other session failed");
            self.steps.load(Ordering::Relaxed) >= before + 20
        })
        .await;
    }

    /// Ends the session, and compares its bytes with an undisturbed run of the same number of steps.
    async fn ends_unharmed(self) {
        self.goes_on().await;
        self.stop.store(true, Ordering::Relaxed);
        let (session, replies) = within(self.task).await.unwrap();
        drop(session);
        let (mut reference, _) = Session::open(&self.address, open("Pendulum", Self::N, 99)).await;
        let actor = Actor::new(&self.environment, Self::N as usize);
        let reference = reference.play(actor, 0, replies.len() as u64).await;
        assert!(replies == reference, "the other session's bytes changed");
    }
}
