//! The two transports of a session: a gRPC stream to a server, or calls of the embedded server.

use std::str::FromStr;
use std::sync::Weak;

use perturb::server::embedded;
use perturb_protocol::{Address, ClientError, Connection, Stream, Timeouts, TypedRequest, connect, proto};
use pyo3::Borrowed;
use pyo3::prelude::*;

use crate::embedded::{EmbeddedStream, NativeServer};
use crate::failure::{self, INVALID, RequestFailure, failure};

/// The server that Python code passes to a session: an address as text, or the object of the embedded server.
pub enum NamedServer<'py> {
    /// The address of a server.
    Address(String),
    /// The embedded server.
    Embedded(PyRef<'py, NativeServer>),
}

impl<'a, 'py> FromPyObject<'a, 'py> for NamedServer<'py> {
    type Error = PyErr;

    fn extract(object: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        match object.cast::<NativeServer>() {
            Ok(server) => Ok(Self::Embedded(server.to_owned().borrow())),
            Err(_) => object.extract().map(Self::Address),
        }
    }
}

/// The server of a session.
#[derive(Clone)]
pub(super) enum SessionServer {
    Address(Address, Timeouts),
    /// The embedded server. The reference is weak, so it does not keep the server alive.
    Embedded(Weak<embedded::EmbeddedServer>),
}

impl SessionServer {
    /// Makes the server of a session from the argument that Python code passed.
    ///
    /// # Errors
    /// If the address is malformed.
    pub(super) fn new(named: &NamedServer<'_>, timeouts: Timeouts) -> PyResult<Self> {
        match named {
            NamedServer::Address(address) => {
                let address = Address::from_str(address).map_err(|error| failure(INVALID, 0, error.to_string()))?;
                Ok(Self::Address(address, timeouts))
            }
            NamedServer::Embedded(server) => Ok(Self::Embedded(server.handle())),
        }
    }

    /// Opens a session.
    pub(super) async fn open(self, request: proto::Open) -> Result<(Transport, proto::Opened), RequestFailure> {
        match self {
            Self::Address(address, timeouts) => {
                let connection = connect(&address, timeouts).await.map_err(failed)?;
                let (stream, opened) = Stream::open(&connection, request).await.map_err(failed)?;
                Ok((Transport::Stream { stream, connection }, opened))
            }
            Self::Embedded(server) => {
                let mut stream = EmbeddedStream::new(&server).map_err(RequestFailure::Ended)?;
                let mut opened = stream.ask(request).await?;
                opened.environment.iter_mut().for_each(perturb_protocol::escape_environment);
                Ok((Transport::Embedded(stream), opened))
            }
        }
    }
}

/// The transport of an open session's requests and replies. The field order ensures that a stream is dropped before its
/// connection.
#[allow(clippy::large_enum_variant)] // each session has only one transport
pub(super) enum Transport {
    Stream {
        stream: Stream,
        #[expect(dead_code, reason = "held")]
        connection: Connection,
    },
    Embedded(EmbeddedStream),
}

impl Transport {
    /// Whether the server runs in this process. Then there is no connection.
    pub(super) fn is_embedded(&self) -> bool {
        matches!(self, Self::Embedded(_))
    }

    /// Sends a request and receives its reply. `None` sends nothing, and receives the oldest reply to a step that
    /// [`send`](Self::send) sent.
    pub(super) async fn exchange<A: TypedRequest>(
        stream: &mut Stream,
        request: Option<A>,
    ) -> Result<A::Reply, RequestFailure> {
        match request {
            Some(request) => stream.ask(request).await.map_err(failed),
            None => stream.receive::<A>().await.map_err(failed),
        }
    }

    /// Sends a step without waiting for its reply. A later [`exchange`](Self::exchange) of `None` receives the reply.
    pub(super) async fn send(&mut self, step: proto::Step) -> Result<(), RequestFailure> {
        match self {
            Self::Stream { stream, .. } => stream.send_ahead(step).await.map_err(failed),
            Self::Embedded(stream) => {
                stream.send(step);
                Ok(())
            }
        }
    }
}

fn failed(error: ClientError) -> RequestFailure {
    let failure = failure::from_client(&error);
    match error {
        ClientError::Refused { .. } => RequestFailure::Refused(failure),
        _ => RequestFailure::Ended(failure),
    }
}
