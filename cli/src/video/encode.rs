//! What encoders of both formats do.

/// What encodes frames to a file.
pub(super) trait Encode {
    /// Adds a frame `[height, width, 3]` that is shown for about so many `seconds`.
    fn write(&mut self, frame: &[u8], seconds: f64) -> std::io::Result<()>;

    /// Completes the file.
    fn finish(self: Box<Self>) -> std::io::Result<()>;
}
