//! Connections to one or more servers.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::runtime::{Builder, Runtime};
use tokio::sync::oneshot;

use perturb_files::interrupt::StopFlag;
use perturb_protocol::names::EnvironmentName;
use perturb_protocol::{
    Address, ClientError, Connection, PrivateServer, ResolvedAddresses, Timeouts, connect, connect_any, resolve,
};
use perturb_settings::Common;

use super::options::{ActorLocation, ServerWait};
use crate::proto;

/// Timeout of sign-of-life requests. After a stop signal, this program waits for pending replies only while every
/// server answers these requests in time.
const LIFE_SIGN_TIMEOUT: Duration = Duration::from_secs(1);
/// Pause before each sign-of-life request after a stop signal.
const LIFE_SIGN_INTERVAL: Duration = Duration::from_millis(500);

/// Connections to one or more servers that serve the same environments.
#[derive(Debug)]
pub struct Servers {
    // Fields are dropped in this order: the connections, the runtime that drives them, the private server.
    connections: Mutex<Vec<Connection>>,
    runtime: Runtime,
    local: Option<Mutex<PrivateServer>>,
    /// Addresses to which lost connections are reopened.
    named: Vec<Address>,
    act: ActorLocation,
    wait: ServerWait,
    stop: StopFlag,
    /// Whether a server did not respond after a stop signal. If so, no call waits for servers any more.
    has_given_up: AtomicBool,
}

impl Servers {
    /// Sets where actions are chosen.
    pub fn with_act(self, act: ActorLocation) -> Self {
        Self { act, ..self }
    }

    /// Sets how long to wait for lost servers.
    pub fn with_wait(self, wait: ServerWait) -> Self {
        Self { wait, ..self }
    }

    /// Returns how long to wait for lost servers.
    pub(super) fn wait(&self) -> ServerWait {
        self.wait
    }

    /// Returns the flag that a stop signal raises.
    pub(crate) fn stop(&self) -> &StopFlag {
        &self.stop
    }

    /// Returns whether the server is a private one, which this process has started. [`Servers::reconnect`] restarts it.
    pub(super) fn is_private(&self) -> bool {
        self.local.is_some()
    }

    /// Returns where actions are chosen.
    pub(super) fn act(&self) -> ActorLocation {
        self.act
    }

    /// Starts a private server with `workers` physics threads (`None` for one per core) and connects to it. The server
    /// also serves the tasks in the folders `tasks`.
    ///
    /// # Errors
    /// The errors of [`PrivateServer::start_unless`] and of [`Servers::connect`].
    pub fn local(workers: Option<usize>, tasks: &[PathBuf], stop: &StopFlag) -> Result<Self, ClientError> {
        let mut server = PrivateServer::start_unless(workers, tasks, &|| stop.signal())?;
        match Self::connect_until(std::slice::from_ref(server.address()), stop) {
            Ok(servers) => Ok(Self { local: Some(Mutex::new(server)), ..servers }),
            Err(error @ ClientError::Stopped { .. }) => {
                server.kill(); // the server does not answer
                Err(error)
            }
            // The user gave no address, so the error does not name the address.
            Err(error) => Err(server.unusable(&match error {
                ClientError::Connect { reason, .. } => reason,
                ClientError::NotPerturb { .. } => "it is not a perturb-server".into(),
                error => error.to_string(),
            })),
        }
    }

    /// Connects to all servers in `addresses`, which must not be empty. Each batch is divided among the servers. A host
    /// name that resolves to several machines counts as one server: only one of the machines is used. Proxy settings
    /// are ignored.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if a server does not answer within some seconds, or is shutting down.
    pub fn connect(addresses: &[Address]) -> Result<Self, ClientError> {
        Self::connect_until(addresses, &StopFlag::default())
    }

    /// Connects like [`Servers::connect`], unless `stop` is raised first. If `stop` is raised later, a request to a
    /// server that does not respond ends within about a second.
    ///
    /// # Errors
    /// The errors of [`Servers::connect`], and [`ClientError::Stopped`] if `stop` is raised first.
    pub fn connect_until(addresses: &[Address], stop: &StopFlag) -> Result<Self, ClientError> {
        let runtime = runtime()?;
        let connections = runtime.block_on(unless_stopped(stop, async {
            let mut connections = Vec::with_capacity(addresses.len());
            for address in addresses {
                connections.push(one(address).await?);
            }
            Ok(connections)
        }))?;
        Ok(Self { named: addresses.to_vec(), ..Self::new(connections, runtime, stop) })
    }

    fn new(connections: Vec<Connection>, runtime: Runtime, stop: &StopFlag) -> Self {
        let named = connections.iter().map(|connection| connection.address().clone()).collect();
        Self {
            connections: Mutex::new(connections),
            runtime,
            local: None,
            named,
            act: ActorLocation::default(),
            wait: ServerWait::default(),
            stop: stop.clone(),
            has_given_up: AtomicBool::new(false),
        }
    }

    /// Reconnects to all servers that answer, and returns the errors of the others. Restarts a private server.
    ///
    /// # Errors
    /// The errors of all servers if none answers.
    pub(super) async fn reconnect(&self) -> Result<Vec<ClientError>, ClientError> {
        if let Some(local) = &self.local {
            local.lock().unwrap_or_else(PoisonError::into_inner).restart(&|| self.stop.signal())?;
        }
        let mut there = Vec::new();
        let mut errors = Vec::new();
        for address in &self.named {
            match one(address).await {
                Ok(connection) => there.push(connection),
                Err(error) => errors.push(error),
            }
        }
        if there.is_empty() {
            return Err(ClientError::from_all(errors));
        }
        *self.locked() = there;
        Ok(errors)
    }

    /// Connects to one of the servers in `addresses`. If a host name resolves to several machines, each counts as a
    /// server. Tries the server with the index `turn` (modulo the number of servers) first, then the next ones until
    /// one accepts sessions. Callers with successive values of `turn` are spread evenly over the servers.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if the only server does not accept sessions, [`ClientError::NoneConnects`] if none of
    /// several does, and [`ClientError::Stopped`] if `stop` is raised first.
    pub fn connect_to_one(addresses: &[Address], turn: usize, stop: &StopFlag) -> Result<Self, ClientError> {
        let runtime = runtime()?;
        let connection = runtime.block_on(unless_stopped(stop, async {
            let (all, mut errors) = all_machines(addresses).await;
            match connect_any(&all.into_order(turn), Timeouts::default()).await {
                Ok(connection) => Ok(connection),
                Err(others) => {
                    errors.extend(others);
                    Err(ClientError::from_all(errors))
                }
            }
        }))?;
        Ok(Self::new(vec![connection], runtime, stop))
    }

    /// Connects to all servers in `addresses` that accept sessions, and returns the errors of the others. If a host
    /// name resolves to several machines, each counts as a server.
    ///
    /// # Errors
    /// The errors of [`Servers::connect_to_one`].
    pub fn connect_to_some(addresses: &[Address], stop: &StopFlag) -> Result<(Self, Vec<ClientError>), ClientError> {
        let runtime = runtime()?;
        let (connections, errors) = runtime.block_on(unless_stopped(stop, async {
            let (all, mut errors) = all_machines(addresses).await;
            let mut connections = Vec::new();
            for address in &all.preferred {
                match Connection::open(address).await {
                    Ok(connection) => connections.push(connection),
                    Err(error) => errors.push(error),
                }
            }
            if connections.is_empty() {
                match connect_any(&all.fallback, Timeouts::default()).await {
                    Ok(connection) => connections.push(connection),
                    Err(others) => errors.extend(others),
                }
            }
            Ok((connections, errors))
        }))?;
        if connections.is_empty() {
            return Err(ClientError::from_all(errors));
        }
        Ok((Self::new(connections, runtime, stop), errors))
    }

    /// Returns the address of each connected server.
    pub fn addresses(&self) -> Vec<Address> {
        self.locked().iter().map(|connection| connection.address().clone()).collect()
    }

    /// Returns all connections, in the order of the addresses.
    pub(super) fn connections(&self) -> Vec<Connection> {
        self.locked().clone()
    }

    /// Locks the list of connections.
    fn locked(&self) -> MutexGuard<'_, Vec<Connection>> {
        self.connections.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Runs `future` to completion on the runtime that drives the connections.
    pub(crate) fn block_on<T>(&self, future: impl Future<Output = T>) -> T {
        self.runtime.block_on(future)
    }

    /// Waits for the reply to a request. After a stop signal, waits only while all servers still respond.
    ///
    /// # Errors
    /// The errors of the request, as changed by [`Servers::explain`], and [`ClientError::Stopped`] if a server does not
    /// respond after a stop signal.
    pub(crate) fn wait_for<T>(&self, request: impl Future<Output = Result<T, ClientError>>) -> Result<T, ClientError> {
        let done = self.block_on(async {
            tokio::select! {
                biased;
                done = request => done,
                silent = self.silent_after_stop() => Err(silent),
            }
        });
        done.map_err(|error| self.explain(error))
    }

    /// Waits for a stop signal, and then until some server does not respond. Returns the error to report.
    async fn silent_after_stop(&self) -> ClientError {
        let signal = self.stop.raised().await;
        loop {
            // The pause comes first, because most requests are answered sooner, and servers limit clients that cancel
            // many calls.
            if !self.has_given_up() {
                tokio::time::sleep(LIFE_SIGN_INTERVAL).await;
            }
            for connection in self.connections() {
                if self.has_given_up() || !connection.is_alive(LIFE_SIGN_TIMEOUT).await {
                    self.has_given_up.store(true, Ordering::Relaxed);
                    if let Some(local) = &self.local {
                        local.lock().unwrap_or_else(PoisonError::into_inner).kill();
                    }
                    let action = format!("waiting for the server at {}, which is silent", connection.address());
                    return ClientError::Stopped { signal, action };
                }
            }
        }
    }

    /// Returns whether a server did not respond after a stop signal, so that no call should wait any more.
    pub(super) fn has_given_up(&self) -> bool {
        self.has_given_up.load(Ordering::Relaxed)
    }

    /// Runs a long computation `work` on this thread, while another thread answers the servers' keepalive pings.
    /// Without this, connections are active only while a request waits, and a server drops its sessions after
    /// `--keepalive-seconds`.
    pub fn keep_alive_during<T>(&self, work: impl FnOnce() -> T) -> T {
        let (done, end) = oneshot::channel::<()>();
        let runtime = &self.runtime;
        std::thread::scope(|scope| {
            // The thread ends when `done` is dropped, by `drop(done)` below or by a panic in `work`.
            let keep_alive = move || drop(runtime.block_on(end));
            if let Err(error) = std::thread::Builder::new().name("keepalive".into()).spawn_scoped(scope, keep_alive) {
                tracing::warn!("connections are not kept alive during an update, because no thread starts: {error}");
            }
            let result = work();
            drop(done);
            result
        })
    }

    /// Returns the catalogue of the first server.
    ///
    /// # Errors
    /// [`ClientError::Lost`] or [`ClientError::TimedOut`] if the server does not answer.
    pub fn catalogue(&self) -> Result<proto::ListEnvironmentsResponse, ClientError> {
        self.connections()
            .first()
            .map_or_else(|| Ok(proto::ListEnvironmentsResponse::default()), |first| self.catalogue_of(first))
    }

    /// Requests the catalogue of one server.
    fn catalogue_of(&self, connection: &Connection) -> Result<proto::ListEnvironmentsResponse, ClientError> {
        self.wait_for(connection.catalogue())
    }

    /// Returns the entry `name`, in any accepted [spelling](perturb_protocol::names), of the servers' catalogues. The
    /// entry must be the same in all catalogues.
    ///
    /// # Errors
    /// [`ClientError::NoEnvironment`] with the known names, [`ClientError::Models`] or [`ClientError::Disagreement`] if
    /// servers differ, and the errors of [`Servers::catalogue`].
    pub fn environment(&self, name: &str) -> Result<proto::Environment, ClientError> {
        let connections = self.connections();
        let Some((first, others)) = connections.split_first() else {
            return Err(ClientError::System {
                action: "ask for an environment",
                source: ErrorKind::NotConnected.into(),
            });
        };
        let environment = self.environment_of(first, name)?;
        for other in others {
            let got = self.environment_of(other, name)?;
            if got == environment {
                continue;
            }
            let first = first.address().clone();
            let other = other.address().clone();
            let name = environment.name;
            if got.model_hash != environment.model_hash {
                let hashes = Box::new([environment.model_hash, got.model_hash]);
                return Err(ClientError::Models { first, other, environment: name, hashes });
            }
            return Err(ClientError::Disagreement { first, other, environment: name });
        }
        Ok(environment)
    }

    /// Returns the environment of a training as its policy sees it: if the policy observes parameters, they are part of
    /// the environment's observations.
    ///
    /// # Errors
    /// The errors of [`Servers::environment`], and [`ClientError::NoParameters`] if the policy observes parameters but
    /// the servers do not support this.
    pub fn environment_seen(&self, common: &Common) -> Result<proto::Environment, ClientError> {
        self.environment_seen_with(common, std::iter::empty())
    }

    /// Returns the environment like [`Servers::environment_seen`]. If one of the parameters in `names` is a
    /// disturbance, the result also lists the disturbances as parameters.
    ///
    /// # Errors
    /// The errors of [`Servers::environment_seen`].
    pub fn environment_seen_with<'a>(
        &self,
        common: &'a Common,
        names: impl Iterator<Item = &'a str>,
    ) -> Result<proto::Environment, ClientError> {
        let environment = self.environment(&common.environment)?;
        let environment = environment.with_parameters(common.parameter_names().chain(names));
        let sees = common.observe.sees_parameters();
        match self.connections().first() {
            Some(first) if sees && environment.parameter_observations.is_empty() => {
                Err(ClientError::NoParameters { address: first.address().clone() })
            }
            _ => Ok(environment.observed(sees)),
        }
    }

    /// Returns the entry `name` of one server's catalogue.
    fn environment_of(&self, connection: &Connection, name: &str) -> Result<proto::Environment, ClientError> {
        let catalogue = self.catalogue_of(connection)?.environments;
        let known = catalogue.iter().map(|environment| (environment.name.as_str(), environment.revision));
        let place = EnvironmentName::new(name).find(known)?;
        Ok(catalogue[place].clone())
    }

    /// If `error` is a lost stream because the private server has ended, replaces its reason by the server's exit
    /// status.
    pub(super) fn explain(&self, error: ClientError) -> ClientError {
        let (ClientError::Lost { address, request, code, .. }, Some(server)) = (&error, &self.local) else {
            return error;
        };
        // The connection may break shortly before the exit status is available.
        std::thread::sleep(Duration::from_millis(50));
        let Some(status) = server.lock().ok().and_then(|mut server| server.exit_status()) else { return error };
        let reason = format!("the private server ended with {status}");
        ClientError::Lost { address: address.clone(), request, code: *code, reason }
    }
}

/// Creates the runtime that drives connections on the thread of the caller.
fn runtime() -> Result<Runtime, ClientError> {
    Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|source| ClientError::System { action: "start the network runtime", source })
}

/// Resolves all addresses. Returns the machines, and the errors of host names that do not resolve.
async fn all_machines(addresses: &[Address]) -> (ResolvedAddresses, Vec<ClientError>) {
    let mut all = ResolvedAddresses::default();
    let mut errors = Vec::new();
    for address in addresses {
        match resolve(address).await {
            Ok(found) => all.extend(found),
            Err(error) => errors.push(error),
        }
    }
    (all, errors)
}

/// Runs `connecting` until it completes or `stop` is raised.
async fn unless_stopped<T>(
    stop: &StopFlag,
    connecting: impl Future<Output = Result<T, ClientError>>,
) -> Result<T, ClientError> {
    tokio::select! {
        biased;
        done = connecting => done,
        signal = stop.raised() => Err(ClientError::Stopped { signal, action: "connecting".into() }),
    }
}

/// Connects to the server at `address`.
async fn one(address: &Address) -> Result<Connection, ClientError> {
    connect(address, Timeouts::default()).await
}
