//! Size limits of requests.

/// The maximum length of a request before its session is open, bytes: enough for thousands of groups with parameters.
/// Bytes beyond the first 64 KiB count against the memory budget.
pub const MAX_BYTES_BEFORE_OPEN: usize = 1 << 20;

/// The size limits of the next request of a stream.
#[derive(Debug, Clone, Copy)]
pub struct RequestLimits {
    /// The maximum length of the request, bytes.
    pub bytes: usize,
    /// The maximum number of entries in a field that has one entry for each environment. Up to
    /// [`MAX_REPEATED`](super::transport::precheck::MAX_REPEATED) entries are accepted even if this limit is lower.
    pub entries: usize,
    /// The bytes that the session has already reserved for requests. Up to this length a request needs no new
    /// reservation.
    pub covered: usize,
}
