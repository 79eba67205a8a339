//! Connections to one or several servers.

use std::io::ErrorKind;
use std::sync::Mutex;
use std::time::Duration;

use tokio::runtime::{Builder, Runtime};
use tokio::sync::oneshot;
use tonic::transport::Channel;

use super::address::Address;
use super::connect::{Machines, connect, first_of, in_short, machines, own_turn};
use super::error::{ClientError, describe};
use super::local::{LocalServer, LocalServerOptions};
use crate::proto;
use crate::proto::perturb_client::PerturbClient;

/// How long a server may take for one reply; also that of a batch of thousands of environments comes much sooner.
pub(super) const REPLY_LIMIT: Duration = Duration::from_secs(60);
/// Connections to servers, all of which serve the same environments.
#[derive(Debug)]
pub struct Servers {
    // Dropped in this order: connections, the runtime that drives them, the server.
    links: Vec<Link>,
    runtime: Runtime,
    local: Option<Mutex<LocalServer>>,
}

/// A connection.
#[derive(Clone, Debug)]
pub(super) struct Link {
    pub(super) address: Address,
    pub(super) client: PerturbClient<Channel>,
}

impl Servers {
    /// Starts a private server and connects to it.
    ///
    /// # Errors
    /// Those of [`LocalServer::start`] and of [`Servers::connect`].
    pub fn local(options: LocalServerOptions) -> Result<Self, ClientError> {
        let server = LocalServer::start(options)?;
        let mut servers = Self::connect(std::slice::from_ref(server.address()))?;
        servers.local = Some(Mutex::new(server));
        Ok(servers)
    }

    /// Connects to every server of `addresses`, of which there must be at least one, and which share each batch. A name
    /// that stands for several machines counts as one server: any of them. Proxy settings are ignored.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if one does not answer within some seconds, or is shutting down.
    pub fn connect(addresses: &[Address]) -> Result<Self, ClientError> {
        let runtime = runtime()?;
        let one = |address| async move { any_of(address, machines(address).await?.into_order(own_turn())).await };
        let links = addresses.iter().map(|address| runtime.block_on(one(address))).collect::<Result<_, _>>()?;
        Ok(Self { links, runtime, local: None })
    }

    /// Connects to one server of `addresses`, where every machine that a name stands for counts: to number `turn`, counted
    /// around, or to the next one that takes sessions. Whoever has successive turns spreads evenly.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if there is only one and it does not take sessions, [`ClientError::NoneConnects`] if none
    /// of several does.
    pub fn connect_to_one(addresses: &[Address], turn: usize) -> Result<Self, ClientError> {
        let runtime = runtime()?;
        let link = runtime.block_on(async {
            let (all, mut errors) = all_machines(addresses).await;
            match first_of(&all.into_order(turn)).await {
                Ok(link) => Ok(link),
                Err(others) => {
                    errors.extend(others);
                    Err(none_connects(errors))
                }
            }
        })?;
        Ok(Self { links: vec![link], runtime, local: None })
    }

    /// Connects to all servers of `addresses` that take sessions, where every machine that a name stands for counts, and
    /// says what is wrong with the others.
    ///
    /// # Errors
    /// Those of [`Servers::connect_to_one`].
    pub fn connect_to_some(addresses: &[Address]) -> Result<(Self, Vec<ClientError>), ClientError> {
        let runtime = runtime()?;
        let (links, errors) = runtime.block_on(async {
            let (all, mut errors) = all_machines(addresses).await;
            let mut links = Vec::new();
            for address in &all.equal {
                match connect(address).await {
                    Ok(link) => links.push(link),
                    Err(error) => errors.push(error),
                }
            }
            if links.is_empty() {
                match first_of(&all.spare).await {
                    Ok(link) => links.push(link),
                    Err(others) => errors.extend(others),
                }
            }
            (links, errors)
        });
        if links.is_empty() {
            return Err(none_connects(errors));
        }
        Ok((Self { links, runtime, local: None }, errors))
    }

    /// Where the servers are, one address for each connection.
    pub fn addresses(&self) -> impl Iterator<Item = &Address> {
        self.links.iter().map(|link| &link.address)
    }

    /// The connections, in the order of their addresses.
    pub(super) fn links(&self) -> &[Link] {
        &self.links
    }

    /// What drives the connections.
    pub(super) fn runtime(&self) -> &Runtime {
        &self.runtime
    }

    /// Does `work`, which may take long, on this thread, and meanwhile answers on another one when servers ask whether
    /// the learner lives. Without it a server drops its sessions after its `--keepalive-seconds`, because otherwise the
    /// connections are driven only while a request waits.
    pub fn keep_alive_during<T>(&self, work: impl FnOnce() -> T) -> T {
        let (done, end) = oneshot::channel::<()>();
        let runtime = &self.runtime;
        std::thread::scope(|scope| {
            // Either way of its ending, by `done` or by a panic in `work`, is the end.
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
        self.links
            .first()
            .map_or_else(|| Ok(proto::ListEnvironmentsResponse::default()), |link| self.catalogue_of(link))
    }

    fn catalogue_of(&self, link: &Link) -> Result<proto::ListEnvironmentsResponse, ClientError> {
        let request = "the catalogue";
        let mut client = link.client.clone();
        self.runtime
            .block_on(async {
                let call = client.list_environments(proto::ListEnvironmentsRequest {});
                tokio::time::timeout(REPLY_LIMIT, call).await
            })
            .map_err(|_| ClientError::TimedOut { address: link.address.clone(), request, limit: REPLY_LIMIT })?
            .map(tonic::Response::into_inner)
            .map_err(|status| self.lost(&link.address, request, &status))
    }

    /// The entry `name` of the catalogues, which must be the same in all of them.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the names that there are, [`ClientError::Disagreement`], and those of
    /// [`Servers::catalogue`].
    pub fn environment(&self, name: &str) -> Result<proto::Environment, ClientError> {
        let Some((first, others)) = self.links.split_first() else {
            return Err(ClientError::System {
                action: "ask for an environment",
                source: ErrorKind::NotConnected.into(),
            });
        };
        let environment = self.environment_of(first, name)?;
        for other in others {
            if self.environment_of(other, name)? != environment {
                let (first, other) = (first.address.clone(), other.address.clone());
                return Err(ClientError::Disagreement { first, other, environment: name.into() });
            }
        }
        Ok(environment)
    }

    fn environment_of(&self, link: &Link, name: &str) -> Result<proto::Environment, ClientError> {
        let catalogue = self.catalogue_of(link)?.environments;
        let names: Vec<&str> = catalogue.iter().map(|environment| environment.name.as_str()).collect();
        let message = format!("there is no environment `{name}`; there are {}", names.join(", "));
        catalogue.iter().find(|environment| environment.name == name).cloned().ok_or_else(|| ClientError::Refused {
            address: link.address.clone(),
            request: "the environment",
            code: tonic::Code::NotFound as i32,
            message,
        })
    }

    /// The error for a stream that ended with `status`; says how the private server ended, if it did.
    pub(super) fn lost(&self, address: &Address, request: &'static str, status: &tonic::Status) -> ClientError {
        let ended = self.local.as_ref().and_then(|server| {
            // The connection may break a moment before the process can be waited for.
            std::thread::sleep(Duration::from_millis(50));
            server.lock().ok()?.exit_status()
        });
        let reason = match ended {
            Some(status) => format!("the private server ended with {status}"),
            None => describe(status),
        };
        ClientError::Lost { address: address.clone(), request, reason }
    }
}

fn runtime() -> Result<Runtime, ClientError> {
    Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|source| ClientError::System { action: "start the network runtime", source })
}

/// The machines of all addresses, and what is wrong with names that stand for none.
async fn all_machines(addresses: &[Address]) -> (Machines, Vec<ClientError>) {
    let (mut all, mut errors) = (Machines::default(), Vec::new());
    for address in addresses {
        match machines(address).await {
            Ok(found) => all.extend(found),
            Err(error) => errors.push(error),
        }
    }
    (all, errors)
}

/// Connects to one of the machines that `address` stands for.
async fn any_of(address: &Address, machines: Vec<Address>) -> Result<Link, ClientError> {
    first_of(&machines).await.map_err(|errors| match none_connects(errors) {
        ClientError::NoneConnects { reasons } => ClientError::Connect { address: address.clone(), reason: reasons },
        error => error,
    })
}

/// The errors of all addresses as one.
fn none_connects(mut errors: Vec<ClientError>) -> ClientError {
    if errors.len() == 1 {
        return errors.remove(0);
    }
    ClientError::NoneConnects { reasons: errors.iter().map(in_short).collect::<Vec<_>>().join("; ") }
}
