//! Frames as a GIF.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use gif::{Encoder, Frame, Repeat};

use super::encode::Encode;

/// A shorter delay, in hundredths of a second, is what many programs take for "as slow as they like".
const SHORTEST: f64 = 2.0;
/// How many pixels a palette of 256 colours is learned from: every tenth, as the library advises.
const SAMPLING: i32 = 10;

/// How long a GIF shows a frame that should be seen for so many `seconds`: in whole hundredths of a second.
pub(super) fn delay(seconds: f64) -> u16 {
    (100.0 * seconds).round().clamp(SHORTEST, f64::from(u16::MAX)) as u16
}

/// Writes a GIF that is repeated for ever. Each frame has a palette of its own: all its colours, if there are no more than
/// 256, as in the drawings of the classic tasks; else 256 that are near all of them.
pub(super) struct GifEncoder {
    encoder: Encoder<BufWriter<File>>,
    size: (u16, u16),
    seconds: f64,
}

impl GifEncoder {
    pub(super) fn new(path: &Path, (width, height): (u32, u32), fps: f64) -> io::Result<Self> {
        let fits = |pixels: u32| {
            u16::try_from(pixels).map_err(|_| io::Error::other(format!("a GIF has no {pixels} pixels in a row")))
        };
        let (width, height) = (fits(width)?, fits(height)?);
        let mut encoder =
            Encoder::new(BufWriter::new(File::create(path)?), width, height, &[]).map_err(io::Error::other)?;
        encoder.set_repeat(Repeat::Infinite).map_err(io::Error::other)?;
        Ok(Self { encoder, size: (width, height), seconds: 1.0 / fps })
    }
}

impl Encode for GifEncoder {
    fn size(&self) -> (u32, u32) {
        (self.size.0.into(), self.size.1.into())
    }

    fn write(&mut self, frame: &[u8], seconds: f64) -> io::Result<()> {
        let (width, height) = self.size;
        let expected = usize::from(width) * usize::from(height) * 3;
        if frame.len() != expected {
            return Err(io::Error::other(format!("a frame has {} bytes, expected {expected}", frame.len())));
        }
        let mut frame = Frame::from_rgb_speed(width, height, frame, SAMPLING);
        frame.delay = delay(seconds.max(self.seconds));
        self.encoder.write_frame(&frame).map_err(io::Error::other)
    }

    fn finish(self: Box<Self>) -> io::Result<()> {
        self.encoder.into_inner().map_err(io::Error::other)?.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_are_hundredths_that_programs_respect() {
        let delays = [0.05, 0.0165, 0.001, 1.0, 0.2, 1e9].map(delay);
        assert_eq!(delays, [5, 2, 2, 100, 20, u16::MAX]);
    }

    #[test]
    fn a_frame_of_another_size_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut encoder = GifEncoder::new(&folder.path().join("a.gif"), (4, 2), 10.0).unwrap();
        assert!(encoder.write(&[0; 23], 0.1).unwrap_err().to_string().contains("23 bytes, expected 24"));
        assert!(encoder.write(&[0; 24], 0.1).is_ok());
        assert!(GifEncoder::new(&folder.path().join("a.gif"), (70_000, 2), 10.0).is_err());
    }
}
