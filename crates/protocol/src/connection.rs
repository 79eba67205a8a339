//! Making one connection: which machine stands for a name, and whether it takes sessions.

use std::io;
use std::net::{IpAddr, SocketAddr};
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
use crate::error::{ClientError, REPLY_LIMIT, describe, lost, system_words, timed_out};
use crate::limits::SERVICE;
use crate::proto::{self, perturb_client::PerturbClient};

/// How long each part of making a connection may take.
const CONNECT_LIMIT: Duration = Duration::from_secs(5);
/// The largest reply that is accepted, in bytes.
const LARGEST_MESSAGE: usize = 256 << 20;
/// Flow-control window, in bytes: a reply of a large batch must not wait for permission to be sent.
const WINDOW: u32 = 16 << 20;

/// How long a client waits for a server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patience {
    /// For a reply.
    pub reply: Duration,
    /// Without a word from the server, before it is asked whether it lives …
    pub keepalive_interval: Duration,
    /// … and for the answer, before it is taken for dead.
    pub keepalive_limit: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self {
            reply: REPLY_LIMIT,
            keepalive_interval: Duration::from_secs(5),
            keepalive_limit: Duration::from_secs(15),
        }
    }
}

/// What calls are made with.
pub type Client = PerturbClient<InterceptedService<Channel, WithToken>>;

/// A connection to a server that takes sessions.
#[derive(Clone, Debug)]
pub struct Connection {
    address: Address,
    client: Client,
    patience: Patience,
}

impl Connection {
    /// Connects to `address`, whose server must take sessions: one that is shutting down still answers.
    ///
    /// # Errors
    /// [`ClientError::Connect`], [`ClientError::Unsafe`].
    pub async fn open(address: &Address) -> Result<Self, ClientError> {
        Self::open_with(address, Patience::default()).await
    }

    /// The same, with another patience.
    ///
    /// # Errors
    /// [`ClientError::Connect`], [`ClientError::Unsafe`].
    pub async fn open_with(address: &Address, patience: Patience) -> Result<Self, ClientError> {
        let wrong = |reason| ClientError::Unsafe { address: address.clone(), reason };
        Self::open_as(address, patience, Credentials::of_environment(address).map_err(wrong)?).await
    }

    /// The same, with other credentials than the environment's.
    ///
    /// # Errors
    /// [`ClientError::Connect`], [`ClientError::Unsafe`].
    pub async fn open_as(
        address: &Address,
        patience: Patience,
        mut credentials: Credentials,
    ) -> Result<Self, ClientError> {
        let token = WithToken(credentials.token.take());
        let (host, port, name) = match address {
            Address::Tcp { host, port, tls: Some(name) } => (host, *port, name),
            _ => {
                let channel = Self::endpoint(address, patience)?.connect().await;
                let opened = Self::opened(address, patience, token, channel).await;
                return match (address, opened) {
                    (
                        Address::Tcp { host, port, tls: None },
                        Err(ClientError::NotPerturb { .. } | ClientError::Connect { .. }),
                    ) if speaks_tls(host, *port).await => {
                        let reason = format!("it speaks TLS; write {}", address.with_tls());
                        Err(ClientError::Unsafe { address: address.clone(), reason })
                    }
                    (_, opened) => opened,
                };
            }
        };
        let refuse = |reason| ClientError::Unsafe { address: address.clone(), reason };
        let connector = Connector::new(host, port, name, credentials).map_err(refuse)?;
        let channel = Self::endpoint(address, patience)?.connect_with_connector(connector.clone()).await;
        Self::opened(address, patience, token, channel).await.map_err(|error| match (error, connector.failure()) {
            (ClientError::NotPerturb { .. } | ClientError::Connect { .. }, Some(reason)) => refuse(reason),
            (error, _) => error,
        })
    }

    /// The same, without credentials, by streams that `connect` makes.
    ///
    /// # Errors
    /// [`ClientError::Connect`].
    pub async fn open_by<C, F, S>(address: &Address, patience: Patience, connect: C) -> Result<Self, ClientError>
    where
        C: Fn() -> F + Send + 'static,
        F: Future<Output = io::Result<S>> + Send + 'static,
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        let connector = service_fn(move |_: Uri| {
            let stream = connect();
            async { stream.await.map(TokioIo::new) }
        });
        let channel = Self::endpoint(address, patience)?.connect_with_connector(connector).await;
        Self::opened(address, patience, WithToken(None), channel).await
    }

    fn endpoint(address: &Address, patience: Patience) -> Result<Endpoint, ClientError> {
        let wrong = |error: tonic::transport::Error| ClientError::Connect {
            address: address.clone(),
            reason: error.to_string(),
        };
        Ok(Endpoint::from_shared(address.to_string())
            .map_err(wrong)?
            .connect_timeout(CONNECT_LIMIT)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(patience.keepalive_interval)
            .keep_alive_timeout(patience.keepalive_limit)
            .initial_stream_window_size(WINDOW)
            .initial_connection_window_size(WINDOW))
    }

    async fn opened(
        address: &Address,
        patience: Patience,
        token: WithToken,
        channel: Result<Channel, tonic::transport::Error>,
    ) -> Result<Self, ClientError> {
        let fail = |reason: String| ClientError::Connect { address: address.clone(), reason };
        let transport = |error: tonic::transport::Error| {
            fail(
                system_words(&error)
                    .unwrap_or_else(|| format!("it did not answer within {} s", CONNECT_LIMIT.as_secs())),
            )
        };
        let channel = channel.map_err(transport)?;
        takes_sessions(address, &channel).await?;
        let client = PerturbClient::with_interceptor(channel, token)
            .max_decoding_message_size(LARGEST_MESSAGE)
            .max_encoding_message_size(LARGEST_MESSAGE);
        Ok(Self { address: address.clone(), client, patience })
    }

    /// Where the server is.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// How long its replies are waited for.
    pub fn patience(&self) -> Patience {
        self.patience
    }

    /// What calls are made with.
    pub fn client(&self) -> Client {
        self.client.clone()
    }

    /// What the server can run.
    ///
    /// # Errors
    /// [`ClientError::Lost`] or [`ClientError::TimedOut`].
    pub async fn catalogue(&self) -> Result<proto::ListEnvironmentsResponse, ClientError> {
        let what = "the catalogue";
        let mut client = self.client();
        tokio::time::timeout(self.patience.reply, client.list_environments(proto::ListEnvironmentsRequest {}))
            .await
            .map_err(|_| timed_out(&self.address, what, self.patience.reply))?
            .map(tonic::Response::into_inner)
            .map_err(|status| match status.code() {
                Code::Unimplemented => ClientError::NotPerturb { address: self.address.clone() },
                _ => lost(&self.address, what, &status),
            })
    }
}

/// The machines that addresses stand for.
#[derive(Debug, Default, PartialEq)]
pub struct Machines {
    /// Any of these is as good as the others.
    pub equal: Vec<Address>,
    /// Other ways to the same machines, by the protocol family that the system likes less.
    pub spare: Vec<Address>,
}

impl Machines {
    /// All of them, beginning with number `turn` of the equal ones, counted around.
    pub fn into_order(mut self, turn: usize) -> Vec<Address> {
        if !self.equal.is_empty() {
            let first = turn % self.equal.len();
            self.equal.rotate_left(first);
        }
        self.equal.append(&mut self.spare);
        self.equal
    }

    /// Adds those of other addresses.
    pub fn extend(&mut self, other: Self) {
        self.equal.extend(other.equal);
        self.spare.extend(other.spare);
    }
}

/// The machines behind `address`: several if it has a name that stands for several, as that of a service whose replicas
/// share it. Their order is the same wherever it is asked, whatever the order of the answer.
///
/// # Errors
/// [`ClientError::Connect`] for a name that stands for none.
pub async fn machines(address: &Address) -> Result<Machines, ClientError> {
    let one = || Machines { equal: vec![address.clone()], spare: Vec::new() };
    let Address::Tcp { host, port, tls } = address else { return Ok(one()) };
    if host.parse::<IpAddr>().is_ok() {
        return Ok(one());
    }
    let fail = |reason| ClientError::Connect { address: address.clone(), reason };
    let found: Vec<SocketAddr> = timeout(CONNECT_LIMIT, tokio::net::lookup_host((&**host, *port)))
        .await
        .map_err(|_| fail(format!("its name was not resolved within {} s", CONNECT_LIMIT.as_secs())))?
        .map_err(|error| fail(format!("its name cannot be resolved: {error}")))?
        .collect();
    // The name says more than a number, as long as it is clear whom it means.
    Ok(if found.len() > 1 { sorted(found, tls.as_deref()) } else { one() })
}

fn sorted(mut found: Vec<SocketAddr>, tls: Option<&str>) -> Machines {
    let liked = found.first().is_some_and(SocketAddr::is_ipv4); // a resolver puts what can be reached first
    found.sort_unstable();
    found.dedup();
    let (equal, spare): (Vec<_>, Vec<_>) = found.into_iter().partition(|found| found.is_ipv4() == liked);
    let address = |found: SocketAddr| Address::Tcp {
        host: found.ip().to_string().into(),
        port: found.port(),
        tls: tls.map(Box::from),
    };
    Machines { equal: equal.into_iter().map(address).collect(), spare: spare.into_iter().map(address).collect() }
}

/// Connects to the first of `machines`, of which there must be at least one, that takes sessions.
///
/// # Errors
/// What is wrong with each.
pub async fn first_of(machines: &[Address]) -> Result<Connection, Vec<ClientError>> {
    let mut errors = Vec::new();
    for (index, address) in machines.iter().enumerate() {
        match Connection::open(address).await {
            Ok(connection) => return Ok(connection),
            Err(error) => {
                if index + 1 < machines.len() {
                    tracing::warn!("{}; trying the next server", error.in_short());
                }
                errors.push(error);
            }
        }
    }
    Err(errors)
}

/// Asks a server for its health. A stopped or overloaded machine may accept connections and never answer.
async fn takes_sessions(address: &Address, channel: &Channel) -> Result<(), ClientError> {
    let refuse = |reason| ClientError::Connect { address: address.clone(), reason };
    let request = HealthCheckRequest { service: SERVICE.into() };
    let answer = timeout(CONNECT_LIMIT, HealthClient::new(channel.clone()).check(request)).await.map_err(|_| {
        refuse(format!("it accepted the connection, but did not answer within {} s", CONNECT_LIMIT.as_secs()))
    })?;
    match answer.map(|reply| reply.into_inner().status()) {
        Ok(ServingStatus::NotServing) => Err(refuse("it is shutting down".into())),
        Ok(_) => Ok(()),
        Err(status) => match status.code() {
            // Something in between that lets only perturb's own calls through.
            Code::NotFound | Code::PermissionDenied | Code::Unauthenticated | Code::Unimplemented => Ok(()),
            // What comes back is not even a refusal.
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
    fn replicas_have_an_order_of_their_own_and_turns_go_around() {
        let answers = [["10.0.0.9:7", "10.0.0.10:7", "10.0.0.2:7"], ["10.0.0.2:7", "10.0.0.9:7", "10.0.0.10:7"]];
        for answer in answers {
            let turn = |turn| sorted(found(&answer), None).into_order(turn);
            assert_eq!(turn(0), addresses(&["10.0.0.2:7", "10.0.0.9:7", "10.0.0.10:7"]));
            assert_eq!(turn(1), addresses(&["10.0.0.9:7", "10.0.0.10:7", "10.0.0.2:7"]));
            assert_eq!(turn(5), addresses(&["10.0.0.10:7", "10.0.0.2:7", "10.0.0.9:7"]));
        }
    }

    #[test]
    fn a_machine_with_two_protocols_is_one_machine() {
        let machines = sorted(found(&["127.0.0.1:7", "[::1]:7", "127.0.0.1:7"]), None);
        assert_eq!(machines.equal, addresses(&["127.0.0.1:7"]));
        for turn in 0..3 {
            assert_eq!(
                sorted(found(&["127.0.0.1:7", "[::1]:7"]), None).into_order(turn),
                addresses(&["127.0.0.1:7", "[::1]:7"])
            );
        }
        assert_eq!(sorted(found(&["[::1]:7", "127.0.0.1:7"]), None).equal, addresses(&["[::1]:7"]));
    }

    #[test]
    fn numbers_and_sockets_stand_for_themselves() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        for text in ["10.1.2.3:7", "[::1]:7", "unix:/a"] {
            let machines = runtime.block_on(machines(&text.parse().unwrap())).unwrap();
            assert_eq!(machines.equal, addresses(&[text]));
        }
        let error = runtime.block_on(machines(&"no-such-host.invalid:7".parse().unwrap())).unwrap_err().to_string();
        assert!(error.contains("http://no-such-host.invalid:7: its name"), "{error}");
    }
}
