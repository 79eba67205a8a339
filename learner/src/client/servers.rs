//! Connections to one or several servers.

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

/// Time in which a server must show that it is alive after this program was asked to end. As long as a server is alive, its
/// reply is waited for.
const LIFE_SIGN_TIMEOUT: Duration = Duration::from_secs(1);
/// Time for which a reply is waited for before its server must show that it is alive.
const LIFE_SIGN_INTERVAL: Duration = Duration::from_millis(500);

/// Connections to servers, all of which serve the same environments.
#[derive(Debug)]
pub struct Servers {
    // Dropped in this order: connections, the runtime that drives them, the server.
    connections: Mutex<Vec<Connection>>,
    runtime: Runtime,
    local: Option<Mutex<PrivateServer>>,
    /// Addresses at which lost servers are looked for.
    named: Vec<Address>,
    act: ActorLocation,
    wait: ServerWait,
    stop: StopFlag,
    /// Set when the program was asked to end and a server did not answer: nothing is waited for any more.
    has_given_up: AtomicBool,
}

impl Servers {
    /// Sets the place where actions are chosen.
    pub fn with_act(self, act: ActorLocation) -> Self {
        Self { act, ..self }
    }

    /// Sets the wait for servers that are lost.
    pub fn with_wait(self, wait: ServerWait) -> Self {
        Self { wait, ..self }
    }

    /// The wait for servers that are lost.
    pub(super) fn wait(&self) -> ServerWait {
        self.wait
    }

    /// The flag that is raised when the program is asked to end.
    pub(crate) fn stop(&self) -> &StopFlag {
        &self.stop
    }

    /// Whether the server is a private one of this process, which [`Servers::reconnect`] starts again.
    pub(super) fn is_private(&self) -> bool {
        self.local.is_some()
    }

    /// The place where actions are chosen.
    pub(super) fn act(&self) -> ActorLocation {
        self.act
    }

    /// Starts a private server with `workers` physics threads (`None`: one a core) that also serves the tasks in the folders
    /// `tasks`, and connects to it.
    ///
    /// # Errors
    /// The errors of [`PrivateServer::start_unless`] and of [`Servers::connect`].
    pub fn local(workers: Option<usize>, tasks: &[PathBuf], stop: &StopFlag) -> Result<Self, ClientError> {
        let mut server = PrivateServer::start_unless(workers, tasks, &|| stop.signal())?;
        match Self::connect_until(std::slice::from_ref(server.address()), stop) {
            Ok(servers) => Ok(Self { local: Some(Mutex::new(server)), ..servers }),
            Err(error @ ClientError::Stopped { .. }) => {
                server.kill(); // it does not answer
                Err(error)
            }
            // The user gave no address, so an error that names the address would not help.
            Err(error) => Err(server.unusable(&match error {
                ClientError::Connect { reason, .. } => reason,
                ClientError::NotPerturb { .. } => "it is no perturb-server".into(),
                error => error.to_string(),
            })),
        }
    }

    /// Connects to every server of `addresses`, at least one. The servers share each batch. A name that resolves to several
    /// machines counts as one server: any of them. Proxy settings are ignored.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if one does not answer within some seconds, or is shutting down.
    pub fn connect(addresses: &[Address]) -> Result<Self, ClientError> {
        Self::connect_until(addresses, &StopFlag::default())
    }

    /// Connects as [`Servers::connect`] does, unless `stop` is raised first. When it is raised later, a request to a server
    /// that gives no sign of life ends within about a second.
    ///
    /// # Errors
    /// The errors of [`Servers::connect`], and [`ClientError::Stopped`].
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

    /// Connects again to the servers that answer, at least one. Returns the errors of the others. A private server is started
    /// again.
    ///
    /// # Errors
    /// The errors of all servers, if none answers.
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

    /// Connects to one server of `addresses`. Every machine that a name resolves to counts as a server. Tries number
    /// `turn`, modulo the number of servers, first, then the next ones until one takes sessions. Callers with successive
    /// turns are spread evenly.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if there is only one and it does not take sessions, [`ClientError::NoneConnects`] if none
    /// of several does, [`ClientError::Stopped`] if `stop` is raised first.
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

    /// Connects to all servers of `addresses` that take sessions. Every machine that a name resolves to counts as a server.
    /// Returns the errors of the others.
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

    /// The addresses of the servers, one for each connection.
    pub fn addresses(&self) -> Vec<Address> {
        self.locked().iter().map(|connection| connection.address().clone()).collect()
    }

    /// The connections, in the order of their addresses.
    pub(super) fn connections(&self) -> Vec<Connection> {
        self.locked().clone()
    }

    fn locked(&self) -> MutexGuard<'_, Vec<Connection>> {
        self.connections.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Runs `future` on the runtime that drives the connections, and waits for it.
    pub(crate) fn block_on<T>(&self, future: impl Future<Output = T>) -> T {
        self.runtime.block_on(future)
    }

    /// Waits for a request. After the program was asked to end, it waits only for servers that give signs of life.
    ///
    /// # Errors
    /// Those of the request, [explained](Servers::explain); [`ClientError::Stopped`] if a server then gives no sign of
    /// life.
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

    /// Waits until the program was asked to end and a server gives no sign of life.
    async fn silent_after_stop(&self) -> ClientError {
        let signal = self.stop.raised().await;
        loop {
            // Most requests are answered sooner, and servers mistrust clients that cancel many calls.
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

    /// Whether the program was asked to end and a server was silent: nothing more is waited for then.
    pub(super) fn has_given_up(&self) -> bool {
        self.has_given_up.load(Ordering::Relaxed)
    }

    /// Runs `work`, which may take long, on this thread. Meanwhile another thread answers the servers' keepalive pings.
    /// Otherwise the connections are driven only while a request waits, and a server drops its sessions after its
    /// `--keepalive-seconds`.
    pub fn keep_alive_during<T>(&self, work: impl FnOnce() -> T) -> T {
        let (done, end) = oneshot::channel::<()>();
        let runtime = &self.runtime;
        std::thread::scope(|scope| {
            // Ends when `done` is dropped, by the line below or by a panic in `work`.
            let keep_alive = move || drop(runtime.block_on(end));
            if let Err(error) = std::thread::Builder::new().name("keepalive".into()).spawn_scoped(scope, keep_alive) {
                tracing::warn!("connections are not kept alive during an update, because no thread starts: {error}");
            }
            let result = work();
            drop(done);
            result
        })
    }

    /// The catalogue of the first server.
    ///
    /// # Errors
    /// [`ClientError::Lost`] or [`ClientError::TimedOut`].
    pub fn catalogue(&self) -> Result<proto::ListEnvironmentsResponse, ClientError> {
        self.connections()
            .first()
            .map_or_else(|| Ok(proto::ListEnvironmentsResponse::default()), |first| self.catalogue_of(first))
    }

    fn catalogue_of(&self, connection: &Connection) -> Result<proto::ListEnvironmentsResponse, ClientError> {
        self.wait_for(connection.catalogue())
    }

    /// The entry `name` of the catalogues, in any [spelling](perturb_protocol::names). It must be the same in all of them.
    ///
    /// # Errors
    /// [`ClientError::NoEnvironment`] with the names that there are, [`ClientError::Models`], [`ClientError::Disagreement`],
    /// and those of [`Servers::catalogue`].
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

    /// The environment as a training's policy sees it: with the parameters in its observations, if the policy sees
    /// parameters.
    ///
    /// # Errors
    /// The errors of [`Servers::environment`]; [`ClientError::NoParameters`] if it sees parameters and the servers
    /// cannot tell them.
    pub fn environment_seen(&self, common: &Common) -> Result<proto::Environment, ClientError> {
        self.environment_seen_with(common, std::iter::empty())
    }

    /// The environment as [`Servers::environment_seen`] gives it. It has its disturbances, too, if one of `names` is a
    /// disturbance.
    ///
    /// # Errors
    /// The errors of [`Servers::environment_seen`].
    pub fn environment_seen_with<'a>(
        &self,
        common: &'a Common,
        names: impl Iterator<Item = &'a str>,
    ) -> Result<proto::Environment, ClientError> {
        let environment = self.environment(&common.environment)?;
        let trained = common.parameters.keys().map(String::as_str);
        let environment = environment.with_parameters(trained.chain(names));
        let sees = common.observe.sees_parameters();
        match self.connections().first() {
            Some(first) if sees && environment.parameter_observations.is_empty() => {
                Err(ClientError::NoParameters { address: first.address().clone() })
            }
            _ => Ok(environment.observed(sees)),
        }
    }

    fn environment_of(&self, connection: &Connection, name: &str) -> Result<proto::Environment, ClientError> {
        let catalogue = self.catalogue_of(connection)?.environments;
        let known = catalogue.iter().map(|environment| (environment.name.as_str(), environment.revision));
        let place = EnvironmentName::new(name).find(known)?;
        Ok(catalogue[place].clone())
    }

    /// Adds the exit status of the private server to an error, if the server ended and a stream was lost with it.
    pub(super) fn explain(&self, error: ClientError) -> ClientError {
        let (ClientError::Lost { address, request, code, .. }, Some(server)) = (&error, &self.local) else {
            return error;
        };
        // The connection may break a moment before the process can be waited for.
        std::thread::sleep(Duration::from_millis(50));
        let Some(status) = server.lock().ok().and_then(|mut server| server.exit_status()) else { return error };
        let reason = format!("the private server ended with {status}");
        ClientError::Lost { address: address.clone(), request, code: *code, reason }
    }
}

fn runtime() -> Result<Runtime, ClientError> {
    Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|source| ClientError::System { action: "start the network runtime", source })
}

/// The machines of all addresses, and the errors of names that do not resolve.
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

/// Waits for `connecting` until `stop` is raised.
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
