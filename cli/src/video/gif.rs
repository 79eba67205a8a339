//! Frames as a GIF.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use gif::{DisposalMethod, Encoder, Frame, Repeat};

use super::encode::Encode;
use super::palette::{Palette, UNCHANGED};

/// The largest GIF: pages that show one, and mails, rarely take more.
const MOST_BYTES: usize = 2_000_000;
/// A shorter delay, in hundredths of a second, is what many programs take for "as slow as they like".
const SHORTEST: f64 = 2.0;
/// Of so many frames one is shown: as few as it takes.
const STRIDES: [u16; 19] = [1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24, 32, 64, 128, 256, 512, 1024, 4096, 16_384];
/// Bytes before the frames and after them: the screen, 256 colours, that it is repeated, the end.
const FRAME_FREE: usize = 13 + 3 * 256 + 19 + 1;
/// Bytes of a frame beside its data: how long and where it is shown, and the end of its data.
const FRAME_HEAD: usize = 8 + 10 + 2;

/// How long a GIF shows a frame that should be seen for so many `seconds`: in whole hundredths of a second.
pub(super) fn delay(seconds: f64) -> u16 {
    (100.0 * seconds).round().clamp(SHORTEST, f64::from(u16::MAX)) as u16
}

/// Writes a GIF that is repeated for ever, of at most [`MOST_BYTES`].
///
/// How many frames fit is known at the end, when they are gone. So several films are made at once, with fewer and fewer
/// frames; one that is too large is forgotten, and the fullest that is left is written. Each takes the memory of a whole
/// one and of a frame.
pub(super) struct GifEncoder {
    file: File,
    size: (u16, u16),
    seconds: f64,
    palette: Option<Palette>,
    /// The present frame: of each pixel the index in the palette.
    indices: Vec<u8>,
    /// The length of the frames so far, in hundredths of a second.
    time: u64,
    films: Vec<Thinned>,
}

impl GifEncoder {
    pub(super) fn new(path: &Path, (width, height): (u32, u32), fps: f64) -> io::Result<Self> {
        let fits = |pixels: u32| {
            u16::try_from(pixels).map_err(|_| io::Error::other(format!("a GIF has no {pixels} pixels in a row")))
        };
        let (size, seconds) = ((fits(width)?, fits(height)?), 1.0 / fps);
        // So short that the delay of a frame can be written, even if one that is held comes in between.
        let fits =
            |stride: &u16| *stride == 1 || u32::from(*stride) * u32::from(delay(seconds)) <= u32::from(u16::MAX / 2);
        let films = STRIDES.into_iter().filter(fits).map(|stride| Thinned::new(stride, delay(seconds))).collect();
        let file = File::create(path)?;
        Ok(Self { file, size, seconds, palette: None, indices: Vec::new(), time: 0, films })
    }
}

impl Encode for GifEncoder {
    fn size(&self) -> (u32, u32) {
        (self.size.0.into(), self.size.1.into())
    }

    fn write(&mut self, frame: &[u8], seconds: f64) -> io::Result<()> {
        let (width, height) = (usize::from(self.size.0), usize::from(self.size.1));
        let expected = width * height * 3;
        if frame.len() != expected {
            return Err(io::Error::other(format!("a frame has {} bytes, expected {expected}", frame.len())));
        }
        self.palette.get_or_insert_with(|| Palette::learn(frame)).indices(frame, &mut self.indices);
        let delay = delay(seconds.max(self.seconds));
        for film in &mut self.films {
            film.add(&self.indices, width, self.time, delay);
        }
        self.films.retain(|film| film.bytes <= MOST_BYTES);
        self.time += u64::from(delay);
        if self.films.is_empty() {
            let megabytes = MOST_BYTES / 1_000_000;
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

/// A film of every `stride`-th frame.
struct Thinned {
    stride: u16,
    /// The frame is shown that is seen at each multiple of it, in hundredths of a second, and any that is held.
    interval: u64,
    /// What a frame takes that is not.
    usual: u16,
    /// Compressed.
    frames: Vec<Frame<'static>>,
    /// Of the file, so far.
    bytes: usize,
    /// What is seen after the last of `frames`.
    seen: Vec<u8>,
}

impl Thinned {
    fn new(stride: u16, delay: u16) -> Self {
        let interval = u64::from(stride) * u64::from(delay);
        Self { stride, interval, usual: delay, frames: Vec::new(), bytes: FRAME_FREE, seen: Vec::new() }
    }

    /// Adds a frame that is to be seen from `time` on, or shows the one before it longer.
    fn add(&mut self, indices: &[u8], width: usize, time: u64, delay: u16) {
        if delay > self.usual || time.next_multiple_of(self.interval) < time + u64::from(delay) {
            let frame = changes(&mut self.seen, indices, width);
            self.bytes += FRAME_HEAD + frame.buffer.len() + frame.buffer.len().div_ceil(255);
            self.frames.push(frame);
        }
        if let Some(last) = self.frames.last_mut() {
            last.delay = last.delay.saturating_add(delay);
        }
    }
}

/// The rectangle of what changes, compressed, from what is `seen`, nothing at first, to `indices`, which then are.
fn changes(seen: &mut Vec<u8>, indices: &[u8], width: usize) -> Frame<'static> {
    seen.resize(indices.len(), UNCHANGED); // which no pixel is
    let (mut left, mut right, mut top, mut bottom) = (width, 0, usize::MAX, 0);
    for (row, (seen, new)) in seen.chunks_exact(width).zip(indices.chunks_exact(width)).enumerate() {
        let differs = |(seen, new)| seen != new;
        let Some(first) = seen.iter().zip(new).position(differs) else { continue };
        let last = seen.iter().zip(new).rposition(differs).unwrap_or(first);
        (left, right) = (left.min(first), right.max(last + 1));
        (top, bottom) = (top.min(row), row + 1);
    }
    if bottom == 0 {
        (left, right, top, bottom) = (0, 1, 0, 1); // a frame has a pixel
    }
    let mut buffer = Vec::with_capacity((right - left) * (bottom - top));
    for row in top..bottom {
        let row = row * width + left..row * width + right;
        let pixels = seen[row.clone()].iter().zip(&indices[row]);
        buffer.extend(pixels.map(|(seen, new)| if seen == new { UNCHANGED } else { *new }));
    }
    seen.copy_from_slice(indices);
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
    frame.buffer.to_mut().shrink_to_fit(); // there was room for half of the pixels
    frame
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encoder(folder: &tempfile::TempDir, size: (u32, u32), fps: f64) -> Box<GifEncoder> {
        Box::new(GifEncoder::new(&folder.path().join("a.gif"), size, fps).unwrap())
    }

    /// What is seen, and for how long, and how many pixels were written for it.
    fn decoded(folder: &tempfile::TempDir) -> Vec<(Vec<u8>, u16, usize)> {
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(File::open(folder.path().join("a.gif")).unwrap()).unwrap();
        let (width, height) = (usize::from(decoder.width()), usize::from(decoder.height()));
        let (mut seen, mut frames) = (vec![0; 3 * width * height], Vec::new());
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            let (left, top) = (usize::from(frame.left), usize::from(frame.top));
            for (index, pixel) in frame.buffer.chunks(4).enumerate().filter(|(_, pixel)| pixel[3] > 0) {
                let (row, column) = (index / usize::from(frame.width), index % usize::from(frame.width));
                seen[3 * ((top + row) * width + left + column)..][..3].copy_from_slice(&pixel[..3]);
            }
            frames.push((seen.clone(), frame.delay, frame.buffer.len() / 4));
        }
        frames
    }

    /// Frames of `pixels` grey pixels, which differ all.
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
    fn only_what_changes_is_written_and_what_was_drawn_is_seen() {
        let folder = tempfile::tempdir().unwrap();
        let mut encoder = encoder(&folder, (40, 30), 10.0);
        // A square on a ground of several colours stands still for a frame, and moves.
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
    fn a_long_film_shows_fewer_frames_fits_and_takes_as_long() {
        let folder = tempfile::tempdir().unwrap();
        let mut encoder = encoder(&folder, (200, 200), 50.0);
        let mut noise = noise(200 * 200);
        let drawn: Vec<Vec<u8>> = (0..300).map(|_| noise()).collect();
        for (index, frame) in drawn.iter().enumerate() {
            encoder.write(frame, if index % 100 == 99 { 2.0 } else { 0.0 }).unwrap();
            let kept: usize = encoder.films.iter().flat_map(|film| &film.frames).map(|frame| frame.buffer.len()).sum();
            assert!(kept <= STRIDES.len() * MOST_BYTES, "no more is kept than of each film a whole one");
        }
        let (counted, stride) = (encoder.films[0].bytes, encoder.films[0].stride);
        assert_eq!(encoder.finish().unwrap(), stride);
        let bytes = std::fs::metadata(folder.path().join("a.gif")).unwrap().len() as usize;
        assert!(stride > 1 && bytes <= counted && counted <= MOST_BYTES && bytes > MOST_BYTES / 2, "{stride}: {bytes}");
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
    fn a_frame_that_is_held_is_shown_however_few_others_are() {
        let mut film = Thinned::new(256, 2);
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
        assert_eq!(delays, [300, 212, 86], "the first, the held one, and that at the first multiple");
    }

    #[test]
    fn what_does_not_fit_even_so_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut encoder = encoder(&folder, (2000, 1400), 50.0);
        let error = encoder.write(&noise(2000 * 1400)(), 0.0).unwrap_err().to_string();
        assert!(error.contains("GIF of 2 MB: give smaller pictures or fewer episodes"), "{error}");
    }
}
