//! The interface that the encoders of all video formats implement.

/// An encoder that writes frames to a file.
pub(super) trait Encode {
    /// Returns the width and height of the whole picture, in pixels.
    fn size(&self) -> (u32, u32);

    /// Adds a frame `[height, width, 3]` that is shown for about `seconds`, and at least for one frame's time.
    fn write(&mut self, frame: &[u8], seconds: f64) -> std::io::Result<()>;

    /// Marks the end of an episode.
    fn end_episode(&mut self) {}

    /// Completes the file. Returns n if the file is a film that shows only every n-th frame, and otherwise 1.
    fn finish(self: Box<Self>) -> std::io::Result<u16>;
}
