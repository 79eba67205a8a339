//! TLS 1.3 for connections: the server's certificate, and the authorities that must have signed clients' certificates.

use crate::config::TlsFiles;
use std::{
    io,
    sync::{Arc, PoisonError, RwLock},
};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
};
use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        RootCertStore, ServerConfig,
        crypto::ring,
        pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
        server::WebPkiClientVerifier,
        version::TLS13,
    },
    server::TlsStream,
};

/// Builds the TLS settings. `contents` has the contents of the files, in the order of [`TlsFiles::paths`].
fn build_config(files: &TlsFiles, contents: &[Vec<u8>]) -> Result<ServerConfig, String> {
    let [cert, key, rest @ ..] = contents else { return Err("a certificate and a key are expected".into()) };
    let chain = certificates(&files.cert, cert)?;
    let key = PrivateKeyDer::from_pem_slice(key).map_err(|error| {
        format!("{}: {error}; expected a private key in PEM, without a passphrase", files.key.display())
    })?;
    let clients = match (&files.client_ca, rest) {
        (Some(path), [authorities, ..]) => {
            let wrong = |error: &dyn ToString| format!("{}: {}", path.display(), error.to_string());
            let mut roots = RootCertStore::empty();
            for certificate in certificates(path, authorities)? {
                roots.add(certificate).map_err(|error| wrong(&error))?;
            }
            let provider = Arc::new(ring::default_provider());
            let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider).build();
            verifier.map_err(|error| wrong(&error))?
        }
        _ => WebPkiClientVerifier::no_client_auth(),
    };
    let (cert, key_file) = (files.cert.display(), files.key.display());
    let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_protocol_versions(&[&TLS13])
        .map_err(|error| error.to_string())?
        .with_client_cert_verifier(clients)
        .with_single_cert(chain, key)
        .map_err(|error| format!("{cert} and {key_file} do not match: {error}"))?;
    config.alpn_protocols = vec![b"h2".to_vec()];
    Ok(config)
}

/// Parses the certificates of a PEM file. The file must have at least one certificate.
fn certificates(path: &std::path::Path, pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, String> {
    let all: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    let all = all.map_err(|error| format!("{}: {error}; expected certificates in PEM", path.display()))?;
    if all.is_empty() {
        return Err(format!("{} contains no certificate; expected at least one in PEM", path.display()));
    }
    Ok(all)
}

/// The TLS settings of new connections, which can be reloaded.
#[derive(Clone)]
pub struct Tls {
    files: Arc<TlsFiles>,
    config: Arc<RwLock<Arc<ServerConfig>>>,
}

impl Tls {
    /// Makes the settings from the contents of the files, in the order of [`TlsFiles::paths`].
    ///
    /// # Errors
    /// If a file is invalid: a text that names the file and the fault.
    pub fn new(files: TlsFiles, contents: &[Vec<u8>]) -> Result<Self, String> {
        let config = Arc::new(build_config(&files, contents)?);
        Ok(Self { files: Arc::new(files), config: Arc::new(RwLock::new(config)) })
    }

    /// Applies new contents of the files to later connections.
    ///
    /// # Errors
    /// If a file is invalid: a text that names the file and the fault. The settings are unchanged then.
    pub fn reload(&self, contents: &[Vec<u8>]) -> Result<(), String> {
        let config = Arc::new(build_config(&self.files, contents)?);
        *self.config.write().unwrap_or_else(PoisonError::into_inner) = config;
        Ok(())
    }

    /// Does the TLS handshake with a client. If the handshake fails, sends the TLS alert, and then reads until the
    /// client closes the connection. If the server closed the connection while data is unread, TCP would reset the
    /// connection, and the alert could be lost.
    ///
    /// # Errors
    /// If the TLS handshake fails.
    pub async fn accept(&self, connection: TcpStream) -> io::Result<TlsStream<TcpStream>> {
        let config = Arc::clone(&self.config.read().unwrap_or_else(PoisonError::into_inner));
        match TlsAcceptor::from(config).accept(connection).into_fallible().await {
            Ok(stream) => Ok(stream),
            Err((error, mut connection)) => {
                let _ = connection.shutdown().await; // fails if the client has disconnected
                let mut rest = [0; 1024];
                while connection.read(&mut rest).await.is_ok_and(|count| count > 0) {}
                Err(error)
            }
        }
    }
}
