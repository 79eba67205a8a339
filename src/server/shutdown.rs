//! Shutting down in order: no new sessions, a grace period for running ones, then the end.

use tokio::sync::watch;

/// The phase of the shutdown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ShutdownPhase {
    /// Serving.
    Running,
    /// New sessions are refused, and running ones continue.
    Draining,
    /// Running sessions are ended.
    Closed,
}

/// A view of the shutdown. A view that was made by [`Drain::enter`] counts as a running session.
#[derive(Clone)]
pub struct Drain {
    phase: watch::Receiver<ShutdownPhase>,
    /// Held by sessions: when the last clone is gone, no session runs.
    _session: Option<watch::Receiver<()>>,
    sessions: watch::Sender<()>,
}

/// Drives the shutdown.
pub struct Controller {
    /// The phase as each view sees it.
    phases: Vec<watch::Sender<ShutdownPhase>>,
    sessions: watch::Sender<()>,
}

impl Controller {
    /// A controller in [`ShutdownPhase::Running`], and a view of it.
    pub fn new() -> (Self, Drain) {
        let (phase, view) = watch::channel(ShutdownPhase::Running);
        let sessions = watch::Sender::new(());
        (Self { phases: vec![phase], sessions: sessions.clone() }, Drain { phase: view, _session: None, sessions })
    }

    /// Another view, for another thread: sessions look at the phase with each request, and two views share no lock.
    pub fn view(&mut self) -> Drain {
        let (phase, view) = watch::channel(ShutdownPhase::Running);
        self.phases.push(phase);
        Drain { phase: view, _session: None, sessions: self.sessions.clone() }
    }

    /// Moves on to a phase.
    pub fn set(&self, phase: ShutdownPhase) {
        self.phases.iter().for_each(|view| _ = view.send_replace(phase));
    }

    /// Waits until no session runs.
    pub async fn idle(&self) {
        self.sessions.closed().await;
    }
}

impl Drain {
    /// Returns a view for a session, which counts as running as long as it holds the view.
    pub fn enter(&self) -> Self {
        Self { _session: Some(self.sessions.subscribe()), ..self.clone() }
    }

    /// The phase of the shutdown.
    pub fn phase(&self) -> ShutdownPhase {
        *self.phase.borrow()
    }

    /// Waits for [`ShutdownPhase::Closed`].
    pub async fn closed(&mut self) {
        self.reached(ShutdownPhase::Closed).await;
    }

    /// Waits for [`ShutdownPhase::Draining`].
    pub async fn draining(&mut self) {
        self.reached(ShutdownPhase::Draining).await;
    }

    async fn reached(&mut self, wanted: ShutdownPhase) {
        if self.phase.wait_for(|phase| *phase >= wanted).await.is_err() {
            std::future::pending().await // the controller is gone: nobody will close
        }
    }
}
