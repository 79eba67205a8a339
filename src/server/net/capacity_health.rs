//! The health service tells load balancers whether there is room for another session.

use super::peer_limiter::PeerLimiter;
use crate::pool::Pool;
use tonic_health::{ServingStatus, server::HealthReporter};

/// The name for which health says NOT_SERVING while all sessions or all environments are taken, and in a drain.
pub const NEW_SESSIONS: &str = "perturb.v1.Perturb.NewSessions";

/// Updates the health of [`NEW_SESSIONS`], for ever.
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
