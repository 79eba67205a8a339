//! Why nothing is served.

use std::io::ErrorKind;
use std::net::SocketAddr;
use std::path::PathBuf;

use perturb_study::files::FileError;

/// Why nothing is served.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum ServeError {
    /// There is nothing to show.
    #[error("{}", perturb_study::runs::no_folder(path))]
    NoFolder { path: PathBuf },
    /// It may not be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// The address cannot be had.
    #[error("cannot listen at {address}: {}", explained(source))]
    Address { address: SocketAddr, source: std::io::Error },
}

fn explained(error: &std::io::Error) -> String {
    match error.kind() {
        ErrorKind::AddrInUse => {
            "something listens there already; end it, or give another port, e.g. --address 127.0.0.1:0 for a free one"
                .into()
        }
        ErrorKind::AddrNotAvailable => "it is no address of this machine".into(),
        ErrorKind::PermissionDenied => "ports below 1024 are the administrator's; give another one".into(),
        _ => error.to_string(),
    }
}
