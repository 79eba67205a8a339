//! Asking a running server for its health, as container engines do by starting the server's own program.

use crate::config::Address;
use std::{
    net::{Ipv4Addr, Ipv6Addr},
    time::Duration,
};
use tonic::transport::Endpoint;
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};

/// How long a server may take to answer.
const LIMIT: Duration = Duration::from_secs(3);

/// Why a server does not take sessions.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The address does not say which port was taken.
    #[error("the server at {address} listens at a port that nobody knows before; give --listen with the real one")]
    UnknownPort {
        /// Where it was told to listen.
        address: Address,
    },
    /// Nobody answers, or not as a server does.
    #[error("no server answers at {address}: {reason}")]
    NoAnswer {
        /// Where.
        address: Address,
        /// The transport's words.
        reason: String,
    },
    /// It says so.
    #[error("the server at {address} answers {}", status.as_str_name())]
    NotServing {
        /// Where.
        address: Address,
        /// Its word.
        status: ServingStatus,
    },
}

/// Asks the server that listens at `listen` whether it takes sessions. One that listens everywhere is asked through the
/// loopback interface.
///
/// # Errors
/// [`Error`], after at most 3 s.
pub async fn probe(listen: &Address) -> Result<(), Error> {
    let address = reachable(listen)?;
    let fail = |reason: String| Error::NoAnswer { address: address.clone(), reason };
    // "transport error" says less than its cause.
    let words = |error: tonic::transport::Error| {
        fail(std::error::Error::source(&error).map_or_else(|| error.to_string(), ToString::to_string))
    };
    let ask = async {
        let channel = Endpoint::from_shared(address.to_string()).map_err(words)?.connect().await.map_err(words)?;
        let reply = HealthClient::new(channel).check(HealthCheckRequest { service: String::new() }).await;
        match reply.map_err(|status| fail(status.to_string()))?.into_inner().status() {
            ServingStatus::Serving => Ok(()),
            status => Err(Error::NotServing { address: address.clone(), status }),
        }
    };
    let late = || fail(format!("it took more than {} s", LIMIT.as_secs()));
    tokio::time::timeout(LIMIT, ask).await.map_err(|_| late())?
}

/// Where a server can be reached that listens at `listen`.
fn reachable(listen: &Address) -> Result<Address, Error> {
    let &Address::Tcp(mut tcp) = listen else { return Ok(listen.clone()) };
    if tcp.port() == 0 {
        return Err(Error::UnknownPort { address: listen.clone() });
    }
    if tcp.ip().is_unspecified() {
        tcp.set_ip(if tcp.is_ipv4() { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() });
    }
    Ok(Address::Tcp(tcp))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_that_listens_everywhere_is_reached_at_home() {
        for (listen, expected) in [
            ("tcp://0.0.0.0:7", "http://127.0.0.1:7"),
            ("tcp://[::]:7", "http://[::1]:7"),
            ("tcp://10.0.0.1:7", "http://10.0.0.1:7"),
            ("unix:/a", "unix:/a"),
        ] {
            let listen = Address::try_from(listen.to_owned()).unwrap();
            assert_eq!(reachable(&listen).unwrap().to_string(), expected);
        }
        let any = Address::try_from("tcp://0.0.0.0:0".to_owned()).unwrap();
        assert!(reachable(&any).unwrap_err().to_string().contains("the real one"));
    }
}
