//! How the server begins and how it ends.

use super::{
    api::{
        dm_env_rpc,
        perturb_v1::{convert, service::Service, session::Shared},
    },
    auth::Gated,
    metrics::{self, Sources},
    net::{
        access_log::Access,
        capacity_health,
        listener::{self, Admission, Listener},
        peers::Places,
    },
    refusals::Refusals,
    security::Guards,
    session::{
        driver::{Limits, Sessions},
        lease::{self, Leases},
    },
    shutdown::{Controller, Phase},
    transport::{
        budget::Budget,
        message_reader::{Keeping, Transit},
    },
};
use crate::{
    config::Config,
    env::{self, Catalogue},
    meters::Histogram,
    pool::Pool,
    proto::{self, dm_env_rpc::v1::environment_server::EnvironmentServer, perturb_server::PerturbServer},
    render::Renderer,
};
use std::{future::Future, io, sync::Arc, time::Duration};
use tonic::transport::Server;
use tonic_health::ServingStatus;

/// What a stream's client may send before it is read: the actions of ten thousand robots.
const STREAM_WINDOW: u32 = 1 << 20;
/// One session whose requests pile up should not stall the others of its connection: room for 16 such.
const CONNECTION_WINDOW: u32 = 16 * STREAM_WINDOW;
/// Streams of a connection beside sessions: health, the catalogue, reflection.
const OTHER_STREAMS: usize = 16;
/// How long a call may take that is no stream.
const UNARY_LIMIT: Duration = Duration::from_secs(10);
/// The most bytes of a request outside streams of sessions: it is a name or nothing.
const UNARY_BYTES: usize = 1 << 10;
/// How long connections may take to notice the end.
const FAREWELL: Duration = Duration::from_secs(1);

/// Why the server stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An environment cannot be built.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The operating system refused something.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// A connection could not be served.
    #[error("the transport failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The descriptors for reflection cannot be read.
    #[error("reflection failed: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// Serves these environments on the listeners, to whom the guards let in, and metrics on another, if there is one, until `shutdown` resolves; then drains: new
/// sessions are refused, running ones may go on for the grace period, and connections are closed. Must run on a tokio
/// runtime; a current-thread one is fastest.
///
/// # Errors
/// [`Error`], before anything is served, or when a listener fails.
pub async fn run(
    listeners: Vec<Listener>,
    metrics: Option<Listener>,
    config: &Config,
    guards: &Guards,
    catalogue: Catalogue,
    shutdown: impl Future<Output = ()>,
) -> Result<(), Error> {
    let listing = listing(&catalogue, config)?;
    let catalogue = Arc::new(catalogue);
    let pool = Arc::new(Pool::new(config.workers, config.max_envs)?);
    // Told from the beginning, as are refusals and ends of sessions: who watches a rate needs its zero.
    catalogue.names().for_each(|name| _ = pool.meter(name));
    let (controller, drain) = Controller::new();
    let idle = (config.idle_seconds > 0).then(|| Duration::from_secs(config.idle_seconds));
    let handshake = Duration::from_secs(config.handshake_seconds);
    let limits = Limits { bytes: config.max_message_bytes, handshake, idle };
    let of_a_peer = if config.max_peer_sessions > 0 { config.max_peer_sessions } else { usize::MAX };
    let (refusals, access) = (Refusals::default(), Access::default());
    let places = Places::new(config.max_sessions, of_a_peer);
    let leased = lease::Numbers::default();
    let leases = Leases::new(Duration::from_secs(config.lease_seconds), leased.clone());
    let sessions =
        Sessions::new(places.clone(), limits, drain.clone(), refusals.clone(), access.clone(), leased.clone());
    let admission = Admission { places: Places::new(usize::MAX, of_a_peer.saturating_add(OTHER_STREAMS)), handshake };
    let stall = (config.stall_seconds > 0).then(|| Duration::from_secs(config.stall_seconds));
    let transit = Transit { budget: Budget::new(config.max_memory), limit: stall, handshake };
    let renderer = Renderer::new();
    let worlds = dm_env_rpc::service::Service::new(
        Arc::clone(&pool),
        Arc::clone(&catalogue),
        sessions.clone(),
        guards.ledger.clone(),
    );
    let pictures = renderer.times();
    let ledger = guards.ledger.clone();
    let shared = Shared { pool: Arc::clone(&pool), catalogue, listing, renderer, ledger, leases };
    let service = Service::new(shared, sessions);
    let requests = [("perturb.v1", service.counts()), ("dm_env_rpc.v1", worlds.counts())];
    requests.iter().for_each(|(protocol, _)| access.tell_of(protocol));
    let sources = Arc::new(Sources {
        pool: Arc::clone(&pool),
        sessions: places.clone(),
        leases: leased,
        connections: admission.places.clone(),
        budget: transit.budget.clone(),
        requests,
        refusals: refusals.clone(),
        access,
        tokens: guards.tokens.clone(),
        pictures,
        lag: Histogram::default(),
    });
    let worlds = EnvironmentServer::new(worlds).max_encoding_message_size(usize::MAX);
    let worlds = Keeping::new(worlds, "/dm_env_rpc.v1.Environment/Process", transit.clone());
    let service = PerturbServer::new(service)
        .max_decoding_message_size(UNARY_BYTES) // of all but sessions
        .max_encoding_message_size(usize::MAX);
    let service = Keeping::new(service, "/perturb.v1.Perturb/Session", transit);
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<PerturbServer<Service>>().await;
    health.set_serving::<EnvironmentServer<dm_env_rpc::service::Service>>().await;
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(proto::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let keepalive = Duration::from_secs(config.keepalive_seconds);
    let tokens = || guards.tokens.clone();
    let router = Server::builder()
        .http2_keepalive_interval(Some(keepalive))
        .http2_keepalive_timeout(Some(keepalive))
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
        .max_concurrent_streams(u32::try_from(config.max_sessions.saturating_add(OTHER_STREAMS)).unwrap_or(u32::MAX))
        .timeout(UNARY_LIMIT) // until an answer begins, which that of a stream does at once
        .add_service(Gated::new(service, tokens(), refusals.clone()))
        .add_service(Gated::new(worlds, tokens(), refusals.clone()))
        // Health is for everybody: whoever watches over servers need not be able to use them.
        .add_service(health_service.max_decoding_message_size(UNARY_BYTES))
        .add_service(Gated::new(
            reflection().build_v1()?.max_decoding_message_size(UNARY_BYTES),
            tokens(),
            refusals.clone(),
        ))
        .add_service(Gated::new(
            reflection().build_v1alpha()?.max_decoding_message_size(UNARY_BYTES),
            tokens(),
            refusals.clone(),
        ));

    // They end with this function.
    let mut watching = tokio::task::JoinSet::new();
    if let Some(listener) = metrics {
        let watched = Arc::clone(&sources);
        watching.spawn(async move { watched.watch_lag().await });
        watching.spawn(metrics::endpoint::serve(listener, Arc::clone(&sources)));
    }
    let mut servers = tokio::task::JoinSet::new();
    for listener in listeners {
        let (router, mut closed, admission, tls) =
            (router.clone(), drain.clone(), admission.clone(), guards.tls.clone());
        servers.spawn(async move {
            let end = async move { closed.closed().await };
            match (listener, tls) {
                (Listener::Tcp(listener), Some(tls)) => {
                    router.serve_with_incoming_shutdown(listener::tls_connections(listener, admission, tls), end).await
                }
                (Listener::Tcp(listener), None) => {
                    router.serve_with_incoming_shutdown(listener::tcp_connections(listener, admission), end).await
                }
                (Listener::Unix(listener, file), _) => {
                    router
                        .serve_with_incoming_shutdown(listener::unix_connections(listener, file, admission), end)
                        .await
                }
            }
        });
    }
    tokio::select! {
        () = shutdown => {}
        () = capacity_health::watch(&health, &places, &pool) => {}
        // A listener ends by itself only if it fails.
        Some(ended) = servers.join_next() => return Ok(ended.map_err(io::Error::other)??),
    }

    tracing::info!(grace_seconds = config.grace_seconds, "shutting down: no new sessions");
    controller.set(Phase::Draining);
    health.set_not_serving::<PerturbServer<Service>>().await;
    health.set_not_serving::<EnvironmentServer<dm_env_rpc::service::Service>>().await;
    health.set_service_status(capacity_health::NEW_SESSIONS, ServingStatus::NotServing).await;
    health.set_service_status("", ServingStatus::NotServing).await;
    if tokio::time::timeout(config.grace(), controller.idle()).await.is_err() {
        tracing::warn!("the grace period is over: ending the sessions that still run");
    }
    controller.set(Phase::Closed);
    for (protocol, counts) in &sources.requests {
        tracing::info!(protocol, "requests: {counts}");
    }
    let farewell = async { while servers.join_next().await.is_some() {} };
    if tokio::time::timeout(FAREWELL, farewell).await.is_err() {
        tracing::debug!("some connections did not close by themselves");
    }
    if let Some(ledger) = &guards.ledger {
        ledger.close().await;
    }
    Ok(())
}

/// The catalogue as the protocol tells it, of a server with these settings. Builds each environment once, so that a
/// model that cannot be loaded is known before anything is served.
///
/// # Errors
/// [`env::Error`].
pub fn listing(catalogue: &Catalogue, config: &Config) -> Result<proto::ListEnvironmentsResponse, env::Error> {
    let environments = catalogue.specs().map(|spec| Ok(convert::environment(spec, (spec.make)()?.model_hash())));
    Ok(proto::ListEnvironmentsResponse {
        environments: environments.collect::<Result<_, env::Error>>()?,
        server_version: env!("CARGO_PKG_VERSION").into(),
        max_batch_size: u32::try_from(config.max_envs).unwrap_or(u32::MAX),
    })
}
