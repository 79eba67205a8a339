//! Encodes episodes as a contact sheet: one picture with a few frames of each episode.

use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use super::encode::Encode;

/// Number of pictures in a row of the sheet. The sets of parameters are side by side and share the row.
const PICTURES_PER_ROW: usize = 6;
/// Minimum number of pictures of an episode: its start and its end.
const MIN_PICTURES: usize = 2;
/// Maximum number of frames of an episode in memory. When it is exceeded, every second frame is dropped.
const MAX_FRAMES: usize = 64;
/// Horizontal distance between the pictures of an episode, in pixels.
const PICTURE_GAP: usize = 2;
/// Horizontal distance between two sets, in pixels.
const SET_GAP: usize = 8;
/// Maximum size of a sheet in memory, in bytes: 256 MiB.
const MAX_BYTES: usize = 1 << 28;

/// The layout of a contact sheet: a column for each set of parameters, and a row for each episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EpisodeGrid {
    /// Number of sets of parameters.
    pub sets: usize,
    /// Number of episodes of each set.
    pub episodes: usize,
}

impl EpisodeGrid {
    /// Returns the number of pictures that are shown of an episode.
    fn pictures(self) -> usize {
        (PICTURES_PER_ROW / self.sets.max(1)).max(MIN_PICTURES)
    }

    /// Returns the width of an episode's row of pictures, in pixels. `width` is the width of one picture.
    fn episode_width(self, width: usize) -> usize {
        self.pictures() * (width + PICTURE_GAP) - PICTURE_GAP
    }
}

/// An encoder that writes a PNG with evenly spaced frames of each episode, from the first frame to the last.
pub(super) struct SheetEncoder {
    path: PathBuf,
    grid: EpisodeGrid,
    /// Width and height of a frame, in pixels.
    frame: (usize, usize),
    /// Width and height of the sheet, in pixels.
    sheet: (usize, usize),
    pixels: Vec<u8>,
    /// Number of finished episodes.
    done: usize,
    /// Every `stride`-th frame of the current episode.
    kept: Vec<Vec<u8>>,
    stride: usize,
    /// Number of frames of the current episode so far.
    count: usize,
    /// The latest frame of the current episode.
    last: Vec<u8>,
}

impl SheetEncoder {
    pub(super) fn new(path: &Path, (width, height): (u32, u32), grid: EpisodeGrid) -> io::Result<Self> {
        let frame = (width as usize, height as usize);
        let width = (grid.episode_width(frame.0) + SET_GAP).saturating_mul(grid.sets).saturating_sub(SET_GAP);
        let sheet = (width, frame.1.saturating_mul(grid.episodes));
        let bytes = sheet.0.saturating_mul(sheet.1).saturating_mul(3);
        if bytes > MAX_BYTES {
            let max = MAX_BYTES >> 20;
            let megabytes = bytes >> 20;
            return Err(io::Error::other(format!(
                "a sheet of {} × {} pixels takes {megabytes} MiB, expected at most {max}: give fewer episodes or smaller pictures",
                sheet.0, sheet.1
            )));
        }
        let pixels = vec![u8::MAX; bytes];
        let kept = Vec::new();
        let last = Vec::new();
        Ok(Self { path: path.to_owned(), grid, frame, sheet, pixels, done: 0, kept, stride: 1, count: 0, last })
    }

    /// Copies a frame of the current episode to position `index` in the episode's row.
    fn copy_to_sheet(&mut self, frame: &[u8], index: usize) {
        let (width, height) = self.frame;
        let set = self.done / self.grid.episodes;
        let episode = self.done % self.grid.episodes;
        let x = set * (self.grid.episode_width(width) + SET_GAP) + index * (width + PICTURE_GAP);
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
            if self.kept.len() == MAX_FRAMES {
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
        let pictures = self.grid.pictures().min(self.count);
        let kept = std::mem::take(&mut self.kept);
        let last = std::mem::take(&mut self.last);
        for picture in 0..pictures {
            let frame = picture * (self.count - 1) / (pictures - 1).max(1);
            let nearest = (frame + self.stride / 2) / self.stride;
            let is_last = picture + 1 == pictures;
            self.copy_to_sheet(if is_last { &last } else { kept.get(nearest).unwrap_or(&last) }, picture);
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

    /// Draws a sheet of episodes with these numbers of steps, and reads it back. Each picture and each gap is 2 pixels
    /// wide. Returns the first byte of every picture and gap, for each row of pixels.
    fn sheet(grid: EpisodeGrid, lengths: &[usize]) -> Vec<Vec<u8>> {
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
        // The gap between pictures is as wide as a frame here.
        let row = |row: &[u8]| row.chunks(6).map(|frame| frame[0]).collect();
        pixels.chunks(3 * size.0 as usize).map(row).collect()
    }

    #[test]
    fn pictures_are_evenly_spaced_over_the_episode() {
        let one = |length| -> Vec<u8> {
            let row = sheet(EpisodeGrid { sets: 1, episodes: 1 }, &[length]).concat();
            assert!(row.iter().skip(1).step_by(2).all(|&gap| gap == 255), "{row:?}");
            row.into_iter().step_by(2).collect()
        };
        assert_eq!(
            one(100),
            [0, 20, 40, 60, 80, 99],
            "within a few frames: 19, 39, 59 and 79 lie between the frames in memory"
        );
        assert_eq!(one(6), [0, 16, 33, 50, 66, 83]);
        assert_eq!(one(3), [0, 33, 66, 255, 255, 255], "an episode of three frames");
        assert_eq!(one(1), [0, 255, 255, 255, 255, 255]);
        let long = one(10_000);
        assert!(long.iter().zip([0, 20, 40, 60, 80, 99]).all(|(a, b)| a.abs_diff(b) <= 2), "{long:?}");
    }

    #[test]
    fn sets_are_side_by_side_and_episodes_below() {
        let rows = sheet(EpisodeGrid { sets: 2, episodes: 2 }, &[3, 4, 5, 6]);
        let gap = [255; 4];
        assert_eq!(rows[0], [&[0, 255, 33, 255, 66][..], &gap, &[0, 255, 40, 255, 80]].concat());
        assert_eq!(rows[1], [&[0, 255, 25, 255, 75][..], &gap, &[0, 255, 33, 255, 83]].concat());
    }

    #[test]
    fn oversized_sheets_and_wrong_frames_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let error = SheetEncoder::new(&path, (2048, 2100), EpisodeGrid { sets: 3, episodes: 1000 }).err().unwrap();
        assert!(error.to_string().contains("expected at most 256: give fewer episodes"), "{error}");
        let mut encoder = SheetEncoder::new(&path, (2, 1), EpisodeGrid { sets: 1, episodes: 1 }).unwrap();
        assert!(encoder.write(&[0; 5], 0.0).unwrap_err().to_string().contains("5 bytes"));
        encoder.write(&[0; 6], 0.0).unwrap();
        encoder.end_episode();
        assert!(encoder.write(&[0; 6], 0.0).unwrap_err().to_string().contains("episode 2, expected"));
    }
}
