//! Limits and defaults that servers and clients must agree on.

use std::ops::RangeInclusive;

/// The name of the gRPC service, as clients send it in health checks.
pub const SERVICE: &str = "perturb.v1.Perturb";
/// Default TCP port of a server, which by default listens only on the loopback interface.
pub const DEFAULT_PORT: u16 = 7447;
/// Default limit of the number of environments on a server, over all sessions.
pub const DEFAULT_MAX_ENVS: usize = 16_384;
/// Default limit of the size of a request, in bytes.
pub const DEFAULT_MAX_MESSAGE_BYTES: usize = 64 << 20;
/// Maximal number of intervals in a distribution. The limit saves memory: every environment may have its own
/// distributions.
pub const MAX_INTERVALS: usize = 64;
/// Maximal number of contexts that the trials of an environment are drawn from.
pub const MAX_DRAWN_CONTEXTS: usize = 1024;
/// Accepted width or height of a picture, in pixels.
pub const PICTURE_PIXELS: RangeInclusive<u16> = 16..=2048;
/// Default width and height of a picture, in pixels.
pub const DEFAULT_PICTURE_PIXELS: u16 = 480;
/// Maximal length of the path of a Unix socket on Linux, in bytes.
pub const MAX_SOCKET_PATH_BYTES: usize = 107;
