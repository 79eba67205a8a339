//! `perturb serve`: a read-only web page that shows trainings and experiments while they run.
//!
//! - [`Server`] listens. `connections` limits the number of connections, and `stream_places` the number of event
//!   streams. `http` routes requests and refuses embedding by other sites, and `links` makes links relative.
//! - `paths` checks the paths in addresses, and `files` sends files of the served folder.
//! - `publisher` reads the files of open pages and sends changes as server-sent events. `cached_loader` limits how
//!   often files are read, and `runs` keeps the state of each run between two readings.
//! - `training`, `experiment`, `assessment`, `index` and `pictures` read runs. `tail` and `curve` follow a growing log,
//!   `eta` estimates the remaining time, `report` builds reports, and `server_status` polls a perturb-server.
//! - `pages` makes HTML from the runs' states.
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

/// Options of the web server.
#[derive(Clone, Debug)]
pub struct ServeOptions {
    /// The folder with the runs.
    pub folder: PathBuf,
    /// Address to listen at. Port 0 takes a free port.
    pub address: SocketAddr,
    /// Host names that requests may state in addition to localhost, e.g. the name of a reverse proxy. They matter only
    /// if the server listens on the loopback address.
    pub hosts: Vec<String>,
    /// A perturb-server (a server that simulates environments) whose status the list of all runs shows.
    pub server: Option<perturb_protocol::Address>,
}

/// A web server that listens at its address.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    state: Arc<AppState>,
}

impl Server {
    /// Opens the folder, and begins to listen at the address.
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
