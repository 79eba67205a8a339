//! Connections: listeners, TLS, limits for each peer, the threads that serve connections, and the access log.

pub mod access_log;
pub mod capacity_health;
pub mod handshake;
pub mod listener;
pub mod load;
pub mod managed_io;
pub mod peer_limiter;
pub mod probe;
pub mod tls;
pub mod transport_threads;
