//! Episodes as a contact sheet: one picture, with a few moments of each.

use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use super::encode::Encode;

/// Pictures in a row, which the sets of parameters share, …
const ROW: usize = 6;
/// … but each has its start and its end.
const LEAST: usize = 2;
/// Of an episode so many frames are kept, and half of them forgotten when there are more.
const KEPT: usize = 64;
/// Between moments and between sets, in pixels; white.
const SEAM: usize = 2;
const GAP: usize = 8;
/// The largest sheet: 256 MiB while it is made.
const MOST_BYTES: usize = 1 << 28;

/// How many episodes a film has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    /// Sets of parameters: they stand side by side in a sheet.
    pub sets: usize,
    /// Of each set: they stand below each other.
    pub episodes: usize,
}

impl Grid {
    /// Pictures of an episode.
    fn moments(self) -> usize {
        (ROW / self.sets.max(1)).max(LEAST)
    }

    /// What they take in a row, in pixels, if each is so wide.
    fn across(self, width: usize) -> usize {
        self.moments() * (width + SEAM) - SEAM
    }
}

/// Writes a PNG with a row for each episode, evenly spaced moments of it from the first to the last.
pub(super) struct SheetEncoder {
    path: PathBuf,
    grid: Grid,
    /// Of a frame and of the sheet, width and height in pixels.
    frame: (usize, usize),
    sheet: (usize, usize),
    pixels: Vec<u8>,
    /// Episodes that are on the sheet.
    done: usize,
    /// Of the present one: every `stride`-th of its `count` frames, and the last.
    kept: Vec<Vec<u8>>,
    stride: usize,
    count: usize,
    last: Vec<u8>,
}

impl SheetEncoder {
    pub(super) fn new(path: &Path, (width, height): (u32, u32), grid: Grid) -> io::Result<Self> {
        let frame = (width as usize, height as usize);
        let across = (grid.across(frame.0) + GAP).saturating_mul(grid.sets).saturating_sub(GAP);
        let sheet = (across, frame.1.saturating_mul(grid.episodes));
        let bytes = sheet.0.saturating_mul(sheet.1).saturating_mul(3);
        if bytes > MOST_BYTES {
            let (most, megabytes) = (MOST_BYTES >> 20, bytes >> 20);
            return Err(io::Error::other(format!(
                "a sheet of {} × {} pixels takes {megabytes} MiB, expected at most {most}: give fewer episodes or smaller pictures",
                sheet.0, sheet.1
            )));
        }
        let pixels = vec![u8::MAX; bytes];
        let (kept, last) = (Vec::new(), Vec::new());
        Ok(Self { path: path.to_owned(), grid, frame, sheet, pixels, done: 0, kept, stride: 1, count: 0, last })
    }

    /// Puts a frame of the present episode where its `moment` has its place.
    fn place(&mut self, frame: &[u8], moment: usize) {
        let (width, height) = self.frame;
        let (set, episode) = (self.done / self.grid.episodes, self.done % self.grid.episodes);
        let x = set * (self.grid.across(width) + GAP) + moment * (width + SEAM);
        for (row, from) in frame.chunks_exact(3 * width).enumerate() {
            let start = 3 * ((episode * height + row) * self.sheet.0 + x);
            self.pixels[start..start + from.len()].copy_from_slice(from);
        }
    }
}

impl Encode for SheetEncoder {
    fn size(&self) -> (u32, u32) {
        (self.sheet.0 as u32, self.sheet.1 as u32)
    }

    fn write(&mut self, frame: &[u8], _seconds: f64) -> io::Result<()> {
        let expected = 3 * self.frame.0 * self.frame.1;
        if frame.len() != expected || self.done == self.grid.sets * self.grid.episodes {
            let has = format!("{} bytes in episode {}", frame.len(), self.done + 1);
            return Err(io::Error::other(format!("a frame has {has}, expected {expected} in one of {:?}", self.grid)));
        }
        if self.count.is_multiple_of(self.stride) {
            if self.kept.len() == KEPT {
                let mut index = 0;
                self.kept.retain(|_| {
                    index += 1;
                    index % 2 == 1
                });
                self.stride *= 2;
            }
            self.kept.push(frame.to_owned());
        }
        self.count += 1;
        self.last.clear();
        self.last.extend_from_slice(frame);
        Ok(())
    }

    fn end_episode(&mut self) {
        let moments = self.grid.moments().min(self.count);
        let (kept, last) = (std::mem::take(&mut self.kept), std::mem::take(&mut self.last));
        for moment in 0..moments {
            let index = moment * (self.count - 1) / (moments - 1).max(1);
            let near = (index + self.stride / 2) / self.stride;
            let is_last = moment + 1 == moments;
            self.place(if is_last { &last } else { kept.get(near).unwrap_or(&last) }, moment);
        }
        self.done += 1;
        (self.stride, self.count) = (1, 0);
    }

    fn finish(self: Box<Self>) -> io::Result<u16> {
        let (width, height) = self.size();
        let mut encoder = png::Encoder::new(BufWriter::new(File::create(&self.path)?), width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().map_err(io::Error::other)?;
        writer.write_image_data(&self.pixels).map_err(io::Error::other)?;
        writer.finish().map_err(io::Error::other)?;
        Ok(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The frames' first bytes on a sheet of frames of 2 × 1 pixels: of each row, of each picture.
    fn sheet(grid: Grid, lengths: &[usize]) -> Vec<Vec<u8>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let mut encoder = SheetEncoder::new(&path, (2, 1), grid).unwrap();
        for &length in lengths {
            for step in 0..length {
                encoder.write(&[(100 * step / length) as u8; 6], 0.0).unwrap();
            }
            encoder.end_episode();
        }
        let size = encoder.size();
        Box::new(encoder).finish().unwrap();
        let mut reader = png::Decoder::new(io::BufReader::new(File::open(path).unwrap())).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        assert_eq!(size, (reader.info().width, reader.info().height));
        // A seam is as wide as a frame.
        let row = |row: &[u8]| row.chunks(6).map(|frame| frame[0]).collect();
        pixels.chunks(3 * size.0 as usize).map(row).collect()
    }

    #[test]
    fn moments_are_evenly_spaced_from_the_first_to_the_last() {
        let one = |length| -> Vec<u8> {
            let row = sheet(Grid { sets: 1, episodes: 1 }, &[length]).concat();
            assert!(row.iter().skip(1).step_by(2).all(|&seam| seam == 255), "{row:?}");
            row.into_iter().step_by(2).collect()
        };
        assert_eq!(one(100), [0, 20, 40, 60, 80, 99], "to a few frames: 19, 39, 59 and 79 are between those kept");
        assert_eq!(one(6), [0, 16, 33, 50, 66, 83]);
        assert_eq!(one(3), [0, 33, 66, 255, 255, 255], "no more than there are");
        assert_eq!(one(1), [0, 255, 255, 255, 255, 255]);
        let long = one(10_000);
        assert!(long.iter().zip([0, 20, 40, 60, 80, 99]).all(|(a, b)| a.abs_diff(b) <= 2), "{long:?}");
    }

    #[test]
    fn sets_stand_side_by_side_and_episodes_below_each_other() {
        let rows = sheet(Grid { sets: 2, episodes: 2 }, &[3, 4, 5, 6]);
        let gap = [255; 4];
        assert_eq!(rows[0], [&[0, 255, 33, 255, 66][..], &gap, &[0, 255, 40, 255, 80]].concat());
        assert_eq!(rows[1], [&[0, 255, 25, 255, 75][..], &gap, &[0, 255, 33, 255, 83]].concat());
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let error = SheetEncoder::new(&path, (2048, 2100), Grid { sets: 3, episodes: 1000 }).err().unwrap();
        assert!(error.to_string().contains("expected at most 256: give fewer episodes"), "{error}");
        let mut encoder = SheetEncoder::new(&path, (2, 1), Grid { sets: 1, episodes: 1 }).unwrap();
        assert!(encoder.write(&[0; 5], 0.0).unwrap_err().to_string().contains("5 bytes"));
        encoder.write(&[0; 6], 0.0).unwrap();
        encoder.end_episode();
        assert!(encoder.write(&[0; 6], 0.0).unwrap_err().to_string().contains("episode 2, expected"));
    }
}
