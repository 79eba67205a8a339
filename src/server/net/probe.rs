//! Checks the health of a running server. Container engines run the server program with the option `--health` for this.

use crate::config::ListenAddress;
use perturb_protocol::{Address, AddressError, ClientError, Connection, Timeouts, credentials::Credentials};
use std::{
    io,
    net::{Ipv4Addr, Ipv6Addr},
    path::{self, Path},
    time::Duration,
};

/// The maximum time for the server's answer.
const PROBE_TIMEOUT: Duration = Duration::from_secs(3);

/// Why the health check of a server failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Clients cannot use the address of the listener, e.g. because its port is 0.
    #[error(transparent)]
    Address(#[from] AddressError),
    /// The path of the Unix socket is relative, and the working directory no longer exists.
    #[error("the socket's path is relative, and the working directory cannot be found: {0}")]
    Directory(#[from] io::Error),
    /// The server did not answer or does not accept sessions, or the certificate cannot be read.
    #[error("the health check of the server at {address} failed: {reason}")]
    NoAnswer {
        /// The address.
        address: Address,
        /// The cause.
        reason: String,
    },
}

/// Checks that the server that listens at `listen` accepts sessions. If `listen` is the address of all interfaces,
/// connects over the loopback interface. If `certificate` is given, uses TLS for TCP addresses, and requires the server
/// to show exactly this certificate. The certificate may be for any host name.
///
/// # Errors
/// [`Error`], if the check fails; after at most 3 s.
pub async fn probe(listen: &ListenAddress, certificate: Option<&Path>) -> Result<(), Error> {
    let mut address = reachable(listen)?;
    let mut credentials = Credentials::default();
    if let (Address::Tcp { host, tls, .. }, Some(certificate)) = (&mut address, certificate) {
        *tls = Some(host.clone());
        credentials = match Credentials::pinned(certificate) {
            Ok(credentials) => credentials,
            Err(reason) => return Err(Error::NoAnswer { address, reason }),
        };
    }
    let connecting = Connection::open_as(&address, Timeouts::default(), credentials);
    let reason = match tokio::time::timeout(PROBE_TIMEOUT, connecting).await {
        Ok(Ok(_)) => return Ok(()),
        Ok(Err(ClientError::Connect { reason, .. } | ClientError::Unsafe { reason, .. })) => reason,
        Ok(Err(error)) => error.to_string(),
        Err(_) => format!("it took more than {} s", PROBE_TIMEOUT.as_secs()),
    };
    Err(Error::NoAnswer { address, reason })
}

/// Returns an address at which clients on this machine reach a server that listens at `listen`.
fn reachable(listen: &ListenAddress) -> Result<Address, Error> {
    match *listen {
        ListenAddress::Unix(ref path) => Ok(Address::Unix(path::absolute(path)?)),
        ListenAddress::Tcp(mut tcp) => {
            if tcp.ip().is_unspecified() {
                tcp.set_ip(if tcp.is_ipv4() { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() });
            }
            Ok(tcp.to_string().parse()?)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_on_all_interfaces_is_reached_over_loopback() {
        for (listen, expected) in [
            ("tcp://0.0.0.0:7", "http://127.0.0.1:7"),
            ("tcp://[::]:7", "http://[::1]:7"),
            ("tcp://10.0.0.1:7", "http://10.0.0.1:7"),
            ("unix:/a", "unix:/a"),
        ] {
            let listen = ListenAddress::try_from(listen.to_owned()).unwrap();
            assert_eq!(reachable(&listen).unwrap().to_string(), expected);
        }
        let any = ListenAddress::try_from("tcp://0.0.0.0:0".to_owned()).unwrap();
        assert!(reachable(&any).unwrap_err().to_string().contains("the real one"));
    }
}
