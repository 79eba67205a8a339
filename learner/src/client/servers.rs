//! Connections to one or several servers.

use std::io::ErrorKind;
use std::sync::Mutex;
use std::time::Duration;

use tokio::runtime::{Builder, Runtime};
use tokio::sync::oneshot;
use tonic::transport::{Channel, Endpoint};

use super::address::Address;
use super::error::ClientError;
use super::local::{LocalServer, LocalServerOptions};
use crate::proto;
use crate::proto::perturb_client::PerturbClient;

/// How long a connection may take to be made.
const CONNECT_LIMIT: Duration = Duration::from_secs(5);
/// How long a server may take for one reply; also that of a batch of thousands of environments comes much sooner.
pub(super) const REPLY_LIMIT: Duration = Duration::from_secs(60);
/// After so long without a word from the server it is asked whether it lives …
const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(5);
/// … and is taken for dead after so long without an answer.
const KEEPALIVE_LIMIT: Duration = Duration::from_secs(15);
/// The largest reply that is accepted, in bytes.
const LARGEST_MESSAGE: usize = 256 << 20;
/// Flow-control window, in bytes: a reply of a large batch must not wait for permission to be sent.
const WINDOW: u32 = 16 << 20;

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

    /// Connects to every server of `addresses`, of which there must be at least one. Proxy settings are ignored.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if one does not answer within 5 s.
    pub fn connect(addresses: &[Address]) -> Result<Self, ClientError> {
        let runtime = Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|source| ClientError::System { action: "start the network runtime", source })?;
        let links = addresses.iter().map(|address| runtime.block_on(connect(address))).collect::<Result<_, _>>()?;
        Ok(Self { links, runtime, local: None })
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

async fn connect(address: &Address) -> Result<Link, ClientError> {
    let fail = |error: tonic::transport::Error| ClientError::Connect {
        address: address.clone(),
        reason: causes(&error).join(": "),
    };
    let channel = Endpoint::from_shared(address.to_string())
        .map_err(fail)?
        .connect_timeout(CONNECT_LIMIT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(KEEPALIVE_INTERVAL)
        .keep_alive_timeout(KEEPALIVE_LIMIT)
        .initial_stream_window_size(WINDOW)
        .initial_connection_window_size(WINDOW)
        .connect()
        .await
        .map_err(fail)?;
    let client = PerturbClient::new(channel)
        .max_decoding_message_size(LARGEST_MESSAGE)
        .max_encoding_message_size(LARGEST_MESSAGE);
    Ok(Link { address: address.clone(), client })
}

/// A status in words, with the transport's cause.
fn describe(status: &tonic::Status) -> String {
    let mut words = vec![format!("{} ({:?})", status.message(), status.code())];
    if let Some(source) = std::error::Error::source(status) {
        words.extend(causes(source));
    }
    words.dedup();
    words.join(": ")
}

/// An error and its causes; without those whose words are contained in others.
fn causes(error: &dyn std::error::Error) -> Vec<String> {
    let chain = std::iter::successors(Some(error), |error| error.source());
    let mut words: Vec<String> = Vec::new();
    for text in chain.map(ToString::to_string) {
        if !words.iter().any(|known| known.contains(&text)) {
            words.push(text);
        }
    }
    words
}
