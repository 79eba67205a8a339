//! A server for tests in simulated time. Its sessions have no environments: they only count steps.
//!
//! Client and server use the real code of gRPC, the transport, sessions and leases. Time and network are simulated by
//! [turmoil](https://docs.rs/turmoil). There is no physics, because its threads would use real time.
#![cfg(feature = "turmoil")]

mod counting;

use std::io;
use std::net::Ipv4Addr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures_util::stream;
use perturb::proto::{self, perturb_server::PerturbServer};
use perturb::server::api::perturb_v1::service::ENDPOINT;
use perturb::server::error::{ErrorCounters, ErrorKind};
use perturb::server::net::access_log::AccessLog;
use perturb::server::net::managed_io::ManagedIo;
use perturb::server::net::peer_limiter::{Peer, PeerLimiter};
use perturb::server::session::admission::{SessionLimits, Sessions};
use perturb::server::session::driver::Responses;
use perturb::server::session::instrumented::RequestCounters;
use perturb::server::session::lease::{LeaseCounters, Leases};
use perturb::server::shutdown::Controller;
use perturb::server::transport::budget::Budget;
use perturb::server::transport::message_reader::StreamLimits;
use perturb::server::transport::raw_body::{self, RawBodyService};
use perturb_protocol::{Address, ClientError, Connection, Timeouts};
use tonic::transport::Server;
use tonic::{Request, Response, Status, Streaming};

use counting::CountingSession;

/// The host name of the server in the simulated network.
pub const SERVER: &str = "server";
/// Time for which the server keeps a session whose connection is lost.
pub const LEASE: Duration = Duration::from_secs(60);

const PORT: u16 = 7471;
/// Interval of keepalive pings on a silent connection, and timeout of their answers.
pub const KEEPALIVE: Duration = Duration::from_secs(1);
/// Time after which a client's attempt to connect over a cut network fails.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// Time after which the server closes a stream that has not opened a session.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximal number of sessions on the server.
const MAX_SESSIONS: usize = 4;
/// Memory budget of the server, and maximal size of a request, in bytes.
const MAX_BYTES: usize = 1 << 20;

/// A record of the steps that the server took, with counters of its sessions. Clones share the same data.
#[derive(Clone)]
pub struct StepLog {
    /// The numbers that clients sent as actions, one for each step, in the order in which the server took the steps.
    done: Arc<Mutex<Vec<u64>>>,
    numbers: LeaseCounters,
    limiter: PeerLimiter,
    counters: ErrorCounters,
}

impl Default for StepLog {
    fn default() -> Self {
        let limiter = PeerLimiter::new(MAX_SESSIONS, MAX_SESSIONS);
        Self { done: Arc::default(), numbers: LeaseCounters::default(), limiter, counters: ErrorCounters::default() }
    }
}

impl StepLog {
    /// Returns the numbers that clients sent as actions, one for each step, in the order in which the server took the
    /// steps.
    pub fn done(&self) -> Vec<u64> {
        self.done.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Returns how often a session was resumed.
    pub fn resumed(&self) -> u64 {
        self.numbers.resumed()
    }

    /// Returns how often a client tried to resume a session that did not exist any more.
    pub fn unknown(&self) -> u64 {
        self.counters.counts().filter(|(kind, _)| *kind == ErrorKind::UnknownLease).map(|(_, count)| count).sum()
    }

    /// Whether the server has no sessions at all: neither connected sessions, nor sessions that wait to be resumed.
    pub fn is_idle(&self) -> bool {
        self.limiter.in_use() == 0 && self.numbers.detached() == 0
    }

    fn add(&self, step: u64) {
        self.done.lock().unwrap_or_else(PoisonError::into_inner).push(step);
    }
}

/// Runs the server on the current host of the simulation, until the simulation ends. Steps are recorded in `ledger`.
///
/// # Errors
/// An error if the port is taken or the transport fails.
pub async fn serve(ledger: StepLog) -> turmoil::Result {
    let (_controller, drain) = Controller::new();
    let budget = Budget::new(MAX_BYTES);
    let limits = SessionLimits { bytes: MAX_BYTES, handshake: HANDSHAKE_TIMEOUT, idle: None };
    let limiter = ledger.limiter.clone();
    let numbers = ledger.numbers.clone();
    let counters = ledger.counters.clone();
    let sessions = Sessions::new(limiter, limits, drain, counters, AccessLog::default(), numbers.clone());
    let counts = RequestCounters::new::<CountingSession>();
    let service = CountingService { sessions, leases: Leases::new(LEASE, numbers), ledger, counts };
    let transit = StreamLimits { budget, limit: Some(LEASE), handshake: HANDSHAKE_TIMEOUT };
    let listener = turmoil::net::TcpListener::bind((Ipv4Addr::UNSPECIFIED, PORT)).await?;
    let connections = PeerLimiter::new(usize::MAX, usize::MAX);
    let incoming = stream::unfold((listener, connections), |(listener, connections)| async {
        let (stream, address) = listener.accept().await.ok()?;
        let peer = Peer::at(address.ip());
        let place = connections.acquire(Some(peer)).ok()?;
        let guarded = ManagedIo::new(stream, peer, place, HANDSHAKE_TIMEOUT);
        Some((Ok::<_, io::Error>(guarded), (listener, connections)))
    });
    Server::builder()
        .http2_keepalive_interval(Some(KEEPALIVE))
        .http2_keepalive_timeout(Some(KEEPALIVE))
        .add_service(RawBodyService::new(PerturbServer::new(service), ENDPOINT, transit))
        .serve_with_incoming(incoming)
        .await?;
    Ok(())
}

/// Connects to the server from another host of the simulation.
///
/// # Errors
/// [`ClientError::Connect`] if the server does not answer.
pub async fn connect() -> Result<Connection, ClientError> {
    let address = Address::Tcp { host: SERVER.into(), port: PORT, tls: None };
    let patience = Timeouts { keepalive_interval: KEEPALIVE, keepalive_limit: KEEPALIVE, ..Timeouts::default() };
    Connection::open_by(&address, patience, stream).await
}

/// Opens a byte stream to the server. turmoil refuses a connection over a cut network at once. In reality it times out,
/// so this function waits before it returns the error.
async fn stream() -> io::Result<turmoil::net::TcpStream> {
    let stream = turmoil::net::TcpStream::connect((SERVER, PORT)).await;
    if stream.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::ConnectionRefused) {
        tokio::time::sleep(CONNECT_TIMEOUT).await;
        return Err(io::ErrorKind::TimedOut.into());
    }
    stream
}

/// The gRPC service of the protocol `perturb.v1`, whose sessions only count steps.
#[derive(Clone)]
struct CountingService {
    sessions: Sessions,
    leases: Leases<proto::SessionResponse>,
    ledger: StepLog,
    counts: Arc<RequestCounters>,
}

#[tonic::async_trait]
impl proto::perturb_server::Perturb for CountingService {
    type SessionStream = Responses<proto::SessionResponse>;

    async fn list_environments(
        &self,
        _: Request<proto::ListEnvironmentsRequest>,
    ) -> Result<Response<proto::ListEnvironmentsResponse>, Status> {
        Ok(Response::new(proto::ListEnvironmentsResponse::default()))
    }

    async fn session(
        &self,
        mut request: Request<Streaming<proto::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let counting = CountingSession::new(self.leases.clone(), self.ledger.clone());
        Ok(Response::new(self.sessions.begin(raw_body::messages(&mut request)?, counting, &self.counts)?))
    }
}
