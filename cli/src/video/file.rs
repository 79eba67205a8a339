//! The file of a video, which appears whole or not at all.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use perturb_files::{io, require_writable};
use tempfile::NamedTempFile;

use super::VideoError;
use super::encode::Encode;
use super::gif::{self, GifEncoder};
use super::mp4::{self, Mp4Encoder};
use super::sheet::{Grid, SheetEncoder};

/// How a video is encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `.gif`: 256 colours, at most 2 MB, and needs nothing.
    Gif,
    /// `.mp4`: H.264, by the program ffmpeg.
    Mp4,
    /// `.png`: a contact sheet, with some frames of each episode; needs nothing.
    Png,
}

impl Format {
    /// The format that the ending of `path` stands for, in upper or lower case.
    ///
    /// # Errors
    /// [`VideoError::Extension`].
    pub fn of(path: &Path) -> Result<Self, VideoError> {
        let ending = path.extension().map(|ending| ending.to_ascii_lowercase());
        match ending.as_ref().and_then(|ending| ending.to_str()) {
            Some("gif") => Ok(Self::Gif),
            Some("mp4") => Ok(Self::Mp4),
            Some("png") => Ok(Self::Png),
            _ => Err(VideoError::Extension { path: path.to_owned() }),
        }
    }
}

/// A video that is to be written: a hidden file in the same folder until it is whole, deleted if it never is.
#[derive(Debug)]
pub struct VideoFile {
    path: PathBuf,
    format: Format,
    temporary: NamedTempFile,
}

impl VideoFile {
    /// Makes sure that `path` can be written before anything is played. A video that is there is
    /// replaced at the end.
    ///
    /// # Errors
    /// [`VideoError::Extension`], [`VideoError::NoFfmpeg`] and [`VideoError::File`].
    pub fn create(path: &Path) -> Result<Self, VideoError> {
        let format = Format::of(path)?;
        require_writable(path)?;
        if format == Format::Mp4 {
            mp4::find_ffmpeg()?;
        }
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let temporary = tempfile::Builder::new()
            .prefix(".perturb-video-")
            .permissions(fs::Permissions::from_mode(0o666)) // as any file; the umask takes its part
            .tempfile_in(folder)
            .map_err(io("write to", folder))?;
        Ok(Self { path: path.to_owned(), format, temporary })
    }

    /// How long a frame is shown of which there should be `fps` in a second, s.
    pub fn frame_seconds(&self, fps: f64) -> f64 {
        match self.format {
            Format::Gif => f64::from(gif::delay(1.0 / fps)) / 100.0,
            Format::Mp4 | Format::Png => 1.0 / fps,
        }
    }

    /// Begins to encode frames of `size`, width and height in pixels, both even. One is shown for 1 / `fps` seconds, or for
    /// a whole multiple of it; in a GIF for whole hundredths of a second. A contact sheet has a place for each episode of
    /// `grid`.
    ///
    /// # Errors
    /// [`VideoError::Encode`].
    pub fn begin(self, size: (u32, u32), fps: f64, grid: Grid) -> Result<VideoWriter, VideoError> {
        let (path, failed) = (self.temporary.path(), encoding(&self.path));
        let encoder: Box<dyn Encode> = match self.format {
            Format::Gif => Box::new(GifEncoder::new(path, size, fps).map_err(failed)?),
            Format::Mp4 => Box::new(Mp4Encoder::new(path, size, fps).map_err(failed)?),
            Format::Png => Box::new(SheetEncoder::new(path, size, grid).map_err(failed)?),
        };
        Ok(VideoWriter { encoder, file: self })
    }
}

/// A video that is being written.
pub struct VideoWriter {
    // Dropped in this order: the encoder before the file that it writes to.
    encoder: Box<dyn Encode>,
    file: VideoFile,
}

impl VideoWriter {
    /// Of the video, width and height in pixels.
    pub fn size(&self) -> (u32, u32) {
        self.encoder.size()
    }

    /// Adds a frame `[height, width, 3]` that is shown for about so many `seconds`, but at least as long as any.
    ///
    /// # Errors
    /// [`VideoError::Encode`].
    pub fn write(&mut self, frame: &[u8], seconds: f64) -> Result<(), VideoError> {
        self.encoder.write(frame, seconds).map_err(encoding(&self.file.path))
    }

    /// The frames since the last call are an episode.
    pub fn end_episode(&mut self) {
        self.encoder.end_episode();
    }

    /// Completes the video and puts it into its place. Returns of how many frames it shows one: 1 if it shows all.
    ///
    /// # Errors
    /// [`VideoError::Encode`] and [`VideoError::File`]; a video that was there before is then still there.
    pub fn finish(self) -> Result<u16, VideoError> {
        let VideoFile { path, temporary, .. } = self.file;
        let shown_every = self.encoder.finish().map_err(encoding(&path))?;
        temporary.persist(&path).map_err(|error| io("rename a file to", &path)(error.error))?;
        Ok(shown_every)
    }
}

/// Names the video in an encoder's error.
fn encoding(path: &Path) -> impl FnOnce(std::io::Error) -> VideoError {
    |source| VideoError::Encode { path: path.to_owned(), source }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ending_says_the_format() {
        for (name, format) in
            [("a.gif", Format::Gif), ("a/b.c.mp4", Format::Mp4), ("A.GIF", Format::Gif), ("a.png", Format::Png)]
        {
            assert_eq!(Format::of(Path::new(name)).unwrap(), format, "{name}");
        }
        for name in ["a", "a.avi", ".gif", "gif", "a.mp4.txt"] {
            assert!(Format::of(Path::new(name)).unwrap_err().to_string().contains(".mp4 or .gif"), "{name}");
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

        let mut writer = VideoFile::create(&path).unwrap().begin((2, 2), 10.0, Grid { sets: 1, episodes: 1 }).unwrap();
        writer.write(&frame, 0.1).unwrap();
        assert_eq!((names(), path.exists()), (1, false), "a hidden file");
        drop(writer);
        assert_eq!(names(), 0);

        fs::write(&path, "the one before").unwrap();
        let mut writer = VideoFile::create(&path).unwrap().begin((2, 2), 10.0, Grid { sets: 1, episodes: 1 }).unwrap();
        writer.write(&frame, 0.1).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"the one before");
        writer.finish().unwrap();
        assert_eq!((names(), &fs::read(&path).unwrap()[..6]), (1, &b"GIF89a"[..]));
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        fs::write(folder.path().join("other"), "").unwrap();
        assert_eq!(mode(&path), mode(&folder.path().join("other")), "readable by whoever reads other files");
    }

    #[test]
    fn what_cannot_be_written_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("file"), "").unwrap();
        fs::create_dir(folder.path().join("folder.gif")).unwrap();
        for (name, part) in [("file/a.gif", "file"), ("folder.gif", "it is a folder"), ("a.avi", "a.avi")] {
            let error = VideoFile::create(&folder.path().join(name)).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
