//! Limits and defaults that servers and clients must agree on.

use std::ops::RangeInclusive;

/// The service's name in health checks.
pub const SERVICE: &str = "perturb.v1.Perturb";
/// Default port of a server on the loopback interface.
pub const DEFAULT_PORT: u16 = 7447;
/// Default limit of a server's environments, over all sessions.
pub const DEFAULT_MAX_ENVS: usize = 16_384;
/// Default limit of the bytes of a request.
pub const DEFAULT_MAX_MESSAGE_BYTES: usize = 64 << 20;
/// Maximal number of intervals of a distribution: every environment holds its own copy.
pub const MAX_INTERVALS: usize = 64;
/// Range of the width and of the height of a picture, in pixels.
pub const PICTURE_PIXELS: RangeInclusive<u16> = 16..=2048;
/// Default width and height of a picture, in pixels.
pub const DEFAULT_PICTURE_PIXELS: u16 = 480;
/// Maximal length of the path of a Unix socket on Linux.
pub const MAX_SOCKET_PATH_BYTES: usize = 107;
