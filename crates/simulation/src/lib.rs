//! A server with counting sessions, for tests in simulated time.
//!
//! gRPC, the transport of sessions and their leases are the real ones, in client and server. Time and network are
//! simulated by [turmoil](https://docs.rs/turmoil). There is no physics, because its threads would use real time.
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

/// Name of the server's machine.
pub const SERVER: &str = "server";
/// Time for which the server holds a session without a stream.
pub const LEASE: Duration = Duration::from_secs(60);

const PORT: u16 = 7471;
/// Silence after which a peer sends a keepalive ping, and time for the answer to it.
pub const KEEPALIVE: Duration = Duration::from_secs(1);
/// Time that a client waits for its connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// Time that a client has for opening a session.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum number of sessions.
const MAX_SESSIONS: usize = 4;
/// Memory budget of the server, and maximum size of a request.
const MAX_BYTES: usize = 1 << 20;

/// Steps and state of the server's sessions. Clones share them.
#[derive(Clone)]
pub struct StepLog {
    /// Numbers of the steps, in the order of the server.
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
    /// Returns the numbers that clients stepped with, in the order of the server.
    pub fn done(&self) -> Vec<u64> {
        self.done.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Returns the number of resumed sessions.
    pub fn resumed(&self) -> u64 {
        self.numbers.resumed()
    }

    /// Returns the number of requests to resume a session that does not exist.
    pub fn unknown(&self) -> u64 {
        self.counters.counts().filter(|(kind, _)| *kind == ErrorKind::UnknownLease).map(|(_, count)| count).sum()
    }

    /// Tells whether no session is left, with or without a stream.
    pub fn is_idle(&self) -> bool {
        self.limiter.in_use() == 0 && self.numbers.detached() == 0
    }

    fn add(&self, step: u64) {
        self.done.lock().unwrap_or_else(PoisonError::into_inner).push(step);
    }
}

/// Serves on this machine of the simulation until the simulation ends.
///
/// # Errors
/// If the port is taken, or the transport fails.
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

/// Connects to the server from another machine of the simulation.
///
/// # Errors
/// [`ClientError::Connect`].
pub async fn connect() -> Result<Connection, ClientError> {
    let address = Address::Tcp { host: SERVER.into(), port: PORT, tls: None };
    let patience = Timeouts { keepalive_interval: KEEPALIVE, keepalive_limit: KEEPALIVE, ..Timeouts::default() };
    Connection::open_by(&address, patience, stream).await
}

/// Connects to the server. A cut connection is refused at once in the simulation, but times out in reality, so this
/// function waits first.
async fn stream() -> io::Result<turmoil::net::TcpStream> {
    let stream = turmoil::net::TcpStream::connect((SERVER, PORT)).await;
    if stream.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::ConnectionRefused) {
        tokio::time::sleep(CONNECT_TIMEOUT).await;
        return Err(io::ErrorKind::TimedOut.into());
    }
    stream
}

/// The service of `perturb.v1` with counting sessions.
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
