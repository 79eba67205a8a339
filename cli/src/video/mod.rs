//! Videos of a policy: `perturb video`.
//!
//! [`film`] plays the episodes and requests a picture of each shown state. `caption` adds the episode's numbers below
//! each picture. [`VideoFile`] writes the frames with one of the encoders `gif` (with its `palette`), `mp4` and
//! `sheet`.

mod caption;
mod encode;
mod file;
mod film;
mod gif;
mod mp4;
mod palette;
mod sheet;

use std::path::PathBuf;

pub use caption::PIXELS;
pub use file::{Format, VideoFile, VideoWriter};
pub use film::{Footage, VideoOptions, film};
pub use sheet::EpisodeGrid;

use perturb_files::FileError;
use perturb_learner::evaluation::TestError;
use perturb_report::plot::PlotError;

/// The reason why a video cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum VideoError {
    /// The policy cannot act, the server cannot draw, a server was lost, or a signal ended the filming.
    #[error(transparent)]
    Test(#[from] TestError),
    /// The file's name has no known extension.
    #[error("`{}` is not a video: expected a name that ends in .mp4 or .gif, or in .png for a contact sheet", path.display())]
    Extension { path: PathBuf },
    /// The program ffmpeg is missing or cannot encode .mp4.
    #[error(
        "an .mp4 is encoded by the program ffmpeg with its encoder libx264, but {reason}: install it, on Debian with \
         `apt-get install ffmpeg`, or write a .gif, which needs no other program"
    )]
    NoFfmpeg {
        /// Why ffmpeg cannot be used.
        reason: String,
    },
    /// The operating system refused to create or write a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// A frame could not be encoded.
    #[error("cannot encode {}: {source}", path.display())]
    Encode {
        path: PathBuf,
        /// Message of the encoder or the operating system.
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
