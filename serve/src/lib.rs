//! A page that shows trainings and experiments as they go: read-only, over HTTP.
//!
//! - [`Server`] listens. [`http`](self) answers: which requests there are, what keeps strangers out.
//! - `paths` and `files`: what of the folder is sent.
//! - `watch`: one task looks at the files for all who look at pages, and tells them by server-sent events; `paced` says how
//!   often anything is looked at, `shelf` keeps what is known of each run under a lock of its own.
//! - `training`, `experiment`, `index`: what is known of each, kept between looks; `tail` and `curve` follow a log that
//!   grows, `remaining` says how long an experiment may take, `report` makes its report, `load` asks a server.
//! - `pages`: all of it as HTML.
#![forbid(unsafe_code)]

mod connections;
mod curve;
mod error;
mod experiment;
mod files;
mod http;
mod index;
mod load;
mod paced;
mod pages;
mod paths;
mod remaining;
mod report;
mod shelf;
mod tail;
mod training;
mod watch;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use tokio::net::TcpListener;

pub use error::ServeError;
use http::Shared;
use paths::Root;

/// What is served, and where.
#[derive(Clone, Debug)]
pub struct Options {
    /// The folder that the runs are in.
    pub folder: PathBuf,
    /// Where to listen; port 0 takes a free one.
    pub address: SocketAddr,
    /// The server of environments whose load is shown.
    pub server: Option<perturb_protocol::Address>,
}

/// A server of pages that listens.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    shared: Arc<Shared>,
}

impl Server {
    /// Begins to listen.
    ///
    /// # Errors
    /// [`ServeError`], with what to do.
    pub async fn bind(options: &Options) -> Result<Self, ServeError> {
        let root = Root::open(&options.folder)?;
        let failed = |source| ServeError::Address { address: options.address, source };
        let listener = TcpListener::bind(options.address).await.map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let shared = Arc::new(Shared::new(root, address, options.server.clone()));
        Ok(Self { listener, address, shared })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers requests, for ever.
    ///
    /// # Errors
    /// The operating system's.
    pub async fn run(self) -> std::io::Result<()> {
        let Self { listener, shared, .. } = self;
        tokio::spawn(Arc::clone(&shared.watch).run());
        axum::serve(connections::Connections::of(listener), http::router(shared)).await
    }
}
