//! Reports to load balancers, through gRPC's health service, whether the server has room for another session.

use super::peer_limiter::PeerLimiter;
use crate::pool::Pool;
use tonic_health::{ServingStatus, server::HealthReporter};

/// The service name whose health is NOT_SERVING while the number of sessions or of environments is at its limit, and
/// during a shutdown.
pub const NEW_SESSIONS: &str = "perturb.v1.Perturb.NewSessions";

/// Keeps the health status of [`NEW_SESSIONS`] up to date. Never returns.
pub async fn report_capacity(health: &HealthReporter, sessions: &PeerLimiter, pool: &Pool) {
    let mut reported = None;
    loop {
        let full = sessions.in_use() >= sessions.limit() || pool.environments() >= pool.limit();
        let status = if full { ServingStatus::NotServing } else { ServingStatus::Serving };
        if reported.replace(full) != Some(full) {
            health.set_service_status(NEW_SESSIONS, status).await;
        }
        tokio::select! {
            () = sessions.changed() => {}
            () = pool.changed() => {}
        }
    }
}
