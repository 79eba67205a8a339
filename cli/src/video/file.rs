//! The file of a video. It gets its name only when it is complete.

use std::path::{Path, PathBuf};

use perturb_files::{replace, require_writable, temporary_beside};
use tempfile::NamedTempFile;

use super::VideoError;
use super::encode::Encode;
use super::gif::{self, GifEncoder};
use super::mp4::{self, Mp4Encoder};
use super::sheet::{EpisodeGrid, SheetEncoder};

/// Format of a video.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `.gif`: 256 colours, at most 2 MB. Needs no other program.
    Gif,
    /// `.mp4`: H.264, encoded by the program ffmpeg.
    Mp4,
    /// `.png`: a contact sheet with some frames of each episode. Needs no other program.
    Png,
}

impl Format {
    /// Returns the format for the extension of `path`. The extension may be in upper or lower case.
    ///
    /// # Errors
    /// [`VideoError::Extension`].
    pub fn from_path(path: &Path) -> Result<Self, VideoError> {
        let ending = path.extension().map(|ending| ending.to_ascii_lowercase());
        match ending.as_ref().and_then(|ending| ending.to_str()) {
            Some("gif") => Ok(Self::Gif),
            Some("mp4") => Ok(Self::Mp4),
            Some("png") => Ok(Self::Png),
            _ => Err(VideoError::Extension { path: path.to_owned() }),
        }
    }
}

/// The file of a video before encoding begins. The video is written to a hidden temporary file in the same folder. The
/// temporary file is deleted if the video is not completed.
#[derive(Debug)]
pub struct VideoFile {
    path: PathBuf,
    format: Format,
    temporary: NamedTempFile,
}

impl VideoFile {
    /// Checks that `path` can be written, and creates the temporary file. [`VideoWriter::finish`] replaces an existing
    /// video.
    ///
    /// # Errors
    /// [`VideoError::Extension`], [`VideoError::NoFfmpeg`] and [`VideoError::File`].
    pub fn create(path: &Path) -> Result<Self, VideoError> {
        let format = Format::from_path(path)?;
        require_writable(path)?;
        if format == Format::Mp4 {
            mp4::find_ffmpeg()?;
        }
        let temporary = temporary_beside(path, ".perturb-video-")?;
        Ok(Self { path: path.to_owned(), format, temporary })
    }

    /// Returns the time for which a frame is shown at `fps` frames per second, in seconds. A GIF rounds it to
    /// hundredths, and shows a frame for at least 0.02 s.
    pub fn frame_seconds(&self, fps: f64) -> f64 {
        match self.format {
            Format::Gif => f64::from(gif::delay(1.0 / fps)) / 100.0,
            Format::Mp4 | Format::Png => 1.0 / fps,
        }
    }

    /// Begins to encode frames of `size`: width and height in pixels, both even. Each frame is shown for at least the
    /// time that [`VideoFile::frame_seconds`] returns for `fps`. `grid` has the numbers of sets and episodes that a
    /// contact sheet will show.
    ///
    /// # Errors
    /// [`VideoError::Encode`].
    pub fn begin(self, size: (u32, u32), fps: f64, grid: EpisodeGrid) -> Result<VideoWriter, VideoError> {
        let path = self.temporary.path();
        let failed = encoding(&self.path);
        let encoder: Box<dyn Encode> = match self.format {
            Format::Gif => Box::new(GifEncoder::new(path, size, fps).map_err(failed)?),
            Format::Mp4 => Box::new(Mp4Encoder::new(path, size, fps).map_err(failed)?),
            Format::Png => Box::new(SheetEncoder::new(path, size, grid).map_err(failed)?),
        };
        Ok(VideoWriter { encoder, file: self })
    }
}

/// A video that is being encoded.
pub struct VideoWriter {
    // Fields are dropped in this order. The encoder must be dropped before the file that it writes to.
    encoder: Box<dyn Encode>,
    file: VideoFile,
}

impl VideoWriter {
    /// Returns the width and height of the video, in pixels.
    pub fn size(&self) -> (u32, u32) {
        self.encoder.size()
    }

    /// Adds a frame `[height, width, 3]` that is shown for about `seconds`, and at least for one frame's time.
    ///
    /// # Errors
    /// [`VideoError::Encode`].
    pub fn write(&mut self, frame: &[u8], seconds: f64) -> Result<(), VideoError> {
        self.encoder.write(frame, seconds).map_err(encoding(&self.file.path))
    }

    /// Marks the end of an episode, which consists of the frames since the last call.
    pub fn end_episode(&mut self) {
        self.encoder.end_episode();
    }

    /// Completes the video and moves it to its path. Returns n if it is a film that shows only every n-th frame, and
    /// otherwise 1.
    ///
    /// # Errors
    /// [`VideoError::Encode`] and [`VideoError::File`]. After an error, an existing video is unchanged.
    pub fn finish(self) -> Result<u16, VideoError> {
        let VideoFile { path, temporary, .. } = self.file;
        let shown_every = self.encoder.finish().map_err(encoding(&path))?;
        replace(temporary, &path)?;
        Ok(shown_every)
    }
}

/// Adds the video's path to an encoder's error.
fn encoding(path: &Path) -> impl FnOnce(std::io::Error) -> VideoError {
    |source| VideoError::Encode { path: path.to_owned(), source }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn the_extension_selects_the_format() {
        for (name, format) in
            [("a.gif", Format::Gif), ("a/b.c.mp4", Format::Mp4), ("A.GIF", Format::Gif), ("a.png", Format::Png)]
        {
            assert_eq!(Format::from_path(Path::new(name)).unwrap(), format, "{name}");
        }
        for name in ["a", "a.avi", ".gif", "gif", "a.mp4.txt"] {
            assert!(Format::from_path(Path::new(name)).unwrap_err().to_string().contains(".mp4 or .gif"), "{name}");
        }
    }

    #[test]
    fn a_video_that_is_not_finished_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/a.gif");
        assert!(VideoFile::create(&path).unwrap_err().to_string().contains("mkdir -p"), "no folder is made");
        fs::create_dir(folder.path().join("new")).unwrap();
        let frame = [7; 2 * 2 * 3];
        let names = || fs::read_dir(folder.path().join("new")).unwrap().count();

        let mut writer =
            VideoFile::create(&path).unwrap().begin((2, 2), 10.0, EpisodeGrid { sets: 1, episodes: 1 }).unwrap();
        writer.write(&frame, 0.1).unwrap();
        assert_eq!((names(), path.exists()), (1, false), "a hidden file");
        drop(writer);
        assert_eq!(names(), 0);

        fs::write(&path, "the one before").unwrap();
        let mut writer =
            VideoFile::create(&path).unwrap().begin((2, 2), 10.0, EpisodeGrid { sets: 1, episodes: 1 }).unwrap();
        writer.write(&frame, 0.1).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"the one before");
        writer.finish().unwrap();
        assert_eq!((names(), &fs::read(&path).unwrap()[..6]), (1, &b"GIF89a"[..]));
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        fs::write(folder.path().join("other"), "").unwrap();
        assert_eq!(mode(&path), mode(&folder.path().join("other")), "readable by whoever reads other files");
    }

    #[test]
    fn unwritable_paths_are_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("file"), "").unwrap();
        fs::create_dir(folder.path().join("folder.gif")).unwrap();
        for (name, part) in [("file/a.gif", "file"), ("folder.gif", "it is a folder"), ("a.avi", "a.avi")] {
            let error = VideoFile::create(&folder.path().join(name)).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
