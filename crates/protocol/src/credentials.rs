//! Credentials of a client: its token, its certificate, and the certificates that it trusts.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use perturb_system::read_plain;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject};
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::{Request, Status};

use crate::address::Address;

/// Environment variable with the path of the file that holds a client's bearer token.
pub const TOKEN_FILE: &str = "PERTURB_TOKEN_FILE";
/// Environment variable with the path of a PEM file of the authorities' certificates that the client trusts.
pub const CA: &str = "PERTURB_CA";
/// Environment variable with the path of a PEM file of a client's certificate chain.
pub const CERT: &str = "PERTURB_CERT";
/// Environment variable with the path of a PEM file of a client's private key.
pub const KEY: &str = "PERTURB_KEY";
/// Environment variable that, if set to 1, lets a client send its token unencrypted to other machines.
pub const INSECURE: &str = "PERTURB_INSECURE";
/// Paths of the PEM file of the authorities that an operating system trusts: on Debian and Alpine, on Red Hat, and on
/// SUSE.
const SYSTEM_CA: [&str; 3] =
    ["/etc/ssl/certs/ca-certificates.crt", "/etc/pki/tls/certs/ca-bundle.crt", "/etc/ssl/ca-bundle.pem"];

/// Maximal size of a file of certificates or of a key, in bytes. The file of an operating system's authorities has some
/// 250 kB.
const MAX_CERTIFICATES_BYTES: u64 = 16 << 20;
/// Maximal size of a file with a token, in bytes.
const MAX_TOKEN_FILE_BYTES: u64 = 64 << 10;

/// A function that returns the value of an environment variable, if it is set.
type Variable<'a> = &'a dyn Fn(&str) -> Option<OsString>;

/// The credentials of a client. The files are read again for each connection, so they may be replaced while a program
/// runs.
#[derive(Default)]
pub struct Credentials {
    /// The token, sent with every call.
    pub(crate) token: Option<BearerHeader>,
    /// The certificate and key that are presented to servers that request a client certificate.
    pub(crate) identity: Option<Identity>,
    pub(crate) trust: Trust,
}

/// A client's certificate chain, from its own certificate to its authority's, and its private key.
type Identity = (Vec<CertificateDer<'static>>, PrivateKeyDer<'static>);

/// The server certificates that a client trusts.
pub(crate) enum Trust {
    /// Certificates that are signed by one of these authorities.
    Authorities(Vec<CertificateDer<'static>>),
    /// Only the first of these certificates.
    Pinned(Vec<CertificateDer<'static>>),
}

impl Default for Trust {
    fn default() -> Self {
        Self::Authorities(Vec::new())
    }
}

impl Credentials {
    /// Reads the credentials for a server at this address. The process's environment variables name the files.
    ///
    /// # Errors
    /// The errors of [`Credentials::from_variables`].
    pub fn from_environment(address: &Address) -> Result<Self, String> {
        Self::from_variables(address, &environment)
    }

    /// Reads the credentials for a server at this address. `variable` looks up environment variables. A Unix socket
    /// needs no credentials.
    ///
    /// # Errors
    /// A message with the variable, the file and the reason, if a file cannot be read, if certificate and key are not
    /// both set, or if a token would be sent unencrypted to another machine.
    pub fn from_variables(address: &Address, variable: Variable<'_>) -> Result<Self, String> {
        let Address::Tcp { host, tls, .. } = address else { return Ok(Self::default()) };
        let file = |name| file(name, variable);
        let token = file(TOKEN_FILE).map(|path| token(&path)).transpose()?;
        if tls.is_none() {
            if token.is_some() && !is_here(host) && variable(INSECURE).is_none_or(|value| value != "1") {
                return Err(format!(
                    "the token of {TOKEN_FILE} would go there unencrypted; write {} if it speaks TLS, or set {INSECURE}=1",
                    address.with_tls()
                ));
            }
            return Ok(Self { token, ..Self::default() });
        }
        let trust = Trust::Authorities(match file(CA) {
            Some(path) => certificates(CA, &path)?,
            None => match SYSTEM_CA.iter().map(Path::new).find(|path| path.exists()) {
                Some(path) => certificates("the system's authorities", path)?,
                None => {
                    return Err(format!(
                        "this system trusts no authority; set {CA} to the certificate of the server's authority"
                    ));
                }
            },
        });
        Ok(Self { token, identity: identity(variable)?, trust })
    }

    /// Creates credentials that trust only one server certificate: the first in the PEM file `certificate`.
    ///
    /// # Errors
    /// A message if the file cannot be read or has no certificate, or if the client's certificate or key, which
    /// environment variables name, cannot be read.
    pub fn pinned(certificate: &Path) -> Result<Self, String> {
        let trust = Trust::Pinned(certificates("the server's certificate", certificate)?);
        Ok(Self { token: None, identity: identity(&environment)?, trust })
    }
}

fn environment(name: &str) -> Option<OsString> {
    std::env::var_os(name)
}

/// Returns the path in an environment variable; `None` if the variable is unset or empty.
fn file(name: &str, variable: Variable<'_>) -> Option<PathBuf> {
    variable(name).filter(|value| !value.is_empty()).map(PathBuf::from)
}

fn is_here(host: &str) -> bool {
    host == "localhost" || host.parse::<std::net::IpAddr>().is_ok_and(|ip| ip.to_canonical().is_loopback())
}

fn identity(variable: Variable<'_>) -> Result<Option<Identity>, String> {
    match (file(CERT, variable), file(KEY, variable)) {
        (None, None) => Ok(None),
        (Some(cert), Some(key)) => {
            let wrong = |reason: &dyn std::fmt::Display| {
                format!("{KEY}={}: {reason}; expected a private key in PEM", key.display())
            };
            let chain = certificates(CERT, &cert)?;
            let content = read_plain(&key, MAX_CERTIFICATES_BYTES).map_err(|error| wrong(&error))?;
            Ok(Some((chain, PrivateKeyDer::from_pem_slice(&content).map_err(|error| wrong(&error))?)))
        }
        (Some(_), None) => Err(format!("{CERT} is set, but {KEY} is not; set both or neither")),
        (None, Some(_)) => Err(format!("{KEY} is set, but {CERT} is not; set both or neither")),
    }
}

fn certificates(what: &str, path: &Path) -> Result<Vec<CertificateDer<'static>>, String> {
    let wrong =
        |reason: &dyn std::fmt::Display| format!("{what}={}: {reason}; expected certificates in PEM", path.display());
    let content = read_plain(path, MAX_CERTIFICATES_BYTES).map_err(|error| wrong(&error))?;
    let all = CertificateDer::pem_slice_iter(&content).collect::<Result<Vec<_>, _>>();
    let all = all.map_err(|error| wrong(&error))?;
    if all.is_empty() { Err(wrong(&"there is no certificate")) } else { Ok(all) }
}

fn token(path: &Path) -> Result<BearerHeader, String> {
    let wrong = |reason: &dyn std::fmt::Display| {
        format!("{TOKEN_FILE}={}: {reason}; expected one line with a token", path.display())
    };
    let content = read_plain(path, MAX_TOKEN_FILE_BYTES).map_err(|error| wrong(&error))?;
    let text = std::str::from_utf8(&content).map_err(|error| wrong(&error))?.trim();
    if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Err(wrong(&"there is none"));
    }
    let mut value: MetadataValue<Ascii> = format!("Bearer {text}").parse().map_err(|_| wrong(&"there is none"))?;
    value.set_sensitive(true);
    Ok(BearerHeader(value))
}

/// The value of the `authorization` header, with the token. It is marked as sensitive, which keeps it out of logs.
#[derive(Clone, Debug)]
pub(crate) struct BearerHeader(MetadataValue<Ascii>);

/// A gRPC interceptor that adds the token, if there is one, to each call.
#[derive(Clone, Debug, Default)]
pub struct WithToken(pub(crate) Option<BearerHeader>);

impl Interceptor for WithToken {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(BearerHeader(value)) = &self.0 {
            request.metadata_mut().insert("authorization", value.clone());
        }
        Ok(request)
    }
}
