//! Connections to one or several servers.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::runtime::{Builder, Runtime};
use tokio::sync::oneshot;

use perturb_protocol::names::EnvironmentName;
use perturb_protocol::{
    Address, ClientError, Connection, PrivateServer, ResolvedAddresses, Timeouts, connect, connect_any, resolve,
};
use perturb_settings::Common;

use super::options::{ActorLocation, ServerWait};
use crate::proto;

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
    /// Those of [`PrivateServer::start_with_tasks`] and of [`Servers::connect`].
    pub fn local(workers: Option<usize>, tasks: &[PathBuf]) -> Result<Self, ClientError> {
        let server = PrivateServer::start_with_tasks(workers, tasks)?;
        let mut servers = Self::connect(std::slice::from_ref(server.address()))?;
        servers.local = Some(Mutex::new(server));
        Ok(servers)
    }

    /// Connects to every server of `addresses`, at least one. The servers share each batch. A name that resolves to several
    /// machines counts as one server: any of them. Proxy settings are ignored.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if one does not answer within some seconds, or is shutting down.
    pub fn connect(addresses: &[Address]) -> Result<Self, ClientError> {
        let runtime = runtime()?;
        let connections = addresses.iter().map(|address| runtime.block_on(one(address))).collect::<Result<_, _>>()?;
        Ok(Self { named: addresses.to_vec(), ..Self::new(connections, runtime) })
    }

    fn new(connections: Vec<Connection>, runtime: Runtime) -> Self {
        let named = connections.iter().map(|connection| connection.address().clone()).collect();
        let act = ActorLocation::default();
        let wait = ServerWait::default();
        Self { connections: Mutex::new(connections), runtime, local: None, named, act, wait }
    }

    /// Connects again to the servers that answer, at least one. Returns the errors of the others. A private server is started
    /// again.
    ///
    /// # Errors
    /// The errors of all servers, if none answers.
    pub(super) async fn reconnect(&self) -> Result<Vec<ClientError>, ClientError> {
        if let Some(local) = &self.local {
            local.lock().unwrap_or_else(PoisonError::into_inner).restart()?;
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

    /// Connects to one server of `addresses`, where every machine that a name resolves to counts: to number `turn`, modulo
    /// their number, or to the next one that takes sessions. Callers with successive turns are spread evenly.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if there is only one and it does not take sessions, [`ClientError::NoneConnects`] if none
    /// of several does.
    pub fn connect_to_one(addresses: &[Address], turn: usize) -> Result<Self, ClientError> {
        let runtime = runtime()?;
        let connection = runtime.block_on(async {
            let (all, mut errors) = all_machines(addresses).await;
            match connect_any(&all.into_order(turn), Timeouts::default()).await {
                Ok(connection) => Ok(connection),
                Err(others) => {
                    errors.extend(others);
                    Err(ClientError::from_all(errors))
                }
            }
        })?;
        Ok(Self::new(vec![connection], runtime))
    }

    /// Connects to all servers of `addresses` that take sessions, where every machine that a name resolves to counts. Returns
    /// the errors of the others.
    ///
    /// # Errors
    /// Those of [`Servers::connect_to_one`].
    pub fn connect_to_some(addresses: &[Address]) -> Result<(Self, Vec<ClientError>), ClientError> {
        let runtime = runtime()?;
        let (connections, errors) = runtime.block_on(async {
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
            (connections, errors)
        });
        if connections.is_empty() {
            return Err(ClientError::from_all(errors));
        }
        Ok((Self::new(connections, runtime), errors))
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

    /// The runtime that drives the connections.
    pub(super) fn runtime(&self) -> &Runtime {
        &self.runtime
    }

    /// Runs `work`, which may take long, on this thread. Meanwhile another thread answers the servers' keepalive pings.
    /// Otherwise the connections are driven only while a request waits, and a server drops its sessions after its
    /// `--keepalive-seconds`.
    pub fn keep_alive_during<T>(&self, work: impl FnOnce() -> T) -> T {
        let (done, end) = oneshot::channel::<()>();
        let runtime = &self.runtime;
        std::thread::scope(|scope| {
            // Ends when `done` is dropped, by the line below or by a panic in `work`.
            scope.spawn(move || drop(runtime.block_on(end)));
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
        self.runtime.block_on(connection.catalogue()).map_err(|error| self.explain(error))
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
                let hashes = [environment.model_hash, got.model_hash];
                return Err(ClientError::Models { first, other, environment: name, hashes });
            }
            return Err(ClientError::Disagreement { first, other, environment: name });
        }
        Ok(environment)
    }

    /// The environment as a training's policy sees it.
    ///
    /// # Errors
    /// Those of [`Servers::environment`]; [`ClientError::NoParameters`] if it sees parameters and the servers cannot
    /// tell them.
    pub fn environment_seen(&self, common: &Common) -> Result<proto::Environment, ClientError> {
        let environment = self.environment(&common.environment)?;
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

/// Connects to the server at `address`.
async fn one(address: &Address) -> Result<Connection, ClientError> {
    connect(address, Timeouts::default()).await
}
