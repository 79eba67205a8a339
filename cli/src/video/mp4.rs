//! Encodes frames as an MP4 with the program ffmpeg.

use std::fs::File;
use std::io::{self, Read, Seek, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use super::VideoError;
use super::encode::Encode;

const PROGRAM: &str = "ffmpeg";
/// The encoder's constant rate factor. A lower value gives better quality and a larger file. Text is readable at this
/// value.
const QUALITY: &str = "20";

/// Checks that ffmpeg is installed and has an encoder for H.264.
///
/// # Errors
/// [`VideoError::NoFfmpeg`].
pub(super) fn find_ffmpeg() -> Result<(), VideoError> {
    let answer = Command::new(PROGRAM)
        .args(["-hide_banner", "-loglevel", "error", "-h", "encoder=libx264"])
        .stdin(Stdio::null())
        .output()
        .map_err(|error| VideoError::NoFfmpeg { reason: format!("`{PROGRAM}` cannot be started: {error}") })?;
    if answer.stdout.starts_with(b"Encoder libx264") {
        return Ok(());
    }
    Err(VideoError::NoFfmpeg { reason: format!("this `{PROGRAM}` has none") })
}

/// An encoder that sends frames to an ffmpeg process. Dropping it ends the process.
pub(super) struct Mp4Encoder {
    child: Child,
    /// Standard error of ffmpeg. It is a file and not a pipe. A pipe would not be read while frames are written, so
    /// ffmpeg would block when the pipe is full.
    stderr_file: File,
    size: (u32, u32),
    fps: f64,
}

impl Mp4Encoder {
    pub(super) fn new(path: &Path, size: (u32, u32), fps: f64) -> io::Result<Self> {
        let stderr_file = tempfile::tempfile()?;
        let size_text = format!("{}x{}", size.0, size.1);
        let fps_text = fps.to_string();
        let child = Command::new(PROGRAM)
            .args(["-hide_banner", "-loglevel", "error", "-y"])
            .args(["-f", "rawvideo", "-pixel_format", "rgb24", "-video_size", &size_text, "-framerate", &fps_text])
            .args(["-i", "pipe:0"])
            // All players support this format. RGB is converted to the colours of HD video, which the file states.
            .args(["-c:v", "libx264", "-crf", QUALITY, "-pix_fmt", "yuv420p", "-vf", "scale=out_color_matrix=bt709"])
            .args(["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"])
            // The index comes first, so that browsers can start before they have the whole file.
            .args(["-movflags", "+faststart", "-f", "mp4"])
            .arg(path)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(stderr_file.try_clone()?)
            // In its own process group, ffmpeg does not receive Ctrl-C. This process receives it and ends ffmpeg.
            .process_group(0)
            .spawn()
            .map_err(|error| io::Error::other(format!("`{PROGRAM}` cannot be started: {error}")))?;
        Ok(Self { child, stderr_file, size, fps })
    }

    /// Waits for the end of ffmpeg, and returns an error with its exit status and messages.
    fn failure(&mut self) -> io::Error {
        drop(self.child.stdin.take());
        let status = self.child.wait().map_or_else(|error| error.to_string(), |status| status.to_string());
        let mut words = String::new();
        let read = self.stderr_file.rewind().and_then(|()| self.stderr_file.read_to_string(&mut words));
        io::Error::other(match (read, words.trim()) {
            (Ok(_), words) if !words.is_empty() => format!("{PROGRAM} ended with {status}: {words}"),
            _ => format!("{PROGRAM} ended with {status}"),
        })
    }
}

impl Encode for Mp4Encoder {
    fn size(&self) -> (u32, u32) {
        self.size
    }

    fn write(&mut self, frame: &[u8], seconds: f64) -> io::Result<()> {
        // A video has a fixed duration per frame, so a longer frame is repeated. Repeated frames take almost no space.
        for _ in 0..((seconds * self.fps).round() as u64).max(1) {
            let written = self.child.stdin.as_mut().map_or(Ok(()), |pipe| pipe.write_all(frame));
            if written.is_err() {
                return Err(self.failure());
            }
        }
        Ok(())
    }

    fn finish(mut self: Box<Self>) -> io::Result<u16> {
        drop(self.child.stdin.take());
        match self.child.wait() {
            Ok(status) if status.success() => Ok(1),
            _ => Err(self.failure()),
        }
    }
}

impl Drop for Mp4Encoder {
    fn drop(&mut self) {
        // Both calls fail only if ffmpeg has ended already.
        self.child.kill().ok();
        self.child.wait().ok();
    }
}
