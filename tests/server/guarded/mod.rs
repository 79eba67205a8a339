//! Servers with tokens, TLS, roles and a ledger.

mod encryption;
mod ledger;
mod quotas;
mod roles;
mod settings;
mod tokens;

pub use tokens::entry;

use crate::common::server::{DEADLINE, Server, open, within};
use perturb_protocol::{Address, ClientError, Connection, Stream, Timeouts, credentials::Credentials};
use std::{ffi::OsString, path::Path, time::Instant};
use tonic::Code;

/// Connects a client that has these environment variables.
async fn connect(address: &str, variables: &[(&str, &Path)]) -> Result<Connection, ClientError> {
    let address: Address = address.parse().unwrap();
    let variable = |name: &str| {
        let found = variables.iter().find(|(its, _)| *its == name);
        found.map(|(_, value)| OsString::from(value))
    };
    match Credentials::from_variables(&address, &variable) {
        Ok(credentials) => within(Connection::open_as(&address, Timeouts::default(), credentials)).await,
        Err(reason) => Err(ClientError::Unsafe { address, reason }),
    }
}

/// Opens a session with `envs` environments.
async fn begin(connection: &Connection, envs: u32) -> Result<Stream, ClientError> {
    within(Stream::open(connection, open("CartPole", envs, 1))).await.map(|(stream, _)| stream)
}

/// Takes steps with `envs` environments.
async fn steps(stream: &mut Stream, envs: usize) -> Result<(), ClientError> {
    let step = perturb::proto::Step { actions: vec![0; 4 * envs].into() };
    within(stream.ask(step)).await.map(drop)
}

/// Returns the message of an error for an unsafe connection, which clients do not retry.
#[track_caller]
fn unsafe_words<T>(result: Result<T, ClientError>) -> String {
    let error = result.err().expect("it is refused");
    assert!(matches!(error, ClientError::Unsafe { .. }), "{error:?}");
    assert!(!error.is_absence() && !error.can_be_retried());
    error.to_string()
}

/// Returns the message of an error for a missing or wrong token, which clients do not retry.
#[track_caller]
fn unauthenticated<T>(result: Result<T, ClientError>) -> String {
    let error = result.err().expect("it is refused");
    assert!(matches!(error, ClientError::Refused { code: Code::Unauthenticated, .. }), "{error:?}");
    assert!(!error.is_absence() && !error.can_be_retried());
    error.to_string()
}

/// Waits until the server's log contains `part`.
async fn logged(server: &Server, part: &str) {
    let start = Instant::now();
    while !server.log().contains(part) {
        assert!(start.elapsed() < DEADLINE, "no {part:?} in the log:\n{}", server.log());
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
}
