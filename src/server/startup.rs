//! Startup and shutdown of the server.

use super::{
    api::{
        dm_env_rpc,
        perturb_v1::{
            convert,
            service::{ENDPOINT, PerturbService},
            session::ServerContext,
        },
    },
    auth::{AuthLayer, Tokens},
    error::ErrorCounters,
    metrics::{self, MetricsSources, RequestCounts, TransportMeter},
    net::{
        access_log::AccessLog,
        capacity_health,
        handshake::{self, Handshakes},
        listener::Listener,
        load::{Balance, ThreadLoad},
        peer_limiter::PeerLimiter,
        transport_threads::{self, TransportThreads},
    },
    security::Security,
    session::{
        admission::{SessionLimits, Sessions},
        lease::{self, Leases},
    },
    shutdown::{Controller, Drain, ShutdownPhase},
    transport::{budget::Budget, message_reader::StreamLimits, raw_body::RawBodyLayer},
};
use crate::{
    config::Config,
    env::{self, Catalogue},
    meters::Histogram,
    pool::Pool,
    proto::{self, dm_env_rpc::v1::environment_server::EnvironmentServer, perturb_server::PerturbServer},
    render::Renderer,
};
use std::{future::Future, io, pin::Pin, sync::Arc, time::Duration};
use tokio::{
    task::JoinSet,
    time::{Instant, timeout},
};
use tonic::{
    codec::CompressionEncoding,
    server::NamedService,
    transport::{Server, server::Router},
};
use tonic_health::{
    ServingStatus,
    pb::health_server::{Health, HealthServer},
    server::HealthReporter,
};
use tower::{Layer, ServiceBuilder};

/// The HTTP/2 flow-control window of a stream, bytes: enough for the actions of ten thousand robots in one step.
const STREAM_WINDOW_BYTES: u32 = 1 << 20;
/// The HTTP/2 flow-control window of a connection, bytes. It has room for the full windows of 16 streams, so the unread
/// requests of fewer sessions cannot block the connection's other sessions.
const CONNECTION_WINDOW_BYTES: u32 = 16 * STREAM_WINDOW_BYTES;
/// The maximum number of streams of a connection in addition to its sessions: health checks, the catalogue, reflection.
const MAX_OTHER_STREAMS: usize = 16;
/// The timeout of unary calls (calls with a single reply).
const UNARY_TIMEOUT: Duration = Duration::from_secs(10);
/// The maximum length of a unary request, bytes. Such a request is a name or empty.
const MAX_UNARY_BYTES: usize = 1 << 10;
/// The time that connections get to close at the end of a shutdown.
const CONNECTION_CLOSE_TIMEOUT: Duration = Duration::from_secs(1);
/// The gRPC services whose health status clients can query by name.
const SERVICES: [&str; 2] =
    [PerturbServer::<PerturbService>::NAME, EnvironmentServer::<dm_env_rpc::service::DmEnvRpcService>::NAME];

/// Why the server could not start, or stopped without a shutdown.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An environment cannot be built.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// An operation of the operating system failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The gRPC transport failed.
    #[error("the transport failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The Protocol Buffers descriptors for gRPC reflection cannot be read.
    #[error("reflection failed: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// A boxed future. Functions that use it need no type parameters, so they are compiled once in this library, not in
/// each program that calls [`run`].
type BoxFuture<'a, T> = Pin<Box<dyn Future<Output = T> + 'a>>;

/// Serves the environments of `catalogue` on `listeners`, and the metrics page on the listener `metrics` if there is
/// one. Returns after a shutdown, which begins when `shutdown` resolves: new sessions are refused, running sessions may
/// continue for the grace period, then all connections are closed.
///
/// Must run on a tokio runtime; a current-thread runtime is fastest. The calling thread accepts connections and is the
/// first transport thread. Each further transport thread has a runtime of its own.
///
/// # Errors
/// [`Error`], if the server cannot start or a transport thread fails.
pub fn run<'a>(
    listeners: Vec<Listener>,
    metrics: Option<Listener>,
    config: &'a Config,
    security: &'a Security,
    catalogue: Catalogue,
    shutdown: impl Future<Output = ()> + 'a,
) -> impl Future<Output = Result<(), Error>> + 'a {
    run_boxed(listeners, metrics, config, security, catalogue, Box::pin(shutdown))
}

/// Does the work of [`run`], without type parameters.
fn run_boxed<'a>(
    listeners: Vec<Listener>,
    metrics: Option<Listener>,
    config: &'a Config,
    security: &'a Security,
    catalogue: Catalogue,
    shutdown: BoxFuture<'a, ()>,
) -> BoxFuture<'a, Result<(), Error>> {
    Box::pin(serve(listeners, metrics, config, security, catalogue, shutdown))
}

/// Starts all parts of the server, serves until the shutdown, and shuts down in order.
async fn serve(
    listeners: Vec<Listener>,
    metrics: Option<Listener>,
    config: &Config,
    security: &Security,
    catalogue: Catalogue,
    shutdown: BoxFuture<'_, ()>,
) -> Result<(), Error> {
    let listing = listing(&catalogue, config)?;
    let (mut controller, drain) = Controller::new();
    let parts = ServerParts::new(config, catalogue, drain.clone())?;
    let renderer = Renderer::new();
    let pictures = renderer.times();
    let worlds = parts.worlds(security);
    let service = parts.service(listing, renderer, security);
    let requests = [("perturb.v1", service.counts()), ("dm_env_rpc.v1", worlds.counts())];
    let balance = Balance::new(config.transport_threads, Instant::now());
    let sources = Arc::new(parts.sources(requests, security, pictures, balance.loads()));
    let (health, health_service) = tonic_health::server::health_reporter();
    set_health(&health, ServingStatus::Serving).await;

    let handshakes = Handshakes { limit: parts.handshake, tls: security.tls.clone() };
    let has_metrics = metrics.is_some();
    // The metrics server stops when this function returns.
    let _metrics_server = metrics.map(|listener| answer_scrapers(listener, &sources));
    // Starts a gRPC server for each transport thread. The first server runs on this thread.
    let mut servers = JoinSet::new();
    let (threads, accepted) = TransportThreads::new(balance);
    for (index, accepted) in accepted.into_iter().enumerate() {
        let view = controller.view();
        let (service, worlds) = (service.with_drain(view.clone()), worlds.with_drain(view.clone()));
        let router = router(config, &parts, security.tokens.clone(), service, worlds, health_service.clone())?;
        let connections = handshake::connections(accepted, handshakes.clone());
        let lag_sources = has_metrics.then(|| Arc::clone(&sources));
        let served = async move {
            tokio::select! {
                served = router.serve_with_incoming_shutdown(connections, closed(view)) => served.map_err(Error::from),
                () = watch_lag(lag_sources, index) => Ok(()),
            }
        };
        if index == 0 {
            servers.spawn(served);
        } else {
            let thread = transport_threads::spawn(format!("transport-{index}"), served)?;
            servers.spawn(async { thread.await? });
        }
    }
    // Accepted connections are passed to the transport threads.
    for listener in listeners {
        servers.spawn(accept(listener, parts.connections.clone(), threads.clone(), drain.clone()));
    }
    tokio::select! {
        () = shutdown => {}
        () = capacity_health::report_capacity(&health, &parts.limiter, &parts.pool) => {}
        // Before the shutdown, a server task ends only if it fails.
        Some(ended) = servers.join_next() => return ended.map_err(io::Error::other)?,
    }
    shut_down(config, &controller, &health, &sources.requests, servers).await;
    if let Some(ledger) = &security.ledger {
        // When a session's environments are freed, the ledger records the end of the session's draws. Therefore the
        // ledger is closed only after all environments are freed, or after a timeout.
        if timeout(CONNECTION_CLOSE_TIMEOUT, parts.pool.freed()).await.is_err() {
            tracing::warn!("the ledger ends before all environments are freed");
        }
        ledger.close().await;
    }
    Ok(())
}

/// The optional protocol features that this server supports, in alphabetical order. docs/protocol.md describes them.
const FEATURES: &[&str] = &[
    "act",
    "contexts",
    "disturbances",
    "groups",
    "lease",
    "observe_parameters",
    "receipt_arrays",
    "release",
    "reply_bounds",
    "reward_terms",
    "save_player",
];

/// Returns, as a message, the catalogue that a server with these settings serves. Builds each environment once, so a
/// model that cannot be loaded is found before the server starts.
///
/// # Errors
/// [`env::Error`], if an environment cannot be built.
pub fn listing(catalogue: &Catalogue, config: &Config) -> Result<proto::ListEnvironmentsResponse, env::Error> {
    let is_served = |feature: &&str| *feature != "lease" || config.lease_seconds > 0;
    let environments = catalogue.specs().map(|spec| Ok(convert::environment(spec, (spec.make)()?.model_hash())));
    Ok(proto::ListEnvironmentsResponse {
        environments: environments.collect::<Result<_, env::Error>>()?,
        server_version: env!("CARGO_PKG_VERSION").into(),
        max_batch_size: u32::try_from(config.max_envs).unwrap_or(u32::MAX),
        features: FEATURES.iter().copied().filter(is_served).map(Into::into).collect(),
    })
}

/// The parts of a server that several services share, or that the metrics read.
struct ServerParts {
    pool: Arc<Pool>,
    catalogue: Arc<Catalogue>,
    limiter: PeerLimiter,
    connections: PeerLimiter,
    handshake: Duration,
    stream_limits: StreamLimits,
    sessions: Sessions,
    leases: Leases<proto::SessionResponse>,
    lease_counters: lease::LeaseCounters,
    errors: ErrorCounters,
    access: AccessLog,
}

impl ServerParts {
    fn new(config: &Config, catalogue: Catalogue, drain: Drain) -> io::Result<Self> {
        let pool = Arc::new(Pool::new(config.workers, config.max_envs)?);
        // Creates the counters of every environment now. A counter that appeared with its first event would hide that
        // event from Prometheus' `rate`.
        catalogue.names().for_each(|name| _ = pool.meter(name));
        let seconds = |count: u64| (count > 0).then(|| Duration::from_secs(count));
        let handshake = Duration::from_secs(config.handshake_seconds);
        let limits = SessionLimits { bytes: config.max_message_bytes, handshake, idle: seconds(config.idle_seconds) };
        let max_per_peer = if config.max_peer_sessions > 0 { config.max_peer_sessions } else { usize::MAX };
        let connections = PeerLimiter::new(usize::MAX, max_per_peer.saturating_add(MAX_OTHER_STREAMS));
        let (errors, access, lease_counters) =
            (ErrorCounters::default(), AccessLog::default(), lease::LeaseCounters::default());
        let limiter = PeerLimiter::new(config.max_sessions, max_per_peer);
        let sessions =
            Sessions::new(limiter.clone(), limits, drain, errors.clone(), access.clone(), lease_counters.clone());
        Ok(Self {
            pool,
            catalogue: Arc::new(catalogue),
            limiter,
            connections,
            handshake,
            stream_limits: StreamLimits {
                budget: Budget::new(config.max_memory),
                limit: seconds(config.stall_seconds),
                handshake,
            },
            sessions,
            leases: Leases::new(Duration::from_secs(config.lease_seconds), lease_counters.clone()),
            lease_counters,
            errors,
            access,
        })
    }

    /// The service of `perturb.v1`.
    fn service(
        &self,
        listing: proto::ListEnvironmentsResponse,
        renderer: Renderer,
        security: &Security,
    ) -> PerturbService {
        let shared = ServerContext {
            pool: Arc::clone(&self.pool),
            catalogue: Arc::clone(&self.catalogue),
            listing,
            renderer,
            ledger: security.ledger.clone(),
            leases: self.leases.clone(),
        };
        PerturbService::new(shared, self.sessions.clone())
    }

    /// The service of `dm_env_rpc.v1`.
    fn worlds(&self, security: &Security) -> dm_env_rpc::service::DmEnvRpcService {
        let (pool, catalogue) = (Arc::clone(&self.pool), Arc::clone(&self.catalogue));
        dm_env_rpc::service::DmEnvRpcService::new(pool, catalogue, self.sessions.clone(), security.ledger.clone())
    }

    /// Collects the counters that the metrics read. Registers the protocols with the access log, so their counts of
    /// ended sessions start at 0.
    fn sources(
        &self,
        requests: [RequestCounts; 2],
        security: &Security,
        pictures: Arc<Histogram>,
        loads: Vec<Arc<ThreadLoad>>,
    ) -> MetricsSources {
        requests.iter().for_each(|(protocol, _)| self.access.register_protocol(protocol));
        MetricsSources {
            pool: Arc::clone(&self.pool),
            sessions: self.limiter.clone(),
            leases: self.lease_counters.clone(),
            connections: self.connections.clone(),
            budget: self.stream_limits.budget.clone(),
            requests,
            errors: self.errors.clone(),
            access: self.access.clone(),
            tokens: security.tokens.clone(),
            ledger: security.ledger.clone(),
            pictures,
            threads: loads.into_iter().map(TransportMeter::new).collect(),
        }
    }
}

/// Builds the router of all gRPC services, with authentication, raw request bodies, compression and size limits.
fn router<H: Health>(
    config: &Config,
    parts: &ServerParts,
    tokens: Option<Tokens>,
    service: PerturbService,
    worlds: dm_env_rpc::service::DmEnvRpcService,
    health: HealthServer<H>,
) -> Result<Router, Error> {
    let auth = AuthLayer::new(tokens, parts.errors.clone());
    let perturb = PerturbServer::new(service)
        .max_decoding_message_size(MAX_UNARY_BYTES) // for unary requests; sessions have limits of their own
        .max_encoding_message_size(usize::MAX)
        .accept_compressed(CompressionEncoding::Gzip)
        .accept_compressed(CompressionEncoding::Deflate);
    let perturb = ServiceBuilder::new()
        .layer(auth.clone())
        .layer(RawBodyLayer::new(ENDPOINT, parts.stream_limits.clone()))
        .service(perturb);
    let worlds = ServiceBuilder::new()
        .layer(auth.clone())
        .layer(RawBodyLayer::new(dm_env_rpc::service::ENDPOINT, parts.stream_limits.clone()))
        .service(
            EnvironmentServer::new(worlds)
                .max_encoding_message_size(usize::MAX)
                .accept_compressed(CompressionEncoding::Gzip)
                .accept_compressed(CompressionEncoding::Deflate),
        );
    let (reflection_v1, reflection_v1alpha) = (reflection().build_v1()?, reflection().build_v1alpha()?);
    let keepalive = Duration::from_secs(config.keepalive_seconds);
    let streams = u32::try_from(config.max_sessions.saturating_add(MAX_OTHER_STREAMS)).unwrap_or(u32::MAX);
    Ok(Server::builder()
        .http2_keepalive_interval(Some(keepalive))
        .http2_keepalive_timeout(Some(keepalive))
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .max_concurrent_streams(streams)
        .timeout(UNARY_TIMEOUT) // until the response begins; a session's response begins at once
        .add_service(perturb)
        .add_service(worlds)
        // Health checks need no token, so a monitoring system can check a server that it may not use.
        .add_service(health.max_decoding_message_size(MAX_UNARY_BYTES))
        .add_service(auth.layer(reflection_v1.max_decoding_message_size(MAX_UNARY_BYTES)))
        .add_service(auth.layer(reflection_v1alpha.max_decoding_message_size(MAX_UNARY_BYTES))))
}

fn reflection() -> tonic_reflection::server::Builder<'static> {
    tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(proto::DESCRIPTORS)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
}

/// Serves the metrics page until the returned set of tasks is dropped.
fn answer_scrapers(listener: Listener, sources: &Arc<MetricsSources>) -> JoinSet<()> {
    let mut tasks = JoinSet::new();
    tasks.spawn(metrics::endpoint::serve(listener, Arc::clone(sources)));
    tasks
}

/// Measures how late transport thread number `index` wakes up, if the metrics are served. Never resolves.
async fn watch_lag(sources: Option<Arc<MetricsSources>>, index: usize) {
    match sources {
        Some(sources) => sources.threads[index].watch_lag().await,
        None => std::future::pending().await,
    }
}

/// Accepts connections until the last phase of the shutdown.
async fn accept(
    listener: Listener,
    limiter: PeerLimiter,
    threads: TransportThreads,
    drain: Drain,
) -> Result<(), Error> {
    tokio::select! {
        never = transport_threads::accept(listener, limiter, threads) => match never {},
        () = closed(drain) => Ok(()),
    }
}

/// Waits for the last phase of the shutdown, [`ShutdownPhase::Closed`].
async fn closed(mut drain: Drain) {
    drain.closed().await;
}

/// Shuts the server down: refuses new sessions, lets running sessions continue for the grace period, closes
/// connections.
async fn shut_down(
    config: &Config,
    controller: &Controller,
    health: &HealthReporter,
    requests: &[RequestCounts],
    mut servers: JoinSet<Result<(), Error>>,
) {
    tracing::info!(grace_seconds = config.grace_seconds, "shutting down: no new sessions");
    controller.set(ShutdownPhase::Draining);
    set_health(health, ServingStatus::NotServing).await;
    health.set_service_status(capacity_health::NEW_SESSIONS, ServingStatus::NotServing).await;
    health.set_service_status("", ServingStatus::NotServing).await;
    if timeout(config.grace(), controller.idle()).await.is_err() {
        tracing::warn!("the grace period is over: ending the sessions that still run");
    }
    controller.set(ShutdownPhase::Closed);
    for (protocol, counts) in requests {
        tracing::info!(protocol, "requests: {counts}");
    }
    let all_closed = async { while servers.join_next().await.is_some() {} };
    if timeout(CONNECTION_CLOSE_TIMEOUT, all_closed).await.is_err() {
        tracing::debug!("some connections did not close by themselves");
    }
}

/// Sets the reported health of the services of both protocols.
async fn set_health(health: &HealthReporter, status: ServingStatus) {
    for service in SERVICES {
        health.set_service_status(service, status).await;
    }
}
