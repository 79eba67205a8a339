//! Addresses of servers, as users write them.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;

use crate::limits::MAX_SOCKET_PATH_BYTES;

/// The address of a server.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum Address {
    /// A Unix socket, written `unix:/path`. A relative path is relative to the working directory.
    Unix(PathBuf),
    /// A TCP port, written `host:port`, `http://host:port` or `tcp://host:port`, or with TLS `https://host:port`. An
    /// IPv6 address is written in brackets.
    Tcp {
        /// A host name or an IP address, without brackets.
        host: Box<str>,
        /// The port, at least 1.
        port: u16,
        /// With TLS, the name that the server's certificate must have; without TLS, `None`. If `host` is an IP address
        /// that was resolved from a name, this is still that name.
        tls: Option<Box<str>>,
    },
}

/// The error for a text that is not the address of a server.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}` is not a server's address: {reason}; write `unix:/path`, `host:port`, `http://host:port` or \
     `tcp://host:port`, with TLS `https://host:port`"
)]
pub struct AddressError {
    /// The text that is not an address.
    pub text: String,
    /// The reason why the text is not an address.
    pub reason: String,
}

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        parse(text).map_err(|reason| AddressError { text: text.to_owned(), reason })
    }
}

impl Address {
    /// The text of this address, with `https://` instead of `http://`.
    pub(crate) fn with_tls(&self) -> String {
        let text = self.to_string();
        text.strip_prefix("http://").map_or_else(|| text.clone(), |rest| format!("https://{rest}"))
    }

    /// Returns a command line that starts a server at this address, as a hint for users. It names the security options
    /// that such a server needs.
    pub fn start_command(&self) -> String {
        let (host, port, tls) = match self {
            Self::Unix(path) => return format!("perturb-server --listen unix:{}", path.display()),
            Self::Tcp { host, port, tls } => (host, port, tls.is_some()),
        };
        let ip = match &**host {
            "localhost" => IpAddr::from(Ipv4Addr::LOCALHOST),
            name => name.parse().unwrap_or(Ipv4Addr::UNSPECIFIED.into()),
        };
        let security = match (tls, ip.is_loopback()) {
            (true, true) => " --tls-cert FILE --tls-key FILE",
            (true, false) => " --tls-cert FILE --tls-key FILE --tokens FILE",
            (false, true) => "",
            (false, false) => " --insecure",
        };
        format!("perturb-server --listen tcp://{}{security}", SocketAddr::new(ip, *port))
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (host, port, tls) = match self {
            Self::Unix(path) => return write!(f, "unix:{}", path.display()),
            Self::Tcp { host, port, tls } => (host, port, tls),
        };
        let scheme = if tls.is_some() { "https" } else { "http" };
        if host.contains(':') { write!(f, "{scheme}://[{host}]:{port}") } else { write!(f, "{scheme}://{host}:{port}") }
    }
}

fn parse(text: &str) -> Result<Address, String> {
    if text.is_empty() {
        return Err("it is empty".into());
    }
    if let Some(path) = text.strip_prefix("unix:") {
        return parse_unix(path);
    }
    let (rest, tls) = match text.strip_prefix("https://") {
        Some(rest) => (rest, true),
        None => (text.strip_prefix("http://").or_else(|| text.strip_prefix("tcp://")).unwrap_or(text), false),
    };
    if let Some((scheme, _)) = rest.split_once("://") {
        return Err(format!("the scheme `{scheme}` is unknown"));
    }
    parse_tcp(rest.strip_suffix('/').unwrap_or(rest), tls)
}

fn parse_unix(path: &str) -> Result<Address, String> {
    let path = match path.strip_prefix("//") {
        Some(path) if path.starts_with('/') => path,
        Some(_) => return Err("the path after unix:// must be absolute".into()),
        None => path,
    };
    if path.is_empty() {
        return Err("the path of the socket is missing".into());
    }
    let path = std::path::absolute(path).map_err(|error| format!("the path of the socket is relative ({error})"))?;
    let path = path.to_str().ok_or("the path of the working folder is not UTF-8")?;
    if path.len() > MAX_SOCKET_PATH_BYTES {
        return Err(format!(
            "the path of the socket has {} bytes, the most that Linux allows is {MAX_SOCKET_PATH_BYTES}",
            path.len()
        ));
    }
    Ok(Address::Unix(path.into()))
}

fn parse_tcp(text: &str, tls: bool) -> Result<Address, String> {
    let Some((host, port)) = text.rsplit_once(':') else {
        return Err("the port is missing".into());
    };
    let port = match port.parse::<u16>() {
        Ok(0) => return Err("port 0 means any free port, the real one is needed".into()),
        Ok(number) if port.starts_with(|c: char| c.is_ascii_digit()) => number,
        _ => return Err(format!("`{port}` is not a port (1 to 65535)")),
    };
    let host = match host.strip_prefix('[').and_then(|inner| inner.strip_suffix(']')) {
        Some(inner) if inner.parse::<std::net::Ipv6Addr>().is_ok() => inner,
        Some(inner) => return Err(format!("`{inner}` is not an IPv6 address")),
        None if host.contains(':') => return Err("an IPv6 address must stand in brackets".into()),
        None => host,
    };
    let plausible = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_' | ':');
    if host.is_empty() {
        return Err("the host is missing".into());
    }
    if !host.chars().all(plausible) {
        return Err(format!("`{host}` is not a host name"));
    }
    Ok(Address::Tcp { host: host.into(), port, tls: tls.then(|| host.into()) })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The tests of the Python package read the same table of accepted and refused addresses, because Python has a
    /// separate parser.
    #[test]
    fn addresses_are_understood_as_in_python() {
        let table: serde_json::Value = serde_json::from_str(include_str!("../tests/addresses.json")).unwrap();
        for (text, target) in table["understood"].as_object().unwrap() {
            let address: Address = text.parse().unwrap();
            assert_eq!(address.to_string().trim_start_matches("http://"), target, "{text}");
        }
        for text in table["refused"].as_array().unwrap() {
            let text = text.as_str().unwrap();
            assert!(text.parse::<Address>().is_err(), "{text} is understood");
        }
    }

    #[test]
    fn an_address_reads_back_from_its_text() {
        for text in ["unix:/a/b", "127.0.0.1:1", "[::1]:80", "tcp://host:65535", "https://[::1]:80"] {
            let address: Address = text.parse().unwrap();
            assert_eq!(address.to_string().parse(), Ok(address));
        }
    }

    #[test]
    fn relative_path_of_a_socket_becomes_absolute() {
        let expected = std::env::current_dir().unwrap().join("a/my.sock");
        assert_eq!("unix:a/my.sock".parse(), Ok(Address::Unix(expected)));
    }

    #[test]
    fn start_command_has_an_address_to_listen_at() {
        for (text, expected) in [
            ("unix:/a/b", "unix:/a/b"),
            ("10.0.0.2:7", "tcp://10.0.0.2:7 --insecure"),
            ("http://localhost:7", "tcp://127.0.0.1:7"),
            ("[::1]:7", "tcp://[::1]:7"),
            ("node-3:7", "tcp://0.0.0.0:7 --insecure"),
            ("https://localhost:7", "tcp://127.0.0.1:7 --tls-cert FILE --tls-key FILE"),
            ("https://node-3:7", "tcp://0.0.0.0:7 --tls-cert FILE --tls-key FILE --tokens FILE"),
        ] {
            let command = text.parse::<Address>().unwrap().start_command();
            assert_eq!(command, format!("perturb-server --listen {expected}"));
        }
    }

    #[test]
    fn a_wrong_address_says_what_is_wrong() {
        for (text, part) in [
            ("", "empty"),
            ("unix://relative", "absolute"),
            ("unix:", "missing"),
            ("https://host", "port is missing"),
            ("ftp://host:1", "scheme `ftp`"),
            ("localhost", "port is missing"),
            ("host:99999", "`99999` is not a port"),
            ("host:0", "port 0"),
            (":80", "host is missing"),
            ("::1:80", "brackets"),
            ("[nonsense]:80", "not an IPv6"),
            ("two words:80", "not a host name"),
        ] {
            let error = text.parse::<Address>().unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
        let long = format!("unix:/{}", "x".repeat(200));
        assert!(long.parse::<Address>().unwrap_err().to_string().contains("201 bytes"));
    }
}
