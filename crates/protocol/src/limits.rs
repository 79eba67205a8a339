//! The numbers that servers and clients must agree on.

use std::ops::RangeInclusive;

/// The service's name, as its health is asked for.
pub const SERVICE: &str = "perturb.v1.Perturb";
/// Where a server listens on the loopback interface unless told otherwise.
pub const DEFAULT_PORT: u16 = 7447;
/// The most environments of a server, over all sessions, unless told otherwise.
pub const DEFAULT_MAX_ENVS: usize = 16_384;
/// The most bytes of a request unless a server is told otherwise.
pub const DEFAULT_MAX_MESSAGE_BYTES: usize = 64 << 20;
/// The most intervals of one distribution: every environment holds its own copy.
pub const MOST_INTERVALS: usize = 64;
/// Width and height of a picture, in pixels.
pub const PICTURE_PIXELS: RangeInclusive<u16> = 16..=2048;
/// Width and height of a picture unless told otherwise, in pixels.
pub const USUAL_PICTURE_PIXELS: u16 = 480;
/// The longest path that a Unix socket can have on Linux, in bytes.
pub const LONGEST_SOCKET_PATH: usize = 107;
