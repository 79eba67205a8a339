//! `perturb serve`: a read-only web page that shows trainings and experiments while they run.
//!
//! - [`Server`] listens. `connections` limits connections and `stream_places` event streams, `http` routes requests and
//!   keeps other sites out, `links` makes links relative.
//! - `paths` and `files` send files of the served folder.
//! - `publisher` reads the files of open pages and sends changes as server-sent events. `cached_loader` limits how
//!   often files are read, `runs` keeps the state of each run between two readings.
//! - `training`, `experiment`, `index` and `pictures` read runs. `tail` and `curve` follow a growing log, `eta`
//!   estimates the remaining time, `report` builds reports, `server_status` polls a server of environments.
//! - `pages` makes HTML of all this.
#![forbid(unsafe_code)]

mod assessment;
mod cached_loader;
mod connections;
mod curve;
mod error;
mod eta;
mod experiment;
mod files;
mod http;
mod index;
mod keyed_cache;
mod links;
mod pages;
mod paths;
mod pictures;
mod publisher;
mod report;
mod runs;
mod server_status;
mod stream_places;
mod tail;
mod training;

use std::convert::Infallible;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use tokio::net::TcpListener;

use connections::ConnectionLimits;
pub use error::ServeError;
use http::AppState;
use paths::Root;

/// Options of the server.
#[derive(Clone, Debug)]
pub struct ServeOptions {
    /// The folder with the runs.
    pub folder: PathBuf,
    /// Address to listen at; port 0 takes a free port.
    pub address: SocketAddr,
    /// Further host names by which a server on the loopback address is asked, of a proxy for instance.
    pub hosts: Vec<String>,
    /// A server of environments whose status is shown.
    pub server: Option<perturb_protocol::Address>,
}

/// A web server that listens.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    state: Arc<AppState>,
}

impl Server {
    /// Opens the folder and listens.
    ///
    /// # Errors
    /// [`ServeError`] if the folder cannot be read or the address cannot be used.
    pub async fn bind(options: &ServeOptions) -> Result<Self, ServeError> {
        let root = Root::open(&options.folder)?;
        let failed = |source| ServeError::Address { address: options.address, source };
        let listener = TcpListener::bind(options.address).await.map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let state = Arc::new(AppState::new(root, address, options.hosts.clone(), options.server.clone()));
        Ok(Self { listener, address, state })
    }

    /// Returns the address at which the server listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers requests. Never returns.
    pub async fn run(self) -> Infallible {
        let Self { listener, state, .. } = self;
        tokio::spawn(Arc::clone(&state.publisher).run());
        connections::serve(listener, http::router(state), ConnectionLimits::default()).await
    }
}
