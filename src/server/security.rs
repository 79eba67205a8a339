//! Loads tokens, TLS settings and the ledger from the files that the configuration names.

use super::{
    audit::ledger::Ledger,
    auth::{
        Tokens,
        file_watcher::{self, FileWatcher, Reloader},
    },
    net::tls::Tls,
};
use crate::{
    config::{Config, TlsFiles},
    env::Catalogue,
};
use std::{io, path::PathBuf};

/// A server's tokens, TLS settings and ledger. The default has none of them.
#[derive(Default)]
pub struct Security {
    /// The tokens; every call over TCP must carry one of them, except health checks.
    pub tokens: Option<Tokens>,
    /// The TLS settings of TCP connections.
    pub tls: Option<Tls>,
    /// The ledger of all draws.
    pub ledger: Option<Ledger>,
    /// The watchers of the token and TLS files. Their threads reload the files when they change.
    watches: Vec<FileWatcher>,
}

impl Security {
    /// Loads the files that the configuration names, and watches the token and TLS files for changes. The token file
    /// may refer to the environments of `catalogue`.
    ///
    /// # Errors
    /// If a file cannot be read or is invalid, or a thread cannot be started. If a file is the cause, the message names
    /// it and says what was expected.
    pub fn load(config: &Config, catalogue: &Catalogue) -> io::Result<Self> {
        let mut security = Self::default();
        if let Some(path) = &config.tokens {
            security.tokens = Some(security.load_tokens(path.clone(), catalogue)?);
        }
        if let Some(files) = config.tls() {
            security.tls = Some(security.load_tls(files)?);
        }
        if let Some(path) = &config.ledger {
            let wrong = |error| io::Error::other(format!("the ledger {}: {error}; correct --ledger", path.display()));
            security.ledger = Some(Ledger::open(path).map_err(wrong)?);
        }
        Ok(security)
    }

    /// Returns a handle with which the token and TLS files can be reloaded immediately.
    pub fn reloader(&self) -> Reloader {
        Reloader::new(&self.watches)
    }

    fn load_tokens(&mut self, path: PathBuf, catalogue: &Catalogue) -> io::Result<Tokens> {
        let wrong = |reason: String| io::Error::other(format!("{reason}; correct --tokens"));
        let before = file_watcher::read(std::slice::from_ref(&path)).map_err(wrong)?;
        let tokens = Tokens::new(catalogue.clone());
        let reloaded = tokens.clone();
        let name = path.display().to_string();
        let reload = move |contents: &[Vec<u8>]| {
            let text = contents.first().map(|text| String::from_utf8_lossy(text)).unwrap_or_default();
            reloaded.reload(&text).map_err(|wrong| format!("{name}, {wrong}"))
        };
        reload(&before).map_err(wrong)?;
        if tokens.count() == 0 {
            tracing::warn!(
                "{} contains no token, so all calls over TCP except health checks are refused",
                path.display()
            );
        }
        self.watches.push(FileWatcher::start("tokens", vec![path], before, reload)?);
        Ok(tokens)
    }

    fn load_tls(&mut self, files: TlsFiles) -> io::Result<Tls> {
        let flags = "--tls-cert, --tls-key or --tls-client-ca";
        let wrong = |reason: String| io::Error::other(format!("{reason}; correct {flags}"));
        let paths = files.paths();
        let before = file_watcher::read(&paths).map_err(wrong)?;
        let tls = Tls::new(files, &before).map_err(wrong)?;
        let reloaded = tls.clone();
        let reload = move |contents: &[Vec<u8>]| reloaded.reload(contents);
        self.watches.push(FileWatcher::start("the TLS files", paths, before, reload)?);
        Ok(tls)
    }
}
