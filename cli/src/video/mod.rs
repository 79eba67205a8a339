//! Videos of a policy that acts: `perturb video`.
//!
//! [`film`] plays the episodes and asks the server for a picture of every state; `panel` writes below it which episode
//! it is and how it goes; [`VideoFile`] is where the frames end up, through `gif` with its `palette`, `mp4` or, some of
//! them side by side, `sheet`.

mod encode;
mod file;
mod film;
mod gif;
mod mp4;
mod palette;
mod panel;
mod sheet;

use std::path::PathBuf;

pub use file::{Format, VideoFile, VideoWriter};
pub use film::{Footage, VideoOptions, film};
pub use panel::PIXELS;
pub use sheet::Grid;

use perturb_files::FileError;
use perturb_learner::evaluation::TestError;
use perturb_report::plot::PlotError;

/// Why there is no video.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum VideoError {
    /// The policy cannot act, or the server cannot draw.
    #[error(transparent)]
    Test(#[from] TestError),
    /// The file's name does not say what to write.
    #[error("`{}` is not a video: expected a name that ends in .mp4 or .gif, or in .png for a contact sheet", path.display())]
    Extension { path: PathBuf },
    /// The program that encodes .mp4 is missing, or cannot do it.
    #[error(
        "an .mp4 is encoded by the program ffmpeg with its encoder libx264, but {reason}: install it, on Debian with \
         `apt-get install ffmpeg`, or write a .gif, which needs nothing"
    )]
    NoFfmpeg {
        /// What happened when it was called.
        reason: String,
    },
    /// The operating system refused a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// A frame could not be encoded.
    #[error("cannot encode {}: {source}", path.display())]
    Encode {
        path: PathBuf,
        /// What the encoder says, or the operating system.
        source: std::io::Error,
    },
    /// The text below a picture could not be drawn.
    #[error(transparent)]
    Plot(#[from] PlotError),
}

impl From<perturb_learner::client::ClientError> for VideoError {
    fn from(error: perturb_learner::client::ClientError) -> Self {
        Self::Test(error.into())
    }
}
