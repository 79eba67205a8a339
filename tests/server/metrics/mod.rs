//! Monitoring of the server: metrics, health when it is full, the access log.

mod counts;
mod endpoint;
mod health;
mod lag;
mod log;
mod page;

use crate::common::server::{Server, until};
pub use page::Page;
use std::path::PathBuf;
use tempfile::TempDir;

/// A server with a metrics page on a Unix socket.
pub struct Watched {
    pub server: Server,
    socket: PathBuf,
    _directory: TempDir,
}

impl Watched {
    pub fn start(flags: &[&str]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let socket = directory.path().join("metrics");
        let metrics = format!("unix:{}", socket.display());
        Self { server: Server::start(&[&["--metrics", &metrics], flags].concat()), socket, _directory: directory }
    }

    pub fn page(&self) -> Page {
        Page::scrape(&self.socket)
    }

    /// Waits until a series of the metrics has this value.
    pub async fn until(&self, series: &str, number: f64) {
        let what = format!("{series} is {number}");
        until(&what, async || self.page().number(series) == number).await;
    }
}
