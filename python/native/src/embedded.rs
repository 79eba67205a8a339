//! The embedded server: runs the pool and the session handler of `perturb-server` in this process.

use std::collections::VecDeque;
use std::future::{Future, poll_fn};
use std::path::PathBuf;
use std::pin::{Pin, pin};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::task::{Context, Poll, Waker};

use perturb::env::Catalogue;
use perturb::server::embedded as server;
use perturb::tasks;
#[cfg(feature = "mujoco")]
use perturb::tasks::folder::{self, LoadError};
use perturb_protocol::proto::{self, SessionRequest, SessionResponse, session_response::Response};
use perturb_protocol::{AdaptiveSpin, TypedRequest, escape_lines};
use pyo3::prelude::*;
use tonic::Status;

use crate::failure::{INVALID, LOST, MISMATCH, REFUSED, RequestFailure, UNREACHABLE, failure};

/// A task folder as a Python tuple: the path of `perturb-server`, the path of the folder, and the digest of its files.
type TaskFolderTuple = (PathBuf, PathBuf, String);

/// For each loaded task folder: its path, the digest of its files, and a catalogue that contains its task. A task stays
/// in memory until the process ends, so each folder is loaded only once.
#[cfg(feature = "mujoco")]
static LOADED: Mutex<Vec<((PathBuf, String), Catalogue)>> = Mutex::new(Vec::new());

#[cfg(feature = "mujoco")]
fn catalogue_with((program, path, digest): TaskFolderTuple) -> PyResult<Catalogue> {
    let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
    let key = (path, digest);
    if let Some((_, catalogue)) = loaded.iter().find(|(other, _)| *other == key) {
        return Ok(catalogue.clone());
    }
    let refused = |error: LoadError| failure(INVALID, 0, error.to_string());
    folder::child::check(&program, &key.0, false).map_err(refused)?;
    let catalogue = tasks::catalogue_with(std::slice::from_ref(&key.0)).map_err(refused)?;
    loaded.push((key, catalogue.clone()));
    Ok(catalogue)
}

#[cfg(not(feature = "mujoco"))]
fn catalogue_with(_: TaskFolderTuple) -> PyResult<Catalogue> {
    Err(failure(INVALID, 0, "this package was built without MuJoCo, which task= needs here: leave server= out"))
}

/// The embedded server as a Python class.
#[pyclass(frozen, module = "perturb._native")]
pub struct NativeServer {
    /// `None` after [`close`](Self::close).
    server: Mutex<Option<Arc<server::EmbeddedServer>>>,
    /// The process that started the server.
    owner: u32,
}

#[pymethods]
impl NativeServer {
    /// Starts the server's threads. If `task` is given, the server also serves that task folder. A separate
    /// `perturb-server` process loads the task first, because a broken model can kill the process that loads it.
    #[new]
    #[pyo3(signature = (task = None))]
    fn new(py: Python<'_>, task: Option<TaskFolderTuple>) -> PyResult<Self> {
        let server = py.detach(|| {
            let catalogue = task.map_or_else(|| Ok(tasks::catalogue()), catalogue_with)?;
            server::EmbeddedServer::start(catalogue).map_err(|error| failure(UNREACHABLE, 0, error.to_string()))
        })?;
        Ok(Self { server: Mutex::new(Some(Arc::new(server))), owner: std::process::id() })
    }

    /// Ends the server's threads. The caller must close all sessions of the server first, because an open session keeps
    /// the threads running.
    fn close(&self, py: Python<'_>) {
        if std::process::id() == self.owner {
            let server = self.server.lock().unwrap_or_else(PoisonError::into_inner).take();
            py.detach(|| drop(server));
        }
    }
}

impl NativeServer {
    /// Returns a weak reference, which does not keep the server alive.
    pub fn handle(&self) -> Weak<server::EmbeddedServer> {
        self.server.lock().unwrap_or_else(PoisonError::into_inner).as_ref().map(Arc::downgrade).unwrap_or_default()
    }
}

impl Drop for NativeServer {
    fn drop(&mut self) {
        if std::process::id() != self.owner {
            // Dropping the server waits for its threads. A forked process does not have these threads, so it leaks the
            // server instead.
            std::mem::forget(self.server.get_mut().unwrap_or_else(PoisonError::into_inner).take());
        }
    }
}

/// The answer to a request: a response, or the status that ends the session.
type Answer = Result<SessionResponse, Status>;
/// The future of a running step. It owns the session, and returns it with the answer.
type StepUnderWay = Pin<Box<dyn Future<Output = (server::EmbeddedSession, Answer)> + Send>>;

/// A session of the embedded server. Steps may be sent before earlier replies are received. Replies come in the order
/// of the requests.
pub struct EmbeddedStream {
    /// `None` while a step is running.
    session: Option<server::EmbeddedSession>,
    running: Option<StepUnderWay>,
    /// A function that queues one step in the pool, behind the running step. `None` if no step is running, if the next
    /// step must wait, or after the function was called.
    offer: Option<Box<dyn FnOnce(SessionRequest) + Send>>,
    /// Steps that wait until the running one has finished.
    waiting: VecDeque<SessionRequest>,
    /// Answers to steps that have finished, until [`receive`](Self::receive) takes them.
    answers: VecDeque<Answer>,
    /// Decides whether this thread spins or blocks while the server's workers run a step.
    spin: AdaptiveSpin,
}

impl EmbeddedStream {
    /// Begins a session.
    ///
    /// # Errors
    /// If the server was closed.
    pub fn new(server: &Weak<server::EmbeddedServer>) -> PyResult<Self> {
        let server = server.upgrade().ok_or_else(|| failure(UNREACHABLE, 0, "the embedded server was closed"))?;
        let session = Some(server.session());
        Ok(Self {
            session,
            running: None,
            offer: None,
            waiting: VecDeque::new(),
            answers: VecDeque::new(),
            spin: AdaptiveSpin::default(),
        })
    }

    /// Sends a request and waits for its reply. `None` sends nothing, and waits for the oldest reply to a step that
    /// [`send`](Self::send) sent.
    ///
    /// # Errors
    /// [`RequestFailure`].
    pub async fn exchange<A: TypedRequest>(&mut self, request: Option<A>) -> Result<A::Reply, RequestFailure> {
        match request {
            Some(request) => self.ask(request).await,
            None => self.receive::<A>().await,
        }
    }

    /// Sends a request and waits for its reply. The replies to all earlier steps must have been received.
    ///
    /// # Errors
    /// [`RequestFailure`].
    pub async fn ask<A: TypedRequest>(&mut self, request: A) -> Result<A::Reply, RequestFailure> {
        let session = self.session.as_mut().ok_or_else(defect)?;
        let mut answer = pin!(session.answer(SessionRequest { request: Some(request.into()) }));
        let now = poll_fn(|context| Poll::Ready(answer.as_mut().poll(context))).await;
        reply::<A>(match now {
            Poll::Ready(answer) => answer,
            Poll::Pending => self.spin.until(answer).await,
        })
    }

    /// Begins a step, or queues it behind the steps that were sent before. Must be called in the context of a tokio
    /// runtime.
    pub fn send(&mut self, step: proto::Step) {
        let request = SessionRequest { request: Some(step.into()) };
        self.waiting.push_back(request);
        self.offer_next();
        self.advance();
    }

    /// Waits for the oldest reply to a step that was sent.
    ///
    /// # Errors
    /// [`RequestFailure`].
    async fn receive<A: TypedRequest>(&mut self) -> Result<A::Reply, RequestFailure> {
        if let Some(answer) = self.answers.pop_front() {
            return reply::<A>(answer);
        }
        let running = self.running.as_mut().ok_or_else(defect)?;
        let (session, answer) = self.spin.until(running).await;
        (self.session, self.running, self.offer) = (Some(session), None, None);
        self.advance();
        reply::<A>(answer)
    }

    /// Starts the steps in `waiting` in order, until a step is still running after its first poll.
    fn advance(&mut self) {
        while self.running.is_none() {
            let Some(request) = self.waiting.pop_front() else { return };
            let Some(mut session) = self.session.take() else { return };
            self.offer = session.pipeline(&request).map(|offer| Box::new(offer) as Box<_>);
            let mut running: StepUnderWay = Box::pin(async move {
                let answer = session.answer(request).await;
                (session, answer)
            });
            match poll_once(running.as_mut()) {
                Some((session, answer)) => {
                    (self.session, self.offer) = (Some(session), None);
                    self.answers.push_back(answer);
                }
                None => {
                    self.running = Some(running);
                    self.offer_next();
                }
            }
        }
    }

    /// Queues the next step in the pool, so that it begins as soon as the running step ends.
    fn offer_next(&mut self) {
        if let Some(next) = self.waiting.front()
            && let Some(offer) = self.offer.take()
        {
            offer(next.clone()); // a cheap clone, which shares the bytes of the actions
        }
    }
}

fn reply<A: TypedRequest>(answer: Answer) -> Result<A::Reply, RequestFailure> {
    match answer.map(|answer| answer.response) {
        Ok(Some(Response::Error(proto::Error { code, message }))) => {
            Err(RequestFailure::Refused(failure(REFUSED, code, escape_lines(&message))))
        }
        Ok(Some(response)) => A::reply(response).map_err(|other| RequestFailure::Ended(failure(MISMATCH, 0, other))),
        Ok(None) => Err(RequestFailure::Ended(failure(MISMATCH, 0, "an empty reply"))),
        Err(status) => Err(RequestFailure::Ended(failure(LOST, status.code() as i32, escape_lines(status.message())))),
    }
}

/// Returns the failure for a call that is not possible in the stream's present state, such as receiving a reply while
/// no step is running. Such a call is a bug in this module.
fn defect() -> RequestFailure {
    RequestFailure::Ended(failure(MISMATCH, 0, "no session: a defect of the native module"))
}

/// Polls a future once, and returns its output if it is ready. Works outside an async runtime, unless the future itself
/// needs one.
pub fn poll_once<T>(future: Pin<&mut (dyn Future<Output = T> + Send + '_)>) -> Option<T> {
    match future.poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(output) => Some(output),
        Poll::Pending => None,
    }
}
