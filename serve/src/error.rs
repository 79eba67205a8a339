//! Errors of the web server and of its pages.

use std::io::ErrorKind;
use std::net::SocketAddr;
use std::path::PathBuf;

use perturb_files::FileError;

use crate::cached_loader::CachedLoadError;

/// The reason why the web server cannot start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages explain the fields")]
pub enum ServeError {
    /// The folder does not exist.
    #[error("{}", perturb_experiment::runs::no_folder(path))]
    NoFolder { path: PathBuf },
    /// The folder cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// The address cannot be used.
    #[error("cannot listen at {address}: {}", explained(source))]
    Address { address: SocketAddr, source: std::io::Error },
}

fn explained(error: &std::io::Error) -> String {
    match error.kind() {
        ErrorKind::AddrInUse => {
            "another program already listens there; stop it, or give another port, for example --address 127.0.0.1:0"
                .into()
        }
        ErrorKind::AddrNotAvailable => "it is not an address of this machine".into(),
        ErrorKind::PermissionDenied => "ports below 1024 need administrator rights; give another port".into(),
        _ => error.to_string(),
    }
}

/// The reason why a page cannot be shown.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum ViewError {
    /// The address does not name the folder of a run.
    RunNotFound,
    /// The served folder cannot be listed. The text has the reason.
    Unlisted(String),
    /// Loading the page has panicked or takes too long.
    Load(CachedLoadError),
}
