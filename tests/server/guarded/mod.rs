//! Servers that ask who comes: tokens, TLS, and what is refused without.

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

/// A connection of a client whose environment has these variables.
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

/// A session of some environments.
async fn begin(connection: &Connection, envs: u32) -> Result<Stream, ClientError> {
    within(Stream::open(connection, open("CartPole", envs, 1))).await.map(|(stream, _)| stream)
}

/// A step of `envs` environments.
async fn steps(stream: &mut Stream, envs: usize) -> Result<(), ClientError> {
    let step = perturb::proto::Step { actions: vec![0; 4 * envs].into() };
    within(stream.ask(step)).await.map(drop)
}

/// The sentence of what is no safe connection, which nobody waits for.
#[track_caller]
fn unsafe_words<T>(result: Result<T, ClientError>) -> String {
    let error = result.err().expect("it is refused");
    assert!(matches!(error, ClientError::Unsafe { .. }), "{error:?}");
    assert!(!error.is_absence() && !error.can_be_retried());
    error.to_string()
}

/// The sentence of a refusal for want of a good token, which nobody waits for.
#[track_caller]
fn unauthenticated<T>(result: Result<T, ClientError>) -> String {
    let error = result.err().expect("it is refused");
    assert!(matches!(error, ClientError::Refused { code: Code::Unauthenticated, .. }), "{error:?}");
    assert!(!error.is_absence() && !error.can_be_retried());
    error.to_string()
}

/// Waits until the server has logged something.
async fn logged(server: &Server, part: &str) {
    let start = Instant::now();
    while !server.log().contains(part) {
        assert!(start.elapsed() < DEADLINE, "no {part:?} in the log:\n{}", server.log());
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
}
