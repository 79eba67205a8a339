//! Connects to a server: resolves its name, and checks that it accepts sessions.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs};
use std::time::Duration;

use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::timeout;
use tonic::Code;
use tonic::codegen::http::Uri;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tower::service_fn;

use crate::address::Address;
use crate::credentials::{Credentials, WithToken};
use crate::encryption::{Connector, speaks_tls};
use crate::error::{ClientError, REPLY_TIMEOUT, describe, lost, system_words, timed_out};
use crate::escape::escape_catalogue;
use crate::limits::SERVICE;
use crate::proto::{self, perturb_client::PerturbClient};

/// Timeout of each of the steps of a connection: resolving the name, connecting, and the health check.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximal size of a message that a client sends or receives, in bytes.
const MAX_MESSAGE_BYTES: usize = 256 << 20;
/// HTTP/2 flow-control window, in bytes. It is large so that the server can send the reply of a large batch without
/// waiting for the client's permission.
const WINDOW_BYTES: u32 = 16 << 20;

/// The timeouts of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timeouts {
    /// Maximal time to wait for a reply.
    pub reply: Duration,
    /// Time without data from the server after which the client sends a keepalive ping.
    pub keepalive_interval: Duration,
    /// Maximal time to wait for the answer to a ping. Then the connection counts as lost.
    pub keepalive_limit: Duration,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            reply: REPLY_TIMEOUT,
            keepalive_interval: Duration::from_secs(5),
            keepalive_limit: Duration::from_secs(15),
        }
    }
}

/// The gRPC client of a connection, which sends the token with each call.
pub type Client = PerturbClient<InterceptedService<Channel, WithToken>>;

/// A connection to a server that accepted sessions when the connection was opened.
#[derive(Clone, Debug)]
pub struct Connection {
    address: Address,
    client: Client,
    health: HealthClient<Channel>,
    timeouts: Timeouts,
}

impl Connection {
    /// Connects to `address`, with the default timeouts and the credentials that environment variables name.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if no server answers or the server is shutting down, [`ClientError::NotPerturb`] if
    /// another program answers, [`ClientError::Unsafe`] if the credentials are unusable or either side does not trust
    /// the other.
    pub async fn open(address: &Address) -> Result<Self, ClientError> {
        Self::open_with(address, Timeouts::default()).await
    }

    /// Connects to `address` as [`Connection::open`] does, but with these timeouts.
    ///
    /// # Errors
    /// The errors of [`Connection::open`].
    pub async fn open_with(address: &Address, timeouts: Timeouts) -> Result<Self, ClientError> {
        let wrong = |reason| ClientError::Unsafe { address: address.clone(), reason };
        Self::open_as(address, timeouts, Credentials::from_environment(address).map_err(wrong)?).await
    }

    /// Connects to `address` with these timeouts and credentials.
    ///
    /// # Errors
    /// The errors of [`Connection::open`].
    pub async fn open_as(
        address: &Address,
        timeouts: Timeouts,
        mut credentials: Credentials,
    ) -> Result<Self, ClientError> {
        let token = WithToken(credentials.token.take());
        let (host, port, name) = match address {
            Address::Tcp { host, port, tls: Some(name) } => (host, *port, name),
            _ => {
                let channel = Self::endpoint(address, timeouts)?.connect().await;
                let opened = Self::opened(address, timeouts, token, channel).await;
                return match (address, opened) {
                    (
                        Address::Tcp { host, port, tls: None },
                        Err(ClientError::NotPerturb { .. } | ClientError::Connect { .. }),
                    ) if speaks_tls(host, *port).await => {
                        let reason = format!("the server uses TLS; write {}", address.with_tls());
                        Err(ClientError::Unsafe { address: address.clone(), reason })
                    }
                    (_, opened) => opened,
                };
            }
        };
        let refuse = |reason| ClientError::Unsafe { address: address.clone(), reason };
        let connector = Connector::new(host, port, name, credentials).map_err(refuse)?;
        let channel = Self::endpoint(address, timeouts)?.connect_with_connector(connector.clone()).await;
        Self::opened(address, timeouts, token, channel).await.map_err(|error| match (error, connector.failure()) {
            (ClientError::NotPerturb { .. } | ClientError::Connect { .. }, Some(reason)) => refuse(reason),
            (error, _) => error,
        })
    }

    /// Connects over byte streams that `connect` opens, without credentials. `address` only names the server in errors.
    ///
    /// # Errors
    /// [`ClientError::Connect`], [`ClientError::NotPerturb`].
    pub async fn open_by<C, F, S>(address: &Address, timeouts: Timeouts, connect: C) -> Result<Self, ClientError>
    where
        C: Fn() -> F + Send + 'static,
        F: Future<Output = io::Result<S>> + Send + 'static,
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        let connector = service_fn(move |_: Uri| {
            let stream = connect();
            async { stream.await.map(TokioIo::new) }
        });
        let channel = Self::endpoint(address, timeouts)?.connect_with_connector(connector).await;
        Self::opened(address, timeouts, WithToken(None), channel).await
    }

    fn endpoint(address: &Address, timeouts: Timeouts) -> Result<Endpoint, ClientError> {
        let wrong = |error: tonic::transport::Error| ClientError::Connect {
            address: address.clone(),
            reason: error.to_string(),
        };
        Ok(Endpoint::from_shared(address.to_string())
            .map_err(wrong)?
            .connect_timeout(CONNECT_TIMEOUT)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(timeouts.keepalive_interval)
            .keep_alive_timeout(timeouts.keepalive_limit)
            .initial_stream_window_size(WINDOW_BYTES)
            .initial_connection_window_size(WINDOW_BYTES))
    }

    async fn opened(
        address: &Address,
        timeouts: Timeouts,
        token: WithToken,
        channel: Result<Channel, tonic::transport::Error>,
    ) -> Result<Self, ClientError> {
        let fail = |reason: String| ClientError::Connect { address: address.clone(), reason };
        let transport = |error: tonic::transport::Error| {
            fail(
                system_words(&error)
                    .unwrap_or_else(|| format!("it did not answer within {} s", CONNECT_TIMEOUT.as_secs())),
            )
        };
        let channel = channel.map_err(transport)?;
        check_health(address, &channel).await?;
        let health = HealthClient::new(channel.clone());
        let client = PerturbClient::with_interceptor(channel, token)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        Ok(Self { address: address.clone(), client, health, timeouts })
    }

    /// The address of the server.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// The timeouts of this connection.
    pub fn timeouts(&self) -> Timeouts {
        self.timeouts
    }

    /// Returns a gRPC client that uses this connection.
    pub fn client(&self) -> Client {
        self.client.clone()
    }

    /// Whether the server answers a health check within `limit`, even if the answer is an error.
    pub async fn is_alive(&self, limit: Duration) -> bool {
        let mut health = self.health.clone();
        match timeout(limit, health.check(HealthCheckRequest { service: SERVICE.into() })).await {
            Err(_) => false,
            Ok(Ok(_)) => true,
            // An error without a source is the server's own answer. An error of the connection has a source.
            Ok(Err(status)) => std::error::Error::source(&status).is_none(),
        }
    }

    /// Requests the server's catalogue of environments.
    ///
    /// # Errors
    /// [`ClientError::Lost`], [`ClientError::TimedOut`], or [`ClientError::NotPerturb`] if the server does not know the
    /// request.
    pub async fn catalogue(&self) -> Result<proto::ListEnvironmentsResponse, ClientError> {
        let what = "the catalogue";
        let mut client = self.client();
        tokio::time::timeout(self.timeouts.reply, client.list_environments(proto::ListEnvironmentsRequest {}))
            .await
            .map_err(|_| timed_out(&self.address, what, self.timeouts.reply))?
            .map(|reply| {
                let mut catalogue = reply.into_inner();
                escape_catalogue(&mut catalogue);
                catalogue
            })
            .map_err(|status| match status.code() {
                Code::Unimplemented => ClientError::NotPerturb { address: self.address.clone() },
                _ => lost(&self.address, what, &status),
            })
    }
}

/// The IP addresses to which one or more host names resolve.
#[derive(Debug, Default, PartialEq)]
pub struct ResolvedAddresses {
    /// Addresses of the IP version, 4 or 6, that the resolver listed first. Different addresses count as different
    /// machines.
    pub preferred: Vec<Address>,
    /// Addresses of the IP version that the resolver listed later. They are assumed to belong to the same machines as
    /// `preferred`.
    pub fallback: Vec<Address>,
}

impl ResolvedAddresses {
    /// Returns all addresses in the order in which to try them. The preferred addresses come first, rotated left by
    /// `turn` positions. Clients with different values of `turn` thus begin with different machines.
    pub fn into_order(mut self, turn: usize) -> Vec<Address> {
        if !self.preferred.is_empty() {
            let first = turn % self.preferred.len();
            self.preferred.rotate_left(first);
        }
        self.preferred.append(&mut self.fallback);
        self.preferred
    }

    /// Adds the addresses of another host name.
    pub fn extend(&mut self, other: Self) {
        self.preferred.extend(other.preferred);
        self.fallback.extend(other.fallback);
    }
}

/// Resolves the host name in `address`. The name of a service with replicas resolves to several addresses, which are
/// returned in sorted order. A name of a single machine, an IP address and a Unix socket are returned unchanged.
///
/// # Errors
/// [`ClientError::Connect`] for a name that cannot be resolved.
pub async fn resolve(address: &Address) -> Result<ResolvedAddresses, ClientError> {
    let one = || ResolvedAddresses { preferred: vec![address.clone()], fallback: Vec::new() };
    let Address::Tcp { host, port, tls } = address else { return Ok(one()) };
    if host.parse::<IpAddr>().is_ok() {
        return Ok(one());
    }
    let fail = |reason| ClientError::Connect { address: address.clone(), reason };
    let found: Vec<SocketAddr> = timeout(CONNECT_TIMEOUT, resolve_in_thread(host, *port))
        .await
        .map_err(|_| fail(format!("its name was not resolved within {} s", CONNECT_TIMEOUT.as_secs())))?
        .map_err(|error| fail(format!("its name cannot be resolved: {error}")))?;
    // A name tells users more than an IP address, so the name of a single machine is kept.
    Ok(if found.len() > 1 { sorted(found, tls.as_deref()) } else { one() })
}

/// Resolves a host name in a new thread, so that a resolver that hangs blocks nothing else. Returns an error if no
/// thread can be started; tokio's own resolver would panic.
async fn resolve_in_thread(host: &str, port: u16) -> io::Result<Vec<SocketAddr>> {
    let name = host.to_owned();
    let (sender, found) = tokio::sync::oneshot::channel();
    let resolve = move || {
        // The send fails if the caller gave up waiting.
        let _ = sender.send((name.as_str(), port).to_socket_addrs().map(Vec::from_iter));
    };
    std::thread::Builder::new().name("resolver".into()).spawn(resolve)?;
    found.await.unwrap_or_else(|_| Err(io::ErrorKind::Interrupted.into()))
}

fn sorted(mut found: Vec<SocketAddr>, tls: Option<&str>) -> ResolvedAddresses {
    let prefers_ipv4 = found.first().is_some_and(SocketAddr::is_ipv4); // resolvers list the reachable IP version first
    found.sort_unstable();
    found.dedup();
    let (preferred, fallback): (Vec<_>, Vec<_>) = found.into_iter().partition(|found| found.is_ipv4() == prefers_ipv4);
    let address = |found: SocketAddr| Address::Tcp {
        host: found.ip().to_string().into(),
        port: found.port(),
        tls: tls.map(Box::from),
    };
    ResolvedAddresses {
        preferred: preferred.into_iter().map(address).collect(),
        fallback: fallback.into_iter().map(address).collect(),
    }
}

/// Tries the addresses in order, and connects to the first whose server accepts sessions. Logs a warning for each
/// address that fails. `addresses` must not be empty.
///
/// # Errors
/// One error for each address, in order, if all fail.
pub async fn connect_any(addresses: &[Address], timeouts: Timeouts) -> Result<Connection, Vec<ClientError>> {
    let mut errors = Vec::new();
    for (index, address) in addresses.iter().enumerate() {
        match Connection::open_with(address, timeouts).await {
            Ok(connection) => return Ok(connection),
            Err(error) => {
                if index + 1 < addresses.len() {
                    tracing::warn!("{}; trying the next server", error.in_short());
                }
                errors.push(error);
            }
        }
    }
    Err(errors)
}

/// Connects to the server at `address`. If the name resolves to several machines, connects to one that accepts
/// sessions. Different processes begin with different machines.
///
/// # Errors
/// [`ClientError::Connect`] with the reason for each machine, [`ClientError::NotPerturb`], [`ClientError::Unsafe`].
pub async fn connect(address: &Address, timeouts: Timeouts) -> Result<Connection, ClientError> {
    let machines = resolve(address).await?.into_order(rotation());
    connect_any(&machines, timeouts).await.map_err(|errors| match ClientError::from_all(errors) {
        ClientError::NoneConnects { reasons } => ClientError::Connect { address: address.clone(), reason: reasons },
        error => error,
    })
}

/// Returns a number for [`ResolvedAddresses::into_order`] that spreads processes over machines. It is a hash of the
/// process id and the host name: processes on one machine differ in the id, containers in the host name.
fn rotation() -> usize {
    let mut hasher = DefaultHasher::new(); // unlike `RandomState`, it has the same key in every process
    std::fs::read("/proc/sys/kernel/hostname").unwrap_or_default().hash(&mut hasher);
    std::process::id().hash(&mut hasher);
    hasher.finish() as usize
}

/// Checks by a health request that a server answers and accepts sessions. An accepted connection alone proves nothing:
/// a stopped or overloaded machine may accept connections and never answer.
async fn check_health(address: &Address, channel: &Channel) -> Result<(), ClientError> {
    let refuse = |reason| ClientError::Connect { address: address.clone(), reason };
    let request = HealthCheckRequest { service: SERVICE.into() };
    let answer = timeout(CONNECT_TIMEOUT, HealthClient::new(channel.clone()).check(request)).await.map_err(|_| {
        refuse(format!("it accepted the connection, but did not answer within {} s", CONNECT_TIMEOUT.as_secs()))
    })?;
    match answer.map(|reply| reply.into_inner().status()) {
        Ok(ServingStatus::NotServing) => Err(refuse("it is shutting down".into())),
        Ok(_) => Ok(()),
        Err(status) => match status.code() {
            // The health check was refused. The server may still accept sessions, because a proxy may pass on only
            // perturb's own calls.
            Code::NotFound | Code::PermissionDenied | Code::Unauthenticated | Code::Unimplemented => Ok(()),
            // An error with a source was created by the client, because the answer is not gRPC.
            _ if std::error::Error::source(&status).is_some() => {
                Err(ClientError::NotPerturb { address: address.clone() })
            }
            _ => Err(refuse(describe(&status))),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn addresses(texts: &[&str]) -> Vec<Address> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    fn found(texts: &[&str]) -> Vec<SocketAddr> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    #[test]
    fn replicas_are_sorted_and_turns_wrap_around() {
        let answers = [["10.0.0.9:7", "10.0.0.10:7", "10.0.0.2:7"], ["10.0.0.2:7", "10.0.0.9:7", "10.0.0.10:7"]];
        for answer in answers {
            let turn = |turn| sorted(found(&answer), None).into_order(turn);
            assert_eq!(turn(0), addresses(&["10.0.0.2:7", "10.0.0.9:7", "10.0.0.10:7"]));
            assert_eq!(turn(1), addresses(&["10.0.0.9:7", "10.0.0.10:7", "10.0.0.2:7"]));
            assert_eq!(turn(5), addresses(&["10.0.0.10:7", "10.0.0.2:7", "10.0.0.9:7"]));
        }
    }

    #[test]
    fn machine_with_two_protocol_families_counts_once() {
        let resolved = sorted(found(&["127.0.0.1:7", "[::1]:7", "127.0.0.1:7"]), None);
        assert_eq!(resolved.preferred, addresses(&["127.0.0.1:7"]));
        for turn in 0..3 {
            assert_eq!(
                sorted(found(&["127.0.0.1:7", "[::1]:7"]), None).into_order(turn),
                addresses(&["127.0.0.1:7", "[::1]:7"])
            );
        }
        assert_eq!(sorted(found(&["[::1]:7", "127.0.0.1:7"]), None).preferred, addresses(&["[::1]:7"]));
    }

    #[test]
    fn numbers_and_sockets_need_no_resolver() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        for text in ["10.1.2.3:7", "[::1]:7", "unix:/a"] {
            let resolved = runtime.block_on(resolve(&text.parse().unwrap())).unwrap();
            assert_eq!(resolved.preferred, addresses(&[text]));
        }
        let error = runtime.block_on(resolve(&"no-such-host.invalid:7".parse().unwrap())).unwrap_err().to_string();
        assert!(error.contains("http://no-such-host.invalid:7: its name"), "{error}");
    }
}
