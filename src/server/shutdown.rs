//! The phases of a shutdown: no new sessions, a grace period for running sessions, the end.

use tokio::sync::watch;

/// The phase of the shutdown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ShutdownPhase {
    /// The server serves and accepts new sessions.
    Running,
    /// New sessions are refused; running sessions continue.
    Draining,
    /// All sessions are ended.
    Closed,
}

/// A handle that observes the phase of the shutdown. A handle made by [`Drain::enter`] also counts as a running session
/// until it is dropped.
#[derive(Clone)]
pub struct Drain {
    phase: watch::Receiver<ShutdownPhase>,
    /// A receiver of `sessions`, which only the handle of a session has. When all receivers are dropped, no session
    /// runs.
    _session: Option<watch::Receiver<()>>,
    sessions: watch::Sender<()>,
}

/// The controller of the shutdown: it sets the phase, and waits for sessions to end.
pub struct Controller {
    /// The senders of the phase: one for the handle from `new`, and one for each handle from `view`.
    phases: Vec<watch::Sender<ShutdownPhase>>,
    sessions: watch::Sender<()>,
}

impl Controller {
    /// Makes a controller in [`ShutdownPhase::Running`], and a handle that observes it.
    pub fn new() -> (Self, Drain) {
        let (phase, view) = watch::channel(ShutdownPhase::Running);
        let sessions = watch::Sender::new(());
        (Self { phases: vec![phase], sessions: sessions.clone() }, Drain { phase: view, _session: None, sessions })
    }

    /// Makes a handle for another thread. Sessions read the phase at each request. The handle shares no lock with the
    /// handles of other threads, so the sessions of different threads do not wait for each other.
    pub fn view(&mut self) -> Drain {
        let (phase, view) = watch::channel(ShutdownPhase::Running);
        self.phases.push(phase);
        Drain { phase: view, _session: None, sessions: self.sessions.clone() }
    }

    /// Sets the phase that all handles observe.
    pub fn set(&self, phase: ShutdownPhase) {
        self.phases.iter().for_each(|view| _ = view.send_replace(phase));
    }

    /// Waits until no session runs.
    pub async fn idle(&self) {
        self.sessions.closed().await;
    }
}

impl Drain {
    /// Returns a handle for a session. The session counts as running until the handle is dropped.
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

    /// Waits for [`ShutdownPhase::Draining`] or a later phase.
    pub async fn draining(&mut self) {
        self.reached(ShutdownPhase::Draining).await;
    }

    async fn reached(&mut self, wanted: ShutdownPhase) {
        if self.phase.wait_for(|phase| *phase >= wanted).await.is_err() {
            std::future::pending().await // the controller was dropped, so the phase never changes again
        }
    }
}
