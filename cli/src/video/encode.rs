//! What encoders of all formats do.

/// What encodes frames to a file.
pub(super) trait Encode {
    /// Of the whole picture, width and height in pixels.
    fn size(&self) -> (u32, u32);

    /// Adds a frame `[height, width, 3]` that is shown for about so many `seconds`.
    fn write(&mut self, frame: &[u8], seconds: f64) -> std::io::Result<()>;

    /// The frames that came are an episode.
    fn end_episode(&mut self) {}

    /// Completes the file, which shows one frame of so many: 1 if it shows all.
    fn finish(self: Box<Self>) -> std::io::Result<u16>;
}
