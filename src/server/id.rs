//! Random names for leases and worlds. Clients cannot guess these names.

use super::error::{ErrorKind, RequestError};

/// A random name of 128 bits.
pub type Id = [u8; 16];

/// The operating system provides no random bits, so the server cannot make a name that nobody can guess.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "the operating system provides no random numbers; open without a lease, or name the world with the setting \
     world_name"
)]
pub struct NoRandomness;

impl RequestError for NoRandomness {
    fn kind(&self) -> ErrorKind {
        ErrorKind::NoRandomness
    }
}

/// Returns 128 random bits from the operating system. The bits do not depend on any seed.
///
/// # Errors
/// [`NoRandomness`], if the operating system has no random bits.
pub fn random() -> Result<Id, NoRandomness> {
    let mut bytes = Id::default();
    let got = rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty());
    if got.is_ok_and(|n| n == bytes.len()) { Ok(bytes) } else { Err(NoRandomness) }
}
