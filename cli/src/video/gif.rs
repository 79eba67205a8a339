//! Encodes frames as a GIF.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use gif::{DisposalMethod, Encoder, Frame, Repeat};

use super::encode::Encode;
use super::palette::{Palette, UNCHANGED};

/// Maximum size of a GIF. Web pages and mails often refuse larger ones.
const MAX_BYTES: usize = 2_000_000;
/// Minimum delay of a frame, in hundredths of a second. Many programs show shorter delays much slower.
const MIN_DELAY: f64 = 2.0;
/// Numbers n for films that show every n-th frame. The smallest n whose film fits into [`MAX_BYTES`] is used.
const STRIDES: [u16; 19] = [1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24, 32, 64, 128, 256, 512, 1024, 4096, 16_384];
/// Number of bytes of a file without frames: screen descriptor, 256 colours, repetition and end.
const FILE_OVERHEAD_BYTES: usize = 13 + 3 * 256 + 19 + 1;
/// Number of bytes of a frame in addition to its pixels: delay, position and end.
const FRAME_OVERHEAD_BYTES: usize = 8 + 10 + 2;

/// Returns the GIF delay of a frame that is shown for `seconds`. The unit is hundredths of a second.
pub(super) fn delay(seconds: f64) -> u16 {
    (100.0 * seconds).round().clamp(MIN_DELAY, f64::from(u16::MAX)) as u16
}

/// An encoder that writes a GIF of at most [`MAX_BYTES`]. The GIF repeats endlessly.
///
/// The number of frames that fit is not known before the end. So the encoder makes several films at the same time,
/// which show every n-th frame for different n. It drops a film that becomes too large, and writes the remaining film
/// with the most frames. Each film needs the memory of a whole GIF and of a frame.
pub(super) struct GifEncoder {
    file: File,
    size: (u16, u16),
    seconds: f64,
    palette: Option<Palette>,
    /// Palette index of each pixel of the current frame.
    indices: Vec<u8>,
    /// Total duration of the frames so far, in hundredths of a second.
    time: u64,
    films: Vec<ThinnedFilm>,
}

impl GifEncoder {
    pub(super) fn new(path: &Path, (width, height): (u32, u32), fps: f64) -> io::Result<Self> {
        let fits = |pixels: u32| {
            u16::try_from(pixels).map_err(|_| io::Error::other(format!("a GIF has no {pixels} pixels in a row")))
        };
        let size = (fits(width)?, fits(height)?);
        let seconds = 1.0 / fps;
        // The delay of a shown frame includes the delays of the skipped frames after it, and must fit into 16 bits.
        // Half of the range is reserved for the longer delay of an episode's last frame.
        let fits =
            |stride: &u16| *stride == 1 || u32::from(*stride) * u32::from(delay(seconds)) <= u32::from(u16::MAX / 2);
        let films = STRIDES.into_iter().filter(fits).map(|stride| ThinnedFilm::new(stride, delay(seconds))).collect();
        let file = File::create(path)?;
        Ok(Self { file, size, seconds, palette: None, indices: Vec::new(), time: 0, films })
    }
}

impl Encode for GifEncoder {
    fn size(&self) -> (u32, u32) {
        (self.size.0.into(), self.size.1.into())
    }

    fn write(&mut self, frame: &[u8], seconds: f64) -> io::Result<()> {
        let width = usize::from(self.size.0);
        let height = usize::from(self.size.1);
        let expected = width * height * 3;
        if frame.len() != expected {
            return Err(io::Error::other(format!("a frame has {} bytes, expected {expected}", frame.len())));
        }
        self.palette.get_or_insert_with(|| Palette::learn(frame)).indices(frame, &mut self.indices);
        let delay = delay(seconds.max(self.seconds));
        for film in &mut self.films {
            film.add(&self.indices, width, self.time, delay);
        }
        self.films.retain(|film| film.bytes <= MAX_BYTES);
        self.time += u64::from(delay);
        if self.films.is_empty() {
            let megabytes = MAX_BYTES / 1_000_000;
            return Err(io::Error::other(format!(
                "it does not fit into a GIF of {megabytes} MB: give smaller pictures or fewer episodes, or write an .mp4"
            )));
        }
        Ok(())
    }

    fn finish(self: Box<Self>) -> io::Result<u16> {
        let colours = self.palette.map(|palette| palette.bytes()).unwrap_or_default();
        let (width, height) = self.size;
        let mut encoder = Encoder::new(BufWriter::new(self.file), width, height, &colours).map_err(io::Error::other)?;
        encoder.set_repeat(Repeat::Infinite).map_err(io::Error::other)?;
        let Some(film) = self.films.first() else { return Ok(1) };
        for frame in &film.frames {
            encoder.write_lzw_pre_encoded_frame(frame).map_err(io::Error::other)?;
        }
        encoder.into_inner().map_err(io::Error::other)?.flush()?;
        Ok(film.stride)
    }
}

/// A film that shows every `stride`-th frame.
struct ThinnedFilm {
    stride: u16,
    /// Time between two shown frames, in hundredths of a second. The last frame of an episode is always shown, even if
    /// less time has passed.
    interval: u64,
    /// Duration of a normal frame, in hundredths of a second. The last frame of an episode is shown longer.
    frame_delay: u16,
    /// Compressed frames.
    frames: Vec<Frame<'static>>,
    /// Size of the file so far.
    bytes: usize,
    /// Pixels that are visible after the last of `frames`.
    visible: Vec<u8>,
}

impl ThinnedFilm {
    fn new(stride: u16, delay: u16) -> Self {
        let interval = u64::from(stride) * u64::from(delay);
        Self {
            stride,
            interval,
            frame_delay: delay,
            frames: Vec::new(),
            bytes: FILE_OVERHEAD_BYTES,
            visible: Vec::new(),
        }
    }

    /// Adds a frame that begins at `time`. If the film skips this frame, the frame before it is shown for longer. Times
    /// are in hundredths of a second.
    fn add(&mut self, indices: &[u8], width: usize, time: u64, delay: u16) {
        // The film shows the last frame of an episode, which has a longer delay, and each frame during which a multiple
        // of `interval` occurs.
        if delay > self.frame_delay || time.next_multiple_of(self.interval) < time + u64::from(delay) {
            let frame = changed_rectangle(&mut self.visible, indices, width);
            self.bytes += FRAME_OVERHEAD_BYTES + frame.buffer.len() + frame.buffer.len().div_ceil(255);
            self.frames.push(frame);
        }
        if let Some(last) = self.frames.last_mut() {
            last.delay = last.delay.saturating_add(delay);
        }
    }
}

/// Returns a compressed frame of the smallest rectangle that contains all pixels in which `visible` and `indices`
/// differ. Updates `visible`, which is empty before the first frame.
fn changed_rectangle(visible: &mut Vec<u8>, indices: &[u8], width: usize) -> Frame<'static> {
    visible.resize(indices.len(), UNCHANGED); // no pixel of `indices` has this value, so all differ from it
    let mut left = width;
    let mut right = 0;
    let mut top = usize::MAX;
    let mut bottom = 0;
    for (row, (visible, new)) in visible.chunks_exact(width).zip(indices.chunks_exact(width)).enumerate() {
        let differs = |(visible, new)| visible != new;
        let Some(first) = visible.iter().zip(new).position(differs) else { continue };
        let last = visible.iter().zip(new).rposition(differs).unwrap_or(first);
        (left, right) = (left.min(first), right.max(last + 1));
        (top, bottom) = (top.min(row), row + 1);
    }
    if bottom == 0 {
        (left, right, top, bottom) = (0, 1, 0, 1); // a frame must have at least one pixel
    }
    let mut buffer = Vec::with_capacity((right - left) * (bottom - top));
    for row in top..bottom {
        let row = row * width + left..row * width + right;
        let pixels = visible[row.clone()].iter().zip(&indices[row]);
        buffer.extend(pixels.map(|(visible, new)| if visible == new { UNCHANGED } else { *new }));
    }
    visible.copy_from_slice(indices);
    let mut frame = Frame {
        dispose: DisposalMethod::Keep,
        transparent: Some(UNCHANGED),
        left: left as u16,
        top: top as u16,
        width: (right - left) as u16,
        height: (bottom - top) as u16,
        buffer: buffer.into(),
        ..Frame::default()
    };
    frame.make_lzw_pre_encoded();
    frame.buffer.to_mut().shrink_to_fit(); // its capacity is half the number of pixels
    frame
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encoder(folder: &tempfile::TempDir, size: (u32, u32), fps: f64) -> Box<GifEncoder> {
        Box::new(GifEncoder::new(&folder.path().join("a.gif"), size, fps).unwrap())
    }

    /// Returns for each frame the pixels that are visible after it, its delay in hundredths of a second, and the number
    /// of pixels in its rectangle.
    fn decoded(folder: &tempfile::TempDir) -> Vec<(Vec<u8>, u16, usize)> {
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(File::open(folder.path().join("a.gif")).unwrap()).unwrap();
        let width = usize::from(decoder.width());
        let height = usize::from(decoder.height());
        let mut seen = vec![0; 3 * width * height];
        let mut frames = Vec::new();
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            let left = usize::from(frame.left);
            let top = usize::from(frame.top);
            for (index, pixel) in frame.buffer.chunks(4).enumerate().filter(|(_, pixel)| pixel[3] > 0) {
                let row = index / usize::from(frame.width);
                let column = index % usize::from(frame.width);
                seen[3 * ((top + row) * width + left + column)..][..3].copy_from_slice(&pixel[..3]);
            }
            frames.push((seen.clone(), frame.delay, frame.buffer.len() / 4));
        }
        frames
    }

    /// Returns a function that makes a new frame of `pixels` random grey pixels at each call.
    fn noise(pixels: usize) -> impl FnMut() -> Vec<u8> {
        let mut state = 1_u32;
        move || {
            let mut grey = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 26) as u8 * 4
            };
            (0..pixels).flat_map(|_| [grey(); 3]).collect()
        }
    }

    #[test]
    fn delays_are_hundredths_that_programs_respect() {
        let delays = [0.05, 0.0165, 0.001, 1.0, 0.2, 1e9].map(delay);
        assert_eq!(delays, [5, 2, 2, 100, 20, u16::MAX]);
    }

    #[test]
    fn a_frame_of_another_size_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut encoder = encoder(&folder, (4, 2), 10.0);
        assert!(encoder.write(&[0; 23], 0.1).unwrap_err().to_string().contains("23 bytes, expected 24"));
        assert!(encoder.write(&[0; 24], 0.1).is_ok());
        assert!(GifEncoder::new(&folder.path().join("a.gif"), (70_000, 2), 10.0).is_err());
    }

    #[test]
    fn only_changed_pixels_are_written() {
        let folder = tempfile::tempdir().unwrap();
        let mut encoder = encoder(&folder, (40, 30), 10.0);
        // A square on a background of several colours stands still for a frame and then moves.
        let drawn: Vec<Vec<u8>> = [0, 0, 3, 17, 35]
            .map(|place| {
                let is_square = |x: usize, y: usize| (place..place + 5).contains(&x) && (9..12).contains(&y);
                let colour = |x, y| if is_square(x, y) { [213, 94, 0] } else { [x / 4 * 20, y / 3 * 25, 200] };
                (0..30).flat_map(|y| (0..40).flat_map(move |x| colour(x, y).map(|value| value as u8))).collect()
            })
            .into();
        for frame in &drawn {
            encoder.write(frame, 0.0).unwrap();
        }
        assert_eq!(encoder.finish().unwrap(), 1);
        let (seen, sizes): (Vec<_>, Vec<_>) =
            decoded(&folder).into_iter().map(|(seen, _, pixels)| (seen, pixels)).unzip();
        assert!(seen == drawn);
        assert_eq!(sizes, [40 * 30, 1, 8 * 3, 19 * 3, 23 * 3]);
    }

    #[test]
    fn a_long_film_shows_fewer_frames_in_the_same_time() {
        let folder = tempfile::tempdir().unwrap();
        let mut encoder = encoder(&folder, (200, 200), 50.0);
        let mut noise = noise(200 * 200);
        let drawn: Vec<Vec<u8>> = (0..300).map(|_| noise()).collect();
        for (index, frame) in drawn.iter().enumerate() {
            encoder.write(frame, if index % 100 == 99 { 2.0 } else { 0.0 }).unwrap();
            let kept: usize = encoder.films.iter().flat_map(|film| &film.frames).map(|frame| frame.buffer.len()).sum();
            assert!(kept <= STRIDES.len() * MAX_BYTES, "each film keeps at most a whole GIF");
        }
        let counted = encoder.films[0].bytes;
        let stride = encoder.films[0].stride;
        assert_eq!(encoder.finish().unwrap(), stride);
        let bytes = std::fs::metadata(folder.path().join("a.gif")).unwrap().len() as usize;
        assert!(stride > 1 && bytes <= counted && counted <= MAX_BYTES && bytes > MAX_BYTES / 2, "{stride}: {bytes}");
        let frames = decoded(&folder);
        assert_eq!(frames.iter().map(|frame| u32::from(frame.1)).sum::<u32>(), 3 * (99 * 2 + 200));
        for end in [99, 199, 299] {
            let shown = frames.iter().find(|frame| frame.0 == drawn[end]);
            assert!(shown.is_some_and(|frame| frame.1 >= 200), "an episode's end is always shown");
        }
        assert!(frames.iter().all(|(seen, ..)| drawn.contains(seen)));
        assert!(frames.len().abs_diff(297 / usize::from(stride) + 3) <= 3, "{} of 300", frames.len());
    }

    #[test]
    fn last_frames_of_episodes_are_always_shown() {
        let mut film = ThinnedFilm::new(256, 2);
        for frame in 0..200_u64 {
            let held = frame == 150;
            film.add(
                &[frame as u8 + 1; 4],
                2,
                2 * frame + if frame > 150 { 198 } else { 0 },
                if held { 200 } else { 2 },
            );
        }
        let delays: Vec<u16> = film.frames.iter().map(|frame| frame.delay).collect();
        assert_eq!(delays, [300, 212, 86], "the first, the held one, and the one at the first multiple");
    }

    #[test]
    fn films_that_cannot_fit_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut encoder = encoder(&folder, (2000, 1400), 50.0);
        let error = encoder.write(&noise(2000 * 1400)(), 0.0).unwrap_err().to_string();
        assert!(error.contains("GIF of 2 MB: give smaller pictures or fewer episodes"), "{error}");
    }
}
