//! The Python class of a session. Its methods raise a [`Failure`](crate::failure::Failure), or the error of a signal's
//! handler.
//!
//! - [`exchange`]: ownership of the session by one thread, requests and replies.
//! - [`transport`]: the gRPC stream, or the embedded server.
//! - [`opened`]: the reply to opening the session.

mod exchange;
mod opened;
mod transport;

use std::ops::Range;
use std::pin::pin;
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use numpy::{PyArray1, PyArray2, PyArray3};
use perturb_protocol::proto;
use perturb_protocol::{Address, ClientError, Timeouts, check_observations, check_step, connect, snapshot_parts};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::arrays;
use crate::embedded::poll_once;
use crate::failure::{self, INVALID, MALFORMED, RequestFailure, UNREACHABLE, UNUSABLE, failure, malformed};
use crate::infos::{Events, InfoKeys};
use crate::requests::{self, Actions, IntervalsByName};
use crate::session_runtime::{CloseSignal, SessionRuntime};
use exchange::{BusyGuard, FORKS, OpenSession, SessionState, duration, explain, unpoisoned};
use transport::SessionServer;

pub use exchange::note_fork;
pub use opened::PythonOpened;
pub use transport::NamedServer;

/// Maximum number of steps that were sent and whose reply was not received yet. It bounds the memory of stored replies.
const MAX_STEPS_UNDER_WAY: usize = 64;
/// The outcome of a step: observations, rewards, terminated flags, truncated flags, and episodes that began or ended.
type StepArrays<'py> = (
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray1<bool>>,
    Bound<'py, PyArray1<bool>>,
    Option<Events>,
);

/// The outcome of a step of a single environment: observation, reward, terminated flag, truncated flag, and info.
type SingleStep<'py> = (Bound<'py, PyArray1<f32>>, f64, bool, bool, Bound<'py, PyDict>);

/// A session with a server. It owns a batch of environments.
#[pyclass(frozen, name = "Session", module = "perturb._native")]
pub struct PythonSession {
    server: SessionServer,
    /// Maximum time to wait for a reply; `None` for no limit.
    timeout: Mutex<Option<Duration>>,
    actions: Actions,
    /// Number O of values in an observation.
    observation_size: usize,
    /// Id of the process that made the session.
    owner: u32,
    /// The number of forks, [`FORKS`], when the session was made.
    forks: u32,
    closing: Arc<CloseSignal>,
    state: Mutex<SessionState>,
    last: Mutex<LastStep>,
    /// An upper bound of the length of one snapshot, bytes; 0 from older servers.
    snapshot_bytes: AtomicUsize,
    /// Whether the server restored a snapshot into an environment.
    restored: AtomicBool,
}

/// The observations and flags of a batch after the last reply. They are copies, because Python may change its arrays.
#[derive(Default)]
struct LastStep {
    /// The last observations, float32 `[N, O]`. They complete the observations of a request that resets or restores
    /// only some environments.
    observations: Bytes,
    /// Flags `[N]` of environments whose episode was terminated in the last step and that were not reset or restored
    /// since. Empty before the first step, and after a reset or restore of all environments.
    terminated: Bytes,
    /// The flags for truncated episodes, like `terminated`.
    truncated: Bytes,
}

#[pymethods]
impl PythonSession {
    /// Makes a session with the server at an address, or with the embedded server. [`open`](Self::open) connects to it.
    /// `timeout` is the maximum time to wait for a reply. `keepalive` is the interval of keepalive pings and the
    /// maximum time to wait for their answer. Times are in seconds, and may be infinite. `action_size` is None for
    /// discrete actions. Actions of a `single` environment have no batch axis.
    #[new]
    #[pyo3(signature = (server, timeout, keepalive, num_envs, observation_size, action_size, single))]
    fn new(
        server: NamedServer<'_>,
        timeout: f64,
        keepalive: (f64, f64),
        num_envs: usize,
        observation_size: usize,
        action_size: Option<usize>,
        single: bool,
    ) -> PyResult<Self> {
        let forever = |seconds| duration(seconds).unwrap_or(Duration::MAX);
        let timeouts = Timeouts {
            reply: Duration::MAX, // `timeout` limits each wait, because it can be changed later
            keepalive_interval: forever(keepalive.0),
            keepalive_limit: forever(keepalive.1),
        };
        Ok(Self {
            server: SessionServer::new(&server, timeouts)?,
            timeout: Mutex::new(duration(timeout)),
            actions: Actions { num_envs, size: action_size, single },
            observation_size,
            owner: std::process::id(),
            forks: FORKS.load(Ordering::Relaxed),
            closing: Arc::default(),
            state: Mutex::new(SessionState::New),
            last: Mutex::default(),
            snapshot_bytes: AtomicUsize::new(0),
            restored: AtomicBool::new(false),
        })
    }

    /// Sets the maximum time to wait for a reply, s.
    #[setter]
    fn set_timeout(&self, seconds: f64) {
        *unpoisoned(&self.timeout) = duration(seconds);
    }

    /// Whether the server restored a snapshot into an environment. Also true if a restore in several requests failed
    /// after the first of them.
    #[getter]
    fn restored(&self) -> bool {
        self.restored.load(Ordering::Relaxed)
    }

    /// Whether a thread is waiting for a reply.
    #[getter]
    fn waits(&self) -> bool {
        matches!(*self.state(), SessionState::Busy)
    }

    /// Whether the session has ended.
    #[getter]
    fn ended(&self) -> bool {
        self.require_own().is_err() || matches!(*self.state(), SessionState::Ended)
    }

    /// Number of steps that were sent and whose reply was not received yet.
    #[getter]
    fn under_way(&self) -> usize {
        match &*self.state() {
            SessionState::Idle(open) => open.under_way,
            _ => 0,
        }
    }

    /// Returns the mask, bool `[N]`, of environments whose episode ended in the last step and that were not reset or
    /// restored since.
    fn last_ended<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<bool>> {
        let last = unpoisoned(&self.last);
        let mut ended = vec![false; self.actions.num_envs];
        for (ended, (terminated, truncated)) in ended.iter_mut().zip(last.terminated.iter().zip(&last.truncated)) {
            *ended = *terminated != 0 || *truncated != 0;
        }
        PyArray1::from_vec(py, ended)
    }

    /// Connects to the server, creates the environments, and begins their first episodes.
    #[pyo3(signature = (*, environment, version, parameters, seed, first_environment_index, episodes_per_trial, autoreset_mode, receipts, reward_terms, observe_parameters))]
    #[expect(clippy::too_many_arguments, reason = "each is a field of the request, given by its name")]
    fn open(
        &self,
        py: Python<'_>,
        environment: String,
        version: &str,
        parameters: IntervalsByName,
        seed: u64,
        first_environment_index: u32,
        episodes_per_trial: u32,
        autoreset_mode: &str,
        receipts: bool,
        reward_terms: bool,
        observe_parameters: bool,
    ) -> PyResult<PythonOpened> {
        self.require_own()?;
        let n = self.actions.num_envs;
        let request = proto::Open {
            environment,
            version: requests::version(version)?.into(),
            parameters: requests::distributions(parameters),
            batch_size: u32::try_from(n).map_err(|error| failure(INVALID, 0, error.to_string()))?,
            seed,
            first_environment_index,
            episodes_per_trial,
            autoreset_mode: requests::autoreset_mode(autoreset_mode)?.into(),
            receipts,
            reward_terms,
            observe_parameters,
            // Receipts of a batch come as arrays, which are cheaper than a message for each episode. For a single
            // environment, messages are as cheap as arrays.
            receipt_arrays: receipts && !self.actions.single,
            // In particular, the session has no lease, so it cannot be resumed after its connection is lost.
            ..proto::Open::default()
        };
        {
            let mut state = self.state();
            match *state {
                SessionState::New => *state = SessionState::Busy,
                _ => return Err(failure(UNUSABLE, 0, "the session was opened before")),
            }
        }
        let unopened = BusyGuard(self);
        let runtime = SessionRuntime::new().map_err(|error| failure(UNREACHABLE, 0, error.to_string()))?;
        let opening = pin!(self.server.clone().open(request));
        let outcome = runtime.wait(py, opening, self.deadline(), &self.closing).map_err(explain)?;
        let (transport, opened) = outcome.map_err(RequestFailure::into_error)?;
        // An older server ignores `observe_parameters`. Do not check the observations then, because the Python package
        // raises an error with a better message.
        if opened.observes_parameters == observe_parameters {
            check_observations(&opened.observations, n, self.observation_size).map_err(|error| malformed(&error))?;
        }
        let served = opened.environment.unwrap_or_default();
        let labels = Arc::new(InfoKeys::new(py, &served, n));
        let events = Events::begun(&labels, opened.started)?;
        self.snapshot_bytes.store(opened.max_snapshot_reply_bytes as usize / n.max(1), Ordering::Relaxed);
        *unpoisoned(&self.last) = LastStep { observations: opened.observations.clone(), ..LastStep::default() };
        std::mem::forget(unopened);
        self.put_back(py, Box::new(OpenSession { transport, runtime, labels, under_way: 0 }));
        Ok(PythonOpened {
            environment: perturb_protocol::catalogue::environment(&served).to_string(),
            observes_parameters: opened.observes_parameters,
            served: Arc::new(served),
            observations: opened.observations,
            shape: [n, self.observation_size],
            events: Py::new(py, events)?,
        })
    }

    /// Advances every environment by one step. The Python function `encode` converts actions of unusual types to bytes,
    /// or raises an error.
    fn step<'py>(
        &self,
        py: Python<'py>,
        actions: &Bound<'py, PyAny>,
        encode: &Bound<'py, PyAny>,
    ) -> PyResult<StepArrays<'py>> {
        let request = proto::Step { actions: self.actions.encode(actions, encode)? };
        let open = self.take(0)?;
        let (labels, stepped) = self.ask(py, open, request)?;
        self.stepped(py, &labels, stepped)
    }

    /// Advances a single environment by one step. Returns observation `[O]`, reward, terminated and truncated flag, and
    /// info.
    fn step_single<'py>(
        &self,
        py: Python<'py>,
        action: &Bound<'py, PyAny>,
        encode: &Bound<'py, PyAny>,
    ) -> PyResult<SingleStep<'py>> {
        let request = proto::Step { actions: self.actions.encode(action, encode)? };
        let open = self.take(0)?;
        let (labels, stepped) = self.ask(py, open, request)?;
        self.store_step(&stepped)?;
        let observation = arrays::row(py, &stepped.observations, self.observation_size)?;
        let reward = stepped.rewards.as_chunks::<4>().0.first().map_or(f32::NAN, |word| f32::from_le_bytes(*word));
        let flag = |flags: &Bytes| flags.first().is_some_and(|&flag| flag != 0);
        let (terminated, truncated) = (flag(&stepped.terminated), flag(&stepped.truncated));
        let info = match Events::stepped(&labels, stepped, self.observation_size)? {
            Some(events) => events.single(py)?,
            None => PyDict::new(py),
        };
        Ok((observation, reward.into(), terminated, truncated, info))
    }

    /// Sends the actions of a step without waiting for the reply.
    fn send(&self, py: Python<'_>, actions: &Bound<'_, PyAny>, encode: &Bound<'_, PyAny>) -> PyResult<()> {
        let request = proto::Step { actions: self.actions.encode(actions, encode)? };
        let mut open = self.take(MAX_STEPS_UNDER_WAY - 1)?;
        let busy = BusyGuard(self);
        let OpenSession { transport, runtime, under_way, .. } = &mut *open;
        let is_embedded = transport.is_embedded();
        let sent = {
            let mut sending = pin!(transport.send(request));
            match is_embedded.then(|| runtime.now(py, || poll_once(sending.as_mut()))).flatten() {
                Some(sent) => Ok(sent),
                None => runtime.wait(py, sending, self.deadline(), &self.closing),
            }
        };
        match sent {
            Ok(Ok(())) => {
                *under_way += 1;
                if !is_embedded {
                    py.detach(|| runtime.poll_io());
                }
                std::mem::forget(busy);
                self.put_back(py, open);
                Ok(())
            }
            Ok(Err(failed)) => Err(failed.into_error()),
            Err(broken) => Err(explain(broken)),
        }
    }

    /// Waits for the oldest reply to a step that was sent, and returns the outcome of the step.
    fn recv<'py>(&self, py: Python<'py>) -> PyResult<StepArrays<'py>> {
        let open = self.take(MAX_STEPS_UNDER_WAY)?;
        if open.under_way == 0 {
            self.put_back(py, open);
            return Err(failure(UNUSABLE, 0, "no step is under way: send() first"));
        }
        let (labels, stepped) = self.receive::<proto::Step>(py, open)?;
        self.stepped(py, &labels, stepped)
    }

    /// Begins new episodes in the environments that the mask selects. Returns the observations `[N, O]` of all
    /// environments, and the episodes that began. The rows of the other environments are their last observations.
    fn reset<'py>(
        &self,
        py: Python<'py>,
        mask: &[u8],
        seeds: Vec<u64>,
        parameters: IntervalsByName,
        states: &[u8],
    ) -> PyResult<(Bound<'py, PyArray2<f32>>, Events)> {
        let selected = self.selected(mask);
        let request = proto::Reset {
            mask: Bytes::copy_from_slice(mask),
            seeds,
            parameters: requests::distributions(parameters),
            states: Bytes::copy_from_slice(states),
        };
        let open = self.take(0)?;
        let (labels, done) = self.ask(py, open, request)?;
        check_observations(&done.observations, selected, self.observation_size).map_err(|error| malformed(&error))?;
        self.merge(mask, &done.observations);
        let observations = self.last_observations(py)?;
        Ok((observations, Events::begun(&labels, done.started)?))
    }

    /// Saves the environments that the mask selects, one snapshot each. If the snapshots together are too long for one
    /// reply, they are requested in several requests.
    fn snapshot<'py>(&self, py: Python<'py>, mask: &[u8]) -> PyResult<Vec<Bound<'py, PyBytes>>> {
        let length = self.snapshot_bytes.load(Ordering::Relaxed);
        let selected = self.selected(mask);
        let mut snapshots = Vec::with_capacity(selected);
        for part in snapshot_parts((0..selected).map(|_| length)) {
            let expected = part.len();
            let open = self.take(0)?;
            let (_, saved) = self.ask(py, open, proto::Snapshot { mask: self.part_mask(mask, &part, selected) })?;
            let got = saved.snapshots.len();
            if got != expected {
                return Err(failure(MALFORMED, 0, format!("the server sent {got} snapshots; expected {expected}")));
            }
            snapshots.extend(saved.snapshots.iter().map(|snapshot| PyBytes::new(py, snapshot)));
        }
        Ok(snapshots)
    }

    /// Restores snapshots into the environments that the mask selects. Returns the observations `[N, O]` of all
    /// environments. The rows of the other environments are their last observations.
    ///
    /// If the snapshots together are too long for one request, they are sent in several requests. If one of these
    /// requests is refused, the snapshots of the earlier requests stay restored.
    fn restore<'py>(
        &self,
        py: Python<'py>,
        mask: &[u8],
        snapshots: Vec<Vec<u8>>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let snapshots: Vec<Bytes> = snapshots.into_iter().map(Bytes::from).collect();
        let parts = snapshot_parts(snapshots.iter().map(Bytes::len));
        let given = snapshots.len();
        let selected = self.selected(mask);
        if given != selected && parts.len() > 1 {
            let words =
                format!("snapshots has {given} entries, expected {selected}: one for each selected environment");
            return Err(failure(INVALID, 0, words));
        }
        // If the number of snapshots is wrong, send all in one request, so that the server refuses it with its own
        // message.
        let all = 0..given;
        let parts = if given == selected { parts } else { vec![all] };
        for part in parts {
            let mask = self.part_mask(mask, &part, snapshots.len());
            let open = self.take(0)?;
            let request = proto::Restore { mask: mask.clone(), snapshots: snapshots[part].to_vec() };
            let (_, restored) = self.ask(py, open, request)?;
            self.restored.store(true, Ordering::Relaxed);
            // Check only the length of the observations. They may not be finite, because the physics of a snapshot may
            // have diverged.
            arrays::numbers(&restored.observations, &[self.selected(&mask), self.observation_size])?;
            self.merge(&mask, &restored.observations);
        }
        self.last_observations(py)
    }

    /// Draws the environment in a slot. Returns a picture, uint8 `[height, width, 3]`.
    fn render<'py>(&self, py: Python<'py>, slot: u32, width: u32, height: u32) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let open = self.take(0)?;
        let (_, rendered) = self.ask(py, open, proto::Render { slot, width, height })?;
        let size = [height as usize, width as usize, 3];
        let sent = [rendered.height as usize, rendered.width as usize, 3];
        if sent != size || rendered.pixels.len() != size.iter().product::<usize>() {
            let bytes = rendered.pixels.len();
            let words = format!("the server sent a picture {sent:?} in {bytes} bytes; expected {size:?}");
            return Err(failure(MALFORMED, 0, words));
        }
        arrays::picture(py, &rendered.pixels, size)
    }

    /// Answers the server's keepalive pings. Does nothing while a thread waits for a reply, because that thread answers
    /// them.
    fn poll_io(&self, py: Python<'_>) {
        if std::process::id() != self.owner {
            return;
        }
        // Release the GIL before locking the state. Otherwise this thread could hold the lock of the state and wait for
        // the GIL, while another thread holds the GIL and waits for the lock of the state.
        py.detach(|| {
            if let Ok(SessionState::Idle(open)) = self.state.try_lock().as_deref()
                && !open.transport.is_embedded()
            {
                open.runtime.poll_io();
            }
        });
    }

    /// Ends the session. The server then frees its environments. A thread that waits for a reply gets an error.
    fn close(&self, py: Python<'_>) {
        if std::process::id() != self.owner {
            return;
        }
        self.closing.close();
        let mut state = self.state();
        if matches!(*state, SessionState::Busy) {
            return; // the waiting thread ends the session
        }
        if let SessionState::Idle(open) = std::mem::replace(&mut *state, SessionState::Ended) {
            drop(state);
            open.close(py);
        }
    }
}

impl PythonSession {
    /// Replaces the stored observations of the environments that the mask selects by `rows` `[M, O]`. An empty mask
    /// selects all. The caller has checked the length of `rows`.
    fn merge(&self, mask: &[u8], rows: &Bytes) {
        let mut last = unpoisoned(&self.last);
        let width = 4 * self.observation_size;
        if mask.is_empty() || width == 0 {
            *last = LastStep { observations: rows.clone(), ..LastStep::default() };
        } else {
            let mut merged = last.observations.to_vec();
            let selected = mask.iter().zip(merged.chunks_mut(width)).filter(|(selected, _)| **selected != 0);
            selected.zip(rows.chunks(width)).for_each(|((_, old), new)| old.copy_from_slice(new));
            let left = |flags: &Bytes| {
                flags.iter().zip(mask).map(|(&flag, &selected)| if selected == 0 { flag } else { 0 }).collect()
            };
            let (terminated, truncated) = (left(&last.terminated), left(&last.truncated));
            *last = LastStep { observations: merged.into(), terminated, truncated };
        }
    }

    /// Returns the last observations `[N, O]` of all environments.
    fn last_observations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let last = unpoisoned(&self.last);
        arrays::rows(py, &last.observations, self.actions.num_envs, self.observation_size)
    }

    /// Returns a mask `[N]` for one of several requests. `mask` selects n environments, which are numbered from 0. The
    /// request is for the numbers in `part`.
    fn part_mask(&self, mask: &[u8], part: &Range<usize>, n: usize) -> Bytes {
        if part.len() == n {
            return Bytes::copy_from_slice(mask);
        }
        let mut numbers = 0..;
        let mut is_in_part = |slot| {
            let is_selected = mask.is_empty() || mask.get(slot).is_some_and(|&selected| selected != 0);
            is_selected && numbers.next().is_some_and(|number| part.contains(&number))
        };
        (0..self.actions.num_envs).map(|slot| u8::from(is_in_part(slot))).collect()
    }

    /// Checks the reply to a step, and stores the reply's observations and flags in `last`.
    fn store_step(&self, stepped: &proto::Stepped) -> PyResult<()> {
        check_step(stepped, self.actions.num_envs, self.observation_size).map_err(|error| malformed(&error))?;
        *unpoisoned(&self.last) = LastStep {
            observations: stepped.observations.clone(),
            terminated: stepped.terminated.clone(),
            truncated: stepped.truncated.clone(),
        };
        Ok(())
    }

    fn stepped<'py>(
        &self,
        py: Python<'py>,
        labels: &Arc<InfoKeys>,
        stepped: proto::Stepped,
    ) -> PyResult<StepArrays<'py>> {
        let n = self.actions.num_envs;
        self.store_step(&stepped)?;
        Ok((
            arrays::rows(py, &stepped.observations, n, self.observation_size)?,
            arrays::floats(py, &stepped.rewards, n)?,
            arrays::flags(py, &stepped.terminated, n)?,
            arrays::flags(py, &stepped.truncated, n)?,
            Events::stepped(labels, stepped, self.observation_size)?,
        ))
    }
}

/// Requests the catalogue of the server at an address. Returns it as JSON. `timeout` is in seconds.
#[pyfunction]
pub fn catalogue(py: Python<'_>, address: &str, timeout: f64) -> PyResult<String> {
    let address = Address::from_str(address).map_err(|error| failure(INVALID, 0, error.to_string()))?;
    let runtime = SessionRuntime::new().map_err(|error| failure(UNREACHABLE, 0, error.to_string()))?;
    let asking = pin!(async move { connect(&address, Timeouts::default()).await?.catalogue().await });
    let deadline = duration(timeout).and_then(|timeout| Instant::now().checked_add(timeout));
    let outcome: Result<_, ClientError> = runtime.wait(py, asking, deadline, &Arc::default()).map_err(explain)?;
    Ok(perturb_protocol::catalogue::to_json(&outcome.map_err(|error| failure::from_client(&error))?).to_string())
}
