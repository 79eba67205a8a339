//! What encoders of both formats do.

/// What encodes frames to a file.
pub(super) trait Encode {
    /// Adds a frame `[height, width, 3]` that is shown for about so many `seconds`. What went wrong is said in words.
    fn write(&mut self, frame: &[u8], seconds: f64) -> Result<(), String>;

    /// Completes the file.
    fn finish(self: Box<Self>) -> Result<(), String>;
}
