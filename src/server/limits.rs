//! Size limits of requests.

/// The maximum length of a request before a session is open: enough for thousands of groups with parameters. Bytes
/// beyond the first 64 KiB count against the memory budget.
pub const MAX_BYTES_BEFORE_OPEN: usize = 1 << 20;

/// The size limits of the next request of a stream.
#[derive(Debug, Clone, Copy)]
pub struct RequestLimits {
    /// The most bytes of a message.
    pub bytes: usize,
    /// The most entries of fields that have one for each environment.
    pub entries: usize,
    /// The bytes of a message that are already reserved in the memory budget.
    pub covered: usize,
}
